"""One call that fits: MAP, SVI, NUTS; seeds, processes, errors, what it leaves behind."""

import numpy as np
import pyro
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.mode import best_optima
from pyro_dynogp.inference.run import Run
from tests.conftest import simulate_record


def same(a, b):
    return all(torch.equal(a.draws[name], b.draws[name]) for name in a.draws)


class TestMap:
    def test_recovers_the_system(self, one_pair):
        record = simulate_record(one_pair, 0.05, n=1200, seed=5)
        fit = dgp.fit(
            dgp.LinearDynamicGP(inputs=1, pairs=1),
            record,
            restarts=3,
            workers=1,
            progress=False,
            method="map",
        )
        pole = complex(fit.modes.poles[0])
        assert abs(pole - (-0.5 + 2.0j)) < 0.08
        assert fit.noise_sd[0] == pytest.approx(0.05, rel=0.15)
        np.testing.assert_allclose(
            complex((fit.modes.C[0] * fit.modes.B[:, 0])[0]), 1.0 + 0.3j, atol=0.08
        )

    def test_is_a_stationary_point(self, map_fit, record):
        from pyro_dynogp.inference.density import Potential

        function = Potential(map_fit.model, (record[:160],), dict(map_fit.mode))
        energy, slope = function.value_and_gradient(function.pack(map_fit.mode).numpy())
        assert energy == pytest.approx(map_fit.start_energies[0])
        assert np.abs(slope).max() < 0.5

    def test_history_falls_to_the_best_start(self, map_fit):
        assert map_fit.history[-1] == pytest.approx(map_fit.start_energies[0], abs=1e-6)
        assert map_fit.history[0] > map_fit.history[-1]
        assert (np.diff(map_fit.start_energies) >= 0).all()

    def test_adam_reaches_the_same_optimum(self, map_fit, record):
        adam = dgp.fit(
            dgp.LinearDynamicGP(inputs=1, pairs=1),
            record[:160],
            optimizer="adam",
            restarts=1,
            steps=600,
            workers=1,
            progress=False,
            method="map",
        )
        assert adam.start_energies[0] == pytest.approx(map_fit.start_energies[0], abs=0.5)

    def test_same_seed_same_bits_here_and_in_processes(self, record, map_fit):
        model = dgp.LinearDynamicGP(inputs=1, pairs=1)
        options = {"restarts": 2, "progress": False, "method": "map"}
        assert same(map_fit, dgp.fit(model, record[:160], workers=1, **options))
        assert same(map_fit, dgp.fit(model, record[:160], workers=2, **options))

    def test_global_random_state_and_parameter_store_are_left_alone(self, record):
        pyro.get_param_store().clear()
        pyro.param("mine", torch.tensor(3.0))
        torch.manual_seed(7)
        before = torch.rand(3)
        torch.manual_seed(7)
        dgp.fit(
            dgp.LinearDynamicGP(inputs=1, pairs=1),
            record[:80],
            method="svi",
            restarts=1,
            steps=20,
            workers=1,
            progress=False,
        )
        assert torch.equal(torch.rand(3), before)
        assert list(pyro.get_param_store().keys()) == ["mine"]
        assert pyro.param("mine").item() == 3.0
        pyro.get_param_store().clear()

    def test_two_models_in_one_process_do_not_meet(self, record, one_pair, svi_fit):
        other = simulate_record(
            dgp.Modes([-2.0 + 0.5j], [[3.0]], [1.0], [[0.1]]), 0.3, n=120, seed=9
        )
        model = dgp.LinearDynamicGP(inputs=1, pairs=1)
        options = {"method": "svi", "restarts": 2, "steps": 60, "draws": 40}
        second = dgp.fit(model, other, workers=1, progress=False, **options)
        again = dgp.fit(model, record[:160], workers=1, progress=False, **options)
        assert same(again, svi_fit)
        assert not same(again, second)


@pytest.mark.parametrize("initial_state", ["integrated", "zero", "site"])
@pytest.mark.parametrize("priors", ["default", "paper"])
@pytest.mark.parametrize("noise", ["shared", "independent"])
def test_every_variant_of_the_model_can_be_fitted(record, initial_state, priors, noise):
    model = dgp.LinearDynamicGP(
        inputs=1, pairs=2, initial_state=initial_state, priors=priors, noise=noise
    )
    fit = dgp.fit(
        model, record[:160], restarts=1, steps=60, workers=1, progress=False, method="map"
    )
    test = dgp.scores(fit.forecast(record[:160], record[160:]), record[160:])
    assert test["nrmse"] < 0.6
    assert fit.noise_sd[0] == pytest.approx(0.1, rel=0.5)


