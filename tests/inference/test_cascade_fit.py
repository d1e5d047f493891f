"""Fits of cascades: every architecture, guide and noise; what an ELBO must be; what is refused."""

import pickle
from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro.infer.autoguide import AutoNormal

import pyro_dynogp as dgp
from pyro_dynogp.guides.families import Point
from pyro_dynogp.inference.methods.trajectory_guide import layer_guide
from pyro_dynogp.inference.posteriors import Mixture
from pyro_dynogp.inference.starts.linear import linear_twin
from pyro_dynogp.inference.starts.plans import Plan, starting_point
from pyro_dynogp.inference.starts.poles import starting_values
from tests.inference.cascades import FAST, same, wiener, wiener_record

SMALL = {"pairs": 1, "inducing": 5}
ARCHITECTURES = {
    "wiener": dgp.Wiener(1, **SMALL),
    "hammerstein": dgp.Hammerstein(1, **SMALL),
    "wiener-hammerstein": dgp.WienerHammerstein(1, **SMALL),
    "hammerstein-wiener": dgp.HammersteinWiener(1, **SMALL),
}


def options_for(guide, **changes):
    """Of a fast fit: the mode without a guide, else SVI with trajectories as sites."""
    options = {**FAST, **changes}
    if guide is not None:
        return {**options, "guide": guide}
    return {k: v for k, v in options.items() if k not in ("particles", "draws")} | {"method": "map"}


def usable(fit, record):
    """A fit with finite numbers that predicts."""
    assert np.isfinite(fit.history).all()
    assert np.isfinite(fit.start_energies).all()
    assert all(bool(torch.isfinite(v).all()) for v in fit.draws.values())
    prediction = fit.predict(record)
    assert np.isfinite(prediction.mean).all()
    assert (prediction.variance > 0).all()
    return True


@pytest.mark.parametrize("name", list(ARCHITECTURES))
@pytest.mark.parametrize("guide", [None, "gauss-markov", "inducing times"])
def test_every_architecture_with_every_guide(name, guide, bent):
    fit = dgp.fit(ARCHITECTURES[name], bent[:60], **options_for(guide, steps=2))
    assert usable(fit, bent[:60])
    assert fit.method == ("map" if guide is None else "svi")
    dynamic = [one.name for one in fit.model.wires if isinstance(one.layer, dgp.Dynamic)]
    exact = dynamic[-1] == fit.model.wires[-1].name  # a last linear layer needs no guide
    sites = [] if guide is None else dynamic[: len(dynamic) - exact]
    assert [k for k in fit.trajectories if k in dynamic] == sites
    for site in sites:
        assert fit.trajectories[site].shape == (10, 60)


@pytest.mark.parametrize("hyperparameters", ["map", "normal"])
def test_hyperparameters(hyperparameters, bent):
    fit = dgp.fit(wiener(), bent[:60], guide="collapsed", hyperparameters=hyperparameters, **FAST)
    assert usable(fit, bent[:60])
    spread = {name: float((v.amax(0) - v.amin(0)).max()) for name, v in fit.draws.items()}
    still = {name for name, sd in spread.items() if sd == 0.0}
    if hyperparameters == "map":
        assert set(fit.draws) - still == {"f_values", "g_initial_state"}
        assert isinstance(fit.posterior, Mixture)
        assert set(fit.posterior.points) == still
    else:
        assert not still
        assert not fit.posterior.points
    assert set(fit.guide(bent)) == set(fit.draws)


def test_one_dynamic_layer_is_the_linear_model(record):
    """Densities of the two at the optimum, by another code path each; all sites in one normal."""
    train = record[:60]
    model = dgp.Cascade(1, (dgp.Dynamic(pairs=1),), priors="paper")
    cascade = dgp.fit(model, train, method="svi", **FAST)
    assert not cascade.posterior.points
    assert all(bool((v[0] != v[-1]).any()) for v in cascade.draws.values())
    # Flat priors: by default gains of a layer, which has unit scale, have a narrower one.
    linear = dgp.LinearDynamicGP(inputs=1, pairs=1, priors="paper").scaled_to(train)
    twin = replace(cascade, model=linear)
    assert cascade.log_joint(train) == pytest.approx(twin.log_joint(train), abs=1e-5)
    np.testing.assert_allclose(
        cascade.log_likelihood(train), twin.log_likelihood(train), rtol=1e-6, atol=1e-6
    )


