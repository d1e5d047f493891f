"""Starting points of a cascade: which restart takes which linear optimum."""

import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.methods import mode as cascade_fit
from pyro_dynogp.inference.optimise.maximum import maximise
from pyro_dynogp.inference.starts.plans import plans
from pyro_dynogp.models.variants import without_noise_below_functions
from pyro_dynogp.models.wiring import Dynamic, Static
from tests.inference.cascades import wiener

OPTIMA = [{"optimum": torch.tensor(float(k))} for k in range(4)]


def taken(model, count, optima):
    return [
        (plan.leading, None if plan.linear is None else int(plan.linear["optimum"]), plan.curved)
        for plan in plans(model, optima, count, seed=0)
    ]


class TestPlans:
    def test_curved_starts_take_the_linear_optima_in_turn(self):
        found = taken(wiener(), 8, {"g": OPTIMA})
        curved = [optimum for _, optimum, bent in found if bent]
        straight = [optimum for _, optimum, bent in found if not bent]
        assert curved == [0, 1, 2, 3, 0, 1]
        assert straight == [0, 1]
        assert found[0] == ("g", 0, True)

    def test_no_curve_without_a_static_layer_at_the_end(self):
        found = taken(dgp.Hammerstein(1, pairs=1), 3, {"g": OPTIMA})
        assert found == [("g", 0, False), ("g", 1, False), ("g", 2, False)]

    def test_leading_layers_take_turns(self):
        model = dgp.WienerHammerstein(1, pairs=1)
        found = taken(model, 4, {"g1": OPTIMA, "g2": OPTIMA[:1]})
        assert [name for name, _, _ in found] == ["g1", "g2", "g1", "g2"]
        assert [optimum for _, optimum, _ in found] == [0, 0, 1, 0]

    def test_seeds_differ(self):
        seeds = [plan.seed for plan in plans(wiener(), {"g": OPTIMA}, 5, seed=3)]
        assert len(set(seeds)) == 5


def test_without_process_noise():
    quiet = without_noise_below_functions(dgp.WienerHammerstein(1, pairs=2))
    assert [one.process_noise for one in quiet.layers if isinstance(one, Dynamic)] == [False] * 2
    assert [one.name for one in quiet.wires] == ["g1", "f", "g2"]
    for model in (
        dgp.Hammerstein(1, pairs=2),  # no static layer sees noise
        dgp.Wiener(1, pairs=2, process_noise=False),
        dgp.WienerHammerstein(1, pairs=2, process_noise=(False, True)),
        dgp.Cascade(1, (Dynamic(pairs=2),)),
    ):
        assert without_noise_below_functions(model) == model
    # What nothing else drives keeps its noise.
    layers = (Dynamic(pairs=1), Static(inducing=4))
    alone = dgp.Cascade(0, layers)
    assert without_noise_below_functions(alone).layers[0].process_noise


def test_starts_climb_without_process_noise_first(monkeypatch, bent):
    calls = []

    def recorded(model, records, starts, run, **options):
        found = maximise(model, records, starts, run, **options)
        calls.append((model, list(starts), options["key"], found))
        return found

    monkeypatch.setattr(cascade_fit, "maximise", recorded)
    model = dgp.Wiener(1, pairs=2, inducing=6)
    fit = dgp.fit(model, bent, method="map", restarts=5, steps=40, workers=1, progress=False)
    by_key = {key: (model, starts, found) for model, starts, key, found in calls}
    quiet, first, optima = by_key["without-process-noise"]
    assert not quiet.layers[0].process_noise
    assert len(first) == 5
    _, second, _ = by_key["cascade"]
    assert len(second) == 3 == len(fit.start_energies)
    # Linear fits leave what is unexplained to process noise: here it is for measurement noise.
    assert all(float(start["noise_sd"]) >= 0.5 for start in first)
    for start, optimum in zip(second, optima[:3], strict=True):
        assert torch.equal(start["f_values"], optimum.values["f_values"])
        # What the deterministic model lacks is as at the start.
        assert torch.equal(start["g_noise_gain_unit"], first[0]["g_noise_gain_unit"])


@pytest.mark.parametrize(
    ("model", "count"),
    [
        (dgp.Wiener(1, pairs=1, inducing=4), 8),
        (dgp.NonlinearFeedback(1, inducing=4), 4),
        (dgp.NonlinearFeedback(1, inducing=4, hidden=1), 8),
    ],
    ids=["function", "feedback", "feedback of a hidden signal"],
)
def test_restarts_by_default(model, count, monkeypatch):
    asked = []

    class DoneError(Exception):
        pass

    def starts_of(model, records, twins, count, seed):
        asked.append(count)
        raise DoneError

    monkeypatch.setattr(cascade_fit, "starts_of", starts_of)
    record = dgp.datasets.load("gas_furnace").train[:60]
    with pytest.raises(DoneError):
        dgp.fit(model, record, method="map", steps=2, workers=1, progress=False)
    with pytest.raises(DoneError):
        dgp.fit(model, record, method="map", steps=2, restarts=3, workers=1, progress=False)
    assert asked == [count, 3]
