"""A fit in ArviZ: groups, names, units, numbers that agree with the fit, and files."""

import random

import arviz as az
import numpy as np
import pyro
import pytest
import torch
import xarray as xr

import pyro_dynogp as dgp
from pyro_dynogp.criticism.inference_data import _Export, exported_draws, prior_draws
from pyro_dynogp.criticism.labelled import Variable, dataset_of, ratio_units, units_of
from tests.conftest import simulate_record
from tests.inference.cascades import FAST, wiener, wiener_record

QUICK = {"restarts": 1, "workers": 1, "progress": False}
FEW = {"samples": 7, "prior_samples": 9}
GROUPS = {
    "posterior",
    "prior",
    "posterior_predictive",
    "prior_predictive",
    "log_likelihood",
    "sample_stats",
    "observed_data",
    "constant_data",
}


@pytest.fixture(scope="module")
def exported(map_fit, record):
    return map_fit.to_arviz(future=record[160:], **FEW)


@pytest.fixture(scope="module")
def nuts_fit(one_pair):
    """A record with stamps, units and gaps; far fewer draws than anyone should use."""
    record = simulate_record(
        one_pair,
        0.1,
        n=60,
        start="2024-03-01T12:00+01:00",
        input_units="V",
        output_units="m/s",
    )
    y = record.outputs.copy()
    y[[5, 20]] = np.nan
    record = record.with_outputs(y)
    model = dgp.LinearDynamicGP(inputs=1, pairs=1)
    return dgp.fit(model, record, method="nuts", chains=2, draws=6, warmup=6, **QUICK)


@pytest.fixture(scope="module")
def nuts_data(nuts_fit):
    return nuts_fit.to_arviz(**FEW)


class TestMap:
    def test_groups(self, exported):
        future = {"predictions", "predictions_constant_data"}
        assert set(exported.groups()) == GROUPS | future

    def test_one_chain_one_draw(self, exported, map_fit):
        assert dict(exported.posterior.sizes)["chain"] == 1
        assert dict(exported.posterior.sizes)["draw"] == 1
        assert set(map_fit.draws) < set(exported.posterior)
        gain = exported.posterior["g_input_gain"]
        assert gain.dims == ("chain", "draw", "pair", "input", "term")
        assert list(gain.term.values) == ["derivative", "steady state"]
        assert gain.attrs["units"] == "scaled"

    def test_lp_is_the_log_joint(self, exported, map_fit):
        lp = exported.sample_stats["lp"].item()
        assert lp == pytest.approx(map_fit.log_joint(map_fit.records), abs=1e-9)
        assert "log_q" not in exported.sample_stats

    def test_physical_quantities_are_those_of_the_modes(self, exported, map_fit):
        at, modes = exported.posterior.isel(chain=0, draw=0), map_fit.modes
        np.testing.assert_allclose(at["g_decay_rate"], -modes.poles.real)
        np.testing.assert_allclose(at["g_frequency"], modes.poles.imag)
        np.testing.assert_allclose(at["g_time_constant"], -1.0 / modes.poles.real)
        np.testing.assert_allclose(at["measurement_noise_sd"], map_fit.noise_sd)
        held = 2.0 * (modes.C @ (modes.B / -modes.poles[:, None])).real + modes.D
        np.testing.assert_allclose(at["g_steady_state_gain"], held)
        # The prior states the gains of each pair in standard deviations.
        scaling, gain = map_fit.scaling, map_fit.mode["g_input_gain"]
        scale = scaling.output_scale[0] / scaling.input_scale[0]
        pair = {"output": 0}
        np.testing.assert_allclose(at["g_pair_derivative_gain"][pair], scale * gain[..., 0])
        np.testing.assert_allclose(at["g_pair_steady_state_gain"][pair], scale * gain[..., 1])
        assert exported.posterior["g_decay_rate"].attrs["units"] == "1/s"
        assert exported.posterior["g_frequency"].attrs["units"] == "rad/s"

    def test_log_likelihood_adds_up(self, exported, map_fit, record):
        total = exported.log_likelihood["y"].sum(("time", "output"))
        np.testing.assert_allclose(total.values[0], map_fit.log_likelihood(record[:160]))
        assert "az.loo" in exported.log_likelihood.attrs["kind"]

    def test_data_and_predictions_keep_their_own_clock(self, exported, record):
        np.testing.assert_array_equal(exported.observed_data["y"], record[:160].outputs)
        np.testing.assert_array_equal(exported.constant_data["u"], record[:160].inputs)
        assert exported.predictions["y"].dims == ("chain", "draw", "time", "output")
        assert exported.predictions["y"].shape == (1, 7, 80, 1)
        np.testing.assert_array_equal(exported.predictions.time, record[160:].time)
        np.testing.assert_array_equal(exported.predictions_constant_data["u"], record[160:].inputs)
        np.testing.assert_array_equal(exported.posterior_predictive.time, record[:160].time)
        assert exported.posterior_predictive["y"].shape == (1, 7, 160, 1)

    def test_what_was_fitted_is_written_down(self, exported, map_fit):
        for group in (exported, exported.posterior, exported.observed_data):
            assert group.attrs["method"] == "map"
            assert group.attrs["inference_library_version"] == dgp.__version__
            assert group.attrs["record_fingerprints"] == map_fit.training[0]
            assert group.attrs["model"].startswith("Model(inputs=1")

    def test_forecast_is_that_of_the_fit(self, exported, map_fit, record):
        found = map_fit.forecast(record[:160], record[160:], samples=7)
        np.testing.assert_array_equal(exported.predictions["y"][0], found.samples)

    def test_refuses(self, map_fit, record):
        with pytest.raises(ValueError, match="samples: expected a whole number >= 1"):
            map_fit.to_arviz(samples=0)
        with pytest.raises(ValueError, match="times after the end of past"):
            map_fit.to_arviz(future=record[:20])


