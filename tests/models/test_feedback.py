"""Static layers in feedback: a line closes the loop to a linear system, densely computed."""

import numpy as np
import pytest
import torch
from scipy.stats import ks_2samp

from pyro_dynogp.inference.density import Potential
from pyro_dynogp.models.draws import JointState, Randomness, Switches
from pyro_dynogp.models.feedback_draws import draw_outputs
from pyro_dynogp.models.outputs import output_process
from tests.models.closed_loops import (
    ClosedLoop,
    check_gradient,
    make_record,
    spring,
    springs,
    system_at,
    values_of,
)

CASES = [(1, 1, False, {}), (1, 1, True, {}), (2, 1, False, {}), (2, 2, True, {}),
         (1, 1, False, {"hidden": 1}), (1, 2, True, {"hidden": 1, "both": False}),
         (2, 1, True, {"hidden": 2}), (2, 2, True, {"each": True}),
         (2, 1, False, {"each": True, "hidden": 2})]  # fmt: skip


def line_case(outputs, inputs, irregular, each=False, **options):
    make = springs if each else spring
    model = make(outputs, inputs=inputs, **options)
    record = make_record(inputs, outputs, irregular=irregular)
    model = model.scaled_to(record)
    system = system_at(model, values_of(model, record, seed=outputs + 2 * irregular))
    (prepared,) = model.prepare(record)
    return record, ClosedLoop(model, system, record), output_process(system, prepared)


