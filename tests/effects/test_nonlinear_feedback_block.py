"""A function of the output that acts back on the dynamics: its blocks."""

from types import SimpleNamespace

import pytest

import pyro_dynogp as dgp
from pyro_dynogp.effects.nonlinear_feedback import (
    NonlinearFeedbackOfOutput,
)
from pyro_dynogp.models.feedback_variants import with_feedback, with_products

EFFECT = NonlinearFeedbackOfOutput()
SAID = SimpleNamespace(sentence="What the test said.", where={"output": "x", "products": 0.6})


OF_OUTPUT = ["cube_of_output", "step_of_output", "root_of_output"]
OF_HIDDEN = ["cube_of_hidden", "step_of_hidden", "root_of_hidden"]
FUNCTIONS = ["feedback", *OF_OUTPUT, *OF_HIDDEN, "hidden_feedback"]
PRODUCTS = ["feedback_product", "hidden_product"]


class TestBlock:
    def test_functions_see_the_output_a_hidden_signal_or_both_and_come_back(self, spring):
        variants = EFFECT.extend(dgp.LinearDynamicGP(1, pairs=2), SAID, spring)
        wired = [{w.name: (w.sources, w.feedback) for w in model.wires} for model in variants]
        output, hidden = (("g",), ()), (("g_hidden",), ())
        unseen = ("hidden_feedback", "feedback_step")
        forms = ("output_root", "output_edge", "output_step")
        more = (*forms[:2], "hidden_root", "hidden_edge", "hidden_step")
        assert wired == [
            {"g": (("inputs",), ("feedback",)), "feedback": output},
            *({"g": (("inputs",), (name,)), name: output} for name in OF_OUTPUT),
            *({"g": (("inputs",), (name,)), name: hidden} for name in OF_HIDDEN),
            {"g": (("inputs",), unseen[:1]), unseen[0]: hidden},
            {"g": (("inputs",), ("feedback_product",)),
             "feedback_product": (("inputs", "g"), ())},
            {"g": (("inputs",), ("hidden_product",)),
             "hidden_product": (("inputs", "g_hidden"), ())},
            {"g": (("inputs",), unseen), **dict.fromkeys(unseen, hidden)},
            {"g": (("inputs",), forms), **dict.fromkeys(forms, output)},
            {"g": (("inputs",), more), **dict.fromkeys(more[:2], output),
             **dict.fromkeys(more[2:], hidden)},
            {w.name: (w.sources, w.feedback) for w in dgp.Compartments(1).wires},
            {"g": (("inputs",), ("feedback_products",)), "feedback_products": hidden},
            {"g": (("inputs",), ("feedback_hysteresis",)), "feedback_hysteresis": hidden},
            {"g": (("inputs",), ("feedback", *unseen)), "feedback": output,
             **dict.fromkeys(unseen, hidden)},
        ]  # fmt: skip
        for model in (*variants[:13], *variants[14:]):
            assert model.output_wire.name == "g"
            assert model.dynamic[0][1].pairs == 2
        unseen = (
            "A nonlinear function of a signal of the dynamics of 'x' that is not measured acts "
            "back on them."
        )
        said = [EFFECT.sentence(SAID, model) for model in variants]
        assert said == [
            *("What the test said." for _ in range(4)),
            *(unseen for _ in range(4)),
            "Inputs times 'x' act back on its dynamics.",
            "Inputs times a signal of the dynamics of 'x' that is not measured act back on its "
            "dynamics.",
            unseen,
            "What the test said.",
            both := "Nonlinear functions of 'x', and of a signal of the dynamics of 'x' that is "
            "not measured, act back on them.",
            "'x' is the level of the last of 2 compartments: what flows out of one, by a root and "
            "over an edge, enters the next.",
            "Products of signals of the dynamics of 'x' that are not measured act back on them.",
            "It depends on the past: a hysteresis of two signals of the dynamics of 'x' that are "
            "not measured acts back on them.",
            both,
        ]

    @pytest.mark.parametrize(
        ("share", "leading"),
        [
            (1.0, [*PRODUCTS, *FUNCTIONS]),
            (0.99, [*FUNCTIONS, *PRODUCTS]),
            (0.5, [*FUNCTIONS, *PRODUCTS]),
            (0.49, FUNCTIONS),
        ],
    )
    def test_products_are_tried_by_what_the_test_says_of_them(self, spring, share, leading):
        said = SimpleNamespace(where={"output": "x", "products": share})
        made = EFFECT.extend(dgp.LinearDynamicGP(1), said, spring)
        assert [one.dynamic[0][0].feedback[0] for one in made] == [
            *leading, "hidden_feedback", "output_root", "output_root", "root1",
            "feedback_products", "feedback_hysteresis", "feedback",
        ]  # fmt: skip
        assert made[-1].dynamic[0][0].feedback == (
            "feedback", "hidden_feedback", "feedback_step"
        )  # fmt: skip

    def test_of_several_outputs_each_has_its_function(self, spring):
        """And all have one together. Where functions act back there are those of other signals."""
        made = EFFECT.extend(dgp.LinearDynamicGP(1, outputs=2, pairs=2), SAID, spring)
        wired = [{w.name: w.sources for w in one.wires if w.name != "g"} for one in made]
        own = {"feedback_1": ("g[0]",), "feedback_2": ("g[1]",)}
        hidden = {"hidden_feedback_1": ("g_hidden[0]",), "hidden_feedback_2": ("g_hidden[1]",)}
        steps = {"feedback_step_1": ("g_hidden[0]",), "feedback_step_2": ("g_hidden[1]",)}
        cubes = {f"cube_of_output_{k + 1}": own[f"feedback_{k + 1}"] for k in range(2)}
        cubed = {f"cube_of_hidden_{k + 1}": (f"g_hidden[{k}]",) for k in range(2)}
        assert (wired[0], wired[1], wired[4], wired[7]) == (own, cubes, cubed, hidden)
        assert wired[10:12] == [hidden | steps, {"joint_feedback": ("g",)}]
        assert [len(one) for one in wired[12:]] == [
            6,
            10,
            6,
        ]  # forms, and all smooth ones with steps
        assert wired[-1] == own | hidden | steps
        assert made[7].dynamic[0][1].hidden == 2
        assert made[11].wires[1].layer.outputs == 2
        again = EFFECT.extend(made[0], SAID, spring)
        added = [{w.name for w in one.wires} - {"g", *own} for one in again]
        assert added[0] == set(cubed)
        assert added[3:] == [set(hidden), {"feedback_product"}, {"hidden_product"}]
        assert len(EFFECT.extend(made[11], SAID, spring)) == 6  # none of what the joint one sees
        test = "What the test said."
        unseen = "signals of the dynamics that are not measured"
        assert [EFFECT.sentence(SAID, one) for one in (made[0], made[7], made[11], made[-1])] == [
            f"{test} The model has a function of each output.",
            f"Nonlinear functions of {unseen} act back on them.",
            test,
            f"Nonlinear functions of each output, and of {unseen}, act back on them.",
        ]

    def test_of_functions_and_products_both_are_said(self):
        model = with_products(with_feedback(dgp.LinearDynamicGP(1)))
        assert EFFECT.sentence(SAID, model) == (
            "What the test said. Inputs times 'x' act back on its dynamics."
        )

    def test_what_is_there_is_not_added_again(self, spring):
        """To a function of the output one of a hidden signal, and the other way round."""
        made = EFFECT.extend(dgp.LinearDynamicGP(1), SAID, spring)
        first, cube, _, _, cubed, _, _, second, product, hidden, _, forms, more, chain, *rest = made
        _, past, both = rest
        for model, one, other in (
            (cube, "cube_of_output", "hidden_feedback"), (cubed, "cube_of_hidden", "feedback")
        ):  # fmt: skip
            # A function of what the cube sees is none that is new.
            extended = [set(x.dynamic[0][0].feedback) for x in EFFECT.extend(model, SAID, spring)]
            assert {one, other} in extended
            assert not any({"feedback", "hidden_feedback"} <= names for names in extended)
        back = {"feedback", "hidden_feedback", "feedback_step"}
        products = [{"feedback_product"}, {"hidden_product"}]
        of_output = {"output_root", "output_edge", "output_step"}
        of_hidden = {"hidden_root", "hidden_edge", "hidden_step"}
        for model, others in ((first, of_hidden), (second, of_output)):
            own = set(model.dynamic[0][0].feedback)
            extended = EFFECT.extend(model, SAID, spring)
            made = [set(one.dynamic[0][0].feedback) for one in extended]
            simple = OF_HIDDEN if model is first else OF_OUTPUT
            *leading, function, product_, hidden_product = made[:6]
            assert sorted(map(sorted, (*leading, function))) == sorted(
                sorted(one) for one in (back - {"feedback_step"}, *(own | {x} for x in simple))
            )
            assert [product_, hidden_product] == [own | products[0], own | products[1]]
            assert (back in made) == (model is first)
            assert own | others in made
            assert extended[1].dynamic[0][1].hidden == 1
        made = [set(one.dynamic[0][0].feedback) for one in EFFECT.extend(forms, SAID, spring)]
        assert of_output | of_hidden in made
        for model in (more, both):
            assert len(EFFECT.extend(model, SAID, spring)) == 2  # products
        assert len(EFFECT.extend(product, SAID, spring)) == 15
        added = [one.dynamic[0][0].feedback for one in EFFECT.extend(past, SAID, spring)]
        assert ("feedback_hysteresis", "feedback") in added
        assert all(one.count("feedback_hysteresis") == 1 and len(one) > 1 for one in added)
        for model in EFFECT.extend(chain, SAID, spring):  # of inputs and the level
            assert model.dynamic[-1][0].feedback[-1] == "feedback_product"
            assert EFFECT.sentence(SAID, model).endswith(
                "Inputs times 'x' act back on its dynamics."
            )
        for model in (product, hidden):
            assert model not in EFFECT.extend(model, SAID, spring)
        own = [
            one.dynamic[0][0].feedback
            for one in EFFECT.extend(dgp.NonlinearFeedback(1), SAID, spring)
        ]
        assert own[:4] == [*(("f", name) for name in OF_HIDDEN), ("f", "hidden_feedback")]
        more = EFFECT.extend(dgp.NonlinearFeedback(1, hidden=2), SAID, spring)
        assert [set(one.dynamic[0][0].feedback[2:]) for one in more] == products

    def test_a_function_before_the_dynamics_stays(self, spring):
        for model in EFFECT.extend(dgp.Hammerstein(1), SAID, spring):
            assert [wire.name for wire in model.wires if wire.feedback] == ["g"]
            assert model.wires[0].name == "f"
            assert model.output_wire.name == "g"

    def test_a_sensor_stays_behind_the_loop(self, spring):
        for model in EFFECT.extend(dgp.Wiener(1), SAID, spring):
            wires = {wire.name: wire for wire in model.wires}
            assert wires["g"].feedback
            assert model.output_wire.name == "f"
            assert wires["f"].sources == ("g",)

    @pytest.mark.parametrize(
        "model",
        [
            dgp.Cascade(
                1,
                (
                    dgp.Dynamic(feedback=("f",), name="g1"),
                    dgp.Static(name="f"),
                    dgp.Dynamic(name="g2", sees=("g1",)),
                ),
            ),
            dgp.LinearDynamicGP(1, likelihood=dgp.StudentT(4)),
            dgp.LinearDynamicGP(1, likelihood=dgp.Heteroscedastic(of="output")),
        ],
        ids=["feedback of another layer", "heavy tails", "noise of the output"],
    )
    def test_elsewhere_there_is_no_such_block(self, model, spring):
        assert EFFECT.extend(model, SAID, spring) == []
        assert with_feedback(model) is None
