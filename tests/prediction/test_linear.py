"""Simulation, prediction and forecast against dense Gaussian conditioning."""

import numpy as np
import pyro
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.lti.state import ModalState
from tests.lti.dense import signal_covariance
from tests.models.outputs import physical_of, prior_process


def dense(fit, record, draw=0):
    """Mean (N,), covariance of the signal (N, N) and noise variance (N,) of one draw."""
    process = prior_process(fit, record)
    modes = process.modes[draw]
    P0 = process.initial_covariance
    S = signal_covariance(modes, record.time, record.time, P0 if P0 is None else P0[draw])
    noise = np.atleast_1d(physical_of(fit).noise_sd[draw].numpy()) ** 2
    return process.mean[draw].reshape(-1).numpy(), S.numpy(), np.tile(noise, len(record))


def given(mean, S, noise, y, past):
    """Mean and covariance of the signal given the samples in `past` (boolean, N)."""
    use = past & np.isfinite(y)
    if not use.any():
        return mean, S
    K = S[np.ix_(use, use)] + np.diag(noise[use])
    gain = np.linalg.solve(K, S[use]).T
    return mean + gain @ (y - mean)[use], S - gain @ S[use]


@pytest.fixture(params=["map_fit", "two_output_fit"])
def case(request, record, two_outputs):
    fit = request.getfixturevalue(request.param)
    full = record if request.param == "map_fit" else two_outputs
    y = full.outputs[:60].copy()
    y[[5, 6, 30]] = np.nan
    y[40, 0] = np.nan
    return fit, full[:60].with_outputs(y)