class TestGuides:
    def test_a_mapping_chooses_the_family_of_a_site(self, bent):
        guide = {"g": dgp.InducingTimes(20), "f_values": dgp.guides.MeanField()}
        fit = dgp.fit(wiener(), bent[:60], guide=guide, **FAST)
        assert usable(fit, bent[:60])
        assert set(fit.trajectories) == {"g", "f"}

    def test_a_function_of_the_users(self, bent):
        """AutoDelta's job, written by hand: every site at a point, trajectories too."""

        def point(records):
            for name, shape, positive in SITES:
                constraint = dist.constraints.positive if positive else dist.constraints.real_vector
                start = torch.full(shape, 0.5 if positive else 0.01, dtype=torch.float64)
                value = pyro.param(f"{name}_at", start, constraint=constraint)
                pyro.sample(name, dist.Delta(value, event_dim=len(shape)))

        trace = pyro.poutine.trace(wiener().__call__).get_trace(bent[:40])
        SITES = [
            (n, tuple(s["value"].shape), s["fn"].support is not None and n.endswith(POSITIVE))
            for n, s in trace.nodes.items()
            if s["type"] == "sample" and not s["is_observed"]
        ]
        fit = dgp.fit(wiener(), bent[:40], guide=point, **FAST)
        assert usable(fit, bent[:40])
        assert all(torch.equal(v[0], v[-1]) for v in fit.draws.values())

    def test_an_object_with_parameters_of_its_own_is_refused(self, bent):
        """Restarts would go on from each other, and other processes cannot have it."""
        with pytest.raises(ValueError, match=r"guide: expected a Pyro function .* got AutoNormal"):
            dgp.fit(wiener(), bent[:40], guide=AutoNormal(wiener()), **FAST)

    def test_a_guide_object_is_as_it_was(self, bent):
        """Its first call fixes starts and sites: another fit, or start, must not find them."""
        guide = dgp.LayerGuide(wiener())
        one = dgp.fit(wiener(), bent[:40], guide=guide, **{**FAST, "restarts": 2, "steps": 1})
        dgp.fit(wiener(), bent[:30], guide=guide, **{**FAST, "steps": 1})
        assert one.trajectories["g"].shape == (10, 40)

    def test_a_guide_without_all_parameters_is_refused(self, bent):
        def partly(records):
            pyro.sample("noise_sd", dist.Delta(torch.full((1,), 0.1).double(), event_dim=1))

        with pytest.raises(ValueError, match="guide: expected a guide that samples every param"):
            dgp.fit(wiener(), bent[:20], guide=partly, **{**FAST, "steps": 1})


POSITIVE = ("sd", "scale", "lengthscale", "half_width")


class TestRecords:
    @pytest.mark.parametrize("guide", [None, "gauss-markov"])
    def test_several_of_unequal_length_with_gaps(self, guide):
        records = [wiener_record(n=50), wiener_record(n=30, seed=1)]
        y = records[0].outputs.copy()
        y[[3, 4, 20]] = np.nan
        records[0] = records[0].with_outputs(y)
        fit = dgp.fit(wiener(), records, **options_for(guide))
        assert len(fit.training) == 2
        assert fit.draws["g_initial_state_1"].shape[-1] == 2
        if guide is not None:
            assert fit.trajectories["g_0"].shape == (10, 50)
            assert fit.trajectories["g_1"].shape == (10, 30)
        for one in records:
            assert usable(fit, one)

    @pytest.mark.parametrize("guide", [None, "gauss-markov"])
    def test_two_outputs(self, guide, two_outputs):
        model = dgp.Wiener(2, outputs=2, pairs=1, inducing=5)
        train = two_outputs[:40]
        fit = dgp.fit(model, train, **options_for(guide, steps=2))
        assert usable(fit, train)
        assert fit.predict(train).mean.shape == (40, 2)

    @pytest.mark.parametrize("guide", [None, "gauss-markov"])
    @pytest.mark.parametrize("likelihood", [dgp.StudentT(4.0), dgp.Heteroscedastic(4)])
    def test_other_noise(self, guide, likelihood, bent):
        fit = dgp.fit(wiener(likelihood=likelihood), bent[:40], **options_for(guide, steps=2))
        assert usable(fit, bent[:40])


