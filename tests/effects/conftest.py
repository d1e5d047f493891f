"""Fewer replicates, for many series."""

import pytest

from pyro_dynogp.statistics import bootstrap as sieve


@pytest.fixture
def few(monkeypatch):
    """Fewer replicates, for many series."""
    monkeypatch.setattr(sieve, "REPLICATES", 19)
    monkeypatch.setattr(sieve, "FEWEST", 19)
