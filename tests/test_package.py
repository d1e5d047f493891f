"""The top level of the package."""

import subprocess
import sys

import pytest

import pyro_dynogp as dgp


@pytest.mark.parametrize("name", dgp.__all__)
def test_every_public_name_is_there_and_documented(name):
    assert getattr(dgp, name).__doc__
    assert name in dir(dgp)


def test_unknown_names():
    with pytest.raises(AttributeError, match="no attribute 'Fitt'"):
        dgp.Fitt  # noqa: B018


def test_importing_the_package_imports_nothing_heavy():
    code = "import sys, pyro_dynogp; print(sorted({'torch', 'pyro', 'pandas'} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