class TestRepeatable:
    @pytest.mark.parametrize("guide", [None, "gauss-markov"])
    def test_seed_and_processes(self, guide, bent):
        options = options_for(guide, restarts=2, steps=1)
        one = dgp.fit(wiener(), bent[:40], **options)
        workers = 1 if guide is None else 2
        assert same(one, dgp.fit(wiener(), bent[:40], **{**options, "workers": workers}))
        assert not same(one, dgp.fit(wiener(), bent[:40], seed=1, **options))

    def test_random_numbers_and_parameters_of_others_are_left_alone(self, bent):
        pyro.get_param_store().clear()
        pyro.param("mine", torch.tensor(3.0))
        state = torch.get_rng_state()
        dgp.fit(wiener(), bent[:40], guide="gauss-markov", **{**FAST, "steps": 1})
        assert torch.equal(torch.get_rng_state(), state)
        assert list(pyro.get_param_store().keys()) == ["mine"]
        pyro.get_param_store().clear()


class TestElbo:
    def test_rises(self, layered_fit):
        elbo = layered_fit.elbo
        assert len(elbo) == 75
        assert np.median(elbo[-10:]) > np.median(elbo[:10])

    def conjugate(self, record, model):
        """A guide whose pseudo-observations are the data themselves; the rest conditioned."""
        scaling = dgp.Scaling.from_records(record)
        model = model.scaled_to(record)
        linear = dgp.LinearDynamicGP(inputs=1, pairs=1, scaling=scaling)
        values = starting_values(linear, linear.prepare(record), count=1, seed=0)[0]
        values["offset"] = torch.tensor([0.2], dtype=torch.float64)
        y = (record.outputs[:, 0] - scaling.output_offset[0]) / scaling.output_scale[0]
        family = dgp.GaussMarkov(init_mean=y - 0.2, init_sd=float(values["noise_sd"][0]))
        conditioned = pyro.poutine.condition(model, data=values)
        guide = dgp.LayerGuide(conditioned, {"g": family})
        with torch.no_grad():
            trace = pyro.poutine.trace(
                pyro.poutine.condition(model.collapsed, data=values)
            ).get_trace(record)
        trace.compute_log_prob()
        return conditioned, guide, float(trace.nodes["y"]["log_prob"])

    def test_conjugate_guide_is_exact_in_every_particle(self, record):
        """With one linear layer the posterior is in the family: no particle differs."""
        model, guide, exact = self.conjugate(
            record[:80], dgp.Cascade(1, (dgp.Dynamic(pairs=1),), initial_state="integrated")
        )
        with pyro.get_param_store().scope(), torch.no_grad():
            for seed in range(3):
                torch.manual_seed(seed)
                drawn = pyro.poutine.trace(guide).get_trace(record[:80])
                played = pyro.poutine.trace(pyro.poutine.replay(model, drawn))
                joint = played.get_trace(record[:80])
                joint.compute_log_prob()
                log_p = joint.nodes["g"]["log_prob"] + joint.nodes["y"]["log_prob"]
                drawn.compute_log_prob()
                particle = float(log_p - drawn.nodes["g"]["log_prob"])
                # The jitter of the prior of a trajectory, 1e-9 of its variance or so, remains.
                assert particle == pytest.approx(exact, abs=1e-6 * abs(exact) + 1e-4)

    def test_a_trained_guide_comes_within_nats_of_the_evidence(self, record):
        """By `fit` itself, all parameters at a point: the ELBO is log p(y, point) less the KL."""
        train = record[:40]
        model = dgp.Cascade(1, (dgp.Dynamic(pairs=1),))
        scaled = model.scaled_to(train)
        twin = dgp.LinearDynamicGP(inputs=1, pairs=1, scaling=scaled.scaling)
        optimum = dgp.fit(twin, train, restarts=1, workers=1, progress=False, method="map")
        values = {k: v.clone() for k, v in optimum.mode.items()}
        y = (train.outputs[:, 0] - scaled.scaling.output_offset[0]) / scaled.scaling.output_scale[0]
        guide = dgp.LayerGuide(
            scaled,
            {"g": dgp.GaussMarkov(init_mean=y - float(values["offset"][0]), init_sd=0.3)},
            default=Point(),
            values=values,
        )
        fit = dgp.fit(model, train, guide=guide,
                      **{**FAST, "steps": 150, "learning_rate": 0.08})  # fmt: skip
        exact = fit.log_joint(train)
        gap = exact - fit.elbo[-30:].mean()
        assert -1.0 < gap < 4.0  # nats; at the start it is some hundred
        assert exact - fit.elbo[:5].mean() > 2 * max(gap, 1.0)