def test_scaling_is_learnt_from_the_training_record_alone(map_fit, record):
    """The paper's electricity run standardises with the test period too; ours must not."""
    train = record[:160]
    assert map_fit.scaling.output_offset[0] == train.outputs.mean()
    assert map_fit.scaling.output_scale[0] == train.outputs.std()
    assert abs(record.outputs.mean() - train.outputs.mean()) > 1e-3  # the printed way differs
    before = map_fit.scaling
    map_fit.forecast(train, record[160:])
    assert map_fit.scaling == before


class TestSeveralRecords:
    def test_more_records_pin_the_pole_down(self, one_pair):
        records = [simulate_record(one_pair, 0.1, n=150, seed=s) for s in range(3)]
        model = dgp.LinearDynamicGP(inputs=1, pairs=1)
        fit = dgp.fit(model, [records[0], records[1][:90], records[2]], restarts=2, workers=1,
                      progress=False, method="map")  # fmt: skip
        assert abs(complex(fit.modes.poles[0]) - (-0.5 + 2.0j)) < 0.15
        assert len(fit.training) == 3

    @pytest.mark.parametrize("initial_state", ["integrated", "site"])
    def test_a_sequence_of_one_record_is_that_record(self, record, initial_state):
        model = dgp.LinearDynamicGP(inputs=1, pairs=1, initial_state=initial_state)
        options = {"restarts": 1, "steps": 20, "workers": 1, "progress": False, "method": "map"}
        assert same(
            dgp.fit(model, [record[:80]], **options),
            dgp.fit(model, record[:80], **options),
        )

    def test_missing_outputs_are_integrated_out(self, one_pair):
        record = simulate_record(one_pair, 0.05, n=600, seed=5)
        holes = record.outputs.copy()
        holes[np.random.default_rng(0).random(600) < 0.3] = np.nan
        fit = dgp.fit(
            dgp.LinearDynamicGP(inputs=1, pairs=1),
            record.with_outputs(holes),
            restarts=2,
            workers=1,
            progress=False,
            method="map",
        )
        assert abs(complex(fit.modes.poles[0]) - (-0.5 + 2.0j)) < 0.1


class TestVariational:
    def test_elbo_bounds_and_nears_the_evidence(self, svi_fit, record):
        """Importance sampling with the guide gives the evidence; the ELBO must be just below."""
        train = record[:160]
        model, guide = svi_fit.model, svi_fit.guide
        torch.manual_seed(0)
        with torch.no_grad(), pyro.plate("draws", 400, dim=-1):
            drawn = pyro.poutine.trace(guide).get_trace(train)
            replayed = pyro.poutine.trace(pyro.poutine.replay(model, drawn)).get_trace(train)
        drawn.compute_log_prob()
        replayed.compute_log_prob()
        log_q = sum(n["log_prob"] for n in drawn.nodes.values() if n["type"] == "sample")
        log_p = sum(n["log_prob"] for n in replayed.nodes.values() if n["type"] == "sample")
        ratios = log_p - log_q
        evidence = float(torch.logsumexp(ratios, 0)) - np.log(400)
        elbo = float(ratios.mean())
        assert elbo == pytest.approx(svi_fit.diagnostics["elbo"], abs=0.5)
        assert 0.0 < evidence - elbo < 1.0

    def test_posterior_is_about_the_mode(self, svi_fit, map_fit):
        decay = svi_fit.draws["g_log_decay"]
        assert abs(float(decay.mean() - map_fit.mode["g_log_decay"])) < 3 * float(decay.std())
        assert svi_fit.modes.batch_shape == (40,)

    def test_history_is_the_elbo(self, svi_fit):
        assert svi_fit.history[-50:].mean() == pytest.approx(svi_fit.diagnostics["elbo"])


