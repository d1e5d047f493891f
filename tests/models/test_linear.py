"""The linear dynamic GP as a Pyro model."""

import math

import numpy as np
import pyro
import pytest
import torch
from pyro.infer.inspect import get_model_relations

import pyro_dynogp as dgp
from pyro_dynogp.lti.covariance import real_covariance
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.past_inputs import past_input_covariance


def latent(trace):
    return {
        name: node["value"]
        for name, node in trace.nodes.items()
        if node["type"] == "sample" and not node["is_observed"]
    }


def draw(model, record, seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return pyro.poutine.trace(model).get_trace(record)


def log_joint(model, record, values):
    conditioned = pyro.poutine.condition(model, data=values)
    return float(pyro.poutine.trace(conditioned).get_trace(record).log_prob_sum())


@pytest.mark.parametrize("initial_state", ["integrated", "zero", "site"])
@pytest.mark.parametrize("priors", ["default", "paper"])
def test_every_site_changes_the_likelihood(record, initial_state, priors):
    model = dgp.LinearDynamicGP(inputs=1, pairs=2, initial_state=initial_state, priors=priors)
    start = dgp.LinearDynamicGP(inputs=1, pairs=2, initial_state=initial_state)
    values = latent(draw(start, record))
    assert ("g_initial_state" in values) == (initial_state == "site")

    def likelihood(v):
        trace = pyro.poutine.trace(pyro.poutine.condition(model, data=v)).get_trace(record)
        trace.compute_log_prob()
        return float(trace.nodes["y"]["log_prob_sum"])

    before = likelihood(values)
    for name, value in values.items():
        after = likelihood({**values, name: value + 0.05 + 0.05 * torch.rand_like(value)})
        assert abs(after - before) > 1e-6, name


def test_dependencies_are_what_the_model_says(record):
    relations = get_model_relations(dgp.LinearDynamicGP(inputs=1, pairs=2), (record,))
    parents = set(relations["sample_sample"]["y"])
    assert parents == {
        "g_log_decay",
        "g_log_frequency",
        "g_input_gain",
        "g_feedthrough",
        "g_noise_gain_local_scale",
        "g_noise_gain_unit",
        "offset",
        "noise_sd",
    }
    assert relations["observed"] == ["y"]


def test_same_record_in_other_units_has_the_same_posterior(record):
    """Hours for seconds, millivolts for volts: the density changes by the Jacobian alone."""
    model = dgp.LinearDynamicGP(inputs=1, pairs=2)
    values = latent(draw(model, record))
    other = dgp.Record(
        time=record.time / 3600.0,
        inputs=record.inputs * 1e3 + 5.0,
        outputs=record.outputs * 1e-3 - 2.0,
        time_unit="h",
    )
    shift = len(record) * math.log(1e3)
    assert log_joint(model, other, values) == pytest.approx(
        log_joint(model, record, values) + shift, rel=1e-9
    )


def test_likelihood_is_in_the_units_of_the_record(record):
    """The observed site scores the raw outputs: absolute value against a dense normal."""
    from scipy.stats import multivariate_normal

    from tests.lti.dense import signal_covariance

    short = record[:40]
    model = dgp.LinearDynamicGP(inputs=1, pairs=2).scaled_to(record)
    trace = draw(model, short)
    trace.compute_log_prob()
    values = latent(trace)
    (along,) = model.prepare(short)
    observed = output_process(model.system(values, model.scaling), along).process
    system, process = model.system(values, model.scaling).physical(model.scaling), observed.process
    S = signal_covariance(system.modes, short.time, short.time, process.initial_covariance)
    K = S + system.noise_sd**2 * torch.eye(40, dtype=torch.float64)
    dense = multivariate_normal(process.mean.numpy(), K.numpy()).logpdf(short.outputs[:, 0])
    assert float(trace.nodes["y"]["log_prob_sum"]) == pytest.approx(dense, rel=1e-9)


def test_integrated_initial_state_is_the_average_over_sampled_ones(record):
    """exp of the integrated log-likelihood = mean of the conditional ones (importance check)."""
    short = record[:6]
    integrated = dgp.LinearDynamicGP(inputs=1, pairs=1).scaled_to(record)
    sampled = dgp.LinearDynamicGP(inputs=1, pairs=1, initial_state="site").scaled_to(record)
    values = latent(draw(integrated, short, seed=4))
    # Noise so large that the sampled states overlap the likelihood.
    values["noise_sd"] = torch.tensor([1.5], dtype=torch.float64)
    system = integrated.system(values, integrated.scaling)
    count = 40_000
    with torch.random.fork_rng():
        torch.manual_seed(0)
        states = torch.randn(count, 2).double()
    y = torch.as_tensor(short.outputs[:, 0].copy())
    begun = sampled.begin(system, {"g": states})
    (along,) = sampled.prepare(short)
    conditional = output_process(begun, along).log_prob(y)
    average = float(torch.logsumexp(conditional, 0) - math.log(count))
    ratio = (conditional - conditional.max()).exp()
    error = float(ratio.std() / ratio.mean()) / math.sqrt(count)
    exact = float(output_process(system, along).log_prob(y))
    assert error < 0.05
    assert abs(average - exact) < 4 * error


def test_past_inputs_covariance_matches_a_simulation():
    """Random constant plus white noise of intensity 2 memory, held for long, leaves this state."""
    modes = dgp.Modes([-1.0 + 2.0j], [[0.7 - 0.4j]], [1.0])
    memory, step = 0.3, 0.02
    P = past_input_covariance(modes, memory).numpy()
    rng = np.random.default_rng(0)
    count, n = 4000, 500
    white = rng.standard_normal((count, n, 1)) * math.sqrt(2 * memory / step)
    constant = rng.standard_normal((count, 1, 1))
    u = torch.as_tensor(white + constant)
    from pyro_dynogp.lti.response import mean_response

    x = mean_response(modes, np.arange(n) * step, u).state[:, 0].numpy()
    sample = np.cov(np.stack([x.real, x.imag]))
    np.testing.assert_allclose(sample, P, atol=5 * np.abs(P).max() * math.sqrt(2 / count))
    assert real_covariance(torch.eye(1) + 0j, torch.zeros(1, 1) + 0j).shape == (2, 2)


def test_several_records_share_their_parameters(record):
    model = dgp.LinearDynamicGP(inputs=1, pairs=1)
    parts = (record[:100], record[120:200])
    scaled = model.scaled_to(parts)
    trace = draw(scaled, parts)
    trace.compute_log_prob()
    assert {"y_0", "y_1"} <= set(trace.nodes)
    values = latent(trace)
    for index, part in enumerate(parts):
        alone = pyro.poutine.trace(pyro.poutine.condition(scaled, data=values)).get_trace(part)
        alone.compute_log_prob()
        assert float(trace.nodes[f"y_{index}"]["log_prob_sum"]) == pytest.approx(
            float(alone.nodes["y"]["log_prob_sum"]), rel=1e-12
        )


def test_prior_and_posterior_predictive_by_pyro(record, map_fit):
    blank = dgp.Record(
        time=record.time[:30], inputs=record.inputs[:30], input_names=record.input_names
    )
    model = dgp.LinearDynamicGP(inputs=1, pairs=2).scaled_to(record)
    prior = pyro.infer.Predictive(model, num_samples=6, parallel=True)(blank)
    assert prior["y"].shape == (6, 30)
    draws = pyro.infer.Predictive(map_fit.model, guide=map_fit.guide, num_samples=300)(blank)["y"]
    simulated = map_fit.simulate(blank)
    z = (draws.mean(0).numpy() - simulated.mean[:, 0]) / (simulated.sd[:, 0] / math.sqrt(300))
    assert np.abs(z).max() < 5


def test_intervention_and_conditioning(record):
    model = dgp.LinearDynamicGP(inputs=1, pairs=1)
    fixed = pyro.do(model, data={"noise_sd": torch.tensor([0.5], dtype=torch.float64)})
    trace = draw(fixed, record)
    assert float(trace.nodes["y"]["fn"].process.noise_variance.reshape(-1)[0]) == pytest.approx(
        (0.5 * record.outputs.std()) ** 2
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"inputs": -1}, "inputs: expected a whole number >= 0"),
        ({"inputs": 1, "outputs": 0}, "outputs of layer 'g'"),
        ({"inputs": 1, "pairs": 0}, "pairs of layer 'g'"),
        ({"inputs": 1, "pairs": 2.0}, "pairs"),
        ({"inputs": 1, "noise": "white"}, "noise of layer 'g': expected 'shared' or 'independent'"),
        ({"inputs": 1, "initial_state": "random"}, "initial_state"),
        ({"inputs": 1, "priors": "none"}, "priors"),
        ({"inputs": 0, "process_noise": False}, "process_noise"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        dgp.LinearDynamicGP(**options)


def test_records_that_do_not_fit(record):
    with pytest.raises(ValueError, match="expected 2 inputs, as the model has, got 1"):
        dgp.LinearDynamicGP(inputs=2)(record)
    model = dgp.LinearDynamicGP(inputs=1).scaled_to(record)
    volts = dgp.Record(time=record.time, inputs=record.inputs, outputs=record.outputs,
                       input_units=("V",))  # fmt: skip
    with pytest.raises(ValueError, match="unit"):
        model(volts)
