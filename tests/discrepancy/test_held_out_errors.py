"""One-step errors where a model was half-known: what the noise is tested by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.discrepancy import held_out_errors
from pyro_dynogp.discrepancy.held_out_errors import one_step_errors
from pyro_dynogp.discrepancy.residuals import residuals_of
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.statistics.settings import LoopSettings

N, FITTED = 600, 400
HELD_OUT = np.arange(N) >= FITTED


def valve(disturbance: float = 0.0) -> dgp.Record:
    """A flow that grows with the opening by a power; held-out openings go beyond those before."""
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(-1.0, 1.0, N // 10), 10)
    u[HELD_OUT] *= 1.8
    flow = np.exp(1.2 * u)
    y = lfilter([0.0, 0.2], [1.0, -0.8], flow)
    sd = 0.02 * y.std()
    slow = lfilter([1.0], [1.0, -0.8], rng.standard_normal(N))
    y = y + sd * (rng.standard_normal(N) + disturbance * slow)
    return dgp.Record(0.5 * np.arange(N), u[:, None], y[:, None])


def fitted(record: dgp.Record) -> dgp.Fit:
    model = dgp.Hammerstein(1, pairs=1, process_noise=False)
    return dgp.fit(model, record[:FITTED], method="map", workers=1, progress=False)


@pytest.fixture(scope="module")
def plain() -> tuple[dgp.Record, dgp.Fit]:
    record = valve()
    return record, fitted(record)


def p_values(record: dgp.Record, fit: dgp.Fit) -> dict[str, float]:
    settings = LoopSettings()
    found = residuals_of(fit, record, held_out=HELD_OUT, settings=settings)
    tests = (effects.ProcessNoise(), effects.HeteroscedasticNoise(), effects.HeavyTails())
    return {e.name: min(x.p_value for x in e.detect(found, settings)) for e in tests}


def test_errors_held_out_are_those_of_a_fit_that_knows_them(plain) -> None:
    """A fit to all data is the oracle; the step from the mode of some is linear."""
    record, fit = plain
    before = fit.innovations(record)[:, 0]
    known = refit(fit, record).innovations(record)[:, 0]
    errors = one_step_errors(fit, record, HELD_OUT)[:, 0]
    np.testing.assert_array_equal(errors[:FITTED], before[:FITTED])
    assert before[HELD_OUT].std() > 3.0
    assert 0.8 < errors[HELD_OUT].std() < 1.2
    assert np.corrcoef(before[HELD_OUT], known[HELD_OUT])[0, 1] < 0.5
    assert np.corrcoef(errors[HELD_OUT], known[HELD_OUT])[0, 1] > 0.95


def test_what_a_function_did_not_know_is_no_noise(plain, monkeypatch: pytest.MonkeyPatch) -> None:
    record, fit = plain
    assert min(p_values(record, fit).values()) > 0.01
    monkeypatch.setattr(held_out_errors, "has_innovations", lambda model: False)
    assert min(p_values(record, fit).values()) < 1e-6


def stirred(disturbance: float = 0.0) -> dgp.Record:
    """A linear plant with a second input that hardly moves before the data held out."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.standard_normal((N // 10, 2)), 10, axis=0)
    u[~HELD_OUT, 1] *= 0.01
    y = lfilter([0.0, 0.2], [1.0, -0.8], u[:, 0] + u[:, 1])
    sd = 0.05 * y.std()
    slow = lfilter([1.0], [1.0, -0.8], rng.standard_normal(N))
    y = y + sd * (rng.standard_normal(N) + disturbance * slow)
    return dgp.Record(0.5 * np.arange(N), u, y[:, None])


@pytest.mark.parametrize("process_noise", [False, True])
def test_gains_that_were_half_known_are_no_noise(
    monkeypatch: pytest.MonkeyPatch, process_noise: bool
) -> None:
    """Of a linear model too; a fit to all data is the oracle."""
    record = stirred()
    model = dgp.LinearDynamicGP(2, pairs=1, process_noise=process_noise)
    fit = dgp.fit(model, record[:FITTED], method="map", workers=1, progress=False)
    known = refit(fit, record).innovations(record)[HELD_OUT, 0]
    before = fit.innovations(record)[HELD_OUT, 0]
    errors = one_step_errors(fit, record, HELD_OUT)[HELD_OUT, 0]
    assert before.std() > 3.0
    assert np.corrcoef(before, known)[0, 1] < 0.5
    assert 0.8 < errors.std() < 1.2
    assert np.corrcoef(errors, known)[0, 1] > 0.95
    assert min(p_values(record, fit).values()) > 0.01
    monkeypatch.setattr(held_out_errors, "has_innovations", lambda model: False)
    assert min(p_values(record, fit).values()) < 1e-6


def test_noise_that_is_there_is_found() -> None:
    record = valve(disturbance=0.8)
    assert p_values(record, fitted(record))["process noise"] < 1e-4
    record = stirred(disturbance=0.8)
    model = dgp.LinearDynamicGP(2, pairs=1, process_noise=False)
    fit = dgp.fit(model, record[:FITTED], method="map", workers=1, progress=False)
    assert p_values(record, fit)["process noise"] < 1e-4


@pytest.mark.parametrize(
    "model",
    [
        dgp.LinearDynamicGP(1, pairs=1, likelihood=dgp.StudentT()),
        dgp.Hammerstein(1, pairs=1, process_noise=False, likelihood=dgp.StudentT()),
    ],
)
def test_other_errors_stay_as_they_are(plain, model: dgp.Model) -> None:
    record, _ = plain
    quick = {"method": "map", "restarts": 1, "steps": 5, "workers": 1, "progress": False}
    fit = dgp.fit(model, record[:FITTED], **quick)
    errors = one_step_errors(fit, record, HELD_OUT)
    np.testing.assert_array_equal(errors, fit.innovations(record))


def test_where_nothing_was_fitted_nothing_is_learnt(plain) -> None:
    record, fit = plain
    errors = one_step_errors(fit, record[FITTED:], np.ones(N - FITTED, dtype=bool))
    np.testing.assert_array_equal(errors, fit.innovations(record[FITTED:]))


def test_missing_outputs_and_dead_times_keep_their_places(plain) -> None:
    """Errors are missing where outputs are; those that are left hardly change."""
    record, fit = plain
    outputs = record.outputs.copy()
    gaps = [5, 399, 400, 470]
    outputs[gaps] = np.nan
    some = one_step_errors(fit, record.with_outputs(outputs), HELD_OUT)[:, 0]
    assert np.flatnonzero(np.isnan(some)).tolist() == gaps
    whole = one_step_errors(fit, record, HELD_OUT)[:, 0]
    there = HELD_OUT & ~np.isnan(some)
    assert np.corrcoef(some[there], whole[there])[0, 1] > 0.99
    late = replace(fit.model, scaling=None, channels=(dgp.Delayed("u", 2.0),))
    lagging = refit(fit, record[:FITTED], model=late)
    errors = one_step_errors(lagging, record, HELD_OUT)[:, 0]
    np.testing.assert_array_equal(errors[:FITTED], lagging.innovations(record)[:FITTED, 0])
    assert errors[HELD_OUT].std() < lagging.innovations(record)[HELD_OUT, 0].std()
