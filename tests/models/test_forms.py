"""Parametric forms in feedback, against a plain simulation, and as layers that are saved."""

import copy
import pickle

import gpytorch
import numpy as np
import pyro.distributions as dist
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.free_runs import noise_sites
from pyro_dynogp.inference.starts.plans import Plan, plans, starting_point
from pyro_dynogp.models.feedback_variants import with_feedback, with_forms, with_usual_substeps
from pyro_dynogp.models.forms import form_of
from pyro_dynogp.models.outputs import output_process
from tests.models.closed_loops import check_free_run, check_gradient, make_record, system_at
from tests.models.test_known import values_at

SEES = pytest.mark.parametrize(("sees", "hidden"), [("g", 0), ("g_hidden", 1)])
EACH = pytest.mark.parametrize("form", ["step", "root", "edge", "cube"])
# The forms in numpy, and where and how wide they are in the middle of their priors.
PLAIN = {
    "step": lambda x, at, width: np.tanh((x - at) / width),
    "root": lambda x, at, width: np.sqrt(0.1 * np.logaddexp(0.0, (x - at) / 0.1) + 1e-4),
    "edge": lambda x, at, width: width * np.logaddexp(0.0, (x - at) / width),
    "cube": lambda x, at, width: (x - at) ** 3,
}
MIDDLE = {
    "step": (0.0, np.exp(-2.0)),
    "root": (-2.0, None),
    "edge": (1.0, np.exp(-2.0)),
    "cube": (0.0, None),
}
# Those of no width.
NARROW = ("root", "cube")


def looped(record, sees, hidden, form="step", **options):
    dynamic = dgp.Dynamic(pairs=2, feedback=("f",), hidden=hidden, **options)
    return dgp.Cascade(1, (dynamic, dgp.Form(form, sees=(sees,))), output="g").scaled_to(record)


def placed(form, at, width):
    """Sites of a form's place and width, as far as it has them."""
    given = {"f_at": at} | ({} if form in NARROW else {"f_width": width})
    return {k: torch.tensor(v, dtype=torch.float64) for k, v in given.items()}


@EACH
@SEES
def test_free_runs_are_those_of_a_plain_simulation(sees, hidden, form):
    """Of the output, with its offset, in standard deviations; of a hidden signal as it is."""
    record = make_record(missing=False)
    model = looped(record, sees, hidden, form, process_noise=False, feedthrough=False)
    values = values_at(model, 3) | placed(form, 0.2, 0.3)
    plain, middle = PLAIN[form], MIDDLE[form]
    nodes, weights = np.polynomial.hermite_e.hermegauss(11)
    weights = weights / weights.sum()
    typical = plain(nodes, *middle)  # in the middle of the priors
    level = weights @ typical
    size = np.sqrt(weights @ (typical - level) ** 2)

    def back(signals):
        seen = np.clip(signals[hidden], -7.98, 7.98)  # 801 points to 8
        return (plain(seen, 0.2, 0.3) - level) / size

    check_free_run(model, values, record, back, 1e-4)  # a table of 801 points


@EACH
@SEES
def test_gradient_is_that_of_finite_differences(sees, hidden, form):
    record = make_record(n=25)
    model = looped(record, sees, hidden, form)
    values = values_at(model, 1)
    values |= placed(form, float(values["f_at"]), 0.5)
    check_gradient(Potential(model, (model.prepare(record),), values))


@EACH
@SEES
def test_its_place_and_width_matter(sees, hidden, form):
    record = make_record()
    model = looped(record, sees, hidden, form)
    values = values_at(model, 0)
    (prepared,) = model.prepare(record)

    def density(at, width):
        given = values | placed(form, at, width)
        return float(output_process(system_at(model, given), prepared).log_prob(
            prepared.observations))  # fmt: skip

    start = density(0.0, 0.2)
    assert abs(density(0.3, 0.2) - start) > 1e-3
    assert form in NARROW or abs(density(0.0, 0.6) - start) > 1e-3


