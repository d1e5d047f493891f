"""Cascades as Pyro models: which sites there are, that the value of each is used, and for what."""

import math
from dataclasses import replace

import numpy as np
import pyro
import pytest
import torch
from pyro import poutine
from pyro.infer import Predictive
from scipy.stats import norm

import pyro_dynogp as dgp
from pyro_dynogp.models.limits import at_limits
from pyro_dynogp.models.wiring import Dynamic, Static
from tests.models.cascades import (
    MODELS,
    SMALL,
    blank,
    case,
    draw,
    log_prob,
    make_record,
    nodes,
    parameters,
    particles,
    trajectories,
)

DYNAMIC = ("log_decay", "log_frequency", "input_gain", "noise_gain_local_scale",
           "noise_gain_unit", "feedthrough")  # fmt: skip
STATIC = ("lengthscale", "output_scale", "constant", "center", "half_width", "values")
WIDE = ("lengthscale", "output_scale", "constant", "locations", "values")


# The larger ones, which hold what the others are made of.
LARGE = ["Wiener-Hammerstein", "Hammerstein-Wiener", "several channels", "skips"]


def sites(name, kinds, *more):
    return {f"{name}_{kind}" for kind in (*kinds, *more)} | {name}


EXPECTED = {
    "linear": sites("g", DYNAMIC) | {"offset"},
    "Wiener": sites("g", DYNAMIC, "initial_state") | sites("f", STATIC),
    "Hammerstein": sites("f", STATIC, "slope", "residual") | sites("g", DYNAMIC) | {"offset"},
    "Wiener-Hammerstein": sites("g1", DYNAMIC, "initial_state")
    | sites("f", STATIC, "residual")
    | sites("g2", DYNAMIC)
    | {"offset"},
    "Hammerstein-Wiener": sites("f1", STATIC, "slope", "residual")
    | sites("g", DYNAMIC, "initial_state")
    | sites("f2", STATIC),
    "several channels": sites("g1", DYNAMIC, "output_gain", "initial_state")
    | sites("f", WIDE, "residual")
    | sites("g2", DYNAMIC, "output_gain")
    | {"offset"},
    "skips": sites("g1", DYNAMIC, "initial_state")
    | sites("f", WIDE, "residual")
    | sites("g2", DYNAMIC, "output_gain")
    | {"offset"},
    "two dynamic layers": sites("g1", DYNAMIC) | sites("g2", DYNAMIC) | {"offset"},
}


@pytest.mark.parametrize("name", MODELS)
def test_sites_are_those_of_the_docstring(name):
    model, record = case(name)
    found = nodes(model, record, {})
    assert set(found) == EXPECTED[name] | {"noise_sd", "y"}
    assert [k for k, node in found.items() if node["is_observed"] and k not in EXPECTED[name]] == [
        "y"
    ]
    n = len(record)
    for one in model.wires:
        width = one.layer.outputs
        assert found[one.name]["value"].shape == ((n, width) if width > 1 else (n,))
    # Integrated out, trajectories and what completes a path are gone; all other sites stay.
    gone = {one.name for one in model.wires} | {f"{one.name}_residual" for one in model.wires}
    assert set(nodes(model.collapsed, record, {})) == set(found) - gone


@pytest.mark.parametrize("name", MODELS)
def test_prior_is_finite_and_y_has_the_shape_of_the_record(name):
    model, record = case(name)
    for form in (model, model.collapsed):
        trace = draw(form, record)
        assert np.isfinite(float(trace.log_prob_sum()))
        sampled = draw(form, blank(record)).nodes["y"]
        assert not sampled["is_observed"]
        assert (
            sampled["value"].shape == record.outputs.squeeze(-1 if model.outputs == 1 else ()).shape
        )
        assert torch.isfinite(sampled["value"]).all()


def shifted(value, name):
    """Another value of a site within its support."""
    generator = torch.Generator().manual_seed(1)
    by = torch.rand(value.shape, dtype=torch.float64, generator=generator)
    return value - 0.1 * by if "log_" in name else value + 0.02 + 0.1 * by


