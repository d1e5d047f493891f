"""Layers whose function the user writes, against linear systems and plain simulations."""

from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy.stats import ks_2samp

import pyro_dynogp as dgp
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.starts.plans import Plan, starting_point
from pyro_dynogp.layers.sites import Site, sample
from pyro_dynogp.models.known import middle_of
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.wiring import Dynamic, Known
from tests.models.closed_loops import check_gradient, make_record, plain_loop, system_at


def looped(function, parameters, record=None, **options):
    """A layer g whose output comes back through a known function of it."""
    layers = (Dynamic(pairs=2, feedback=("f",)), Known(function, parameters, **options))
    return dgp.Cascade(1, layers, output="g").scaled_to(record or make_record())


def tanh(x, width):
    return torch.tanh((x - 2.0) / width)


WIDTH = {"width": dist.LogNormal(0.0, 0.5)}


def values_at(model, seed):
    """Values of all sites at random, with moderate gains."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        values = sample(model.all_sites(model.scaling, 1))
    small = {k: 0.4 * torch.tanh(v) for k, v in values.items() if k.endswith("_gain")}
    return values | small | {"noise_sd": values["noise_sd"].clamp(0.05, 1.0)}


def log_prob(model, values, record):
    (prepared,) = model.prepare(record)
    return output_process(system_at(model, values), prepared).log_prob(prepared.observations)


@pytest.mark.parametrize("seed", range(3))
def test_the_identity_as_a_sensor_is_the_linear_model(seed):
    record = make_record()
    sensor = dgp.Cascade(
        1, (Dynamic(pairs=2), Known(lambda y: y)), integrate="all", initial_state="site"
    ).scaled_to(record)
    linear = dgp.LinearDynamicGP(1, pairs=2, initial_state="site").scaled_to(record)
    values = values_at(linear, seed)
    found, expected = (float(log_prob(m, values, record)) for m in (sensor, linear))
    assert found == pytest.approx(expected, abs=1e-7)
    (prepared,) = linear.prepare(record)
    ahead = [
        output_process(system_at(m, values), prepared).ahead(prepared.observations, 1)
        for m in (sensor, linear)
    ]
    np.testing.assert_allclose(ahead[0].mean, ahead[1].mean, rtol=1e-8)
    np.testing.assert_allclose(ahead[0].variance, ahead[1].variance, rtol=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_a_line_in_feedback_is_a_linear_system(seed):
    """Seen in the output's units, with the offset; standardised by the training record."""
    record = make_record()
    prior, wide = {"a": dist.LogNormal(0.0, 0.3)}, (-1e3, 1e3)
    model = looped(lambda y, a: 3.0 - a * y, prior, record, range=wide)
    values = values_at(model, seed)
    system = system_at(model, values)
    a, scaling = float(values["f_a"]), model.scaling
    scale, shift = float(scaling.output_scale[0]), float(scaling.output_offset[0])
    # Its mean and standard deviation are those of 3 - y: one is the middle of the prior of a.
    slope = -a
    at_zero = 3.0 - a * (shift + scale * float(values["offset"]))
    loop = plain_loop(model, system, record, slope, (at_zero - (3.0 - shift)) / scale)
    total, _, _ = loop.filter(loop.scaled(record.outputs))
    jacobian = (~np.isnan(record.outputs) * np.log(loop.scale)).sum()
    assert float(log_prob(model, values, record)) == pytest.approx(total - jacobian, rel=1e-10)


def test_a_known_function_of_inputs_is_a_linear_model_of_other_inputs():
    """Seen in the inputs' units; exact, and for several inputs at once."""
    record = make_record(inputs=2)
    first = Known(lambda u, v, a: a * u.square() + v, {"a": dist.LogNormal(0.0, 1.0)})
    model = dgp.Cascade(2, (first, Dynamic(pairs=2)), integrate="all").scaled_to(record)
    values = values_at(model, 0)
    u, v = record.inputs.T
    transformed = float(values["f_a"]) * u**2 + v
    other = dgp.Record(time=record.time, inputs=transformed, outputs=record.outputs)
    function = model.system(values, model.scaling).layer("f").function
    scaling = replace(
        Scaling.from_records([other]),
        input_offset=function.centre.numpy(),
        input_scale=function.size.numpy(),
    )
    linear = dgp.LinearDynamicGP(1, pairs=2, scaling=scaling)
    found = float(log_prob(model, values, record))
    assert found == pytest.approx(float(log_prob(linear, values, other)), rel=1e-12)
    # Mean and standard deviation of u^2 + v for independent normal u and v.
    m, s = model.scaling.input_offset, model.scaling.input_scale
    sd = np.sqrt(4.0 * m[0] ** 2 * s[0] ** 2 + 2.0 * s[0] ** 4 + s[1] ** 2)
    assert float(function.size) == pytest.approx(sd, rel=1e-9)
    assert float(function.centre) == pytest.approx(m[0] ** 2 + s[0] ** 2 + m[1], rel=1e-9)


