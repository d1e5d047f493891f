"""A hysteresis in feedback, against a plain simulation, and as what the loop adds."""

import copy
import pickle

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods import mode
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts import plans
from pyro_dynogp.models.feedback_variants import with_feedback, with_forms, with_hysteresis
from pyro_dynogp.models.forms import form_of, have_no_place
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.moments.functions import HYSTERESIS, Expansion, expansion, expansion_adjoint
from tests.benchmarks.feedback_plants import simulate_bouc_wen
from tests.models.closed_loops import check_free_run, check_gradient, make_record, system_at
from tests.models.test_known import values_at

C = np.sqrt(2.0 / np.pi)
# Signals that it sees, and how many of them nothing measures.
SEES = pytest.mark.parametrize(
    ("sees", "hidden"), [(("g_hidden",), 2), (("g", "g_hidden"), 1), (("g_hidden", "g"), 1)]
)


def looped(record, sees=("g_hidden",), hidden=2, **options):
    layer = dgp.Dynamic(pairs=2, feedback=("past",), hidden=hidden, **options)
    form = dgp.Form("hysteresis", sees=sees, name="past")
    return dgp.Cascade(1, (layer, form), output="g").scaled_to(record)


def density(model, values, record):
    (prepared,) = model.prepare(record)
    return float(output_process(system_at(model, values), prepared).log_prob(prepared.observations))


@SEES
def test_free_runs_are_those_of_a_plain_simulation(sees, hidden):
    record = make_record(missing=False)
    model = looped(record, sees, hidden, process_noise=False, feedthrough=False)
    values = values_at(model, 3)
    small = {k: 0.2 * x for k, x in values.items() if k.endswith("_gain")}  # products grow
    values |= small
    share = float(values["past_share"])

    def back(signals):
        seen = {"g": signals[:1], "g_hidden": signals[1:]}
        v, w = (one for name in sees for one in seen[name])
        return (abs(v) - C) * w + share * v * (abs(w) - C)

    check_free_run(model, values, record, back, 1e-9)


@SEES
def test_gradient_is_that_of_finite_differences(sees, hidden):
    record = make_record(n=25)
    model = looped(record, sees, hidden)
    check_gradient(Potential(model, (model.prepare(record),), values_at(model, 1)))


def test_every_site_matters():
    record = make_record()
    model = looped(record)
    values = values_at(model, 0)
    start = density(model, values, record)
    for name, x in values.items():
        assert abs(density(model, values | {name: x + 0.05}, record) - start) > 1e-4, name


@pytest.mark.parametrize("seed", range(3))
def test_derivatives_by_signals_and_parameters(seed):
    """Of the compiled function, by central differences; away from where it bends."""
    rng = np.random.default_rng(seed)
    names = {"Z": (1, 2), "inverse": (2,), "weight": (1, 1), "constant": (1,), "slope": (1, 2)}
    part = Expansion(**{name: rng.standard_normal(shape) for name, shape in names.items()})
    z = rng.standard_normal(2)

    def value(z, part):
        f = np.empty(1)
        expansion(HYSTERESIS, z, part, f)
        return f[0]

    v, w = z - part.Z[0]
    line = part.constant[0] + part.slope[0] @ z
    assert value(z, part) == pytest.approx(line + abs(v) * w + part.weight[0, 0] * v * abs(w))
    bars = Expansion(*(np.zeros_like(x) for x in part))
    z_bar = np.zeros(2)
    expansion_adjoint(HYSTERESIS, z, part, np.ones(1), z_bar, bars)
    for x, bar in ((z, z_bar), *zip(part, bars, strict=True)):
        for at in np.ndindex(x.shape):
            old = x[at]
            x[at] = old + 1e-6
            above = value(z, part)
            x[at] = old - 1e-6
            below = value(z, part)
            x[at] = old
            assert bar[at] == pytest.approx((above - below) / 2e-6, abs=1e-7)


def test_copies_and_files_keep_it(tmp_path):
    layer = dgp.Form("hysteresis", sees=("g_hidden",), name="past")
    for twin in (copy.deepcopy(layer), pickle.loads(pickle.dumps(layer))):
        assert twin == layer
        assert form_of(twin) == "hysteresis"
    record = make_record(n=60, missing=False)
    fit = dgp.fit(with_hysteresis(dgp.LinearDynamicGP(1, pairs=2)), record, method="map",
                  restarts=1, steps=4, workers=1, progress=False)  # fmt: skip
    fit.save(tmp_path / "fit.safetensors")
    again = dgp.load(tmp_path / "fit.safetensors")
    assert again.model == fit.model
    np.testing.assert_array_equal(again.simulate(record).mean, fit.simulate(record).mean)
    assert "hysteresis" in repr(fit)


