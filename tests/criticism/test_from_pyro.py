"""Any Pyro model: draws and densities from a guide, from MCMC, from tensors; what is refused."""

import random

import arviz as az
import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
import xarray as xr
from pyro.infer import MCMC, NUTS, SVI, Trace_ELBO
from pyro.infer.autoguide import AutoDelta, AutoNormal
from scipy.stats import norm

import pyro_dynogp as dgp
from pyro_dynogp.criticism.densities import pointwise_log_density
from pyro_dynogp.criticism.from_pyro import from_pyro
from pyro_dynogp.distributions.process import ObservedLTIProcess
from pyro_dynogp.inference.log_joint import log_joint_of
from tests.distributions import models

U, Y = models.inputs(), models.data()
GAPS = Y.clone()
GAPS[[3, 7]] = torch.nan
LOC = {"decay": -0.2, "gain": 0.4, "noise": -0.6, "sigma": -0.8}
SD = 0.1


def guide(u, y=None):
    """Independent log-normals by hand, one through an auxiliary site."""
    for name in ("decay", "noise", "sigma"):
        shape = torch.full((2,) if name == "decay" else (), LOC[name], dtype=torch.float64)
        pyro.sample(name, dist.LogNormal(shape, SD).to_event(shape.dim()))
    loc = pyro.param("gain_loc", torch.full((2,), LOC["gain"], dtype=torch.float64))
    raw = pyro.sample("raw", dist.Normal(loc, SD).to_event(1), infer={"is_auxiliary": True})
    pyro.sample("gain", dist.Delta(raw, event_dim=1))


@pytest.fixture(autouse=True)
def _clean_store():
    pyro.clear_param_store()
    yield
    pyro.clear_param_store()


def outliers(count, y=None):
    """Student-t samples around a level, in a plate: nothing dynamic."""
    level = pyro.sample("level", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 3.0))
    pyro.deterministic("double", 2.0 * level)
    with pyro.plate("samples", count):
        return pyro.sample("y", dist.StudentT(4.0, level, 0.5), obs=y)


def two_records_of_a_trajectory(u, y):
    """One system, latent trajectories, heavy tails."""
    modes = models.sample_system()
    sigma = models.sample_sigma()
    with pyro.plate("records", len(u), dim=-1):
        g = pyro.sample("g", dgp.LTIProcess(modes, models.TIME, u, jitter=1e-6))
        pyro.sample("y", dist.StudentT(4.0, g, sigma).to_event(1), obs=y)


def level_draws(count=30, chains=None):
    shape = (count,) if chains is None else (chains, count)
    return torch.as_tensor(np.random.default_rng(5).normal(0.3, 0.1, shape))


LEVEL_DATA = torch.as_tensor(np.random.default_rng(6).normal(0.3, 0.5, 9))


