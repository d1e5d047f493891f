"""Layers that see single channels of signals."""

import copy
import pickle

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.criticism.parameter_table import parameter_table
from pyro_dynogp.inference.canonical import Canonical
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.selection import part, place_of, seen, signal_of, twice, with_channels
from tests.models.closed_loops import check_gradient, make_record, springs, system_at, values_of
from tests.models.test_known import values_at


def test_names_of_channels():
    assert [(signal_of(x), place_of(x)) for x in ("g", "g_hidden[12]")] == [
        ("g", None), ("g_hidden", 12)
    ]  # fmt: skip
    assert with_channels({"g": 2, "f": 1}) == {"g": 2, "f": 1, "g[0]": 1, "g[1]": 1, "f[0]": 1}
    assert (part("g", 3), part("g[2]", 3)) == (slice(0, 3), slice(2, 3))
    x = torch.arange(6.0).reshape(1, 2, 3)
    assert torch.equal(seen({"g": x}, "g[1]"), x[..., 1:2])
    assert torch.equal(seen({"g": x}, "g"), x)


@pytest.mark.parametrize(
    ("sources", "expected"),
    [(("g", "h"), None), (("g[0]", "g[1]"), None), (("g", "g"), "g"), (("g", "g[0]"), "g[0]"),
     (("g[0]", "g"), "g"), (("g[1]", "h", "g[1]"), "g[1]")],
)  # fmt: skip
def test_what_is_seen_twice(sources, expected):
    assert twice(sources) == expected


@pytest.mark.parametrize("sees", [("g[2]",), ("g", "g[0]"), ("g[0]", "g[0]"), ("g[-1]",), ("g[",)])
def test_channels_that_there_are_not_or_twice_are_refused(sees):
    layer = dgp.Dynamic(outputs=2, feedback=("f",))
    expected = r"sees of layer 'f': expected names .* as in 'g\[0\]', .* \['g', 'inputs'\]"
    with pytest.raises(ValueError, match=expected):
        dgp.Cascade(1, (layer, dgp.Static(sees=sees, name="f")), output="g")


def test_hidden_signals_are_all_seen():
    layer = dgp.Dynamic(pairs=2, hidden=2, feedback=("f",))
    with pytest.raises(ValueError, match=r"hidden of layer 'g'.*functions that see all"):
        dgp.Cascade(1, (layer, dgp.Static(sees=("g_hidden[1]",), name="f")), output="g")


def test_layers_before_it_matter_where_one_channel_is_seen():
    """And those of which nothing is seen do not."""
    layers = (dgp.Dynamic(outputs=2, name="g"), dgp.Static(sees=("g[1]",), name="f"))
    assert [wire.reads for wire in dgp.Cascade(2, layers).wires] == [{"inputs"}, {"g"}]
    with pytest.raises(ValueError, match="without effect"):
        dgp.Cascade(2, (layers[0], dgp.Static(sees=("inputs[1]",), name="f")))


def branch(record, **options):
    """A Wiener model, and the same of the second of two inputs, each with its record."""
    record = dgp.Record(record.time, record.inputs, record.outputs)
    single = dgp.Record(record.time, record.inputs[:, 1:], record.outputs)
    for given, sees in ((single, ()), (record, ("inputs[1]",))):
        layers = (dgp.Dynamic(pairs=1, sees=sees, name="g"), dgp.Static(inducing=4, name="f"))
        yield dgp.Cascade(given.n_inputs, layers, **options).scaled_to(given), given


def test_one_channel_is_that_channel():
    """Log density, with trajectories integrated out."""
    densities = []
    for model, record in branch(make_record(inputs=2)):
        (prepared,) = model.prepare(record)
        process = output_process(system_at(model, values_at(model, 2)), prepared)
        densities.append(float(process.log_prob(prepared.observations)))
    assert densities[0] == pytest.approx(densities[1], rel=1e-12)


def test_one_channel_is_that_channel_where_trajectories_are_sites():
    drawn = []
    for model, record in branch(make_record(inputs=2, missing=False), integrate="none"):
        with torch.random.fork_rng():
            torch.manual_seed(0)
            drawn.append(pyro.poutine.trace(model).get_trace(record).nodes)
    assert list(drawn[0]) == list(drawn[1])
    assert {"g", "f"} <= set(drawn[0])
    for name, node in drawn[0].items():
        if node["type"] == "sample":
            torch.testing.assert_close(node["value"], drawn[1][name]["value"], rtol=1e-12, atol=0.0)


def test_known_functions_see_a_channel_in_its_unit():
    """Of two outputs the second one, in units and about the level of that."""
    record = make_record(outputs=2, missing=False)
    known = dgp.Known(lambda x, a: a * x, {"a": dist.Normal(2.0, 1.0)}, sees=("g[1]",), name="f")
    layer = dgp.Dynamic(outputs=2, pairs=2, feedback=("f",))
    model = dgp.Cascade(1, (layer, known), output="g").scaled_to(record)
    values = values_at(model, 0)
    function = system_at(model, values).layer("f").function
    scale, middle = model.scaling.output_scale[1:], model.scaling.output_offset[1:]
    np.testing.assert_allclose(function.scale, scale)
    np.testing.assert_allclose(function.shift, middle + scale * values["offset"].numpy()[1:])


@pytest.mark.parametrize("hidden", [0, 2])
def test_gradient_is_that_of_finite_differences(hidden):
    record = make_record(outputs=2, n=25)
    model = springs(2, hidden).scaled_to(record)
    values = values_of(model, record, linear=False)
    values |= {k: 0.2 * x for k, x in values.items() if k.endswith("_values")}  # loops that hold
    check_gradient(Potential(model, (model.prepare(record),), values))


def test_every_site_matters():
    record = make_record(outputs=2)
    model = springs(2, 2).scaled_to(record)
    values = values_of(model, record, linear=False)
    (prepared,) = model.prepare(record)

    def density(v):
        return float(output_process(system_at(model, v), prepared).log_prob(prepared.observations))

    before = density(values)
    for name, x in values.items():
        assert abs(density(values | {name: x + 0.05}) - before) > 1e-6, name


def test_models_that_select_channels_are_fitted_as_they_are_stated():
    """Their layers name channels by place, which another order would change."""
    record = make_record(outputs=2)
    model = springs(2).scaled_to(record)
    problem = Problem(model, model.prepare(record))
    assert Canonical.of(problem).problem is problem


def test_a_fit_is_kept_and_tells_what_its_functions_see(tmp_path):
    record = make_record(outputs=2, n=60, missing=False)
    fit = dgp.fit(springs(2, pairs=1), record, method="map", restarts=1, workers=1, progress=False)
    fit.save(tmp_path / "fit.safetensors")
    loaded = dgp.load(tmp_path / "fit.safetensors")
    assert loaded.model == fit.model
    for other in (loaded, copy.deepcopy(fit), pickle.loads(pickle.dumps(fit))):
        for name, value in fit.mode.items():
            assert torch.equal(other.mode[name], value)
    band = fit.static_function("f1", record, channel=0)
    np.testing.assert_allclose(band.inputs, fit.layers(record)["g"].mean[:, 1], atol=1e-12)
    table = parameter_table(fit)
    assert {f"f{k}: lengthscale along y{k + 1}" for k in range(2)} <= set(table.index)