@pytest.mark.parametrize("name", LARGE)
def test_every_parameter_changes_the_collapsed_likelihood(name):
    model, record = case(name)
    model = model.collapsed
    values = parameters(model, draw(model, record, seed=4))
    before = log_prob(model, record, values, "y")
    for site, value in values.items():
        after = log_prob(model, record, {**values, site: shifted(value, site)}, "y")
        assert abs(after - before) > 1e-7, site


@pytest.mark.parametrize("name", LARGE)
def test_every_parameter_changes_signals_or_outputs(name):
    model, record = case(name, n=24)
    trace = draw(model, record, seed=3)
    values = parameters(model, trace)
    free = [one.name for one in model.wires if not (one.pathwise and isinstance(one.layer, Static))]
    signals = {one: trace.nodes[one]["value"] for one in free}
    before = log_prob(model, record, values | signals, *free, "y")
    for site, value in values.items():
        changed = {**values, **signals, site: shifted(value, site)}
        after = log_prob(model, record, changed, *free, "y")
        assert abs(after - before) > 1e-7, site


@pytest.mark.parametrize("name", MODELS)
def test_every_signal_changes_what_comes_after_it_and_nothing_else(name):
    """One sample of a signal moved: what sees it changes; all else but its own prior does not."""
    model, record = case(name)
    trace = draw(model, record, seed=3)
    values = parameters(model, trace)
    values |= {one: trace.nodes[one]["value"] for one in trajectories(model)}
    before = nodes(model, record, values)
    wires = model.wires
    for place, one in enumerate(wires):
        moved = values[one.name].clone()
        moved[10] += 0.3
        after = nodes(model, record, {**values, one.name: moved})
        sees = [w.name for w in wires[place + 1 :] if one.name in w.sources]
        if one.last:
            sees.append("y")
        for site, node in after.items():
            same = float(node["log_prob_sum"]) == float(before[site]["log_prob_sum"])
            if site in sees and not _deterministic(model, site):
                assert not same, (one.name, site)
            elif site != one.name:
                assert same, (one.name, site)


def _deterministic(model, site):
    return any(w.name == site and w.pathwise and isinstance(w.layer, Static) for w in model.wires)


@pytest.mark.parametrize("site", ["g1", "f"])
def test_intervention_acts_downstream_only(site):
    model, record = case("Wiener-Hammerstein")
    generator = torch.Generator().manual_seed(0)
    value = torch.randn(len(record), dtype=torch.float64, generator=generator)
    base = draw(model, record, seed=5)
    known = parameters(model, base)
    fixed = poutine.condition(model, data=known)
    plain = draw(fixed, record, seed=5)
    for intervened in (pyro.do(fixed, data={site: value}), poutine.do(fixed, data={site: value})):
        trace = draw(intervened, record, seed=5)
        # Upstream, and the site's own prior draw: as if nothing had happened.
        upstream = ["g1", "f"][: ["g1", "f"].index(site) + 1]
        for one in upstream:
            assert torch.equal(trace.nodes[one]["value"], plain.nodes[one]["value"])
        assert not torch.allclose(trace.nodes["g2"]["fn"].mean, plain.nodes["g2"]["fn"].mean)
        # Downstream: as where the value is given.
        given = draw(poutine.condition(fixed, data={site: value}), record, seed=5)
        for one in ("f", "g2"):
            if one not in upstream:
                name = "value" if one == "f" else "fn"
                a, b = (t.nodes[one][name] for t in (trace, given))
                a, b = (a, b) if one == "f" else (a.mean, b.mean)
                assert torch.equal(a, b)


def test_intervention_on_the_last_function():
    model, record = case("Wiener")
    value = torch.linspace(-1.0, 1.0, len(record), dtype=torch.float64)
    fixed = pyro.do(poutine.condition(model, data=parameters(model, draw(model, record))),
                    data={"f": value})  # fmt: skip
    trace = draw(fixed, record)
    scale, shift = model.scaling.output_scale[0], model.scaling.output_offset[0]
    np.testing.assert_allclose(
        trace.nodes["y"]["fn"].base_dist.loc.numpy(), shift + scale * value.numpy(), rtol=1e-12
    )