class TestGuide:
    def test_log_q_is_that_of_the_guide(self):
        found = from_pyro(models.observed, guide, U, GAPS, draws=12)
        values = {k: v.numpy() for k, v in found.draws.values.items()}
        assert set(values) == set(LOC)
        expected = norm.logpdf(values["gain"], LOC["gain"], SD).sum(1)
        for name in ("decay", "noise", "sigma"):
            density = norm.logpdf(np.log(values[name]), LOC[name], SD) - np.log(values[name])
            expected += density.reshape(12, -1).sum(1)
        np.testing.assert_allclose(found.draws.log_q, expected, rtol=1e-12)

    def test_log_p_is_that_of_the_model_in_one_batch(self):
        found = from_pyro(models.observed, guide, U, GAPS, draws=12)
        log_p = log_joint_of(models.observed, (U, GAPS), found.draws.values)
        np.testing.assert_allclose(found.draws.log_p, log_p, rtol=1e-10)

    def test_densities_are_those_of_the_integrated_site(self):
        found = from_pyro(models.observed, guide, U, GAPS, draws=5)
        assert all(isinstance(one, ObservedLTIProcess) for one in found.sites["y"])
        for kind, horizon in (("missing sample", 1), ("forecast", 1), ("forecast", 3)):
            got = found.pointwise(kind, horizon)
            assert got.shape == (5, models.N - 2)
            for one, site in zip(got, found.sites["y"], strict=True):
                own = pointwise_log_density(site, GAPS, kind, horizon=horizon)[0, :, 0]
                np.testing.assert_array_equal(one, own[~np.isnan(own)])
        total = [float(site.log_prob(GAPS)) for site in found.sites["y"]]
        np.testing.assert_allclose(found.pointwise("forecast").sum(1), total)

    def test_places(self):
        found = from_pyro(models.observed, guide, U, GAPS, draws=2)
        there = [k for k in range(models.N) if k not in (3, 7)]
        np.testing.assert_array_equal(found.places["sample"], there)
        assert not found.places["record"].any()
        assert not found.places["output"].any()
        assert found.data != from_pyro(models.observed, guide, U, Y, draws=2).data

    def test_leaves_no_trace(self):
        pyro.param("mine", torch.tensor(3.0))
        before = torch.get_rng_state(), random.getstate()
        numbers = np.random.get_state()[1].copy()  # noqa: NPY002
        from_pyro(models.observed, guide, U, Y, draws=3).to_arviz()
        assert torch.equal(torch.get_rng_state(), before[0])
        assert random.getstate() == before[1]
        np.testing.assert_array_equal(np.random.get_state()[1], numbers)  # noqa: NPY002
        assert list(pyro.get_param_store().keys()) == ["mine"]  # not the guide's either
        assert pyro.param("mine").item() == 3.0

    def test_same_seed_same_draws(self):
        one, two, other = (
            from_pyro(models.observed, guide, U, Y, draws=3, seed=seed) for seed in (1, 1, 2)
        )
        assert torch.equal(one.draws.values["gain"], two.draws.values["gain"])
        assert not torch.equal(one.draws.values["gain"], other.draws.values["gain"])

    def test_trained_autonormal(self):
        pyro.set_rng_seed(0)
        automatic = AutoNormal(models.observed, init_scale=0.05)
        optimiser = pyro.optim.ClippedAdam({"lr": 0.05})
        svi = SVI(models.observed, automatic, optimiser, Trace_ELBO())
        for _ in range(20):
            svi.step(U, Y)
        before = {k: v.clone() for k, v in pyro.get_param_store().items()}
        found = from_pyro(models.observed, automatic, U, Y, draws=40)
        assert {k for k, v in pyro.get_param_store().items() if torch.equal(v, before[k])} == set(
            before
        )
        loc, scale = (x.detach() for x in automatic._get_loc_and_scale("gain"))
        assert bool(((found.draws.values["gain"] - loc).abs() < 6 * scale).all())
        sites = {}
        for name in LOC:
            loc, scale = (x.detach().numpy() for x in automatic._get_loc_and_scale(name))
            value = found.draws.values[name].numpy()
            plain = value if name == "gain" else np.log(value)
            density = norm.logpdf(plain, loc, scale) - (0 if name == "gain" else plain)
            sites[name] = density.reshape(40, -1).sum(1)
        np.testing.assert_allclose(found.draws.log_q, sum(sites.values()))
        assert np.isfinite(found.to_arviz().sample_stats.attrs["pareto_k"])

    def test_a_point_estimate_has_no_density(self):
        automatic = AutoDelta(models.observed)
        automatic(U, Y)
        found = from_pyro(models.observed, automatic, U, Y, draws=30)
        assert found.draws.log_q is None
        assert found.draws.kind == "point estimate"
        assert "pareto_k" not in found.to_arviz().sample_stats.attrs

    def test_posterior_of_a_fit_of_this_package(self, svi_fit, record):
        found = from_pyro(svi_fit.model, svi_fit.guide, record[:160], draws=30)
        expected = svi_fit.posterior.log_prob(found.draws.values)
        np.testing.assert_allclose(found.draws.log_q, expected, rtol=1e-9)
        again = from_pyro(svi_fit.model, dict(svi_fit.draws), record[:160])
        np.testing.assert_allclose(
            again.pointwise("forecast").sum(1), svi_fit.log_likelihood(record[:160])
        )


