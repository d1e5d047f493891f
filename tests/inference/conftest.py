"""Fitted cascades that several files share."""

from __future__ import annotations

import pytest

import pyro_dynogp as dgp
from tests.inference.cascades import FAST, wiener, wiener_record

# With trajectories as sites: SVI is kept every 50 steps, which makes two pieces.
LAYERED = {**FAST, "guide": "gauss-markov", "steps": 75}
COLLAPSED = {**FAST, "steps": 24}
TRAINED = {**COLLAPSED, "hyperparameters": "multivariate normal"}


@pytest.fixture(scope="session")
def bent():
    return wiener_record()


@pytest.fixture(scope="session")
def collapsed_fit(bent):
    """By the collapsed guide: inducing values and first states normal, all else at its optimum."""
    return dgp.fit(wiener(), bent, **COLLAPSED)


@pytest.fixture(scope="session")
def trained_fit(bent):
    """One normal for all sites, of which SVI has something to mend."""
    return dgp.fit(wiener(), bent, **TRAINED)


@pytest.fixture(scope="session")
def layered_fit(bent):
    """With the trajectory as a site, Gauss-Markov."""
    return dgp.fit(wiener(), bent, **LAYERED)
