"""Which of several effects that explain as much of the held-out data is added."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.discrepancy import decision
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.test_decision import helping, spoken_for

RECORD = SimpleNamespace(missing=np.zeros((100, 1), dtype=bool))
SHORT = SimpleNamespace(missing=np.zeros((99, 1), dtype=bool))


def one(gain, evidence, numbers, record=RECORD):
    """A judged effect by its held-out gain, evidence of training data, and count of parameters."""
    fit = SimpleNamespace(mode={"x": torch.zeros(numbers)}, records=(record,), evidence=evidence)
    return SimpleNamespace(attempt=SimpleNamespace(gain=gain), tried=SimpleNamespace(fit=fit))


@pytest.fixture
def known(monkeypatch):
    monkeypatch.setattr(
        decision, "log_bayes_factor", lambda one, other: one.evidence - other.evidence
    )


STIFF = one(10.0, 0.0, 3)
UNFITTED = one(12.0, 30.0, 8)
UNFITTED.tried.fit = None


@pytest.mark.parametrize(
    ("other", "left"),
    [
        (one(10.0, 5.1, 8), [1]),
        (one(10.0, 4.9, 8), [0, 1]),  # less than very strong evidence
        (one(20.0, 4.9, 8), [0, 1]),  # what it gains of held-out data does not add to it
        (one(6.0, 9.1, 8), [1]),  # what it loses of them is taken off
        (one(6.0, 8.9, 8), [0, 1]),
        (one(10.0, 30.0, 3), [0, 1]),  # no stiffer than the other
        (one(10.0, 30.0, 2), [0, 1]),
        (one(10.0, 30.0, 8, SHORT), [0, 1]),  # fitted to other data
        (UNFITTED, [0, 1]),
    ],
)
def test_what_training_data_find_too_stiff_is_no_tie(known, other, left):
    assert decision._needed([0, 1], [STIFF, other]) == left
    assert decision._needed([1, 0], [other, STIFF]) == [1 - k for k in left]


def test_only_ties_count(known):
    best = one(12.0, 30.0, 8)
    assert decision._needed([0], [STIFF, best]) == [0]
    assert decision._needed([0, 2], [STIFF, best, one(11.0, 1.0, 3)]) == [0, 2]


@pytest.mark.parametrize(("q", "name"), [(0.06, "periodic disturbance"), (0.04, "drift")])
def test_what_the_residual_is_certain_of_comes_before_what_leaves_less_open(q, name):
    """A hum lets tests of a drift nearly reject, and a drift takes up some of it."""
    drift = helping(effects.Drift(), 0.2 * q, q)
    hum = helping(effects.PeriodicDisturbance(), 1e-9, 1e-8, gain=52.0)
    hum = replace(hum, tried=replace(hum.tried, model=dgp.LinearDynamicGP(1, pairs=2)))
    assert drift.found.effect.freedom < hum.found.effect.freedom
    for both in ([drift, hum], [hum, drift]):
        assert both[decision._chosen(both, both, [0, 1], 0.05)].found.effect.name == name


def test_a_wind_that_acts_by_its_square_is_no_dead_zone():
    """Both forecast a short block as well, and a dead zone is stiffer."""
    rng = np.random.default_rng(4)
    n = 700
    u, wind = (np.repeat(rng.standard_normal(n // held + 1), held)[:n] for held in (11, 7))
    y, x = np.zeros(n), 0.0
    for k in range(n):
        y[k] = x
        x += (u[k] + 1.2 * wind[k] * abs(wind[k]) - x) / 6.0
    y += 0.02 * y.std() * rng.standard_normal(n)
    record = dgp.Record(np.arange(n), np.column_stack([u, wind]), y, input_names=("u", "wind"))
    fit = dgp.fit(dgp.LinearDynamicGP(2, pairs=1), record[:500], method="map", workers=1,
                  progress=False)  # fmt: skip
    plain = replace(fit.model, scaling=None)
    zone = spoken_for(effects.DeadZoneOfInput(), 1e-9, 1e-8, channel="wind", low=-0.8, high=0.8)
    curve = spoken_for(effects.InputNonlinearity(), 1e-9, 1e-8, channel="wind")
    tasks = [(found, tuple(found.effect.extend(plain, found.evidence, record)))
             for found in (zone, curve)]  # fmt: skip
    done = decision.confirm(
        tasks, fit, record[:600], np.arange(600) >= 500, number=1, seed=0, level=0.05,
        settings=SETTINGS, workers=1,
    )  # fmt: skip
    assert done.winner is curve
    assert done.ties == ()