class TestSvi:
    def test_densities_of_the_draws(self, svi_fit):
        data = svi_fit.to_arviz(**FEW)
        stats = data.sample_stats
        np.testing.assert_allclose(stats["log_q"][0], svi_fit.posterior.log_prob(svi_fit.draws))
        assert np.isfinite(stats["lp"]).all()
        assert np.isfinite(stats.attrs["pareto_k"])
        np.testing.assert_array_equal(data.constant_data["elbo"], svi_fit.elbo)
        table = az.summary(data, var_names=["g_decay_rate", "measurement_noise_sd"])
        assert table["mean"].iloc[0] == pytest.approx(
            -float(svi_fit.modes.poles.real.mean()), abs=2e-3
        )

    def test_replicates_are_spread_over_all_draws(self, svi_fit):
        thin = _Export(svi_fit, 5, 0).thinned
        kept = [
            int((svi_fit.draws["offset"] == one).nonzero()[0, 0]) for one in thin.draws["offset"]
        ]
        assert kept == [0, 10, 20, 29, 39]

    def test_state_is_left_alone(self, svi_fit):
        pyro.get_param_store().clear()
        pyro.param("mine", torch.tensor(3.0))
        numbers = np.random.get_state()[1].copy()  # noqa: NPY002
        before = torch.get_rng_state(), random.getstate()
        svi_fit.to_arviz(**FEW)
        assert torch.equal(torch.get_rng_state(), before[0])
        assert random.getstate() == before[1]
        np.testing.assert_array_equal(np.random.get_state()[1], numbers)  # noqa: NPY002
        assert list(pyro.get_param_store().keys()) == ["mine"]
        pyro.get_param_store().clear()

    def test_same_seed_same_numbers(self, svi_fit):
        one, two = (svi_fit.to_arviz(seed=3, **FEW) for _ in range(2))
        for group in one.groups():
            xr.testing.assert_identical(one[group], two[group])


class TestPrior:
    def test_follows_the_prior(self, svi_fit):
        values, system = prior_draws(svi_fit, 4000, seed=0)
        offset, log_noise = values["offset"][:, 0], values["noise_sd"][:, 0].log()
        assert float(offset.mean()) == pytest.approx(0.0, abs=5 / 4000**0.5)
        assert float(offset.std()) == pytest.approx(1.0, rel=0.06)
        assert float(log_noise.mean()) == pytest.approx(np.log(0.1), abs=5 * 1.5 / 4000**0.5)
        assert float(log_noise.std()) == pytest.approx(1.5, rel=0.06)
        np.testing.assert_allclose(system.offset[:, 0], offset)

    def test_is_not_the_posterior(self, svi_fit):
        data = svi_fit.to_arviz(**FEW)
        assert set(data.prior) == set(data.posterior)
        assert data.prior["g_log_decay"].std() > 3 * data.posterior["g_log_decay"].std()
        assert data.prior_predictive["y"].shape == (1, 9, 160, 1)

    def test_can_be_left_out(self, map_fit):
        assert "prior" not in map_fit.to_arviz(samples=2, prior_samples=0).groups()

    def test_of_flat_priors_is_left_out(self, record):
        model = dgp.LinearDynamicGP(inputs=1, pairs=1, priors="paper")
        data = dgp.fit(model, record[:100], steps=60, **QUICK, method="map").to_arviz(samples=2)
        assert "prior" not in data.groups()
        assert "flat" in data.posterior.attrs["prior"]