def test_conditioning_on_a_trajectory():
    """The static layer is a function of the trajectory given, and y is normal around it."""
    model, record = case("Wiener")
    g = torch.sin(torch.arange(len(record), dtype=torch.float64))
    values = parameters(model, draw(model, record))
    found = nodes(model, record, {**values, "g": g, "f": torch.cos(g)})
    assert found["g"]["is_observed"]
    scale, shift = model.scaling.output_scale[0], model.scaling.output_offset[0]
    expected = norm(shift + scale * torch.cos(g).numpy(), scale * values["noise_sd"].item())
    assert float(found["y"]["log_prob_sum"]) == pytest.approx(
        expected.logpdf(record.outputs[:, 0]).sum(), rel=1e-12
    )
    # f given g: the conditional of the static layer at g.
    with poutine.condition(data=values):
        function = model.sample_system(model.scaling).layer("f").function
    mean, variance = (m[:, 0] for m in function.moments(g.unsqueeze(-1)))
    expected = norm(mean.numpy(), np.sqrt(variance.numpy() + 1e-10)).logpdf(torch.cos(g).numpy())
    assert float(found["f"]["log_prob_sum"]) == pytest.approx(expected.sum(), rel=1e-9)


@pytest.mark.parametrize("name", LARGE)
def test_predictive_draws_from_the_prior(name):
    model, record = case(name)
    n, n_y = len(record), model.outputs
    with torch.random.fork_rng():
        torch.manual_seed(0)
        looped = Predictive(model, num_samples=2)(blank(record))
        parallel = Predictive(model, num_samples=3, parallel=True)(blank(record))
        collapsed = Predictive(model.collapsed, num_samples=3, parallel=True)(blank(record))
    event = (n, n_y) if n_y > 1 else (n,)
    # Predictive keeps the batch dimensions that a loop needs none of.
    assert looped["y"].shape == (2, *event)
    assert parallel["y"].shape == collapsed["y"].shape == (3, *event)
    for one in model.wires:
        width = one.layer.outputs
        assert parallel[one.name].shape == (3, n, *((width,) if width > 1 else ()))


@pytest.mark.parametrize("form", ["explicit", "collapsed"])
@pytest.mark.parametrize("name", LARGE)
def test_vectorised_particles_equal_a_loop(name, form):
    model, record = case(name, gaps=True)
    model = model.collapsed if form == "collapsed" else model
    trace = draw(particles(model, 3), record, seed=2)
    trace.compute_log_prob()
    found = {
        k: v for k, v in trace.nodes.items()
        if v["type"] == "sample" and k not in ("y", "particles")
    }  # fmt: skip
    assert trace.nodes["y"]["log_prob"].shape == (3,)
    for i in range(3):
        alone = nodes(model, record, {k: v["value"][i] for k, v in found.items()})
        for site in (*found, "y"):
            assert float(alone[site]["log_prob_sum"]) == pytest.approx(
                float(trace.nodes[site]["log_prob"][i]), rel=1e-9, abs=1e-9
            ), site


@pytest.mark.parametrize("name", ["Hammerstein", "Wiener-Hammerstein", "several channels"])
def test_several_records_share_their_parameters(name):
    model = MODELS[name]()
    shape = model.inputs, model.outputs
    records = (make_record(*shape, n=24), make_record(*shape, n=15, seed=1, step=0.2))
    model = model.scaled_to(records)
    for form in (model, model.collapsed):
        trace = draw(form, records)
        trace.compute_log_prob()
        values = parameters(model, trace)
        names = ["y"] if form.integrate == "all" else [*trajectories(model), "y"]
        for index, record in enumerate(records):
            own = {
                site.removesuffix(f"_{index}"): value
                for site, value in values.items()
                if not site.endswith(("state_0", "state_1")) or site.endswith(f"state_{index}")
            }
            signals = {k: trace.nodes[f"{k}_{index}"]["value"] for k in names[:-1]}
            alone = nodes(form, record, own | signals)
            assert set(alone) >= set(own)
            for site in names:
                assert float(alone[site]["log_prob_sum"]) == pytest.approx(
                    float(trace.nodes[f"{site}_{index}"]["log_prob_sum"]), rel=1e-11, abs=1e-12
                )


