"""Predictions of cascades: where all is linear, against the exact ones; else against simulation."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyro
import pytest
import torch
from scipy import stats
from scipy.optimize import minimize
from scipy.stats import kurtosis

import pyro_dynogp as dgp
from pyro_dynogp.distributions.process import ConditionedLTIProcess
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.prediction import first_state
from pyro_dynogp.prediction.first_state import estimate
from pyro_dynogp.support.frozen import FrozenMapping
from tests.models.outputs import by_moments, physical_of, prior_process
from tests.prediction.known import (
    fit_of,
    prior_draws,
    saturation,
    steps_record,
    wiener_data,
    wiener_fit,
)


@pytest.fixture(scope="module")
def twins(record):
    """A linear model and a cascade of one dynamic layer with the same posterior draws."""
    scaling = dgp.Scaling.from_records(record)
    linear = dgp.LinearDynamicGP(inputs=1, pairs=2)
    draws = prior_draws(linear, scaling, 2)
    cascade = dgp.Cascade(1, (dgp.Dynamic(pairs=2),), initial_state="integrated")
    y = record.outputs[:60].copy()
    y[[5, 6, 30]] = np.nan
    return SimpleNamespace(
        linear=fit_of(linear, draws, scaling),
        cascade=fit_of(cascade, draws, scaling),
        record=record[:60].with_outputs(y),
    )


class TestOneDynamicLayer:
    """What moment matching and draws say of a linear model, against the exact engine."""

    @pytest.mark.parametrize("process_noise", [True, False])
    def test_simulation(self, twins, process_noise):
        exact = twins.linear.simulate(twins.record, process_noise=process_noise)
        with by_moments():
            drawn = twins.cascade.simulate(twins.record, process_noise=process_noise, samples=4000)
        self.compare(drawn, exact)

    @pytest.mark.parametrize("process_noise", [True, False])
    def test_forecast(self, twins, process_noise):
        past, future = twins.record.split(40)
        exact = twins.linear.forecast(past, future, process_noise=process_noise)
        with by_moments():
            drawn = twins.cascade.forecast(past, future, process_noise=process_noise, samples=4000)
        self.compare(drawn, exact)

    def test_forecast_over_a_gap_holds_the_last_input(self, twins, record):
        past, future = record[:40], record[47:60]
        exact = twins.linear.forecast(past, future)
        with by_moments():
            self.compare(twins.cascade.forecast(past, future, samples=4000), exact)

    @staticmethod
    def compare(drawn, exact):
        count = len(drawn.component_mean)
        assert count == 4000
        error = (drawn.mean - exact.mean) / (exact.sd / np.sqrt(count))
        assert np.abs(error).max() < 5.0
        np.testing.assert_allclose(drawn.variance, exact.variance, rtol=8.0 * np.sqrt(2.0 / count))
        samples = drawn.samples
        assert np.abs((samples.mean(0) - exact.mean) / exact.sd).max() < 5.0 / np.sqrt(count)
        np.testing.assert_allclose(samples.std(0), exact.sd, rtol=8.0 * np.sqrt(0.5 / count))

    @pytest.mark.parametrize("horizon", [1, 3])
    def test_prediction(self, twins, horizon):
        exact = twins.linear.predict(twins.record, horizon=horizon)
        with by_moments():
            found = twins.cascade.predict(twins.record, horizon=horizon)
        np.testing.assert_allclose(found.component_mean, exact.component_mean, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(found.component_variance, exact.component_variance, rtol=1e-8)
        np.testing.assert_allclose(found.variance, exact.variance, rtol=1e-8)

    def test_log_likelihood(self, twins):
        exact = twins.linear.log_likelihood(twins.record)
        with by_moments():
            found = twins.cascade.log_likelihood(twins.record)
        np.testing.assert_allclose(found, exact, rtol=1e-10)

    @pytest.mark.parametrize("engine", [nullcontext, by_moments])
    def test_smoothed_layer_is_the_conditioned_process(self, twins, engine):
        with engine():
            found = twins.cascade.layers(twins.record)["g"]
        process = prior_process(twins.linear, twins.record)
        y = torch.tensor(twins.record.outputs[:, 0])
        observed = process.observed(physical_of(twins.linear).noise_sd)
        exact = ConditionedLTIProcess(observed, y.expand(2, -1))
        # The layer has neither the output's unit nor its offset.
        scale = twins.linear.scaling.output_scale[0]
        offset = physical_of(twins.linear).offset.unsqueeze(-1)
        mean, sd = ((exact.mean - offset) / scale).numpy(), exact.variance.sqrt().numpy() / scale
        np.testing.assert_allclose(found.draw_mean[..., 0], mean, rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(found.draw_sd[..., 0], sd, rtol=1e-6)
        np.testing.assert_allclose(found.mean[:, 0], mean.mean(0), rtol=1e-7, atol=1e-8)
        total = np.sqrt((sd**2).mean(0) + mean.var(0))
        np.testing.assert_allclose(found.sd[:, 0], total, rtol=1e-6)

    @pytest.mark.parametrize("engine", [nullcontext, by_moments])
    def test_a_layer_without_outputs_is_the_prior(self, twins, engine):
        blank = twins.record.select(outputs=[])
        with engine():
            found = twins.cascade.layers(blank)["g"]
        process = prior_process(twins.linear, twins.record)
        scale = twins.linear.scaling.output_scale[0]
        offset = physical_of(twins.linear).offset.unsqueeze(-1)
        mean, sd = (process.mean - offset) / scale, process.variance.sqrt() / scale
        np.testing.assert_allclose(found.draw_mean[..., 0], mean.numpy(), rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(found.draw_sd[..., 0], sd.numpy(), rtol=1e-7)

    def test_process_noise_part_is_what_noise_since_the_start_adds(self, twins):
        """Exact here, and the rest of the variance within a draw is that of the first state."""
        with by_moments():
            found = dict(twins.cascade.simulate(twins.record, samples=4000).parts)
        exact = twins.linear.simulate(twins.record).parts
        np.testing.assert_allclose(
            found["process noise of g"], exact["process noise"], rtol=1e-8, atol=1e-12
        )
        np.testing.assert_allclose(
            found["measurement noise"], exact["measurement noise"], rtol=1e-10
        )
        # Means over many draws differ by Monte Carlo error from those over the two.
        np.testing.assert_allclose(found["parameters"], exact["parameters"], rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(found["static functions"], 0.0, atol=1e-12)


@pytest.fixture(scope="module")
def known():
    """A Wiener system at rest before the record, its parameters known."""
    return wiener_fit(initial_state="zero")


class TestWiener:
    def test_simulation_has_the_moments_of_the_explicit_model(self, known):
        """The Pyro model with its trajectory as a site, drawn forwards; Predictive does the same.

        Neither the filter nor the package's draws take part.
        """
        record, _ = wiener_data(known, n=30)
        count = 600
        found = known.simulate(record, samples=count)
        values = {k: v[0] for k, v in known.draws.items()}
        model = pyro.poutine.condition(known.model, data=values)
        predictive = pyro.infer.Predictive(model, num_samples=count, parallel=True)
        blank = record.select(outputs=[])
        with torch.random.fork_rng():
            torch.manual_seed(0)
            y = predictive(blank)["y"].reshape(count, -1, 1).numpy()
        sd = y.std(0)
        error = (found.mean - y.mean(0)) / (sd * np.sqrt(2.0 / count))
        assert np.abs(error).max() < 5.0
        np.testing.assert_allclose(found.sd, sd, rtol=8.0 / np.sqrt(count))
        np.testing.assert_allclose(found.samples.std(0), sd, rtol=8.0 / np.sqrt(count))

    def test_parts_add_up_and_each_cause_is_what_it_should_be(self, known):
        record, _ = wiener_data(known, n=60)
        past, future = record.split(40)
        for prediction in (
            known.simulate(record, samples=400),
            known.forecast(past, future, samples=400),
            known.predict(record, horizon=2),
        ):
            total = sum(prediction.parts.values())
            np.testing.assert_allclose(total, prediction.variance, rtol=1e-9)
        # One draw of the parameters, and no process noise asked for.
        quiet = known.simulate(record, process_noise=False)
        assert "process noise of g" not in quiet.parts
        assert quiet.parts["parameters"].max() < 1e-12
        scale = known.scaling.output_scale[0]
        np.testing.assert_allclose(quiet.parts["measurement noise"], (0.05 * scale) ** 2)
        # Small at first: process noise has only begun to act.
        noise = known.simulate(record, samples=500).parts["process noise of g"]
        assert abs(noise[0, 0]) < 1e-6
        assert noise[20:].mean() > 3 * noise[1]

    def test_no_process_noise_and_rest_leave_measurement_noise_alone(self):
        still = wiener_fit(initial_state="zero", process_noise=False)
        record, g = wiener_data(still, n=60)
        simulated = still.simulate(record)
        # 25 inducing values leave the function a band of 0.015 or so.
        np.testing.assert_allclose(simulated.sd, 0.05, rtol=0.1)
        np.testing.assert_allclose(simulated.mean[:, 0], saturation(g), atol=0.015)
        assert simulated.parts["initial state"].max() < 1e-12

    def test_the_forecast_has_no_transient(self, known):
        """The state is carried over: first errors are as their sd says, and smaller than later."""
        errors, sds, naive = [], [], []
        for seed in range(16):
            record, _ = wiener_data(known, n=60, seed=seed)
            past, future = record.split(40)
            forecast = known.forecast(past, future, samples=30)
            errors.append((future.outputs - forecast.mean)[:, 0])
            sds.append(forecast.sd[:, 0])
            if seed < 8:
                naive.append((future.outputs - known.simulate(future, samples=10).mean)[:, 0])
        error, sd = np.array(errors), np.array(sds)
        z = error / sd
        for part in (z[:, :4], z[:, 4:12], z[:, 12:]):
            # 16 records, samples within one strongly correlated: some 16 to 32 squares.
            assert np.mean(part**2) == pytest.approx(1.0, abs=3 * np.sqrt(2 / 16))
        rmse = np.sqrt(np.mean(error[:, :4] ** 2))
        assert rmse < 1.1 * np.sqrt(np.mean(error[:, 12:] ** 2))
        # A simulation of the future by itself does have one.
        assert rmse < 0.5 * np.sqrt(np.mean(np.array(naive)[:, :4] ** 2))

    def test_smoothed_layers_are_calibrated(self, known):
        z, errors, prior = [], [], []
        for seed in range(12):
            record, g = wiener_data(known, n=80, seed=seed)
            found = known.layers(record)["g"]
            assert found.mean.shape == found.sd.shape == (80, 1)
            error = g - found.mean[:, 0]
            z.append(error / found.sd[:, 0])
            errors.append(error)
            prior.append(g - known.layers(record.select(outputs=[]))["g"].mean[:, 0])
        # Samples of a record are correlated over some 10 of them: about 100 independent squares.
        assert np.mean(np.square(z)) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 100))
        assert np.mean(z) == pytest.approx(0.0, abs=4 / np.sqrt(100))
        assert np.std(errors) < 0.6 * np.std(prior)

    def test_smoothed_layers_agree_with_importance_sampling(self):
        """Trajectories from the prior, weighted by the likelihood: exact as their number grows."""
        known = wiener_fit(noise_sd=0.3, initial_state="zero")
        record, _ = wiener_data(known, n=12, seed=3)
        found = known.layers(record)["g"]
        layer = known.system.layer("g")
        start = known.model.begin(known.system, {}).layer("g").prior_state()
        u = PreparedRecord.of(record, known.scaling).scaled_inputs
        count = 200_000
        process = dgp.LTIProcess(layer.modes, record.time, u, start)
        with torch.random.fork_rng(), torch.no_grad():
            torch.manual_seed(0)
            g = process.sample((count,))[:, 0].numpy()
        y = (record.outputs[:, 0] - known.scaling.output_offset) / known.scaling.output_scale
        logs = -0.5 * (((y - saturation(g)) / 0.3) ** 2).sum(-1)
        w = np.exp(logs - logs.max())
        w = w / w.sum()
        assert 1 / (w**2).sum() > 400  # effective draws
        mean = w @ g
        sd = np.sqrt(w @ (g - mean) ** 2)
        # Monte Carlo error of 0.05 sd or less, and what moment matching leaves out.
        assert np.abs((found.mean[:, 0] - mean) / sd).max() < 0.25
        np.testing.assert_allclose(found.sd[:, 0], sd, rtol=0.25)

    def test_layers_without_outputs_are_the_mean_response(self, known):
        record, _ = wiener_data(known, n=60)
        found = known.layers(record.select(outputs=[]))["g"]
        modes = known.system.layer("g").modes
        u = PreparedRecord.of(record, known.scaling).scaled_inputs
        process = dgp.LTIProcess(modes, record.time, u)
        np.testing.assert_allclose(found.draw_mean[..., 0], process.mean.numpy(), atol=1e-9)
        np.testing.assert_allclose(found.sd, 0.3, rtol=1e-6)  # stationary from the start

    def test_innovations_are_white_and_standard(self, known):
        record, _ = wiener_data(known, n=600, seed=1)
        e = known.innovations(record)[:, 0]
        assert e.std() == pytest.approx(1.0, abs=4 * np.sqrt(0.5 / 600))
        for lag in (1, 2, 5):
            assert abs(np.corrcoef(e[lag:], e[:-lag])[0, 1]) < 4 / np.sqrt(600)

    def test_a_short_horizon_knows_more(self, known):
        record, _ = wiener_data(known, n=120, seed=1)
        near, far = (known.predict(record, horizon=k) for k in (1, 5))
        prior = known.simulate(record, samples=40)
        rmse = [dgp.scores(p, record, skip=20)["rmse"] for p in (near, far)]
        assert rmse[0] < rmse[1]
        sd = [p.sd[20:].mean() for p in (near, far, prior)]
        assert sd[0] < 0.9 * sd[1]
        assert sd[1] < 1.1 * sd[2]  # nearly all is forgotten by then

    def test_scores(self, known):
        record, _ = wiener_data(known, n=250, seed=2)
        for prediction in (known.predict(record), known.simulate(record, samples=100)):
            found = dgp.scores(prediction, record)
            assert found["count"] == 250
            assert found["coverage_95"] == pytest.approx(0.95, abs=0.05)
            assert found["crps"] < found["mae"] < found["rmse"]
        assert dgp.scores(known.predict(record), record)["fit_percent"] > 70

    def test_missing_outputs_are_bridged(self, known):
        record, g = wiener_data(known, n=60)
        y = record.outputs.copy()
        y[20:24] = np.nan
        found, whole = (known.layers(r)["g"] for r in (record.with_outputs(y), record))
        assert (found.sd[20:24] > 1.5 * whole.sd[20:24]).all()
        assert np.abs(g - found.mean[:, 0])[20:24].max() < 4 * found.sd[20:24].max()
        assert np.isnan(known.innovations(record.with_outputs(y))[20:24]).all()

    def test_same_seed_same_numbers(self, known):
        record, _ = wiener_data(known, n=40)
        state = torch.get_rng_state()
        one, two, other = (known.simulate(record, seed=s) for s in (4, 4, 5))
        assert np.array_equal(one.mean, two.mean)
        assert np.array_equal(one.samples, two.samples)
        assert not np.array_equal(one.mean, other.mean)
        assert torch.equal(torch.get_rng_state(), state)

    def test_wrong_uses(self, known):
        record, _ = wiener_data(known, n=40)
        past, future = record.split(20)
        blank = past.select(outputs=[])
        with pytest.raises(ValueError, match="future: expected times after the end of past"):
            known.forecast(future, past)
        with pytest.raises(ValueError, match="past: expected measured outputs"):
            known.forecast(blank, future)
        with pytest.raises(ValueError, match="record: expected measured outputs"):
            known.predict(blank)
        with pytest.raises(ValueError, match="horizon: expected a whole number >= 1"):
            known.predict(record, horizon=0)
        with pytest.raises(ValueError, match="one Record"):
            known.simulate([record])
        with pytest.raises(ValueError, match="modes: expected a model that is one layer"):
            _ = known.modes
        stamped = dgp.Record(
            time=future.time,
            inputs=future.inputs,
            outputs=future.outputs,
            start="2024-01-01T00:00:00Z",
        )
        with pytest.raises(ValueError, match="same kind of clock"):
            known.forecast(past, stamped)


class TestStaticFunction:
    def test_band_holds_the_function(self, known):
        record, g = wiener_data(known, n=80)
        band = known.static_function("f", record, points=50)
        assert band.x.shape == (50,)
        assert band.mean.shape == band.sd.shape == (50, 1)
        assert band.inputs.shape == (80,)
        # The range is that of the smoothed input and a tenth beyond.
        margin = 0.1 * np.ptp(band.inputs)
        assert band.x[0] == pytest.approx(band.inputs.min() - margin)
        assert band.x[-1] == pytest.approx(band.inputs.max() + margin)
        assert np.abs(band.inputs - g).mean() < 0.25
        np.testing.assert_allclose(band.mean[:, 0], saturation(band.x), atol=0.015)
        assert (band.sd > 0).all()

    def test_spread_of_draws_widens_the_band(self, known):
        record, _ = wiener_data(known, n=40)
        draws = {k: v.expand(2, *v.shape[1:]).clone() for k, v in known.draws.items()}
        draws["f_constant"] = torch.tensor([[-0.5], [0.5]], dtype=torch.float64)
        wide = fit_of(known.model, draws, known.scaling).static_function("f", record)
        at = known.system.layer("f").function.moments(torch.tensor(wide.x)[:, None])
        np.testing.assert_allclose(wide.mean, at[0][0], atol=1e-9)
        np.testing.assert_allclose(wide.sd, np.sqrt(at[1][0].numpy() + 0.25), rtol=1e-9)

    def test_wrong_uses(self, known, twins):
        record, _ = wiener_data(known, n=20)
        with pytest.raises(ValueError, match="name: expected a static layer, got 'g'"):
            known.static_function("g", record)
        with pytest.raises(ValueError, match="one of the layers"):
            known.static_function("h", record)
        with pytest.raises(ValueError, match="channel: expected 0 to 0"):
            known.static_function("f", record, channel=1)
        with pytest.raises(ValueError, match="name: expected one of the layers"):
            twins.linear.static_function("f", record)


class TestBeginning:
    def test_the_first_state_of_a_new_record_is_found(self):
        """A record that begins far from rest: the transient is explained, not ignored."""
        fit = wiener_fit(noise_sd=0.02, drift=0.05)
        x0 = torch.tensor([0.5 - 0.6j], dtype=torch.complex128)
        record, g = wiener_data(fit, n=60, x0=x0)
        modes = fit.system.layer("g").modes[0]
        z = estimate(fit, PreparedRecord.of(record, fit.scaling))["g"]
        found = fit.model.begin(fit.system, {"g": z}).layer("g").first_state[0]
        u = PreparedRecord.of(record, fit.scaling).scaled_inputs
        response = dgp.LTIProcess(modes, record.time, u, found).mean.numpy()
        assert np.abs(response - g)[:20].max() < 0.25  # process noise has sd 0.05 times a few
        rest = dgp.LTIProcess(modes, record.time, u).mean.numpy()
        assert np.abs(response - g)[:5].max() < 0.2 * np.abs(rest - g)[:5].max()
        # Predictions use it, whether or not gradients are recorded.
        error = (record.outputs - fit.predict(record).mean)[:5]
        assert np.abs(error).max() < 0.3
        assert np.isfinite(fit.log_likelihood(record)).all()

    def test_what_is_learnt_of_training_records_is_a_start(self, monkeypatch):
        """A record may begin as a training record does."""
        fit = wiener_fit(noise_sd=0.02, drift=0.05)
        known = torch.tensor([0.7, -0.4], dtype=torch.float64)
        record, _ = wiener_data(fit, n=60)
        mode = FrozenMapping(dict(fit.mode) | {"g_initial_state": known})
        fit = replace(fit, mode=mode, records=(record,))
        assert [wire.name for wire in fit.model.state_sites] == ["g"]
        began = []

        def newton(functions, starts):
            began.extend(starts.tolist())
            return starts, np.arange(len(starts), dtype=float)[::-1]

        monkeypatch.setattr(first_state, "newton", newton)
        z = estimate(fit, PreparedRecord.of(record, fit.scaling))["g"]
        assert len(began) == 4
        assert began[0] == [0.0, 0.0]
        torch.testing.assert_close(z, known)  # the last one, which is the best

    def test_it_is_the_most_probable_one(self):
        """To what a general optimiser with a tolerance of rounding finds."""
        fit = wiener_fit(noise_sd=0.02, drift=0.05)
        record, _ = wiener_data(fit, n=60, x0=torch.tensor([0.5 - 0.6j], dtype=torch.complex128))
        prepared = PreparedRecord.of(record, fit.scaling)
        z = estimate(fit, prepared)["g"]

        def energy(x):
            at = torch.tensor(x, requires_grad=True)
            begun = fit.model.begin(fit.system_at(fit.mode), {"g": at})
            value = 0.5 * at.square().sum() - output_process(begun, prepared).log_prob(
                prepared.observations
            )
            (gradient,) = torch.autograd.grad(value, at)
            return value.item(), gradient.numpy()

        tight = {"ftol": 1e-15, "gtol": 1e-9, "maxiter": 500}
        exact = minimize(energy, z.numpy() + 0.1, jac=True, method="L-BFGS-B", options=tight)
        np.testing.assert_allclose(z, exact.x, atol=1e-6)

    def test_without_outputs_it_is_unknown(self):
        fit = wiener_fit()
        record, _ = wiener_data(fit, n=30)
        sd = fit.simulate(record, samples=1000).signal_sd[:, 0]
        assert sd[0] > 1.5 * sd[-1]


class TestNoise:
    def test_heteroscedastic_noise_changes_over_time(self):
        likelihood = dgp.Heteroscedastic(4)
        fit = wiener_fit(initial_state="zero", likelihood=likelihood)
        # log(sd / 0.1) of a prior draw of the function; made steep so that it is seen.
        draws = dict(fit.draws)
        draws["log_noise_values"] = torch.tensor([[[-2.0, -1.0, 1.0, 2.0]]], dtype=torch.float64)
        fit = fit_of(fit.model, draws, fit.scaling)
        record, _ = wiener_data(fit, n=300)
        u = PreparedRecord.of(record, fit.scaling).scaled_inputs
        scale = fit.scaling.output_scale
        sd = scale * fit.system.noise.sd(u)[0].numpy()
        assert sd.max() > 2 * sd.min()
        for prediction in (fit.predict(record), fit.simulate(record, samples=100)):
            assert prediction.noise_variance.ndim == 3
            np.testing.assert_allclose(prediction.parts["measurement noise"], sd**2, rtol=1e-9)
        assert fit.innovations(record).std() == pytest.approx(1.0, abs=0.2)
        with pytest.raises(ValueError, match="noise of constant scale"):
            _ = fit.noise_sd

    def test_noise_that_follows_the_output_follows_it_into_the_future(self):
        fit = wiener_fit(initial_state="zero", likelihood=dgp.Heteroscedastic(4, of="output"))
        draws = dict(fit.draws)
        draws["log_noise_values"] = torch.tensor([[[-2.0, -1.0, 1.0, 2.0]]], dtype=torch.float64)
        fit = fit_of(fit.model, draws, fit.scaling)
        record, _ = wiener_data(fit, n=300)
        # By definition: f's mean along g's mean response, through the noise's function.
        modes = fit.system.layer("g").modes
        g = dgp.LTIProcess(
            modes, record.time, PreparedRecord.of(record, fit.scaling).scaled_inputs
        ).mean
        output = fit.system.layer("f").function.mean(g.reshape(1, -1, 1))
        sd = 0.1 * fit.scaling.output_scale * fit.system.noise.log_sd.mean(output)[0].exp().numpy()
        assert sd.max() > 2 * sd.min()
        for prediction in (fit.predict(record), fit.simulate(record, samples=100)):
            np.testing.assert_allclose(prediction.parts["measurement noise"], sd**2, rtol=1e-9)
        found = fit.forecast(record[:200], record[200:], samples=100)
        at_rest = fit.simulate(record[200:], samples=100).parts["measurement noise"]
        expected = fit.predict(record).parts["measurement noise"][200:]
        np.testing.assert_allclose(found.parts["measurement noise"], expected, rtol=1e-9)
        assert np.abs(at_rest / expected - 1).max() > 0.05

    def test_student_noise_has_heavier_tails(self):
        plain, heavy = (
            wiener_fit(initial_state="zero", process_noise=False, likelihood=likelihood)
            for likelihood in (dgp.Gaussian(), dgp.StudentT(5.0))
        )
        record, _ = wiener_data(plain, n=30)
        residuals = [
            (fit.simulate(record, samples=4000).samples - fit.simulate(record).mean).reshape(-1)
            for fit in (plain, heavy)
        ]
        assert abs(kurtosis(residuals[0])) < 0.3
        assert kurtosis(residuals[1]) > 1.0  # 6 in theory, estimated low from heavy tails
        assert np.median(np.abs(residuals[1])) < 1.2 * np.median(np.abs(residuals[0]))
        # Variance nu / (nu - 2) of the squared scale.
        ratio = residuals[1].var() / residuals[0].var()
        assert ratio == pytest.approx(5 / 3, rel=0.15)

    def test_one_step_ahead_student_noise_is_that_and_innovations_are_normal(self):
        nu = 4.0
        fit = wiener_fit(
            initial_state="zero", process_noise=False, noise_sd=2.0, likelihood=dgp.StudentT(nu)
        )
        record, _ = wiener_data(fit, n=2000)
        found = fit.predict(record)
        scale = 2.0 * fit.scaling.output_scale.item()
        assert found.signal_sd.max() < 0.1 * scale  # nearly all is noise
        t = stats.t(nu, found.mean, scale)
        for q in (0.001, 0.025, 0.3, 0.9, 0.999):
            expected = t.ppf(q) - found.mean
            np.testing.assert_allclose(found.quantile(q) - found.mean, expected, rtol=0.05)
        y = t.rvs(found.mean.shape, random_state=1)
        assert found.log_density(y).mean() == pytest.approx(t.logpdf(y).mean(), abs=0.01)
        np.testing.assert_allclose(sum(found.parts.values()), found.variance, rtol=1e-9)
        # The mixture that stands for a Student-t lacks the end of its tails: 5 % of the variance.
        assert found.variance.mean() == pytest.approx(nu / (nu - 2) * scale**2, rel=0.06)
        drawn = (found.samples - found.mean).var()
        assert drawn == pytest.approx(nu / (nu - 2) * scale**2, rel=0.05)
        e = fit.innovations(record.with_outputs(y))[:, 0]
        assert stats.kstest(e, "norm").pvalue > 0.01
        # Which errors over their standard deviation are not.
        errors = y - fit.predict(record.with_outputs(y)).mean
        assert kurtosis(errors[:, 0]) > 2.0 > 0.5 > abs(kurtosis(e))


def test_steps_record_is_standardised():
    """The known systems count on it: their scaled signals are those of the record."""
    scaling = dgp.Scaling.from_records(steps_record())
    np.testing.assert_allclose([scaling.output_offset[0], scaling.output_scale[0]], [0.0, 1.0],
                               atol=1e-12)  # fmt: skip
