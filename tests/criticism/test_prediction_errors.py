"""Joint samples of k-step predictions: their errors against dense algebra and simulated records."""

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pyro
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.criticism.comparison import mix
from tests.models.outputs import physical_of, prior_process
from tests.prediction.known import wiener_data, wiener_fit
from tests.prediction.test_linear import dense

K = 4


@pytest.fixture(params=["map_fit", "two_output_fit"])
def case(request, record, two_outputs):
    """A fit and a record with gaps and a step of its own in the middle of the clock."""
    fit = request.getfixturevalue(request.param)
    full = record if request.param == "map_fit" else two_outputs
    y = full.outputs[:30].copy()
    y[[5, 6]] = np.nan
    y[20, 0] = np.nan
    time = full.time[:30].copy()
    time[15:] += 0.07
    return fit, dgp.Record(
        time, full.inputs[:30], y, input_names=full.input_names, output_names=full.output_names
    )


def error_covariance(fit, record, horizon):
    """Covariance (N, N) of y - E(y | outputs `horizon` samples before and earlier), exact."""
    _, S, noise = dense(fit, record)
    n_y = record.n_outputs
    there = np.isfinite(record.outputs.reshape(-1))
    full = S + np.diag(noise)
    A = np.eye(len(full))
    for row in range(len(full)):
        use = there & (np.arange(len(full)) < max(0, row // n_y - horizon + 1) * n_y)
        if use.any():
            A[row, use] -= np.linalg.solve(full[np.ix_(use, use)], S[use, row])
    return A @ full @ A.T


@pytest.mark.parametrize("horizon", [1, K])
def test_errors_have_the_joint_law_of_dense_algebra(case, horizon):
    """With gaps, an irregular clock, the first samples from the prior, and two outputs."""
    fit, record = case
    exact = error_covariance(fit, record, horizon)
    found = fit.predict(record, horizon=horizon, samples=4000)
    np.testing.assert_allclose(found.variance.reshape(-1), np.diag(exact), rtol=1e-7)
    errors = (found.samples - found.mean).reshape(4000, -1)
    scale = np.sqrt(np.diag(exact))
    difference = (errors.T @ errors / 4000 - exact) / np.outer(scale, scale)
    assert np.abs(difference).max() < 6 * np.sqrt(2 / 4000)


def test_errors_are_a_moving_average(map_fit, record):
    """On a regular record, once the filter has settled: nothing is left from lag k on."""
    exact = error_covariance(map_fit, record[:60], K)[30:, 30:]
    assert abs(exact[10, 9]) > 0.1 * exact[10, 10]
    tail = [exact[i, j] for i in range(30) for j in range(30) if abs(i - j) >= K]
    assert np.abs(tail).max() < 1e-9 * exact[10, 10]
    found = map_fit.predict(record[:60], horizon=K, samples=3000)
    errors = (found.samples - found.mean)[:, 30:, 0]
    for lag, expected in ((1, exact[11, 10]), (K - 1, exact[13, 10]), (K, 0.0), (K + 3, 0.0)):
        products = errors[:, lag:] * errors[:, : 30 - lag]
        error = 5 * products.mean(1).std() / np.sqrt(3000)
        assert products.mean() == pytest.approx(expected, abs=error)


def test_errors_are_those_of_simulated_records(map_fit, record):
    """Brute force: records drawn from the model, each predicted from its own past."""
    short = record[:24]
    process = prior_process(map_fit, short)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(5)
        y = process.observed(physical_of(map_fit).noise_sd).sample((400,))[:, 0].numpy()
    real = np.stack(
        [
            one - map_fit.predict(short.with_outputs(one), horizon=K, samples=1).mean[:, 0]
            for one in y
        ]
    )
    found = map_fit.predict(short, horizon=K, samples=400)
    drawn = (found.samples - found.mean)[..., 0]
    for lag in range(K + 2):
        a, b = ((e[:, lag:] * e[:, : 24 - lag]).mean(1) for e in (real, drawn))
        assert a.mean() == pytest.approx(b.mean(), abs=5 * np.hypot(a.std(), b.std()) / 20)


def test_calibration_several_steps_ahead_keeps_its_level(map_fit, record):
    """Right predictions are rejected at 5 %, ones with independent samples far more often."""
    short = record[:60]
    process = prior_process(map_fit, short)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(1)
        y = process.observed(physical_of(map_fit).noise_sd).sample((48,))[:, 0].numpy()
    joint, apart = [], []
    for seed, one in enumerate(y):
        measured = short.with_outputs(one)
        found = map_fit.predict(measured, horizon=8, samples=99, seed=seed)
        joint.append(not dgp.calibration(found, measured).calibrated[0])
        shuffled = np.random.default_rng(seed).permuted(found.samples, axis=0)
        other = replace(found, sampler=lambda shuffled=shuffled: shuffled)
        apart.append(not dgp.calibration(other, measured).calibrated[0])
    assert np.mean(joint) < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 48)
    assert np.mean(apart) > 0.2


def test_the_note_is_kept_where_samples_are_independent(map_fit, record):
    short = record[:80]
    assert dgp.calibration(map_fit.predict(short, horizon=K), short).note == ""
    mixed = dgp.stack({"a": map_fit, "b": map_fit}, {"a": 0.5, "b": 0.5})
    assert dgp.calibration(mixed.predict(short, horizon=K), short).note == ""
    known = wiener_fit()
    bent, _ = wiener_data(known, n=80)
    ahead = known.predict(bent, horizon=K)
    assert "up to 3 samples apart" in dgp.calibration(ahead, bent).note
    both = mix([map_fit.predict(short, horizon=K), ahead], np.array([0.5, 0.5]))
    assert both.kind == ahead.kind


@pytest.fixture(scope="module")
def apart(map_fit):
    """Forty draws, told apart by their offsets 0, 100, 200, ..."""
    draws = {name: value.repeat(40, *[1] * (value.dim() - 1)) for name, value in
             map_fit.draws.items()}  # fmt: skip
    scale = torch.tensor(map_fit.scaling.output_scale)
    draws["offset"] = 100.0 * torch.arange(40, dtype=torch.float64)[:, None] / scale
    return replace(map_fit, draws=MappingProxyType(draws))


@pytest.mark.parametrize("samples", [10, 40, 50, 90])
def test_few_samples_come_from_all_draws(apart, record, samples):
    past, future = record.split(160)
    for prediction in (
        apart.simulate(future, samples=samples),
        apart.forecast(past, future, samples=samples),
        apart.predict(future, horizon=3, samples=samples),
    ):
        assert len(prediction.samples) == samples
        gaps = np.abs(prediction.samples[:, None] - prediction.component_mean)
        which = gaps.mean((2, 3)).argmin(1)
        counts = np.bincount(which, minlength=40)
        assert counts.max() - counts.min() <= 1
        assert abs(which.mean() - 19.5) < 2.0


def test_a_first_state_that_is_a_site(record):
    """Given a draw a training record begins where the draw says; another one is unknown there."""
    model = dgp.LinearDynamicGP(inputs=1, pairs=1, initial_state="site")
    fit = dgp.fit(model, record[:60], restarts=1, steps=30, workers=1, progress=False, method="map")
    data = fit.to_arviz(samples=3, prior_samples=0)
    total = float(data.log_likelihood["y"].sum())
    assert total == pytest.approx(float(fit.log_likelihood(record[:60])[0]))
    sites = {name: value[0] for name, value in fit.draws.items()}
    prior = fit.log_joint(record[:60]) - _outputs_given(fit, sites, record[:60])
    assert float(data.sample_stats["lp"][0, 0]) == pytest.approx(total + prior)
    unknown = prior_process(fit, record[:60], unknown_start=True)
    integrated = unknown.observed(physical_of(fit).noise_sd).log_prob(
        record.tensors().outputs[:60, 0]
    )
    assert abs(total - float(integrated[0])) > 0.1
    other = record[60:120]
    same = prior_process(fit, other).observed(physical_of(fit).noise_sd)
    assert float(fit.log_likelihood(other)[0]) == pytest.approx(
        float(same.log_prob(other.tensors().outputs[:, 0])[0])
    )
    assert np.allclose(fit.simulate(record[:60]).mean, unknown.mean[0].numpy()[:, None])


def _outputs_given(fit, sites, record):
    """Log p(y | sites) by the Pyro model itself."""
    conditioned = pyro.poutine.condition(fit.model, data=sites)
    trace = pyro.poutine.trace(conditioned).get_trace(record)
    trace.compute_log_prob()
    return float(trace.nodes["y"]["log_prob_sum"])