class TestNuts:
    def test_chains(self, nuts_fit, nuts_data):
        assert nuts_data.posterior.sizes["chain"] == 2
        assert nuts_data.posterior.sizes["draw"] == 6
        for name, value in nuts_fit.draws.items():
            flat = nuts_data.posterior[name].values.reshape(value.shape)
            np.testing.assert_array_equal(flat, value)
        assert "log_q" not in nuts_data.sample_stats
        assert nuts_data.sample_stats.attrs["divergences"] == nuts_fit.diagnostics["divergences"]
        assert np.isfinite(az.summary(nuts_data, var_names=["g_decay_rate"])["r_hat"]).all()

    def test_missing_outputs_stay_missing(self, nuts_fit, nuts_data):
        density = nuts_data.log_likelihood["y"]
        assert np.isnan(density[:, :, [5, 20]]).all()
        assert int(np.isnan(density).sum()) == 2 * 12
        assert nuts_data.log_likelihood.attrs["missing_outputs"] == 2
        total = density.sum(("time", "output")).values.reshape(-1)
        np.testing.assert_allclose(total, nuts_fit.log_likelihood(nuts_fit.records[0]))

    def test_stamps_and_units(self, nuts_data):
        assert nuts_data.observed_data.time.values[0] == np.datetime64("2024-03-01T11:00")
        assert nuts_data.observed_data["y"].attrs["units"] == "m/s"
        assert nuts_data.posterior["g_steady_state_gain"].attrs["units"] == "m/s/V"
        assert list(nuts_data.posterior["input_unit"].values) == ["V"]

    def test_survives_a_file(self, nuts_data, tmp_path):
        path = str(tmp_path / "fit.nc")
        nuts_data.to_netcdf(path)
        again = az.from_netcdf(path)
        assert again.groups() == nuts_data.groups()
        for group in again.groups():
            xr.testing.assert_equal(again[group], nuts_data[group])
            for name, variable in nuts_data[group].data_vars.items():
                assert again[group][name].attrs == variable.attrs
        assert again.attrs["model"] == nuts_data.attrs["model"]


def test_two_outputs(two_output_fit):
    data = two_output_fit.to_arviz(**FEW)
    posterior = data.posterior
    assert posterior["g_output_gain"].dims[2:] == ("output", "pair", "part")
    assert posterior["g_feedthrough"].dims[2:] == ("output", "input")
    assert posterior["g_pair_steady_state_gain"].dims[2:] == ("pair", "output", "input")
    assert list(posterior.output.values) == ["force", "speed"]
    modes = two_output_fit.modes
    held = 2.0 * (modes.C @ (modes.B / -modes.poles[:, None])).real + modes.D
    np.testing.assert_allclose(posterior["g_steady_state_gain"][0, 0], held, rtol=1e-9)
    total = data.log_likelihood["y"].sum(("time", "output")).values[0]
    np.testing.assert_allclose(total, two_output_fit.log_likelihood(two_output_fit.records))


def test_two_records(record, tmp_path):
    model = dgp.LinearDynamicGP(inputs=1, pairs=1, initial_state="site")
    fit = dgp.fit(model, [record[:90], record[90:150]], steps=60, **QUICK, method="map")
    data = fit.to_arviz(future=record[150:170], **FEW)
    assert data.observed_data["y_0"].dims == ("time_0", "output")
    assert data.observed_data.sizes["time_1"] == 60
    assert data.posterior["g_initial_state_1"].dims[2:] == ("state",)
    assert data.prior["g_initial_state_1"].shape == (1, 9, 2)
    assert data.posterior_predictive["y_1"].shape == (1, 7, 60, 1)
    both = sum(data.log_likelihood[k].sum() for k in ("y_0", "y_1"))
    assert float(both) == pytest.approx(float(fit.log_likelihood(fit.records)[0]))
    assert data.predictions.sizes["time"] == 20
    data.to_netcdf(str(tmp_path / "two.nc"))


@pytest.fixture(scope="module")
def collapsed():
    return dgp.fit(wiener(), wiener_record(), **FAST)