def test_simulation_is_the_prior(case):
    fit, record = case
    mean, S, noise = dense(fit, record)
    simulated = fit.simulate(record)
    np.testing.assert_allclose(simulated.mean.reshape(-1), mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(simulated.variance.reshape(-1), np.diag(S) + noise, rtol=1e-9)


@pytest.mark.parametrize("horizon", [1, 4])
def test_predictions_are_conditional_means(case, horizon):
    fit, record = case
    mean, S, noise = dense(fit, record)
    n_y = record.n_outputs
    y = record.outputs.reshape(-1)
    rows = np.arange(len(y))
    predicted = fit.predict(record, horizon=horizon)
    for k in (0, 3, 7, 31, 59):
        past = rows < max(0, k - horizon + 1) * n_y
        m, C = given(mean, S, noise, y, past)
        at = slice(k * n_y, (k + 1) * n_y)
        np.testing.assert_allclose(predicted.mean[k], m[at], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(predicted.variance[k], np.diag(C)[at] + noise[at], rtol=1e-8)


def test_forecast_is_the_conditional_of_the_joined_record(case):
    fit, record = case
    mean, S, noise = dense(fit, record)
    y = record.outputs.reshape(-1)
    n_y = record.n_outputs
    past, future = record.split(45)
    m, C = given(mean, S, noise, y, np.arange(len(y)) < 45 * n_y)
    forecast = fit.forecast(past, future)
    np.testing.assert_allclose(forecast.mean.reshape(-1), m[45 * n_y :], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(
        forecast.variance.reshape(-1), (np.diag(C) + noise)[45 * n_y :], rtol=1e-8
    )
    # joint in time: sample covariance of the signal at two far-apart times
    wide = fit.forecast(past, future, samples=4000).samples.reshape(4000, -1)
    exact = C[45 * n_y :, 45 * n_y :] + np.diag(noise[45 * n_y :])
    error = np.abs(np.cov(wide.T) - exact) / np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    assert error.max() < 6 * np.sqrt(2 / 4000)


def test_forecast_over_a_gap_holds_the_last_input(map_fit, record):
    past, future = record[:50], record[57:80]
    joined = fit_mean_with_hold(map_fit, record)
    forecast = map_fit.forecast(past, future)
    np.testing.assert_allclose(forecast.mean[:, 0], joined, rtol=1e-8, atol=1e-10)


def fit_mean_with_hold(fit, record):
    held = record.inputs[:80].copy()
    held[50:57] = held[49]
    full = dgp.Record(time=record.time[:80], inputs=held, outputs=record.outputs[:80])
    mean, S, noise = dense(fit, full)
    m, _ = given(mean, S, noise, full.outputs[:, 0], np.arange(80) < 50)
    return m[57:]


def test_without_process_noise_only_state_and_noise_are_uncertain(map_fit, record):
    past, future = record.split(160)
    quiet = map_fit.forecast(past, future, process_noise=False)
    noisy = map_fit.forecast(past, future)
    np.testing.assert_allclose(quiet.mean, noisy.mean, rtol=1e-9, atol=1e-12)
    assert (quiet.variance < noisy.variance).all()
    floor = map_fit.noise_sd[0] ** 2
    assert quiet.variance[-1, 0] == pytest.approx(floor, rel=1e-3)  # the state is forgotten
    assert not quiet.parts["process noise"].any()
    simulated = map_fit.simulate(record, process_noise=False)  # 24 s: the state is forgotten
    assert simulated.variance[-1, 0] == pytest.approx(floor, rel=1e-6)


@pytest.mark.parametrize("name", ["map_fit", "svi_fit", "two_output_fit"])
def test_parts_add_up_to_the_variance(name, request, record, two_outputs):
    fit = request.getfixturevalue(name)
    full = two_outputs if name == "two_output_fit" else record
    past, future = full.split(160)
    for prediction in (
        fit.simulate(future),
        fit.forecast(past, future),
        fit.predict(full, horizon=3),
    ):
        total = sum(prediction.parts.values())
        np.testing.assert_allclose(total, prediction.variance, rtol=1e-10)
        assert all((part >= -1e-12).all() for part in prediction.parts.values())
        assert (prediction.parts["parameters"].max() > 0) == (name == "svi_fit")


def test_process_noise_part_is_what_noise_since_the_start_adds(map_fit, record):
    """Checked by simulating from a state that is known exactly."""
    future = record[:40]
    modes = map_fit.modes
    known = ModalState(torch.zeros(1, dtype=torch.complex128), torch.zeros(2, 2).double())
    process = dgp.LTIProcess(modes, future.time, future.inputs * 0.0, known)
    torch.manual_seed(0)
    draws = process.sample((4000,)).numpy()
    part = map_fit.simulate(future).parts["process noise"][:, 0]
    np.testing.assert_allclose(draws.var(0)[1:], part[1:], rtol=6 * np.sqrt(2 / 4000))
    assert part[0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("name", ["map_fit", "svi_fit"])
def test_samples_have_the_moments_of_the_mixture(name, request, record):
    fit = request.getfixturevalue(name)
    past, future = record.split(160)
    for prediction in (
        fit.simulate(future, samples=4000),
        fit.forecast(past, future, samples=4000),
        fit.predict(future, samples=4000),
    ):
        samples = prediction.samples
        assert samples.shape == (4000, 80, 1)
        z = (samples.mean(0) - prediction.mean) / (prediction.sd / np.sqrt(4000))
        assert np.abs(z).max() < 5
        np.testing.assert_allclose(samples.std(0), prediction.sd, rtol=8 * np.sqrt(0.5 / 4000))


def test_same_seed_same_samples(map_fit, record):
    one, two = (map_fit.simulate(record, seed=4).samples for _ in range(2))
    assert np.array_equal(one, two)
    assert not np.array_equal(one, map_fit.simulate(record, seed=5).samples)


def test_innovations_of_a_true_model_are_white_and_standard(one_pair):
    from tests.conftest import simulate_record

    record = simulate_record(one_pair, 0.1, n=2000, seed=11)
    fit = dgp.fit(dgp.LinearDynamicGP(inputs=1, pairs=1), record[:1000], restarts=2, workers=1,
                  progress=False, method="map")  # fmt: skip
    e = fit.innovations(record)[1000:, 0]
    assert e.std() == pytest.approx(1.0, abs=4 * np.sqrt(0.5 / 1000))
    for lag in (1, 2, 5):
        assert abs(np.corrcoef(e[lag:], e[:-lag])[0, 1]) < 4 / np.sqrt(1000)


def test_log_likelihood_is_the_sum_of_one_step_densities(map_fit, record):
    """Chain rule: the joint density is the product of the one-step predictive ones."""
    y = record.outputs.copy()
    y[10:15] = np.nan
    holes = record.with_outputs(y)
    total = np.nansum(map_fit.predict(holes).log_density(y))
    assert map_fit.log_likelihood(holes)[0] == pytest.approx(total, rel=1e-10)


def test_elpd_does_not_depend_on_the_scaling(record):
    """The same record in other units: the same fit, densities shifted by the Jacobian."""
    other = dgp.Record(
        time=record.time * 1e3, inputs=record.inputs * 7.0 - 1.0, outputs=record.outputs * 20.0,
        time_unit="ms",
    )  # fmt: skip
    model = dgp.LinearDynamicGP(inputs=1, pairs=1)
    options = {"restarts": 2, "workers": 1, "progress": False}
    one = dgp.fit(model, record[:160], **options, method="map")
    two = dgp.fit(model, other[:160], **options, method="map")
    a = one.forecast(record[:160], record[160:]).log_density(record.outputs[160:])
    b = two.forecast(other[:160], other[160:]).log_density(other.outputs[160:])
    # The optimiser stops within 1e-4 nats of the optimum, by another path in other units.
    np.testing.assert_allclose(b + np.log(20.0), a, atol=5e-3)


def test_wrong_uses(map_fit, record, two_outputs):
    past, future = record.split(160)
    with pytest.raises(ValueError, match="future: expected times after the end of past"):
        map_fit.forecast(future, past)
    with pytest.raises(ValueError, match="horizon: expected a whole number >= 1"):
        map_fit.predict(record, horizon=0)
    with pytest.raises(ValueError, match="expected 1 inputs, as the model has, got 2"):
        map_fit.simulate(two_outputs)
    with pytest.raises(ValueError, match="one Record"):
        map_fit.simulate([record])
    blank = dgp.Record(time=past.time, inputs=past.inputs)
    with pytest.raises(ValueError, match="past: expected measured outputs"):
        map_fit.forecast(blank, future)
    with pytest.raises(ValueError, match="record: expected measured outputs"):
        map_fit.predict(blank)


def test_future_without_outputs_is_enough(map_fit, record):
    past, future = record.split(160)
    blank = dgp.Record(time=future.time, inputs=future.inputs)
    assert np.array_equal(map_fit.forecast(past, blank).mean, map_fit.forecast(past, future).mean)


def test_no_gradient_and_no_site_is_left_in_a_prediction(map_fit, record):
    with pyro.poutine.trace() as tracer:
        map_fit.simulate(record)
    assert not [n for n, v in tracer.trace.nodes.items() if v["type"] == "sample"]