def test_nuts_one_pair_of_300_samples(one_pair):
    """The sampler mixes, and SVI's posterior agrees with it; long chains are in `reference`."""
    record = simulate_record(one_pair, 0.1, n=300, seed=2)
    model = dgp.LinearDynamicGP(inputs=1, pairs=1)
    options = {"restarts": 2, "progress": False, "workers": 1}
    nuts = dgp.fit(model, record, method="nuts", chains=2, draws=80, warmup=50, seed=1, **options)
    r_hat = {k: v for k, v in nuts.diagnostics.items() if k.startswith("r_hat")}
    assert len(r_hat) == 8
    # Of two chains of 80 draws of the same distribution it is below 1.05 nearly always.
    assert max(r_hat.values()) < 1.05, r_hat
    assert nuts.diagnostics["divergences"] <= 2
    assert nuts.draws["noise_sd"].shape == (160, 1)
    svi = dgp.fit(model, record, method="svi", steps=400, draws=400, **options)
    for name in ("g_log_decay", "g_log_frequency", "g_input_gain", "noise_sd"):
        exact, approximate = nuts.draws[name], svi.draws[name]
        shift = (approximate.mean(0) - exact.mean(0)).abs() / exact.std(0)
        assert float(shift.max()) < 0.35, name
        ratio = approximate.std(0) / exact.std(0)
        assert float(ratio.min()) > 0.6, name
        assert float(ratio.max()) < 1.5, name


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "mcmc"}, "method: expected 'importance', 'map', 'svi' or 'nuts'"),
        (
            {"optimizer": "sgd"},
            "optimizer: expected 'gauss-newton', 'lbfgs', 'preconditioned' or 'adam'",
        ),
        ({"restarts": 0}, "restarts: expected a whole number >= 1"),
        ({"chains": 0, "method": "nuts"}, "chains"),
        ({"workers": 0}, "workers"),
    ],
)
def test_bad_options(record, options, message):
    with pytest.raises(ValueError, match=message):
        dgp.fit(dgp.LinearDynamicGP(inputs=1, pairs=1), record, progress=False, **options)


def test_bad_records():
    time, u = np.arange(20.0), np.sin(np.arange(20.0))
    model = dgp.LinearDynamicGP(inputs=1, pairs=1)
    with pytest.raises(ValueError, match="constant"):
        dgp.fit(model, dgp.Record(time=time, inputs=u, outputs=np.ones(20)), progress=False)
    with pytest.raises(ValueError, match="missing samples alone"):
        dgp.fit(model, dgp.Record(time=time, inputs=u, outputs=np.full(20, np.nan)))
    with pytest.raises(ValueError, match="expected 1 inputs"):
        dgp.fit(model, dgp.Record(time=time, outputs=u), progress=False)
    with pytest.raises(ValueError, match="Record"):
        dgp.fit(model, np.ones((20, 2)), progress=False)


def test_summary_names_poles_and_noise(map_fit):
    text = map_fit.summary()
    assert "natural frequency" in text
    assert f"{map_fit.noise_sd[0]:.4g}" in text


class TestWarmStart:
    def test_goes_on_from_another_fit(self, record, map_fit):
        model = dgp.LinearDynamicGP(inputs=1, pairs=1)
        options = {"restarts": 1, "steps": 2, "workers": 1, "progress": False, "method": "map"}
        cold = dgp.fit(model, record[:160], **options)
        warm = dgp.fit(model, record[:160], start=map_fit, **options)
        assert warm.start_energies[0] <= map_fit.start_energies[0] + 1e-6
        assert warm.start_energies[0] < cold.start_energies[0] - 1.0

    def test_without_restarts_it_goes_on_from_the_start_alone(self, record, map_fit):
        model = dgp.LinearDynamicGP(inputs=1, pairs=1)
        options = {"restarts": 0, "workers": 1, "progress": False}
        again = dgp.fit(model, map_fit.records, start=map_fit, **options)
        (energy,) = again.start_energies
        assert energy == pytest.approx(map_fit.start_energies[0], abs=0.05)
        # The climb has nothing to do there; two iterations say so.
        assert len(again.history) <= 4
        with pytest.raises(ValueError, match="restarts: expected a whole number >= 1"):
            dgp.fit(model, record, **options)

    def test_a_larger_model_keeps_what_a_smaller_one_has_learnt(self, record, map_fit):
        wider = dgp.fit(
            dgp.LinearDynamicGP(inputs=1, pairs=2), record[:160], start=map_fit,
            restarts=1, steps=200, workers=1, progress=False, method="map")  # fmt: skip
        near = np.abs(wider.modes.poles.numpy() - complex(map_fit.modes.poles[0]))
        assert near.min() < 0.3 * abs(complex(map_fit.modes.poles[0]))

    def test_of_a_linear_model_starts_the_dynamics_of_a_larger_one(self, record, map_fit):
        """Before units of its own: only a problem without a start is fitted in them."""
        wiener = dgp.Wiener(1, pairs=2, inducing=5, process_noise=False)
        begun, fresh = (
            best_optima(Problem.of(wiener, record[:60], start), Run(workers=1, restarts=1), None, 1)
            for start in (map_fit, None)
        )
        begun, fresh = (min(one.energy for one in optima) for optima in (begun, fresh))
        assert begun <= fresh
