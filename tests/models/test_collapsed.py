"""Trajectories integrated out: the same model, in any units, as the one with them as sites."""

import math

import gpytorch
import numpy as np
import pytest
import torch
from pyro import poutine
from scipy.stats import norm

import pyro_dynogp as dgp
from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.layers.functions import StaticFunction
from pyro_dynogp.models.filter_functions import GRID, table_range
from pyro_dynogp.models.wiring import Dynamic, Static
from tests.models.cascades import (
    MODELS,
    blank,
    case,
    draw,
    log_prob,
    make_record,
    nodes,
    parameters,
    particles,
)


def signals_at(model, trace):
    """Signals that are sites with a density of their own."""
    return {
        one.name: trace.nodes[one.name]["value"]
        for one in model.wires
        if not (one.pathwise and isinstance(one.layer, Static))
    }


@pytest.mark.parametrize("form", ["explicit", "collapsed"])
@pytest.mark.parametrize("name", MODELS)
def test_units_change_the_density_by_the_jacobian_alone(name, form):
    """Hours for seconds, millivolts for volts: all other sites have the very same densities."""
    raw = MODELS[name]()
    raw = raw.collapsed if form == "collapsed" else raw
    record = make_record(raw.inputs, raw.outputs, gaps=True)
    other = dgp.Record(
        time=record.time / 3600.0,
        inputs=record.inputs * 1e3 + 5.0,
        outputs=record.outputs * 1e-3 - 2.0,
        time_unit="h",
    )
    trace = draw(raw, record)
    values = parameters(raw, trace)
    if form == "explicit":
        values |= signals_at(raw, trace)
    here, there = (nodes(raw, r, values) for r in (record, other))
    seen = int((~np.isnan(record.outputs)).sum())
    for site, node in here.items():
        shift = seen * math.log(1e3) if site == "y" else 0.0
        assert float(there[site]["log_prob_sum"]) == pytest.approx(
            float(node["log_prob_sum"]) + shift, rel=1e-8, abs=1e-7
        ), site


@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("gaps", [False, True])
def test_one_dynamic_layer_is_the_linear_model(outputs, gaps):
    """integrate="last", integrate="all" and `LinearDynamicGP`: one density, site by site."""
    record = make_record(1, outputs, gaps=gaps)
    cascade = dgp.Cascade(1, (Dynamic(outputs=outputs, pairs=2),), initial_state="integrated")
    linear = dgp.LinearDynamicGP(1, outputs=outputs, pairs=2)
    values = parameters(cascade, draw(cascade, record))
    forms = [
        dgp.Cascade(1, cascade.layers, initial_state="integrated", integrate=form)
        for form in ("last", "all")
    ]

    def densities(model):
        found = nodes(model, record, values)
        # Layers of a cascade have unit scale, and their gains a narrower prior for it.
        return {k: float(v["log_prob_sum"]) for k, v in found.items() if k != "g_input_gain"}

    for model in forms:
        assert densities(model) == pytest.approx(densities(linear), rel=1e-9, abs=1e-9)


def test_last_layer_integrated_below_a_static_one():
    """Hammerstein given f: exact in both forms, with the residual of the path and at its mean."""
    model, record = case("Hammerstein", gaps=True)
    values = parameters(model, draw(model, record))
    last = dgp.Cascade(1, model.layers, integrate="last", scaling=model.scaling)
    residual = values.pop("f_residual")
    at_mean = log_prob(last, record, values | {"f_residual": 0.0 * residual}, "y")
    assert log_prob(model.collapsed, record, values, "y") == pytest.approx(at_mean, rel=1e-6)
    with_residual = log_prob(last, record, values | {"f_residual": residual}, "y")
    assert abs(with_residual - at_mean) > 1e-3


