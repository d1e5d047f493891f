"""Starting points of a cascade: which restart takes which linear optimum."""

import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.cascade_starts import plans
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
