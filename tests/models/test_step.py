"""A step in feedback, against a plain simulation, and as a layer that is saved and copied."""

import copy
import pickle

import numpy as np
import pyro.distributions as dist
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.starts.plans import Plan, plans, starting_point
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.step import is_step
from pyro_dynogp.models.variants import with_feedback
from tests.models.closed_loops import check_gradient, make_record, system_at
from tests.models.test_known import values_at

SEES = pytest.mark.parametrize(("sees", "hidden"), [("g", 0), ("g_hidden", 1)])


def looped(record, sees, hidden, **options):
    dynamic = dgp.Dynamic(pairs=2, feedback=("f",), hidden=hidden, **options)
    return dgp.Cascade(1, (dynamic, dgp.Step(sees=(sees,))), output="g").scaled_to(record)


@SEES
def test_free_runs_are_those_of_a_plain_simulation(sees, hidden):
    """Of the output, with its offset, in standard deviations; of a hidden signal as it is."""
    record = make_record(missing=False)
    model = looped(record, sees, hidden, process_noise=False, feedthrough=False)
    values = values_at(model, 3)
    system = system_at(model, values)
    modes, scaling = system.layer("g").modes, model.scaling
    offset = float(values["offset"])
    at, width = float(values["f_at"]), float(values["f_width"])
    nodes, weights = np.polynomial.hermite_e.hermegauss(11)
    weights = weights / weights.sum()
    typical = np.tanh(nodes / np.exp(-2.0))  # in the middle of the priors
    size = np.sqrt(weights @ typical**2)
    lam, B = (np.concatenate([x, x.conj()]) for x in (modes.poles.numpy(), modes.B.numpy()))
    C = np.concatenate([modes.C.numpy(), modes.C.numpy().conj()], -1)
    first = system.layer("g").first_state.numpy()
    x = np.concatenate([first, first.conj()])
    u = (record.inputs[:, 0] - scaling.input_offset) / scaling.input_scale
    expected = []
    for k, step in enumerate(np.diff(record.time, append=record.time[-1] + 0.1)):
        signals = (C @ x).real
        expected.append(float(signals[0] + offset))
        seen = signals[1] if hidden else signals[0] + offset
        gain = (np.expm1(lam * step) / lam)[:, None] * B
        back = np.tanh((seen - at) / width) / size
        x = np.exp(lam * step) * x + gain[:, 0] * float(u[k]) + gain[:, 1] * back
    (prepared,) = model.prepare(record)
    # Without process noise outputs say nothing of the state.
    found = output_process(system, prepared).one_step(prepared.observations).mean.numpy()
    found = ((found - scaling.output_offset) / scaling.output_scale).ravel()
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)  # a table of 801 points


@SEES
def test_gradient_is_that_of_finite_differences(sees, hidden):
    record = make_record(n=25)
    model = looped(record, sees, hidden)
    values = values_at(model, 1) | {"f_width": torch.tensor(0.5, dtype=torch.float64)}
    check_gradient(Potential(model, (model.prepare(record),), values))


@SEES
def test_its_place_and_width_matter(sees, hidden):
    record = make_record()
    model = looped(record, sees, hidden)
    values = values_at(model, 0)
    (prepared,) = model.prepare(record)

    def density(**other):
        given = values | {k: torch.tensor(v, dtype=torch.float64) for k, v in other.items()}
        return float(output_process(system_at(model, given), prepared).log_prob(
            prepared.observations))  # fmt: skip

    start = density(f_at=0.0, f_width=0.2)
    assert abs(density(f_at=0.3, f_width=0.2) - start) > 1e-3
    assert abs(density(f_at=0.0, f_width=0.6) - start) > 1e-3


def test_copies_are_the_same_layer_also_in_another_process():
    layer = dgp.Step(sees=("g_hidden",), name="edge")
    for twin in (copy.deepcopy(layer), pickle.loads(pickle.dumps(layer)), dgp.Step(
            sees=("g_hidden",), name="edge")):  # fmt: skip
        assert twin == layer
        assert is_step(twin)
    other = dgp.Known(lambda x, at: x - at, {"at": dist.Normal(0.0, 1.0)})
    assert not is_step(other)
    assert not is_step(dgp.Static())


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
    kinds = {w.name: is_step(w.layer) for w in model.wires}
    assert kinds == {
        "g": False, "feedback": False, "hidden_feedback": False, "feedback_step": True
    }  # fmt: skip
    assert not any(is_step(w.layer) for w in with_feedback(dgp.LinearDynamicGP(1)).wires)


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


def test_a_file_keeps_it(tmp_path):
    record = make_record(n=60, missing=False)
    fit = dgp.fit(dgp.NonlinearFeedback(1, hidden=1, inducing=6), record, method="map", restarts=1,
                  steps=4, workers=1, progress=False)  # fmt: skip
    path = tmp_path / "step.safetensors"
    fit.save(path)
    again = dgp.load(path)
    assert again.model == fit.model
    np.testing.assert_array_equal(again.simulate(record).mean, fit.simulate(record).mean)
    assert "step: at" in str(fit.summary())
    assert "step" in repr(fit)