def calm(model, record, seed, noise_sd):
    """Parameters from the prior, but static functions near a line and noise of a given size."""
    values = parameters(model, draw(model, record, seed))
    for one in model.wires:
        if isinstance(one.layer, Static):
            e, d = one.layer.outputs, one.channels
            values |= {
                f"{one.name}_output_scale": torch.full((e,), 0.1).double(),
                f"{one.name}_constant": torch.full((e,), 0.1).double(),
                f"{one.name}_slope": torch.ones(e, d).double(),
                f"{one.name}_lengthscale": torch.ones(d).double(),
            }
        else:
            P = one.layer.pairs
            values |= {
                f"{one.name}_log_decay": torch.linspace(-0.3, 0.3, P).double(),
                f"{one.name}_log_frequency": torch.linspace(0.2, 0.6, P).double(),
                f"{one.name}_noise_gain_local_scale": torch.full((P,), 4.0).double(),
                f"{one.name}_noise_gain_unit": torch.full((P, 1, 2), 0.7).double(),
                f"{one.name}_input_gain": torch.full((P, one.channels, 2), 0.4).double(),
                f"{one.name}_feedthrough": torch.full((one.channels,), 0.3).double(),
            }
    values["noise_sd"] = torch.full((model.outputs,), noise_sd).double()
    return values


LINES = {
    "Wiener": (Dynamic(pairs=1), Static(inducing=6, mean="linear")),
    "Wiener-Hammerstein": (
        Dynamic(pairs=1),
        Static(inducing=12, mean="linear"),
        Dynamic(pairs=1),
    ),
    "Hammerstein-Wiener": (
        Static(inducing=12),
        Dynamic(pairs=1),
        Static(inducing=6, mean="linear"),
    ),
    "skips": (
        Dynamic(pairs=1),
        Static(inducing=12, mean="linear", skip=("inputs",)),
        Dynamic(pairs=1, skip=("g1",)),
    ),
}


@pytest.mark.parametrize("name", LINES)
def test_collapsed_likelihood_is_the_average_of_explicit_ones(name):
    """Importance sampling from the prior of all trajectories, a short record, nearly linear layers.

    Wide noise makes the average converge; functions bend by a tenth, so that what moment matching
    gives up stays within 0.03. The collapsed form has functions below dynamic layers at their mean.
    """
    record = make_record(1, n=7, step=0.4)
    model = dgp.Cascade(1, LINES[name]).scaled_to(record)
    values = calm(model, record, 1, noise_sd=0.8)
    y = nodes(model.collapsed, blank(record), values)["y"]["value"]
    record = record.with_outputs(y.numpy())
    collapsed = log_prob(model.collapsed, record, values, "y")
    values |= {k: 0.0 * v for k, v in values.items() if k.endswith("residual")}
    count = 4000
    trace = draw(particles(poutine.condition(model, data=values), count), record)
    trace.compute_log_prob()
    conditional = trace.nodes["y"]["log_prob"]
    average = float(torch.logsumexp(conditional, 0)) - math.log(count)
    ratio = (conditional - conditional.max()).exp()
    error = float(ratio.std() / ratio.mean()) / math.sqrt(count)
    assert error < 0.05
    assert abs(average - collapsed) < 4.0 * error + 0.03
    # The trajectories matter: at their means alone the density is another.
    assert float(conditional.std()) > 0.3