class TestDraws:
    def test_flat_and_by_chain(self):
        flat = from_pyro(outliers, {"level": level_draws()}, 9, LEVEL_DATA)
        chains = from_pyro(outliers, {"level": level_draws().reshape(3, 10)}, 9, LEVEL_DATA)
        assert flat.chains == 1
        assert chains.chains == 3
        np.testing.assert_array_equal(flat.draws.log_p, chains.draws.log_p)
        posterior = chains.to_arviz().posterior
        assert posterior["level"].shape == (3, 10)
        np.testing.assert_array_equal(posterior["double"], 2.0 * posterior["level"])

    def test_mcmc(self):
        pyro.set_rng_seed(0)
        mcmc = MCMC(NUTS(outliers), num_samples=8, warmup_steps=8, disable_progbar=True)
        mcmc.run(9, LEVEL_DATA)
        found = from_pyro(outliers, mcmc, 9, LEVEL_DATA)
        assert torch.equal(found.draws.values["level"], mcmc.get_samples()["level"])
        assert found.draws.log_q is None
        data = found.to_arviz()
        assert "log_q" not in data.sample_stats
        assert len(az.summary(data, var_names=["level"])) == 1

    def test_samples_that_are_independent_given_the_draw(self):
        level = level_draws()
        found = from_pyro(outliers, {"level": level}, 9, LEVEL_DATA)
        own = dist.StudentT(4.0, level.unsqueeze(1), 0.5).log_prob(LEVEL_DATA)
        for kind in ("missing sample", "forecast"):
            np.testing.assert_allclose(found.pointwise(kind), own)
        np.testing.assert_allclose(found.to_arviz().log_likelihood["y"][0], own)

    def test_elements_of_an_event_and_masks(self):
        keep = torch.tensor([True, True, False, True])

        def model(y):
            level = pyro.sample("level", dist.Normal(torch.tensor(0.0).double(), 1.0))
            pyro.factor("more", -level.square())
            with pyro.poutine.mask(mask=keep):
                pyro.sample("masked", dist.Normal(level.expand(4), 1.0), obs=y)
            pyro.sample("inner", dist.Normal(level.expand(4), 1.0).mask(keep).to_event(1), obs=y)
            pyro.sample("joint", dist.MultivariateNormal(level * y, torch.eye(4).double()), obs=y)

        y = torch.arange(4.0).double()
        found = from_pyro(model, {"level": level_draws(3)}, y)
        assert list(found.observed) == ["masked", "inner", "joint"]
        densities = found.pointwise("missing sample")
        assert densities.shape == (3, 3 + 3 + 1)
        one = norm.logpdf(y, found.draws.values["level"].numpy()[:, None])[:, keep]
        np.testing.assert_allclose(densities[:, :3], one)
        np.testing.assert_allclose(densities[:, 3:6], one)
        np.testing.assert_array_equal(found.places["record"], [0, 0, 0, 1, 1, 1, 2])
        np.testing.assert_array_equal(found.places["sample"], [0, 1, 3, 0, 1, 3, 0])
        prior = norm.logpdf(found.draws.values["level"])
        more = -(found.draws.values["level"].numpy() ** 2)
        np.testing.assert_allclose(found.draws.log_p, prior + more + densities.sum(1))

    def test_data_given_by_name(self):
        draws = {"level": level_draws()}
        found = from_pyro(outliers, draws, 9, observed={"y": LEVEL_DATA})
        expected = from_pyro(outliers, draws, 9, LEVEL_DATA)
        np.testing.assert_array_equal(found.draws.log_p, expected.draws.log_p)