@EACH
def test_copies_are_the_same_layer_also_in_another_process(form):
    options = {"sees": ("g_hidden",), "name": "flow"}
    layer = dgp.Form(form, **options)
    twins = (copy.deepcopy(layer), pickle.loads(pickle.dumps(layer)), dgp.Form(form, **options))
    for twin in twins:
        assert twin == layer
        assert form_of(twin) == form
    assert [form_of(other) for other in map(dgp.Form, PLAIN)] == list(PLAIN)


def test_other_functions_are_no_forms():
    assert form_of(dgp.Known(lambda x, at: x - at, {"at": dist.Normal(0.0, 1.0)})) is None
    assert form_of(dgp.Static()) is None
    with pytest.raises(
        ValueError,
        match="form: expected one of 'step', 'root', 'edge', 'cube', 'hysteresis', got 'square",
    ):
        dgp.Form("square")
    with pytest.raises(AttributeError, match=r"it is now pyro_dynogp\.models\.forms\.Form"):
        dgp.Step  # noqa: B018


def test_the_parametric_model_has_them_alone():
    wires = {w.name: w for w in dgp.NonlinearFeedback(1, hidden=1, parametric=True).wires}
    assert {name: (form_of(w.layer), w.sources) for name, w in wires.items() if name != "g"} == {
        "output_root": ("root", ("g",)),
        "output_edge": ("edge", ("g",)),
        "hidden_root": ("root", ("g_hidden",)),
        "hidden_edge": ("edge", ("g_hidden",)),
        "hidden_step": ("step", ("g_hidden",)),
    }
    assert wires["g"].feedback == tuple(name for name in wires if name != "g")
    assert wires["g"].layer.substeps == 3
    alone = dgp.NonlinearFeedback(1, parametric=True, substeps=2)
    assert [w.name for w in alone.wires] == ["g", "output_root", "output_edge", "output_step"]
    assert alone.wires[0].layer.substeps == 2
    wires = dgp.NonlinearFeedback(1, outputs=2, hidden=1, parametric=True).wires
    assert {w.name: w.sources for w in wires if w.name != "g"} == {
        "output_1_root": ("g[0]",), "output_1_edge": ("g[0]",),
        "output_2_root": ("g[1]",), "output_2_edge": ("g[1]",),
        "hidden_root": ("g_hidden",), "hidden_edge": ("g_hidden",), "hidden_step": ("g_hidden",),
    }  # fmt: skip
    names = [w.name for w in dgp.NonlinearFeedback(1, outputs=2, parametric=True).wires]
    assert names[-2:] == ["output_1_step", "output_2_step"]
    for options in ({"step": False}, {"inducing": 8}, {"kernel": gpytorch.kernels.RBFKernel()}):
        with pytest.raises(ValueError, match="parametric: expected False beside step, kernel or"):
            dgp.NonlinearFeedback(1, parametric=True, **options)
    with pytest.raises(ValueError, match="parametric: expected True or False"):
        dgp.NonlinearFeedback(1, parametric=2)


def test_the_parametric_model_has_one_form_alone():
    wires = {w.name: w for w in dgp.NonlinearFeedback(1, parametric="cube").wires}
    assert list(wires) == ["g", "cube_of_output"]
    assert wires["g"].layer.substeps == 3
    assert form_of(wires["cube_of_output"].layer) == "cube"
    two = dgp.NonlinearFeedback(1, outputs=2, hidden=1, parametric="root").wires
    names = ["g", "root_of_output_1", "root_of_output_2", "root_of_hidden"]
    assert [w.name for w in two] == names
    for unlike in ("hysteresis", "square"):
        with pytest.raises(ValueError, match=f"parametric: expected True, .* got '{unlike}'"):
            dgp.NonlinearFeedback(1, parametric=unlike)
    with pytest.raises(ValueError, match="parametric: expected False beside step, kernel or"):
        dgp.NonlinearFeedback(1, parametric="cube", step=True)


