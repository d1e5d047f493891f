"""Every public name has an example in its docstring, and every example of the package runs."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import pyro_dynogp as dgp

# What an example may use without importing it.
NAMES = {"np": np, "pyro": pyro, "dist": dist, "torch": torch, "dgp": dgp}


def modules() -> list[str]:
    """All modules of the package, by name."""
    return [m.name for m in pkgutil.walk_packages(dgp.__path__, "pyro_dynogp.")
            if not m.name.endswith("__main__")]  # fmt: skip


def examples() -> list[doctest.DocTest]:
    """All docstrings of the package with examples in them."""
    finder = doctest.DocTestFinder(exclude_empty=True)
    found = [
        test
        for name in modules()
        for test in finder.find(importlib.import_module(name), name, extraglobs=NAMES)
        if test.examples
    ]
    return sorted(found, key=lambda test: test.name)


@pytest.mark.parametrize("test", examples(), ids=lambda test: test.name)
def test_example_runs(test):
    pyro.set_rng_seed(0)
    lines: list[str] = []
    with pyro.get_param_store().scope():
        result = doctest.DocTestRunner(verbose=False).run(test, out=lines.append)
    assert not result.failed, "".join(lines)


@pytest.mark.parametrize("name", dgp.__all__)
def test_every_public_name_has_an_example(name):
    assert ">>> " in (getattr(dgp, name).__doc__ or ""), name