def test_records_in_a_plate():
    u, y = models.inputs(3), models.data(3)
    y[1, 4] = torch.nan
    found = from_pyro(models.observed_records, guide, u, y, draws=3)
    densities = found.pointwise("forecast")
    assert densities.shape == (3, 3 * models.N - 1)
    total = [float(site.log_prob(y).sum()) for site in found.sites["y"]]
    np.testing.assert_allclose(densities.sum(1), total)
    np.testing.assert_array_equal(np.bincount(found.places["record"]), [12, 11, 12])
    data = found.to_arviz()
    assert data.log_likelihood["y"].shape == (1, 3, 3, models.N)
    np.testing.assert_allclose(np.nansum(data.log_likelihood["y"][0], (1, 2)), total)


class TestLatentTrajectory:
    @pytest.fixture
    def found(self):
        u, y = models.inputs(2), models.data(2)

        def own(u, y):
            guide(u)
            with pyro.plate("records", 2, dim=-1):
                pyro.sample("g", dist.Normal(y, 0.1).to_event(1))

        return from_pyro(two_records_of_a_trajectory, own, u, y, draws=4)

    def test_densities_are_refused(self, found):
        assert found.trajectories == ("g",)
        with pytest.raises(ValueError, match="trajectories are integrated out"):
            found.pointwise("missing sample")

    def test_export_says_what_they_are_given(self, found):
        data = found.to_arviz()
        assert "fitted to the data" in data.log_likelihood["y"].attrs["kind"]
        assert data.posterior["g"].shape == (1, 4, 2, models.N)
        assert data.posterior_predictive["y"].shape == (1, 4, 2, models.N)

    def test_before_an_integrated_one_too(self):
        def model(u, y):
            modes = models.sample_system()
            g = pyro.sample("g", dgp.LTIProcess(modes, models.TIME, u, jitter=1e-6))
            after = dgp.LTIProcess(modes, models.TIME, g.unsqueeze(-1))
            pyro.sample("y", after.observed(models.sample_sigma()), obs=y)

        def own(u, y):
            guide(u)
            pyro.sample("g", dist.Normal(y, 0.1).to_event(1))

        found = from_pyro(model, own, U, Y, draws=2)
        with pytest.raises(ValueError, match=r"latent trajectories \['g'\]"):
            found.pointwise("forecast")


class TestExport:
    def test_names_units_and_file(self, tmp_path):
        found = from_pyro(
            models.observed,
            guide,
            U,
            GAPS,
            draws=30,
            coords={"time": models.TIME, "pair": ["slow", "fast"]},
            dims={"y": ["time"], "decay": ["pair"]},
            units={"y": "m", "decay": "1/s"},
        )
        data = found.to_arviz()
        assert set(data.groups()) == {
            "posterior",
            "posterior_predictive",
            "log_likelihood",
            "sample_stats",
            "observed_data",
        }
        assert data.posterior["decay"].dims == ("chain", "draw", "pair")
        assert list(data.posterior.pair.values) == ["slow", "fast"]
        assert data.posterior["gain"].dims[2:] == ("gain_dim_0",)
        assert data.posterior["decay"].attrs == {"units": "1/s"}
        assert data.posterior_predictive["y"].dims == ("chain", "draw", "time")
        np.testing.assert_array_equal(data.observed_data.time, models.TIME)
        np.testing.assert_array_equal(
            np.isnan(data.log_likelihood["y"][0, 0]), np.isnan(GAPS.numpy())
        )
        assert "az.loo" in data.log_likelihood["y"].attrs["kind"]
        np.testing.assert_array_equal(data.sample_stats["lp"][0], found.draws.log_p)
        path = str(tmp_path / "own.nc")
        data.to_netcdf(path)
        again = az.from_netcdf(path)
        for group in data.groups():
            xr.testing.assert_equal(again[group], data[group])

    def test_wrong_dims(self):
        found = from_pyro(models.observed, guide, U, Y, draws=2, dims={"y": ["time", "output"]})
        with pytest.raises(ValueError, match="dims of 'y': expected 3 names"):
            found.to_arviz()