def test_missing_outputs_are_not_scored():
    model, record = case("several channels", gaps=True)
    assert np.isnan(record.outputs).sum() == 5
    trace = draw(model, record)
    y = trace.nodes["y"]
    trace.compute_log_prob()
    base = y["fn"].base_dist
    mean, sd = (getattr(base.base_dist, name).numpy() for name in ("loc", "scale"))
    seen = ~np.isnan(record.outputs)
    expected = norm(mean, sd).logpdf(record.outputs)[seen].sum()
    assert float(y["log_prob_sum"]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", ["Hammerstein", "skips", "Hammerstein-Wiener"])
def test_a_path_is_one_function(name):
    """Equal inputs of a static layer below a dynamic one give equal outputs, residual and all."""
    model, record = case(name)
    trace = draw(model, record)
    one = next(w for w in model.wires if isinstance(w.layer, Static))
    values = parameters(model, trace)
    x = {"inputs": torch.tensor((record.inputs - model.scaling.input_offset)
                                / model.scaling.input_scale)}  # fmt: skip
    for source in one.sources:
        if source != "inputs":  # a trajectory that comes back to where it was
            g = torch.sin(torch.arange(len(record), dtype=torch.float64) * np.pi / 3)
            g = g.round(decimals=12)
            values[source], x[source] = g, g.unsqueeze(-1)
    seen = torch.cat([x[source] for source in one.sources], -1)
    f = nodes(model, record, values)[one.name]["value"]
    _, group = torch.unique(seen, dim=0, return_inverse=True)
    assert group.max() + 1 < len(record)
    for index in range(int(group.max()) + 1):
        same = f[group == index]
        torch.testing.assert_close(same, same[:1].expand_as(same), rtol=0.0, atol=1e-12)
    # ... of which the residual is a part: without it the path is another.
    without = values | {f"{one.name}_residual": 0.0 * values[f"{one.name}_residual"]}
    assert (nodes(model, record, without)[one.name]["value"] - f).abs().max() > 1e-3


@pytest.mark.parametrize("initial_state", ["auto", "integrated", "zero"])
def test_initial_state_is_a_site_where_a_static_layer_sees_it(initial_state):
    for name, expected in {
        "linear": [],
        "Wiener": ["g"],
        "Hammerstein": [],
        "Wiener-Hammerstein": ["g1"],
        "Hammerstein-Wiener": ["g"],
        "two dynamic layers": [],
        "skips": ["g1"],
    }.items():
        raw = MODELS[name]()
        model = dgp.Cascade(raw.inputs, raw.layers, initial_state=initial_state)
        wanted = expected if initial_state == "auto" else []
        assert [one.name for one in model.state_sites] == wanted, name
    # A layer before a dynamic one that a static layer sees is below that one all the same.
    model = dgp.Cascade(1, (Dynamic(pairs=1), Dynamic(pairs=1), Static()))
    assert [one.name for one in model.state_sites] == ["g1", "g2"]
    # Without inputs nothing is left of them.
    assert dgp.Wiener(0, **SMALL).state_sites == ()


def test_limits_of_a_sensor_are_in_the_unit_of_the_output():
    """What the data say nothing of goes on as a straight line does, and stops at the limits."""
    record = make_record()
    low, high = np.quantile(record.outputs, [0.1, 0.8])
    model = dgp.Cascade(1, (dgp.Dynamic(pairs=1), dgp.Static(inducing=4, limits=(low, high))))
    f = model.scaled_to(record).wires[-1]
    offset, scale = record.outputs.mean(), record.outputs.std()
    values = {
        "f_lengthscale": torch.ones(1).double(), "f_output_scale": torch.ones(1).double(),
        "f_constant": torch.zeros(1).double(), "f_slope": torch.ones(1, 1).double(),
        "f_center": torch.zeros(1).double(), "f_half_width": torch.ones(1).double(),
        "f_values": torch.zeros(1, 4).double(),
    }  # fmt: skip
    function = model.scaled_to(record).static_function(f, f.layer, values)
    x = torch.linspace(-9.0, 9.0, 50).double().unsqueeze(-1)
    expected = np.clip(offset + scale * x.numpy(), low, high)
    assert np.allclose(offset + scale * function.mean(x).numpy(), expected, rtol=1e-12)
    with pytest.raises(ValueError, match="scaling: expected that of the training record"):
        model.static_function(f, f.layer, values)


@pytest.mark.parametrize("integrate", ["none", "all"])
def test_outputs_at_a_limit_are_probabilities(integrate):
    """However small the noise, none of them counts for more than a probability of one."""
    record = make_record(n=24)
    top = float(np.sort(record.outputs[:, 0])[-6])
    stopped = record.with_outputs(np.minimum(record.outputs, top))
    model = dgp.Wiener(inputs=1, pairs=1, inducing=4)
    given = dgp.Static(inducing=4, mean="linear", limits=(None, top))
    model = replace(model, layers=(model.layers[0], given), integrate=integrate)
    model = model.scaled_to(record)
    assert at_limits(model.layers, stopped).sum() == 6
    trace = draw(model, stopped)
    count = 6 * (trace.nodes["noise_sd"]["value"].log() + 0.5 * math.log(2.0 * math.pi))
    assert trace.nodes["at_limits"]["fn"].log_factor.item() == pytest.approx(
        count.item(), rel=1e-12
    )
    assert "at_limits" not in draw(model, record.with_outputs(0.5 * record.outputs)).nodes
    blank_record = record.with_outputs(np.full((24, 1), np.nan))
    assert "at_limits" not in draw(model, blank_record).nodes


def test_first_state_acts_on_the_beginning():
    """The site moves the first samples of the mean of g, and is forgotten later."""
    model, record = case("Wiener", n=60, step=1.0)
    values = parameters(model, draw(model, record))
    values["g_log_decay"] = torch.zeros(2, dtype=torch.float64)
    zero, one = (
        nodes(model, record, values | {"g_initial_state": torch.full((4,), x).double()})["g"]["fn"]
        for x in (0.0, 1.0)
    )
    off = (one.mean - zero.mean).abs()
    assert off[0] > 1e-2
    assert off[-1] < 1e-2 * off.max()
    torch.testing.assert_close(one.variance, zero.variance)


@pytest.mark.parametrize(("options", "message"), [
    ({"inputs": -1}, "inputs: expected a whole number >= 0"),
    ({"inputs": 1.0}, "inputs"),
    ({"likelihood": "gaussian"}, "likelihood: expected Gaussian"),
    ({"priors": "none"}, "priors: expected 'default' or 'paper'"),
    ({"integrate": "first"}, "integrate: expected 'none', 'last' or 'all'"),
    ({"initial_state": "random"}, "initial_state: expected 'auto', 'site'"),
    ({"integrate": "last", "likelihood": dgp.StudentT()}, "only a dynamic last layer"),
    ({"integrate": "last", "likelihood": dgp.Heteroscedastic()}, "only a dynamic last layer"),
    ({"integrate": "last", "layers": (Dynamic(), Static())}, "only a dynamic last layer"),
    ({"layers": ()}, "layers: expected at least one layer"),
])  # fmt: skip
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        dgp.Cascade(**{"inputs": 1, "layers": (Dynamic(),), **options})


@pytest.mark.parametrize(("options", "message"), [
    ({"inducing": 0}, "inducing: expected a whole number >= 1, got 0"),
    ({"of": "time"}, "of: expected 'inputs' or 'output', got 'time'"),
])  # fmt: skip
def test_bad_noise(options, message):
    with pytest.raises(ValueError, match=message):
        dgp.Heteroscedastic(**options)


def test_records_that_do_not_fit():
    model, record = case("Wiener")
    with pytest.raises(ValueError, match="expected 1 inputs, as the model has, got 2"):
        model(make_record(2))
    with pytest.raises(ValueError, match="expected 1 outputs, as the model has, got 2"):
        model(make_record(1, 2))
    volts = dgp.Record(time=record.time, inputs=record.inputs, input_units=("V",))
    with pytest.raises(ValueError, match="unit"):
        model(volts)
    with pytest.raises(ValueError, match="constant noise for a model without inputs"):
        draw(dgp.Wiener(0, likelihood=dgp.Heteroscedastic(), **SMALL), make_record(0))
    system = draw(model.collapsed, record).nodes["y"]["fn"].system
    with pytest.raises(ValueError, match="one of the layers"):
        system.layer("g7")