def test_a_cube_forecasts_beyond_the_amplitudes_of_the_training_record():
    generator = np.random.default_rng(0)
    force = np.repeat(generator.uniform(-1.0, 1.0, 150), 4)
    force *= np.where(np.arange(600) < 400, 3.0, 10.0)
    state, positions, h = np.zeros(2), [], 0.005
    for u in force:
        positions.append(state[0])
        for _ in range(10):  # semi-implicit Euler steps, of a spring that hardens
            state[1] += h * (u - 0.6 * state[1] - 4.0 * state[0] - 4.0 * state[0] ** 3)
            state[0] += h * state[1]
    outputs = np.array(positions) + generator.normal(0.0, 0.005, 600)
    record = dgp.Record(0.05 * np.arange(600), force, outputs)
    assert np.abs(outputs[400:]).max() > 1.3 * np.abs(outputs[:400]).max()
    model = dgp.NonlinearFeedback(1, parametric="cube", process_noise=False)
    fit = dgp.fit(model, record[:400], method="map", workers=1, progress=False)
    error = fit.forecast(record[:400], record[400:]).mean[:, 0] - outputs[400:]
    assert np.sqrt(np.mean(error**2)) < 0.01  # of a standard deviation of 0.6


def test_the_loop_adds_those_that_a_model_lacks():
    model = dgp.LinearDynamicGP(1)
    for hidden in (False, True):
        ready = dgp.NonlinearFeedback(1, hidden=int(hidden), parametric=True)
        assert [w.name for w in with_forms(model, hidden=hidden).wires] == [
            w.name for w in ready.wires
        ]
    assert with_forms(model).substeps == 1  # more where they are better, see the loop's trials
    assert with_usual_substeps(with_forms(model)).substeps == 3
    both = with_feedback(with_forms(model), output=False, hidden=True)  # no name twice
    assert len(both.wires) == len({w.name for w in both.wires}) == 6
    for ready in (with_forms(model, hidden=True), both):  # sites of a layer begin with its name
        assert not any(w.name.startswith("g_") for w in ready.wires)
    names = {w.name for w in with_forms(with_feedback(model), hidden=True).wires}
    assert names == {"g", "feedback", "hidden_root", "hidden_edge", "hidden_step"}
    assert with_forms(with_forms(model)) is with_forms(with_feedback(model)) is None
    ready = dgp.NonlinearFeedback(1, outputs=2, hidden=2, parametric=True)
    each = with_forms(dgp.LinearDynamicGP(1, outputs=2), hidden=True)
    assert [(w.name, w.sources) for w in each.wires] == [(w.name, w.sources) for w in ready.wires]
    assert with_forms(dgp.NonlinearFeedback(1, hidden=2)) is None


def test_the_ready_model_has_one_beside_a_hidden_signal():
    names = {
        options: [w.name for w in dgp.NonlinearFeedback(1, **dict(options)).wires]
        for options in ((), (("hidden", 1),), (("step", True),), (("hidden", 1), ("step", False)),
                        (("hidden", 2),))
    }  # fmt: skip
    assert list(names.values()) == [
        ["g", "f"], ["g", "f1", "f2", "step"], ["g", "f1", "step"], ["g", "f1", "f2"],
        ["g", "f1", "f2"],
    ]  # fmt: skip
    model = dgp.NonlinearFeedback(1, hidden=1)
    assert {w.name: w.sources for w in model.wires}["step"] == ("g_hidden",)
    assert model.wires[0].feedback == ("f1", "f2", "step")
    for options in ({"hidden": 2}, {"outputs": 2}):
        with pytest.raises(ValueError, match="step: expected None or False"):
            dgp.NonlinearFeedback(1, step=True, **options)
    with pytest.raises(ValueError, match="step: expected True or False"):
        dgp.NonlinearFeedback(1, step=2)