class TestRefusals:
    def test_subsampled_plate(self):
        def model(y):
            level = pyro.sample("level", dist.Normal(torch.tensor(0.0).double(), 1.0))
            with pyro.plate("samples", 9, subsample_size=3) as index:
                pyro.sample("y", dist.Normal(level, 1.0), obs=y[index])

        with pytest.raises(ValueError, match="3 of 9 in the plate 'samples' of site 'y'"):
            from_pyro(model, {"level": level_draws()}, LEVEL_DATA)

    def test_sites_that_do_not_match(self):
        with pytest.raises(ValueError, match=r"every latent site, \['noise', 'sigma'\] too"):
            from_pyro(
                models.observed, {k: torch.ones(4, 2).double() for k in ("decay", "gain")}, U, Y
            )
        wrong = {"level": level_draws(), "y": LEVEL_DATA.expand(30, 9)}
        with pytest.raises(ValueError, match=r"got \['y'\] too"):
            from_pyro(outliers, wrong, 9, LEVEL_DATA)

    def test_numbers_of_draws(self):
        draws = {name: torch.ones(4, dtype=torch.float64) for name in LOC}
        with pytest.raises(ValueError, match="as many for each site"):
            from_pyro(models.observed, draws, U, Y)
        with pytest.raises(ValueError, match="at least one draw"):
            from_pyro(outliers, {"level": level_draws(0)}, 9, LEVEL_DATA)
        with pytest.raises(ValueError, match="draws: expected a whole number >= 1"):
            from_pyro(models.observed, guide, U, Y, draws=0)

    def test_nothing_observed(self):
        def model():
            pyro.sample("level", dist.Normal(torch.tensor(0.0).double(), 1.0))

        with pytest.raises(ValueError, match="model: expected an observed site"):
            from_pyro(model, {"level": level_draws()})
        with pytest.raises(ValueError, match="call the model with its data"):
            from_pyro(models.observed, guide, U, draws=2)

    def test_a_posterior_of_another_kind(self):
        with pytest.raises(ValueError, match="a guide, a mapping of draws by site"):
            from_pyro(models.observed, 3.0, U, Y)

    def test_unknown_kind(self):
        found = from_pyro(outliers, {"level": level_draws()}, 9, LEVEL_DATA)
        with pytest.raises(ValueError, match="kind: expected one of"):
            found.pointwise("loo")
        with pytest.raises(ValueError, match="horizon"):
            found.pointwise("forecast", 0)

    def test_masked_trajectory(self):
        def model(u, y):
            modes = models.sample_system()
            site = dgp.LTIProcess(modes, models.TIME, u).observed(models.sample_sigma())
            pyro.sample("y", site.mask(torch.tensor(True)), obs=y)

        with pytest.raises(ValueError, match="Mark missing samples by NaN"):
            from_pyro(model, guide, U, Y, draws=2)

    def test_refits(self):
        found = from_pyro(outliers, {"level": level_draws()}, 9, LEVEL_DATA)
        with pytest.raises(ValueError, match="one without refits"):
            found.without(np.zeros(9, dtype=bool))
        with pytest.raises(ValueError, match="one without refits"):
            found.fresh(0, 0, 3)


def test_data_that_depend_on_a_latent_site_are_refused():
    y = torch.linspace(2.0, 4.0, 20, dtype=torch.float64)

    def model():
        level = pyro.sample("level", dist.Normal(torch.tensor(0.0).double(), 5.0))
        pyro.sample("y", dist.Normal(torch.zeros(20).double(), 1.0).to_event(1), obs=y - level)

    with pytest.raises(ValueError, match="site 'y': expected data that are the same for every"):
        from_pyro(model, {"level": torch.tensor([0.0, 3.0, 5.0], dtype=torch.float64)})