def test_it_sees_two_signals():
    record = make_record(n=20)
    for sees, hidden, got in ((("g",), 0, 1), (("g_hidden",), 1, 1), (("g", "g_hidden"), 2, 3)):
        with pytest.raises(ValueError, match=f"layer 'past': expected 2 signals.*got {got} sig"):
            looped(record, sees, hidden)
    layers = (dgp.Dynamic(feedback=("f",), hidden=2), dgp.Form("step", sees=("g_hidden",)))
    with pytest.raises(ValueError, match=r"layer 'f': expected 1 signals.*got 2 signals"):
        dgp.Cascade(1, layers, output="g")


def test_of_inputs_alone_it_is_the_function_itself():
    layer = dgp.Form("hysteresis")
    v, w = torch.randn(2, 9, dtype=torch.float64)
    expected = (v.abs() - C) * w + 0.3 * v * (w.abs() - C)
    torch.testing.assert_close(layer.function(v, w, share=torch.tensor(0.3).double()), expected)
    nodes = torch.randn(2, 200_000, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = layer.function(*nodes, share=torch.tensor(0.5).double())
    for part in nodes:  # no line where both are standard normal
        assert abs(float((found * part).mean())) < 0.01


def test_which_models_get_one():
    model = with_hysteresis(dgp.LinearDynamicGP(1, pairs=2))
    assert {w.name: w.sources for w in model.wires} == {
        "g": ("inputs",), "feedback_hysteresis": ("g_hidden",)
    }  # fmt: skip
    ((_, layer),) = model.dynamic
    assert (layer.hidden, layer.substeps, model.output_wire.name) == (2, 3, "g")
    assert with_hysteresis(dgp.LinearDynamicGP(1, pairs=1)) is None  # no state for it
    assert with_hysteresis(dgp.LinearDynamicGP(1, pairs=2, outputs=2)) is None
    assert with_hysteresis(dgp.NonlinearFeedback(1, pairs=2, hidden=1)) is None
    assert with_hysteresis(model) is None
    assert with_forms(model, hidden=True) is None
    beside = with_feedback(model)
    assert [w.name for w in beside.wires] == ["g", "feedback", "feedback_hysteresis"]
    assert with_feedback(model, output=False, hidden=True) is None


def test_which_functions_have_no_place():
    line = dgp.LinearDynamicGP(1, pairs=2)
    for model, expected in (
        (with_hysteresis(line), True),
        (with_feedback(line, output=False, hidden=True, step=False), True),
        (with_feedback(line, output=False, hidden=True), False),  # a step has
        (with_forms(line, hidden=True), False),
        (with_feedback(line), False),  # nothing hidden
    ):
        assert have_no_place(model.layers) is expected


def test_hidden_signals_begin_as_the_derivative_and_about_the_output():
    record = make_record(missing=False)
    model = looped(record)
    linear = values_at(dgp.LinearDynamicGP(1, pairs=2).scaled_to(record), 0)
    prepared = model.prepare(record)
    both = [plans.Plan("g", linear, False, seed=seed, ahead=bool(seed)) for seed in (0, 1)]
    starts = [plans.starting_point(model, prepared, plan) for plan in both]
    for start in starts:
        own, rate, force = (torch.view_as_complex(x.contiguous()) for x in start["g_output_gain"])
        poles = torch.complex(-start["g_log_decay"].exp(), start["g_log_frequency"].exp())
        torch.testing.assert_close(rate, poles / poles.abs().median() * own)
        off = torch.view_as_real(force - own).abs()
        assert float(off.min()) > 0.0
        assert float(off.max()) < 1.2
    assert not torch.equal(*(start["g_output_gain"][2] for start in starts))


@pytest.mark.parametrize(("hidden", "count"), [(0, 4), (1, 8), (2, 16)])
def test_more_hidden_signals_have_more_restarts(monkeypatch, hidden, count):
    asked = []

    def starts_of(model, records, twins, restarts, seed):
        asked.append(restarts)
        raise KeyboardInterrupt

    monkeypatch.setattr(mode, "starts_of", starts_of)
    with pytest.raises(KeyboardInterrupt):
        dgp.fit(dgp.NonlinearFeedback(1, hidden=hidden), make_record(missing=False), method="map",
                steps=2, workers=1, progress=False)  # fmt: skip
    assert asked == [count]


def test_it_is_learnt_from_a_linear_fit():
    """Free runs over data to come, from 13 times the noise to the noise."""
    plant = simulate_bouc_wen(6, noise_ratio=0.02, training_samples=500)
    line = dgp.fit(dgp.LinearDynamicGP(1, pairs=2), plant.train, method="map", workers=1,
                   progress=False)  # fmt: skip
    fit = refit(line, plant.train, model=with_hysteresis(line.model), run=Run(0, workers=1))

    def error(found):
        mean = found.forecast(plant.train, plant.test, seed=0).mean
        return float(np.sqrt(np.mean((mean - plant.test.outputs) ** 2))) / plant.noise_sd

    assert error(line) > 5.0
    assert error(fit) < 1.3