def test_the_loop_adds_one_with_a_hidden_signal():
    model = with_feedback(dgp.LinearDynamicGP(1), hidden=True)
    kinds = {w.name: form_of(w.layer) == "step" for w in model.wires}
    assert kinds == {
        "g": False, "feedback": False, "hidden_feedback": False, "feedback_step": True
    }  # fmt: skip
    assert not any(form_of(w.layer) == "step" for w in with_feedback(dgp.LinearDynamicGP(1)).wires)


def test_later_restarts_draw_its_place():
    record = make_record()
    model = dgp.NonlinearFeedback(1, hidden=1).scaled_to(record)
    linear = dgp.LinearDynamicGP(1, pairs=1).scaled_to(record)
    some = plans(model, {"g": [values_at(linear, 0)]}, 4, seed=0)
    assert [plan.usual for plan in some] == [True, True, False, False]
    with torch.random.fork_rng():
        places = [starting_point(model, model.prepare(record), p)["step_at"] for p in some]
    assert [float(x) for x in places[:2]] == [0.0, 0.0]
    assert len({float(x) for x in places[2:]} - {0.0}) == 2


def test_functions_beside_it_begin_with_gains_as_usual():
    """Of the step they are small, since it is not nothing at first."""
    record = make_record()
    model = dgp.NonlinearFeedback(1, pairs=2, hidden=1).scaled_to(record)
    values = values_at(dgp.LinearDynamicGP(1, pairs=2).scaled_to(record), 0)
    values["g_input_gain"] = torch.ones_like(values["g_input_gain"])
    start = starting_point(model, model.prepare(record), Plan("g", values, False, seed=0))
    gains = start["g_input_gain"].abs()
    share = gains / gains[:, :1]  # of what acts as an input does
    assert float(share[:, 1:3].min()) > 0.2
    assert float(share[:, 3].max()) < 0.25


@pytest.mark.parametrize("options", [{"inducing": 6}, {"parametric": True}])
def test_a_file_keeps_them(tmp_path, options):
    record = make_record(n=60, missing=False)
    fit = dgp.fit(dgp.NonlinearFeedback(1, hidden=1, **options), record, method="map", restarts=1,
                  steps=4, workers=1, progress=False)  # fmt: skip
    path = tmp_path / "forms.safetensors"
    fit.save(path)
    again = dgp.load(path)
    assert again.model == fit.model
    np.testing.assert_array_equal(again.simulate(record).mean, fit.simulate(record).mean)
    assert "step: at" in str(fit.summary())
    assert "step" in repr(fit)


@pytest.mark.parametrize(("samples", "learnt"), [(160, True), (150, False)])
def test_what_free_runs_have_ruled_out_does_not_come_back_with_draws(samples, learnt):
    """Along more than 150 samples poles and noise stay where free runs have put them."""
    record = make_record(n=samples, missing=False)
    fit = dgp.fit(dgp.NonlinearFeedback(1, parametric=True), record, restarts=1, steps=4, workers=1,
                  progress=False)  # fmt: skip
    moving = {name for name, x in fit.draws.items() if not torch.equal(x, x[:1].expand_as(x))}
    forms = {
        "output_root_at",
        "output_edge_at",
        "output_edge_width",
        "output_step_at",
        "output_step_width",
    }
    assert moving >= forms
    others = {"g_log_decay", "noise_sd", *noise_sites(fit.model)}
    assert moving.isdisjoint(others) == learnt
    assert fit.method == ("svi" if learnt else "importance")


def test_which_models_learn_a_function():
    back = dgp.Dynamic(pairs=1, feedback=("f",))
    known = dgp.Known(torch.tanh)
    product = dgp.Product(1, sees=("inputs", "g"), name="f")
    for layer, expected in (
        (dgp.Form("root"), True), (dgp.Static(), True), (known, False), (product, False),
    ):  # fmt: skip
        assert dgp.Cascade(1, (back, layer), output="g").learns_function is expected
    sensor = dgp.Cascade(1, (dgp.Dynamic(pairs=1), dgp.Form("root")))
    assert not sensor.learns_function  # forwards
    assert not dgp.Cascade(1, (back, dgp.Form("root")), output="g").has_gaussian_process