class TestCascades:
    def test_collapsed(self, collapsed):
        data = collapsed.to_arviz(**FEW)
        posterior = data.posterior
        assert posterior["f_values"].dims[2:] == ("output", "inducing")
        assert posterior["f_lengthscale"].dims[2:] == ("f_input",)
        assert posterior["g_initial_state"].dims[2:] == ("state",)
        assert list(posterior.f_input.values) == ["g"]
        poles = collapsed.system.layer("g").modes.poles
        np.testing.assert_allclose(posterior["g_decay_rate"][0], -poles.real)
        np.testing.assert_allclose(
            posterior["measurement_noise_sd"].mean(("chain", "draw")), collapsed.noise_sd
        )
        assert "output_offset" not in posterior
        total = data.log_likelihood["y"].sum(("time", "output")).values[0]
        np.testing.assert_allclose(total, collapsed.log_likelihood(collapsed.records))
        np.testing.assert_allclose(
            data.sample_stats["log_q"][0], collapsed.posterior.log_prob(collapsed.draws)
        )
        assert data.prior["f_values"].shape == (1, 9, 1, 6)
        assert np.isfinite(data.prior_predictive["y"]).all()

    def test_ratios_of_each_optimum_by_themselves(self, collapsed):
        draws = exported_draws(collapsed)
        optimum = collapsed.posterior.component(collapsed.draws).numpy()
        np.testing.assert_array_equal(draws.group, optimum)

    def test_trajectories_as_sites(self):
        fit = dgp.fit(wiener(), wiener_record(), **{**FAST, "guide": "gauss-markov"})
        data = fit.to_arviz(**FEW)
        assert data.posterior["g"].dims[2:] == ("time",)
        np.testing.assert_array_equal(data.posterior["g"][0], fit.trajectories["g"])
        assert "g" not in data.prior
        parameters = [v for k, v in fit.log_q_sites.items() if k not in fit.trajectories]
        np.testing.assert_allclose(data.sample_stats["log_q"][0], sum(parameters))

    def test_layers_of_one_kind_have_dimensions_of_their_own(self):
        record = wiener_record()
        model = dgp.WienerHammerstein(1, pairs=(1, 2), inducing=5)
        fit = dgp.fit(model, record, method="map", **{**FAST, "draws": None, "particles": None})
        data = fit.to_arviz(samples=2, prior_samples=2)
        posterior = data.posterior
        assert posterior["g1_decay_rate"].dims[2:] == ("g1_pair",)
        assert posterior["g2_input_gain"].dims[2:] == ("g2_pair", "g2_input", "term")
        assert list(posterior.g2_input.values) == ["f"]
        assert posterior["output_offset"].dims[2:] == ("output",)


class TestDatasets:
    def test_units_of_several_channels(self):
        assert units_of(["N", "N"]) == {"units": "N"}
        assert units_of(["N", ""]) == {"units": "N, 1"}
        assert units_of(["", ""]) == {}
        assert ratio_units(["N", "m"], ["V"]) == {"units": "N/V, m/V"}
        assert ratio_units([""], ["V"]) == {"units": "1/V"}
        assert ratio_units([""], [""]) == {}

    def test_a_variable_named_as_a_dimension(self):
        variables = {"pair": Variable(np.zeros((3, 2)), ("pair",), {})}
        with pytest.raises(ValueError, match=r"names that no dimension.*\['pair'\]"):
            dataset_of(variables, {}, {}, chains=1)

    def test_wrong_number_of_names(self):
        with pytest.raises(ValueError, match="dims of 'x': expected 3 names"):
            dataset_of({"x": Variable(np.zeros((3, 2)), (), {})}, {}, {}, chains=1)


@pytest.mark.parametrize("unit", ["h", "hours", "days"])
def test_units_of_time_are_not_taken_for_time_spans(record, unit, tmp_path):
    """CF conventions read some units of time as spans: numbers have to come back as numbers."""
    own = dgp.Record(record.time[:60], record.inputs[:60], record.outputs[:60], time_unit=unit)
    fit = dgp.fit(dgp.LinearDynamicGP(inputs=1, pairs=1), own, steps=30, **QUICK, method="map")
    data = fit.to_arviz(samples=2, prior_samples=0)
    path = str(tmp_path / "units.nc")
    data.to_netcdf(path)
    again = az.from_netcdf(path)
    assert again.posterior["g_time_constant"].attrs["units"] == unit
    xr.testing.assert_equal(again.posterior, data.posterior)
    xr.testing.assert_equal(again.observed_data, data.observed_data)