@pytest.mark.parametrize("where", ["feedback", "chain"])
def test_gradient_is_that_of_finite_differences(where):
    record = make_record(n=25)
    if where == "feedback":
        model = looped(tanh, WIDTH, record)
    else:
        layers = (
            Known(lambda u, dead: u - dead * torch.tanh(u / dead), {"dead": dist.Gamma(2.0, 4.0)}),
            Dynamic(pairs=2),
            Known(tanh, WIDTH),
        )
        model = dgp.Cascade(1, layers, integrate="all").scaled_to(record)
    values = values_at(model, 1)
    check_gradient(Potential(model, (model.prepare(record),), values))


def test_prior_draws_are_those_of_a_plain_simulation():
    """300 draws of all sites and of the outputs, each way with numbers of its own."""
    record = make_record(missing=False)
    model = looped(tanh, WIDTH, record)
    blank = model.prepare(dgp.Record(time=record.time, inputs=record.inputs))
    count, times = 300, (3, 12, 25, 39)
    scaling = model.scaling
    shift, scale = scaling.output_offset[0], scaling.output_scale[0]
    nodes, weights = np.polynomial.hermite_e.hermegauss(11)
    typical = np.tanh(shift + scale * nodes - 2.0)
    centre = typical @ weights / weights.sum()
    size = np.sqrt((typical - centre) ** 2 @ weights / weights.sum())
    found, expected = np.empty((2, count, len(times)))
    rng = np.random.default_rng(3)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        for draw in range(count):
            trace = pyro.poutine.trace(model).get_trace(blank)
            found[draw] = trace.nodes["y"]["value"].numpy()[list(times)]
        for draw in range(count):
            values = sample(model.all_sites(scaling, 1))
            loop = plain_loop(model, system_at(model, values), record)
            width, offset = float(values["f_width"]), float(values["offset"])

            def back(g, width=width, offset=offset):
                y = shift + scale * (g + offset)
                return (np.tanh((y - 2.0) / width) - centre) / size

            run = loop.simulate(back, rng)[0, :, 0]
            expected[draw] = shift + scale * run[list(times)]
    for k, time in enumerate(times):
        assert ks_2samp(found[:, k], expected[:, k]).pvalue > 0.001, time


def test_beyond_its_range_it_keeps_its_value():
    record = make_record()
    layers = (Dynamic(pairs=1), Known(lambda y: y**3, range=(1.0, 2.5)))
    model = dgp.Cascade(1, layers, integrate="all").scaled_to(record)
    values = values_at(model, 0)
    function = model.system(values, model.scaling).layer("f").function
    scale, shift = float(model.scaling.output_scale[0]), float(model.scaling.output_offset[0])
    y = torch.tensor([-4.0, 0.9, 1.0, 2.0, 2.5, 7.0]).double()
    x = (y - shift) / scale - values["offset"]
    expected = (y.clamp(1.0, 2.5) ** 3 - shift) / scale
    torch.testing.assert_close(function.mean(x[:, None])[:, 0], expected)
    low, high = function.scaled_ends
    assert float(shift + scale * (low + values["offset"])) == pytest.approx(1.0)
    assert float(shift + scale * (high + values["offset"])) == pytest.approx(2.5)


WRONG = [
    ({"function": "tanh"}, "a function of torch"),
    ({"function": lambda y: 0.0 * y + 1.0}, "changes over the range"),
    ({"function": lambda y: (y - 100.0).sqrt()}, "finite"),
    ({"function": lambda y: y.float()}, "float64"),
    ({"function": lambda y: y[..., :3]}, "values of shape"),
    ({"function": lambda y: y, "range": (1.0, 1.0)}, "low < high"),
    ({"function": lambda y, a: a * y, "parameters": {"a": 1.0}}, "distribution of pyro"),
    ({"function": tanh, "parameters": {"width": dist.Normal(torch.zeros(2), 1.0)}}, "one number"),
]


def run(options):
    layers = (Dynamic(feedback=("f",)), Known(**options))
    record = make_record()
    model = dgp.Cascade(1, layers, output="g").scaled_to(record)
    return log_prob(model, values_at(model, 0), record)


@pytest.mark.parametrize(("options", "message"), WRONG)
def test_what_is_wrong_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        run(options)


def test_several_signals_of_a_trajectory_are_refused():
    with pytest.raises(ValueError, match="one signal"):
        run({"function": lambda y, u: y * u, "skip": ("inputs",)})


def test_priors_are_of_double_precision():
    model = looped(tanh, {"width": dist.HalfCauchy(1.0)})
    assert values_at(model, 0)["f_width"].dtype == torch.float64


def test_a_climb_starts_in_the_middle_of_the_priors_with_little_feedback():
    """A learnt function comes back as nothing at first; a known one by gains that are small."""
    record = make_record()
    model = looped(tanh, {"width": dist.LogNormal(0.7, 0.5)}, record)
    linear = dgp.LinearDynamicGP(1, pairs=2).scaled_to(record)
    values = starting_point(
        model, model.prepare(record), Plan("g", values_at(linear, 0), False, seed=0)
    )
    assert float(values["f_width"]) == pytest.approx(np.exp(0.7), rel=1e-6)
    assert float(values["g_input_gain"][:, 1].abs().max()) < 0.25
    half = Site("x", dist.HalfCauchy(torch.tensor(1.0).double()), ())
    assert float(middle_of(half)) == 1.0  # there is no mean
    assert float(middle_of(Site("x", dist.Gamma(2.0, 4.0), ()))) == 0.5
