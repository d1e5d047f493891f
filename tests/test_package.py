"""The top level of the package: one table, and everything else that has to agree with it."""

import ast
import subprocess
import sys
import types
from pathlib import Path

import pytest

import pyro_dynogp as dgp


def imported_for_type_checkers():
    """Name -> module of the imports under TYPE_CHECKING, each written `name as name`."""
    tree = ast.parse(Path(dgp.__file__).read_text())
    (block,) = (n for n in tree.body if isinstance(n, ast.If))
    names = [(node.module, alias) for node in block.body for alias in node.names]
    assert all(alias.asname == alias.name for _, alias in names)
    return {alias.name: module for module, alias in names}


@pytest.mark.parametrize("name", dgp.__all__)
def test_every_public_name_is_there_and_documented(name):
    assert getattr(dgp, name).__doc__
    assert name in dir(dgp)


def test_one_table():
    functions = {name: f"pyro_dynogp.{home}" for name, home in dgp.HOMES.items()}
    modules = {name: f"pyro_dynogp.{home}".rpartition(".")[0] for name, home in dgp.MODULES.items()}
    assert imported_for_type_checkers() == functions | modules
    assert dgp.__all__ == sorted([*dgp.HOMES, *dgp.MODULES])
    assert dir(dgp) == sorted([*dgp.__all__, "__version__"])


def test_the_table_says_where_a_name_is_defined():
    for name, home in dgp.HOMES.items():
        assert getattr(dgp, name).__module__ == f"pyro_dynogp.{home}", name


def test_about_forty_names():
    assert len(dgp.HOMES) <= 56
    assert not {*dgp.MOVED} & {*dgp.__all__}


def test_unknown_names():
    with pytest.raises(AttributeError, match="no attribute 'Fitt'"):
        dgp.Fitt  # noqa: B018


@pytest.mark.parametrize("name", dgp.MOVED)
def test_a_name_that_has_moved_says_where_to(name):
    module, _, attribute = dgp.MOVED[name].rpartition(".")
    with pytest.raises(AttributeError, match=f"it is now pyro_dynogp.{module}.{attribute}"):
        getattr(dgp, name)
    home = __import__(f"pyro_dynogp.{module}", fromlist=[attribute])
    assert getattr(home, attribute).__doc__


def test_a_function_stays_where_a_module_has_its_name():
    """`import pyro_dynogp.fit` binds the module to the package."""
    function = dgp.fit
    dgp.fit = types.ModuleType("pyro_dynogp.fit")
    assert dgp.fit is function
    dgp.another = 1  # everything else may be set
    assert vars(dgp).pop("another") == 1


def test_importing_the_package_imports_nothing_heavy():
    code = "import sys, pyro_dynogp; print(sorted({'torch', 'pyro', 'pandas'} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_the_version_is_that_of_the_distribution():
    text = (Path(dgp.__file__).parents[1] / "pyproject.toml").read_text()
    assert f'\nversion = "{dgp.__version__}"\n' in text