@pytest.mark.parametrize(("outputs", "inputs", "irregular", "more"), CASES)
def test_a_line_in_feedback_is_a_linear_system(outputs, inputs, irregular, more):
    """Log density, and one step ahead mean and variance."""
    record, loop, process = line_case(outputs, inputs, irregular, **more)
    y = record.tensors().observations
    total, means, covariances = loop.filter(loop.scaled(record.outputs))
    jacobian = (~np.isnan(record.outputs) * np.log(loop.scale)).sum()
    assert float(process.log_prob(y)) == pytest.approx(total - jacobian, rel=1e-10)
    found = process.ahead(y, 1)
    variance = np.diagonal(covariances, axis1=1, axis2=2) * loop.scale**2
    np.testing.assert_allclose(found.mean, loop.shift + loop.scale * means, rtol=1e-9)
    np.testing.assert_allclose(found.variance, variance, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("hidden", [0, 1])
@pytest.mark.parametrize("process_noise", [True, False])
def test_every_site_changes_the_likelihood(process_noise, hidden):
    record = make_record()
    model = spring(process_noise=process_noise, hidden=hidden).scaled_to(record)
    (prepared,) = model.prepare(record)
    values = values_of(model, record, linear=False)

    def likelihood(v):
        process = output_process(system_at(model, v), prepared)
        return float(process.log_prob(record.tensors().observations))

    before = likelihood(values)
    generator = torch.Generator().manual_seed(0)
    for name, value in values.items():
        change = 0.05 + 0.05 * torch.rand(value.shape, dtype=value.dtype, generator=generator)
        assert abs(likelihood({**values, name: value + change}) - before) > 1e-6, name


@pytest.mark.parametrize(("outputs", "inputs", "irregular", "more"), CASES)
def test_free_runs_of_a_line_in_feedback_are_those_of_the_linear_system(
    outputs, inputs, irregular, more
):
    _, loop, process = line_case(outputs, inputs, irregular, process_noise=False, **more)
    _, means, _ = loop.filter()
    found = process.components(samples=3, seed=0)
    for mean in found.mean:
        expected = loop.shift + loop.scale * means  # one of them is near zero
        np.testing.assert_allclose(mean, expected, rtol=1e-10, atol=1e-11 * float(loop.scale[0]))
    assert not found.variance.any()


@pytest.mark.parametrize(("outputs", "irregular"), [(1, False), (2, True)])
def test_process_noise_of_free_runs_is_that_of_the_linear_system(outputs, irregular):
    """Mean and variance over draws, within five standard errors."""
    count = 4000
    _, loop, process = line_case(outputs, 1, irregular)
    _, means, covariances = loop.filter()
    found = process.components(samples=count, seed=1).mean
    variance = np.diagonal(covariances, axis1=1, axis2=2) * loop.scale**2
    error = found.mean(0) - (loop.shift + loop.scale * means)
    assert (np.abs(error) < 5.0 * np.sqrt(variance / count) + 1e-9).all()
    ratio = found.var(0) / variance
    assert (np.abs(ratio[variance > 1e-12] - 1.0) < 5.0 * np.sqrt(2.0 / count)).all()


@pytest.mark.parametrize("seen", [0, 1], ids=["output", "hidden signal"])
def test_runs_with_drawn_functions_are_those_of_a_plain_simulation(seen):
    """Functions from their dense conditional, states step by step in numpy; KS at ten times."""
    count = 300
    model = spring(hidden=seen, both=False)
    record = make_record(irregular=True, missing=False)
    model = model.scaled_to(record)
    values = values_of(model, record, seed=5, linear=False)
    values["g_feedthrough"] = 0.0 * values["g_feedthrough"]
    values["f_lengthscale"] = 1.0 + 0.0 * values["f_lengthscale"]
    values["f_half_width"] = 6.0 + 0.0 * values["f_half_width"]
    values["noise_sd"] = 0.02 + 0.0 * values["noise_sd"]
    values["f_output_scale"] = 1.0 + 0.0 * values["f_output_scale"]
    values["g_input_gain"][:, 1] = 0.4
    values["g_initial_state"] = 0.1 * values["g_initial_state"]
    if seen:  # it stays where its function is known
        values["g_output_gain"][1] *= 0.1
    values["g_noise_gain_unit"] = 0.3 * values["g_noise_gain_unit"]
    system = system_at(model, values)
    loop = ClosedLoop(model, system, record)
    function = system.layer("f").function
    rng = np.random.default_rng(0)
    grid = np.linspace(-8.0, 8.0, 321)

    def matern(a, b):
        r = np.sqrt(3.0) * np.abs(a[:, None] - b)
        return (1.0 + r) * np.exp(-r)

    Z, v = function.locations.numpy()[:, 0], function.whitened.numpy()[0]
    L = np.linalg.cholesky(matern(Z, Z) + 1e-8 * np.eye(len(Z)))
    A = np.linalg.solve(L, matern(Z, grid))
    rest = matern(grid, grid) - A.T @ A
    drawn = rng.multivariate_normal(A.T @ v, rest, count, method="eigh")
    drawn *= float(function.output_scale)

    def functions(x):
        x = np.broadcast_to(x, (count,)) if x.size == 1 else x
        return np.array([np.interp(a, grid, f) for a, f in zip(x, drawn, strict=True)])

    expected = loop.simulate(functions, rng, seen)[..., 0]
    with torch.random.fork_rng():
        torch.manual_seed(1)
        process = output_process(system, model.prepare(record)[0])
        found = loop.scaled(process.sample((count,)).numpy()[..., None])[..., 0]
    assert expected[:, 30].std() > 2.0 * float(loop.noise[0]) ** 0.5
    for time in (5, 12, 20, 30, 39):
        assert ks_2samp(found[:, time], expected[:, time]).pvalue > 0.001, time
    runs = process.components(samples=count, seed=2)
    y = runs.mean + np.sqrt(runs.noise_variance) * rng.standard_normal(runs.mean.shape)
    for time in (5, 12, 20, 30, 39):
        assert ks_2samp(loop.scaled(y)[:, time, 0], expected[:, time]).pvalue > 0.001, time


def test_a_function_in_feedback_keeps_its_value_beyond_its_inducing_points():
    """In the filter's table, without variance of its own, and in runs from far away."""
    model = spring()
    record = make_record()
    model = model.scaled_to(record)
    system = system_at(model, values_of(model, record, seed=7, linear=False))
    function = system.layer("f").function
    ends = function.locations[[0, -1]]
    process = output_process(system, model.prepare(record)[0])
    problem = process.assembly.problem
    assert not problem.table_variance.any()
    assert float(problem.low) == pytest.approx(float(ends[0]))
    reach = float(problem.low + problem.spacing * (problem.table_mean.shape[-1] - 1))
    assert reach == pytest.approx(float(ends[1]))
    held = function.mean(ends)[:, 0]
    for at, end in ((-1e3, held[0]), (1e3, held[1])):
        start = JointState(at * torch.tensor([[1.0, 1.0, 0.0, 0.0]]).double(), torch.zeros(4, 4))
        off = Switches(False, frozenset(), False)
        with torch.random.fork_rng():
            random = Randomness.draw(system, len(record), torch.Size((1,)))
        run = draw_outputs(system, process.grid, process.scaled_inputs, start, random, off)
        step = float((function.mean(ends + 1e-3) - function.mean(ends))[:, 0].abs().max()) * 1e3
        width = float(problem.spacing)
        assert float(run.signals["f"][0, 0]) == pytest.approx(float(end), abs=2.0 * step * width)


@pytest.mark.parametrize(("outputs", "hidden"), [(1, 0), (2, 0), (1, 1)])
def test_gradient_is_that_of_finite_differences(outputs, hidden):
    model = spring(outputs, hidden=hidden)
    record = make_record(1, outputs, irregular=True)
    model = model.scaled_to(record)
    potential = Potential(model, (record,), values_of(model, record, seed=3, linear=False))
    check_gradient(potential)
