"""Fits of dead times: where the truth is known, whatever part of a step it has."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

import pyro_dynogp as dgp
from pyro_dynogp.discrepancy.parameters import parameters_of
from pyro_dynogp.effects.dead_time import _later
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.optimise.innovation_energy import Innovations
from pyro_dynogp.inference.starts.delays import delayed_starts, likely_delays, moved
from pyro_dynogp.models.delays import longest_delay

FINER, N, BEFORE = 50, 200, 300
QUICK = {"workers": 1, "progress": False}
MODEL = dgp.LinearDynamicGP(1, pairs=1, channels=(dgp.Delayed("u"),))


def made(
    seed: int, delay: float, noise: float, at: np.ndarray | None = None, n: int = N
) -> dgp.Record:
    """A second-order plant and an input held for five samples on average, long before the record.

    Args:
        seed: of both. delay: [samples]. noise: in sds of the output. at: instants in fine steps.
    """
    rng = np.random.default_rng(seed)
    rate, damping = np.exp(rng.uniform(np.log(0.08), np.log(0.6))), rng.uniform(0.3, 0.95)
    count = n + BEFORE
    at = np.arange(count) * FINER if at is None else at
    held = np.maximum.accumulate(np.where(rng.random(count) < 0.2, np.arange(count), 0))
    u = rng.normal(size=count)[held]
    every = np.arange(at[-1] + 1)
    late = u[np.maximum(np.searchsorted(at, every - round(delay * FINER), side="right") - 1, 0)]
    M = np.zeros((3, 3))
    M[:2, :2], M[1, 2] = [[0.0, 1.0], [-(rate**2), -2.0 * damping * rate]], rate**2
    E = expm(M / FINER)
    x, y = np.zeros(2), np.empty(len(every))
    for k, v in enumerate(late):
        y[k] = x[0]
        x = E[:2, :2] @ x + E[:2, 2] * v
    y = y[at][BEFORE:]
    y = y + noise * y.std() * rng.normal(size=n)
    time = (at[BEFORE:] - at[BEFORE]) / FINER
    return dgp.Record(time, u[BEFORE:], y, input_names=("u",), time_unit="s")


@pytest.fixture(scope="module")
def fitted() -> tuple[dgp.Record, dgp.Fit]:
    record = made(6, 2.4, 0.02)
    return record, dgp.fit(MODEL, record[:150], **QUICK)


@pytest.mark.parametrize("delay", [2.0, 2.4, 2.5, 7.9])
def test_the_dead_time_is_found_at_any_part_of_a_step(delay):
    """And does not stick at whole steps, where the density has kinks."""
    for seed in (6, 17):
        drawn = dgp.fit(MODEL, made(seed, delay, 0.02), **QUICK).draws["delay"][:, 0].numpy()
        low, high = np.quantile(drawn, [0.005, 0.995])
        assert low < delay < high
        assert drawn.std() < 0.35
        assert abs(drawn.mean() - delay) < 0.25
        assert len(np.unique(drawn.round(6))) > 50


def test_no_dead_time_is_less_than_half_a_step():
    for seed in (6, 17):
        drawn = dgp.fit(MODEL, made(seed, 0.0, 0.02), **QUICK).draws["delay"].numpy()
        assert drawn.min() >= 0.0
        assert drawn.mean() < 0.3
        assert np.quantile(drawn, 0.95) < 0.5


def test_uneven_steps():
    steps = np.random.default_rng(2).integers(FINER // 2, 2 * FINER, N + BEFORE - 1)
    record = made(6, 2.4, 0.03, np.concatenate([[0], np.cumsum(steps)]))
    fit = dgp.fit(MODEL, record[:150], **QUICK)
    drawn = fit.draws["delay"][:, 0].numpy()
    assert abs(drawn.mean() - 2.4) < 3.0 * drawn.std()
    assert drawn.std() < 0.3
    error = fit.forecast(record[:150], record[150:]).mean - record.outputs[150:]
    assert np.sqrt(np.mean(error**2)) < 0.06 * record.outputs.std()


def test_a_step_test_with_a_dead_time():
    """Two steps of 240 samples: 18 s, a time constant of 130 s, a sensor in steps of 0.32 degC."""
    rng = np.random.default_rng(3)
    n, step = 240, 3.0
    u = np.zeros(n)
    u[10:90], u[90:160], u[160:] = 60.0, 20.0, 45.0
    truth, decay = np.full(n, 23.0), np.exp(-step / 130.0)
    for k in range(1, n):
        truth[k] = 23.0 + decay * (truth[k - 1] - 23.0) + 0.65 * (1.0 - decay) * u[max(k - 7, 0)]
    read = np.round((truth + 0.1 * rng.standard_normal(n)) / 0.32) * 0.32
    record = dgp.Record(step * np.arange(n), u, read, input_names=("heater",), time_unit="s")
    model = dgp.LinearDynamicGP(1, pairs=1, channels=(dgp.Delayed("heater"),))
    fit = dgp.fit(model, record[:150], **QUICK)
    drawn = fit.draws["delay"].numpy()
    low, high = np.quantile(drawn, [0.01, 0.99])
    assert low < 18.0 < high
    assert drawn.std() < 1.0
    error = fit.forecast(record[:150], record[150:]).mean[:, 0] - truth[150:]
    assert np.sqrt(np.mean(error**2)) < 0.2
    assert 10.0 < fit.summary().table.loc["dead time of heater", "mean"] < 20.0


def test_gaps_short_records_and_several():
    record = made(6, 2.4, 0.02)
    outputs = record.outputs.copy()
    outputs[np.random.default_rng(0).random(N) < 0.3] = np.nan
    gaps = record.with_outputs(outputs)
    for data, sd in ((gaps, 0.3), (record[:30], 1.0), ([record[:80], record[80:]], 0.3)):
        drawn = dgp.fit(MODEL, data, **QUICK).draws["delay"][:, 0].numpy()
        assert drawn.std() < sd
        assert abs(drawn.mean() - 2.4) < max(3.0 * drawn.std(), 0.1)


def test_each_of_two_inputs_has_its_own():
    first, second = made(6, 2.4, 0.0), made(17, 5.5, 0.0)
    noise = 0.03 * np.random.default_rng(1).normal(size=(N, 1))
    record = dgp.Record(
        first.time, np.column_stack([first.inputs, second.inputs]),
        first.outputs / first.outputs.std() + second.outputs / second.outputs.std() + noise,
        input_names=("a", "b"), time_unit="s",
    )  # fmt: skip
    channels = (dgp.Delayed("b"), dgp.Delayed("a"))
    fit = dgp.fit(dgp.LinearDynamicGP(2, pairs=2, channels=channels), record, **QUICK)
    drawn = fit.draws["delay"].numpy()
    assert np.abs(drawn.mean(0) - [5.5, 2.4]).max() < 0.6
    assert drawn.std(0).max() < 0.6


def test_verbs(fitted, tmp_path):
    record, fit = fitted
    past, future = record[:150], record[150:]
    found = fit.forecast(past, future)
    assert np.sqrt(np.mean((found.mean - future.outputs) ** 2)) < 0.1 * record.outputs.std()
    prepared = fit.model.check(record)[0]
    again = fit.forecast(prepared[:150], prepared[150:])
    np.testing.assert_allclose(again.mean, found.mean, rtol=1e-9)
    assert np.isfinite(fit.predict(record, horizon=3).mean).all()
    assert np.isfinite(fit.simulate(record).mean).all()
    fit.save(tmp_path / "late.fit")
    loaded = dgp.load(tmp_path / "late.fit")
    assert loaded.model == fit.model
    np.testing.assert_array_equal(loaded.forecast(past, future).mean, found.mean)
    assert np.isfinite(dgp.loo(fit, target="missing sample").elpd_loo)


def test_names_and_units(fitted):
    _, fit = fitted
    posterior = fit.to_arviz(samples=5, prior_samples=5, future=None).posterior
    assert posterior["delay"].attrs["units"] == "s"
    assert posterior["delay"].coords["delayed input"].values.tolist() == ["u delayed"]
    row = fit.summary().table.loc["dead time of u"]
    drawn = fit.draws["delay"]
    assert row["mean"] == pytest.approx(float(drawn.mean()))
    assert (row["sd"] > 0, row["unit"]) == (True, "s")
    named = parameters_of(fit, fit.model.channels, fit.records[0])
    expected = float(drawn.mean()), float(drawn.std(correction=0))
    assert named == {"dead time of u [s]": pytest.approx(expected)}
    assert longest_delay(fit.model) == 0.0
    assert _later(fit.model, ["u delayed"], 1.0, 0.2) is None
    shortened = fit.at_mode().summary().table.loc["dead time of u"]
    assert shortened["mean"] == pytest.approx(float(fit.mode["delay"]))
    assert np.isnan(shortened["sd"])


def test_outputs_count_from_when_inputs_have_arrived():
    for delay, least, most in ((0.0, 2, 5), (7.9, 10, 16)):
        problem = Problem.of(MODEL, made(6, delay, 0.02))
        missing = np.isnan(problem.records[0].record.outputs[:, 0])
        assert least <= missing.sum() <= most
        assert missing[: missing.sum()].all()
    (short,) = Problem.of(MODEL, made(6, 7.9, 0.02, n=24)).records
    assert np.isnan(short.record.outputs).sum() <= 6  # a quarter


def test_starts_and_what_is_tried_around_an_optimum():
    record = made(6, 7.0, 0.02)
    problem = Problem.of(MODEL, record)
    assert abs(float(likely_delays(problem.model, problem.records)[0][0]) - 7.0) <= 1.0
    starts = delayed_starts(problem.model, problem.records, 12, 0)
    names = {site.name for site in problem.model.sites(problem.scaling)}
    assert all(set(start) == names for start in starts)
    delays = [float(start["delay"][0]) for start in starts]
    assert len(set(delays)) > 5
    around = [float(one["delay"][0]) for one in moved(starts[0], 1.0)]
    assert np.allclose(np.subtract(around, delays[0]), [-2.0, -1.0, -0.5, 0.5, 1.0, 2.0])


def test_gauss_newton_has_the_slope_by_the_dead_time(fitted):
    _, fit = fitted
    potential = Potential(fit.model.collapsed, (fit.records,), fit.mode)
    z = potential.pack(fit.mode).numpy() + 0.01
    local = Innovations(potential).local(z)
    _, gradient = potential.value_and_gradient(z)
    np.testing.assert_allclose(local.gradient, gradient, rtol=1e-3, atol=1e-2)
    assert abs(gradient[-1]) > 1.0