@pytest.mark.parametrize(
    "name",
    [
        "linear",
        "Wiener-Hammerstein",
        "Hammerstein-Wiener",
        "several channels",
        "skips",
        "heavy tails",
        "varying noise",
        "noise of the output",
    ],
)
def test_simulated_outputs_have_the_explicit_model_s_moments(name):
    if name == "heavy tails":
        model = dgp.Wiener(1, pairs=1, inducing=6, likelihood=dgp.StudentT(6.0))
    elif name == "varying noise":
        model = dgp.Wiener(1, pairs=1, inducing=6, likelihood=dgp.Heteroscedastic())
    elif name == "noise of the output":
        noise = dgp.Heteroscedastic(of="output")
        model = dgp.Wiener(1, pairs=1, inducing=6, likelihood=noise)
    else:
        model = MODELS[name]()
    record = make_record(model.inputs, model.outputs)
    model = model.scaled_to(record)
    trace = draw(model, record, seed=4)
    values = parameters(model, trace)
    for one in model.wires:
        values.pop(f"{one.name}_residual", None)
    count = 300
    shorter = blank(record[:10])
    explicit = draw(particles(poutine.condition(model, data=values), count), shorter, seed=1)
    y = explicit.nodes["y"]["value"].reshape(count, -1).numpy()
    distribution = nodes(model.collapsed, shorter, values)["y"]["fn"]
    with torch.random.fork_rng():
        torch.manual_seed(2)
        z = distribution.sample((count,))
    assert z.shape == (count, *distribution.event_shape)
    z = z.reshape(count, -1).numpy()
    error = np.sqrt((y.var(0) + z.var(0)) / count)
    assert np.abs((y.mean(0) - z.mean(0)) / error).max() < 5.0
    # Covariances too, so that correlations over time and outputs agree.
    a, b = (x - x.mean(0) for x in (y, z))
    products = [np.einsum("si,sj->sij", x, x) for x in (a, b)]
    covariance = [p.mean(0) for p in products]
    error = np.sqrt(sum(p.var(0) for p in products) / count)
    assert np.abs((covariance[0] - covariance[1]) / error).max() < 5.5


@pytest.mark.parametrize(("noise", "site"), [
    (dgp.Gaussian(), "g1_log_decay"),
    (dgp.Gaussian(), "g1_input_gain"),
    (dgp.Gaussian(), "g1_initial_state"),
    (dgp.Gaussian(), "f_lengthscale"),
    (dgp.Gaussian(), "f_half_width"),
    (dgp.Gaussian(), "f_values"),
    (dgp.Gaussian(), "g2_noise_gain_unit"),
    (dgp.Gaussian(), "offset"),
    (dgp.Gaussian(), "noise_sd"),
    (dgp.Heteroscedastic(4), "log_noise_lengthscale"),
    (dgp.Heteroscedastic(4, of="output"), "log_noise_values"),
    (dgp.Heteroscedastic(4, of="output"), "log_noise_constant"),
    (dgp.Heteroscedastic(4, of="output"), "log_noise_output_scale"),
    (dgp.Heteroscedastic(4, of="output"), "log_noise_lengthscale"),
    (dgp.Heteroscedastic(4, of="output"), "log_noise_center"),
    (dgp.Heteroscedastic(4, of="output"), "log_noise_half_width"),
    (dgp.Heteroscedastic(4, of="output"), "g1_input_gain"),
])  # fmt: skip
def test_any_site_alone_may_be_a_batch(noise, site):
    """As where all hyperparameters but one are held: nothing says which site brings particles."""
    record = make_record()
    model = dgp.WienerHammerstein(1, pairs=2, inducing=6, likelihood=noise)
    model = model.scaled_to(record).collapsed
    values = parameters(model, draw(model, record))
    before = log_prob(model, record, values, "y")
    batch = torch.stack([values[site], 1.01 * values[site]])
    conditioned = particles(poutine.condition(model, data=values | {site: batch}), 2)
    trace = draw(conditioned, record)
    trace.compute_log_prob()
    found = trace.nodes["y"]["log_prob"]
    assert found.shape == (2,)
    assert float(found[0]) == pytest.approx(before, rel=1e-9)
    assert found[1] != found[0]
    assert draw(conditioned, blank(record)).nodes["y"]["value"].shape == (2, len(record))


