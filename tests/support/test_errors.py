"""Of which line warnings are."""

import pytest

from pyro_dynogp.inference.density import denormals_flushed
from pyro_dynogp.support.errors import POSITIVE_OR_ZERO, warn


def module(name, code, **names):
    """Names of a module that runs some code."""
    space = {"__name__": name, **names}
    exec(compile(code, f"{name}.py", "exec"), space)
    return space


def test_warnings_are_of_the_line_that_called_through_other_libraries():
    inner = module("pyro_dynogp.inner", "def work(): warn('careful')", warn=warn)
    library = module("library", "def run(call): call()")
    outer = module(
        "pyro_dynogp.outer", "def fit(): run(work)", run=library["run"], work=inner["work"]
    )
    with pytest.warns(UserWarning, match="careful") as caught:
        outer["fit"]()
    assert [one.filename for one in caught] == [__file__]


def test_zero_is_no_negative_number_where_small_numbers_are_flushed():
    with denormals_flushed():
        assert POSITIVE_OR_ZERO.plain(0.0) == 0.0
        assert POSITIVE_OR_ZERO.plain(-1e-300) is None
        assert POSITIVE_OR_ZERO.plain(float("inf")) is None