class TestStarts:
    def test_a_straight_start_is_the_linear_fit(self, bent):
        """The same model but for the band of the static function about its straight line.

        Whitened values solve with a ridge of 0.001 and the prior pulls the line back between
        inducing points; that costs a per cent or so of the output's standard deviation, to be seen
        against noise of five per cent: some nats in a hundred samples.
        """
        model = dgp.Wiener(1, pairs=1, inducing=20).scaled_to(bent)
        layer = model.wires[0].layer
        twin = linear_twin(model, layer, model.scaling)
        optimum = dgp.fit(twin, bent, restarts=1, workers=1, progress=False, method="map")
        plan = Plan("g", dict(optimum.mode), False, 0)
        start = starting_point(model, model.prepare(bent), plan)
        condition = pyro.poutine.condition(model.collapsed, data=start)
        with torch.no_grad():
            trace = pyro.poutine.trace(condition).get_trace(bent)
        trace.compute_log_prob()
        straight = float(trace.nodes["y"]["log_prob"])
        exact = float(optimum.log_likelihood(bent)[0])
        # Knowing the first state (a site) instead of integrating it adds a few nats too.
        assert straight == pytest.approx(exact, abs=0.15 * len(bent))
        unset = pyro.poutine.trace(model.collapsed).get_trace(bent)
        sites = {
            n for n, s in unset.nodes.items() if s["type"] == "sample" and not s["is_observed"]
        }
        assert set(start) == sites


class TestErrors:
    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"guide": "mean-field"}, "guide: expected 'collapsed', one of"),
            ({"guide": "gauss-markov", "method": "map"}, "method: expected 'svi' with this guide"),
            ({"method": "laplace"}, "method: expected 'importance', 'map', 'svi' or 'nuts'"),
            (
                {"hyperparameters": "exact"},
                "expected 'map', 'normal' or 'multivariate",
            ),
            ({"restarts": 0}, "restarts: expected a whole number >= 1"),
            ({"steps": 0}, "steps: expected a whole number >= 1"),
            ({"particles": 0}, "particles: expected a whole number >= 1"),
        ],
    )
    def test_options(self, options, message, bent):
        with pytest.raises(ValueError, match=message):
            dgp.fit(wiener(), bent, **{**FAST, **options})

    def test_a_linear_model_takes_no_guide(self, record):
        model = dgp.LinearDynamicGP(inputs=1, pairs=1)
        with pytest.raises(ValueError, match="guide: expected None for a linear model"):
            dgp.fit(model, record, guide="gauss-markov", progress=False)

    def test_a_family_for_a_site_that_is_not_there(self, bent):
        with pytest.raises(ValueError, match="families: expected names of latent sites"):
            dgp.fit(wiener(), bent[:20], guide={"h": dgp.GaussMarkov()}, **{**FAST, "steps": 1})

    def test_a_name_is_checked_before_any_work(self, bent):
        with pytest.raises(ValueError, match="guide"):
            layer_guide(wiener(), "nothing", {}, 10)

    def test_point_estimates_of_a_cascade_without_static_layers(self, record):
        model = dgp.Cascade(1, (dgp.Dynamic(pairs=1),))
        with pytest.raises(ValueError, match="hyperparameters: expected 'normal' or"):
            dgp.fit(model, record[:40], method="svi", hyperparameters="map",
                    **{**FAST, "steps": 1})  # fmt: skip


def test_divergence_names_parameters_and_keeps_the_last_good_ones(bent):
    with pytest.raises(dgp.TrainingDivergedError, match="SVI diverged at step") as caught:
        dgp.fit(wiener(), bent[:40], guide="gauss-markov",
                **{**FAST, "steps": 40, "learning_rate": 1e6})  # fmt: skip
    error = caught.value
    assert isinstance(error, ValueError)
    assert error.step >= 1
    assert len(error.elbo) <= error.step
    assert "g.pseudo_outputs" in error.parameters
    assert all(bool(torch.isfinite(p).all()) for p in error.parameters.values())
    assert "learning_rate" in str(error)
    assert error.sites
    assert "dynamic layer g" in str(error)
    again = pickle.loads(pickle.dumps(error))  # it may come from another process
    assert (str(again), again.sites) == (str(error), error.sites)


def test_a_warm_start_goes_on_from_another_fit(bent):
    model = dgp.Wiener(1, **SMALL)
    options = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
    long = dgp.fit(model, bent[:80], steps=150, **options)
    warm = dgp.fit(model, bent[:80], steps=2, start=long, **options)
    cold = dgp.fit(model, bent[:80], steps=2, **options)
    assert warm.start_energies[0] <= long.start_energies[0] + 1e-6
    assert warm.start_energies[0] < cold.start_energies[0]