def test_expanded_distribution_and_batches():
    model, record = case("Wiener-Hammerstein", gaps=True)
    one = nodes(model.collapsed, record, {})["y"]
    wide = one["fn"].expand((2, 3))
    assert wide.log_prob(one["value"]).shape == (2, 3)
    assert torch.equal(wide.log_prob(one["value"])[1, 2], one["fn"].log_prob(one["value"]))
    # Values with dimensions of their own, as samples have them.
    y = torch.stack([one["value"], one["value"] + 0.1])
    found = one["fn"].log_prob(y)
    assert found.shape == (2,)
    for i in range(2):
        assert float(found[i]) == pytest.approx(float(one["fn"].log_prob(y[i])), rel=1e-12)
    assert wide.sample((4,)).shape == (4, 2, 3, len(record))
    assert wide.log_prob(wide.sample((4,))).shape == (4, 2, 3)
    seen = ~np.isnan(record.outputs)
    ahead = one["fn"].one_step(one["value"])
    r, S = (record.outputs - ahead.mean.numpy())[seen], ahead.variance.numpy()[seen]
    total = -0.5 * (r**2 / S + np.log(2 * np.pi * S)).sum()
    assert total == pytest.approx(float(found[0]), rel=1e-9)
    assert float(ahead.log_density.nansum()) == pytest.approx(float(found[0]), rel=1e-9)


def test_gradients_reach_every_parameter():
    model, record = case("Wiener-Hammerstein")
    values = parameters(model.collapsed, draw(model.collapsed, record))
    leaf = {k: v.clone().requires_grad_() for k, v in values.items()}
    total = nodes(model.collapsed, record, leaf)["y"]["log_prob_sum"]
    grads = torch.autograd.grad(total, list(leaf.values()))
    assert all(grad.abs().max() > 0.0 for grad in grads)
    generator = torch.Generator().manual_seed(0)
    for chosen in (values, {"g1_log_decay"}, {"f_half_width", "f_center"}, {"f_lengthscale"}):
        move = {
            k: torch.randn(v.shape, dtype=torch.float64, generator=generator) * (k in chosen)
            for k, v in values.items()
        }
        h = 1e-5
        sides = [
            log_prob(
                model.collapsed, record, {k: v + s * h * move[k] for k, v in values.items()}, "y"
            )
            for s in (1, -1)
        ]
        slope = (sides[0] - sides[1]) / (2 * h)
        along = sum(float((g * move[k]).sum()) for k, g in zip(leaf, grads, strict=True))
        assert along == pytest.approx(slope, rel=1e-4, abs=1e-5), set(chosen)


def test_table_reaches_beyond_the_inducing_points():
    """Where a trajectory can be, the table is the function: its error is far below the noise."""
    model, record = case("Wiener")
    found = nodes(model.collapsed, record, {})
    function = found["y"]["fn"].system.layer("f").function
    assert isinstance(function, StaticFunction)
    low, high = (float(x) for x in table_range(function))
    z = function.locations
    assert low < float(z.min()) - 1.0
    assert high > float(z.max()) + 1.0
    # Back at the prior mean at the ends, which are held.
    ends = torch.tensor([[low], [high]], dtype=torch.float64)
    off = (function.mean(ends) - function.prior_mean(ends)).abs().max()
    assert off < 0.05 * float(function.output_scale)
    assert (high - low) / GRID < 0.05


def test_kernels_that_are_not_radial():
    """Any kernel of one channel, radial ones of several; others are refused, with a way out."""
    periodic = gpytorch.kernels.PeriodicKernel()
    record = make_record(1)
    model = dgp.Wiener(1, pairs=1, inducing=5, kernel=periodic).scaled_to(record)
    assert np.isfinite(float(draw(model.collapsed, record).log_prob_sum()))
    record = make_record(1, 2)
    model = dgp.Wiener(1, outputs=2, pairs=1, inducing=5, kernel=periodic).scaled_to(record)
    with pytest.raises(ValueError, match=r"kernel: expected RBF or Matern.*integrate='none'"):
        draw(model.collapsed, record).log_prob_sum()
    scaled = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(ard_num_dims=2))
    model = dgp.Wiener(1, outputs=2, pairs=1, inducing=5, kernel=scaled).scaled_to(record)
    assert np.isfinite(float(draw(model.collapsed, record).log_prob_sum()))


def test_static_layer_alone_is_regression():
    """No dynamics: independent normals, the function's own variance beside that of the noise."""
    record = make_record(gaps=True)
    model = dgp.Cascade(1, (Static(inducing=3),)).scaled_to(record)
    values = parameters(model, draw(model, record))
    with poutine.condition(data=values):
        function = model.sample_system(model.scaling).layer("f").function
    u = (record.inputs - model.scaling.input_offset) / model.scaling.input_scale
    mean, variance = (x[:, 0].numpy() for x in function.moments(torch.tensor(u)))
    noise = float(values["noise_sd"]) ** 2
    assert variance.max() > noise
    scale, shift = model.scaling.output_scale[0], model.scaling.output_offset[0]
    exact = norm(shift + scale * mean, scale * np.sqrt(variance + noise))
    expected = np.nansum(exact.logpdf(record.outputs[:, 0]))
    assert log_prob(model.collapsed, record, values, "y") == pytest.approx(expected, rel=1e-9)


def test_variance_of_the_last_function_is_averaged_over_its_input():
    """One sample of a Wiener model with few inducing values, against quadrature by scipy."""
    record = make_record()
    model = dgp.Wiener(1, pairs=1, inducing=3).scaled_to(record)
    values = parameters(model, draw(model, record))
    values |= {
        "g_noise_gain_local_scale": torch.full((1,), 5.0).double(),
        "g_noise_gain_unit": torch.ones(1, 1, 2).double(),
        "noise_sd": torch.full((1,), 0.1).double(),
    }
    model_, first = model.collapsed, record[:1]
    with poutine.condition(data=values):
        system = model_.begin(model_.sample_system(model_.scaling), model_.sample_states(""))
    function, layer = system.layer("f").function, system.layer("g")
    u = (first.inputs - model.scaling.input_offset) / model.scaling.input_scale
    g = LTIProcess(layer.modes, first.time, torch.tensor(u), layer.prior_state())
    at = norm(g.mean.item(), g.variance.sqrt().item())
    x = np.linspace(*at.interval(1.0 - 1e-12), 4001)
    weight = at.pdf(x) * (x[1] - x[0])
    mean, variance = (v[:, 0].numpy() for v in function.moments(torch.tensor(x)[:, None]))
    noise = float(values["noise_sd"]) ** 2
    level = weight @ mean
    total = weight @ mean**2 - level**2 + weight @ variance + noise
    assert weight @ variance > 3.0 * noise
    scale, shift = model.scaling.output_scale[0], model.scaling.output_offset[0]
    expected = norm(shift + scale * level, scale * np.sqrt(total)).logpdf(first.outputs.item())
    assert log_prob(model_, first, values, "y") == pytest.approx(expected, abs=0.02)
    # Without the function's own variance the density would be another altogether.
    certain = norm(shift + scale * level, scale * np.sqrt(total - weight @ variance))
    assert abs(certain.logpdf(first.outputs.item()) - expected) > 0.1


def test_scale_of_a_kernel_is_that_of_the_function():
    """k and 4 k with half the scale beside it are one function, of several channels too."""
    record = make_record(1, 2)
    plain = gpytorch.kernels.RBFKernel(ard_num_dims=2)
    models = [
        dgp.Wiener(1, outputs=2, pairs=1, inducing=5, kernel=k).scaled_to(record).collapsed
        for k in (plain, gpytorch.kernels.ScaleKernel(plain))
    ]
    values = parameters(models[0], draw(models[0], record))
    scaled = {k: v for k, v in values.items() if k != "f_lengthscale"} | {
        "f_base_kernel_lengthscale": values["f_lengthscale"],
        "f_outputscale": torch.tensor(4.0, dtype=torch.float64),
        "f_output_scale": 0.5 * values["f_output_scale"],
    }
    expected = log_prob(models[0], record, values, "y")
    assert log_prob(models[1], record, scaled, "y") == pytest.approx(expected, rel=1e-9)
