"""A function of the output that acts back on the dynamics: its test, its block and its numbers."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Recorded
from pyro_dynogp.discrepancy import residuals
from pyro_dynogp.effects.dead_time import dead_time
from pyro_dynogp.effects.nonlinear_feedback import (
    NonlinearFeedbackOfOutput,
    nonlinear_feedback,
)
from pyro_dynogp.effects.output_nonlinearity import output_nonlinearity
from pyro_dynogp.models.feedback_variants import with_feedback, with_products
from pyro_dynogp.models.system import DynamicSystem
from pyro_dynogp.models.variants import with_channel
from tests.discrepancy.made import SETTINGS, coloured, residuals_of, within_chance
from tests.models.closed_loops import make_record
from tests.models.test_known import values_at

STEP, DAMPING, STIFFNESS = 0.05, 0.6, 4.0
POLE = complex(-0.5 * DAMPING, np.sqrt(STIFFNESS - 0.25 * DAMPING**2))
EFFECT = NonlinearFeedbackOfOutput()
SAID = SimpleNamespace(sentence="What the test said.", where={"output": "x", "products": 0.6})


def sprung(u, cubic):
    """Displacement (n,) under x'' + 0.6 x' + 4 x + cubic x^3 = u, held, by small steps."""
    x = v = 0.0
    out = np.empty(len(u))
    for k, force in enumerate(u):
        out[k] = x
        for _ in range(20):
            v += STEP / 20 * (force - DAMPING * v - STIFFNESS * x - cubic * x**3)
            x += STEP / 20 * v
    return out


def pushed(seed, n, size=5.0):
    return np.repeat(size * np.random.default_rng(seed).standard_normal(n // 4), 4)


# A force pushes a mass, and a spring between this and another one that: positions and velocities.
COUPLED = np.array([
    [0.0, 1.0, 0.0, 0.0], [-7.5, -0.4, 6.0, 0.0], [0.0, 0.0, 0.0, 1.0], [7.5, 0.0, -10.0, -0.6],
])  # fmt: skip


def coupled(u, cubic):
    """Position (n,) of the second mass, with cubic d^3 of the spring's length d, by small steps."""
    x = np.zeros(4)
    out = np.empty(len(u))
    for k, force in enumerate(u):
        out[k] = x[2]
        for _ in range(20):
            more = cubic * (x[0] - x[2]) ** 3
            x = x + STEP / 20 * (COUPLED @ x + np.array([0.0, force - more, 0.0, more / 0.8]))
    return out


@pytest.fixture(scope="module")
def spring():
    u = pushed(0, 600)
    y = sprung(u, 4.0)
    noise = 0.02 * y.std() * np.random.default_rng(1).standard_normal(len(u))
    return dgp.Record(time=STEP * np.arange(len(u)), inputs=u, outputs=y + noise,
                      input_names=("force",), output_names=("x",), input_units=("N",),
                      output_units=("mm",), time_unit="s")  # fmt: skip


class TestDetection:
    def seen(self, seed, cubic, noise=0.05, **more):
        """Residuals of the spring's linear part, which has the right poles."""
        u = pushed(seed, 500, 1.5)
        mean, y = sprung(u, 0.0), sprung(u, cubic)
        e = noise * mean.std() * coloured(np.random.default_rng(seed), 500, 0.5)
        return residuals_of(
            y + e, mean, u[:, None], step=STEP, poles=np.array([POLE]), **more
        )  # fmt: skip

    def test_a_weak_spring_is_found(self):
        r = self.seen(0, 1.2)
        found = nonlinear_feedback(r, SETTINGS)
        assert found.p_value < 1e-4
        assert found.where["output"] == "speed"
        assert "acts back on its dynamics" in found.sentence
        # To first order the poles make the residual; a function at once explains less.
        assert found.gain > output_nonlinearity(r, SETTINGS).gain + 10.0
        assert found.gain > dead_time(r, SETTINGS).gain + 10.0

    def test_a_spring_between_two_masses_is_found(self):
        """Its length is neither the position that is measured nor how fast that changes."""
        u = np.repeat(np.random.default_rng(1).uniform(-8.0, 8.0, 100), 6)
        mean, y = coupled(u, 0.0), coupled(u, 0.5)
        e = 0.02 * mean.std() * coloured(np.random.default_rng(2), len(u), 0.5)
        poles = np.linalg.eigvals(COUPLED)
        poles = poles[poles.imag > 0.0]
        assert len(poles) == 2
        r = residuals_of(y + e, mean, u[:, None], step=STEP, poles=poles)
        assert nonlinear_feedback(r, SETTINGS).p_value < 1e-3
        one = dataclasses.replace(r, poles=poles[:1])
        assert nonlinear_feedback(one, SETTINGS).p_value > 0.05

    def test_the_poles_are_those_of_the_model(self):
        r = self.seen(0, 1.0)
        right = nonlinear_feedback(r, SETTINGS).gain
        wrong = dataclasses.replace(r, poles=np.array([-20.0 + 1.0j]))
        assert nonlinear_feedback(wrong, SETTINGS).gain < right - 10.0

    def test_what_the_mean_does_through_the_poles_is_no_evidence(self):
        """Other poles than the model's are a parameter's affair."""
        p = []
        for seed in range(20):
            u = pushed(seed, 500, 1.5)
            mean = sprung(u, 0.0)
            other = np.roll(mean, 1)
            e = 0.05 * mean.std() * coloured(np.random.default_rng(seed), 500, 0.5)
            r = residuals_of(0.9 * mean + 0.1 * other + e, mean, u[:, None], step=STEP,
                             poles=np.array([POLE]))  # fmt: skip
            p.append(nonlinear_feedback(r, SETTINGS).p_value)
        assert np.mean(np.array(p) <= 0.05) <= 0.2

    def governed(self, seed, drag, n=400):
        """Speed x' = -2 x + u - drag x^3 that a controller makes follow steps."""
        rng = np.random.default_rng(seed)
        goal = np.repeat(rng.uniform(-1.0, 1.0, n // 40), 40)
        u, y, x, total = np.empty(n), np.empty(n), 0.0, 0.0
        decay = np.exp(-2.0 * STEP)
        for k in range(n):
            y[k] = x + 0.01 * rng.standard_normal()
            total += STEP * (goal[k] - y[k])
            u[k] = 2.0 * (goal[k] - y[k]) + 3.0 * total
            x = decay * x + 0.5 * (1.0 - decay) * (u[k] - drag * x**3)
        return u, y

    def test_drag_under_a_controller_is_found_one_step_ahead(self):
        u, y = self.governed(0, 1.0)
        record = dgp.Record(STEP * np.arange(len(u)), u[:, None], y[:, None])
        fit = dgp.fit(
            dgp.LinearDynamicGP(1, pairs=1), record[:200], method="map", workers=1, progress=False
        )
        r = residuals.residuals_of(fit, record, settings=SETTINGS)
        assert nonlinear_feedback(r, SETTINGS).p_value < 1e-4
        order = np.random.default_rng(0).permutation(len(r))
        blind = dataclasses.replace(r, innovations=r.innovations[order])
        assert nonlinear_feedback(blind, SETTINGS).p_value > 1e-2
        # Functions that a model has err beyond their data: no second test, and one p-value.
        first, alone = (nonlinear_feedback(dataclasses.replace(one, linear=False), SETTINGS).p_value
                        for one in (r, blind))  # fmt: skip
        assert first == alone > 1e-2

    def test_a_controller_does_not_make_a_linear_system_look_nonlinear(self):
        p = []
        for seed in range(40):
            u, y = self.governed(seed, 0.0)
            decay = np.exp(-2.0 * STEP)
            mean = lfilter([0.0, 0.5 * (1.0 - decay)], [1.0, -decay], u)
            r = residuals_of(y, mean, u[:, None], step=STEP, poles=np.array([-2.0 + 0.0j]))
            r = dataclasses.replace(r, innovations=(y - mean) / 0.01)
            p.append(nonlinear_feedback(r, SETTINGS).p_value)
        assert within_chance(np.sum(np.array(p) <= 0.05), 40, 0.05)
        assert np.mean(np.array(p) <= 0.5) > 0.2  # twice the smaller one, and no more

    def test_poles_at_zero_are_as_slow_as_the_record(self):
        r = dataclasses.replace(self.seen(1, 0.0), poles=np.array([0.0j, POLE]))
        assert 0.0 < nonlinear_feedback(r, SETTINGS).p_value <= 1.0


# What comes first: functions and simple forms of the output and of a hidden signal; products.
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


class TestNumbers:
    def test_slopes_of_a_spring(self, spring):
        fit = dgp.fit(dgp.NonlinearFeedback(1), spring, method="map", restarts=1, workers=1,
                      progress=False)  # fmt: skip
        found = EFFECT.parameters(fit, SAID, spring)
        assert list(found) == [
            f"inverse steady-state gain of force, {part} [N/mm]"
            for part in ("low end", "middle", "high end")
        ]
        at = np.quantile(spring.outputs[:, 0], (0.02, 0.35, 0.65, 0.98))
        force = STIFFNESS * at + 4.0 * at**3
        slopes = [pair[0] for pair in found.values()]
        np.testing.assert_allclose(slopes, np.diff(force) / np.diff(at), rtol=0.1)
        assert EFFECT.shape(found) == "It hardens to both ends."

    def test_of_draws_mean_and_standard_deviation(self, spring):
        """u(y) = (y - G_f f(y)) / G_u for a stand-in whose gains and function are known."""
        gains = torch.tensor([[2.0, -1.0], [4.0, -1.0]]).double()
        pole = torch.full((2, 1), -1.0 + 0.0j, dtype=torch.complex128)
        modes = dgp.Modes(pole, input_gain=gains.unsqueeze(1) + 0.0j, output_gain=0.5 + 0.0 * pole)
        square = SimpleNamespace(mean=lambda x, t: x.pow(2).expand(2, -1, 1))
        layers = {"g": DynamicSystem(modes, 1.0), "f": square}
        system = SimpleNamespace(layer=layers.__getitem__)
        model = dgp.NonlinearFeedback(1)
        scaling = SimpleNamespace(
            input_scale=np.array([3.0]), output_scale=np.array([0.5]),
            output_offset=np.array([1.0]), input_names=("u",), input_units=("",),
            output_units=("",),
        )  # fmt: skip
        fit = SimpleNamespace(model=model, scaling=scaling, draws={}, system_at=lambda _: system)
        record = SimpleNamespace(outputs=np.linspace(0.0, 2.0, 101)[:, None])
        found = EFFECT.parameters(fit, None, record)
        y = (np.quantile(record.outputs, (0.02, 0.35, 0.65, 0.98)) - 1.0) / 0.5
        slope = (1.0 + y[1:] + y[:-1]) * 3.0 / 0.5  # (y + y^2) / G_u, G_u = 2 and 4
        expected = [(v * (1 / 2 + 1 / 4) / 2, abs(v) * (1 / 2 - 1 / 4) / 2) for v in slope]
        np.testing.assert_allclose(list(found.values()), expected, rtol=1e-12)

    def test_functions_of_the_output_add_up(self):
        """u(y) = (y - G_1 f_1(y) - G_2 f_2(y) - G_3 f_3(y)) / G_u."""
        gains = torch.tensor([[2.0, -1.0, 0.5, 3.0]]).double()
        pole = torch.full((1, 1), -1.0 + 0.0j, dtype=torch.complex128)
        modes = dgp.Modes(pole, input_gain=gains.unsqueeze(1) + 0.0j, output_gain=0.5 + 0.0 * pole)
        functions = {
            "output_root": torch.square,
            "output_edge": torch.exp,
            "output_step": torch.sin,
        }
        layers = {k: SimpleNamespace(mean=lambda x, _, f=f: f(x)) for k, f in functions.items()}
        layers["g"] = DynamicSystem(modes, 1.0)
        system = SimpleNamespace(layer=layers.__getitem__)
        scaling = SimpleNamespace(
            input_scale=np.ones(1), output_scale=np.ones(1), output_offset=np.zeros(1),
            input_names=("u",), input_units=("",), output_units=("",),
        )  # fmt: skip
        model = dgp.NonlinearFeedback(1, parametric=True)
        fit = SimpleNamespace(model=model, scaling=scaling, draws={}, system_at=lambda _: system)
        record = SimpleNamespace(outputs=np.linspace(0.0, 2.0, 101)[:, None])
        y = np.quantile(record.outputs, (0.02, 0.35, 0.65, 0.98))
        u = (y + y**2 - 0.5 * np.exp(y) - 3.0 * np.sin(y)) / 2.0
        slopes = [mean for mean, _ in EFFECT.parameters(fit, None, record).values()]
        np.testing.assert_allclose(slopes, np.diff(u) / np.diff(y), rtol=1e-12)
        for model in (
            dgp.NonlinearFeedback(1, hidden=1, parametric=True),
            with_products(dgp.NonlinearFeedback(1)),
        ):
            assert (
                EFFECT.parameters(SimpleNamespace(model=model, scaling=scaling), None, record) == {}
            )

    def test_none_for_what_has_no_steady_state(self, spring):
        line = SimpleNamespace(model=dgp.LinearDynamicGP(1), scaling=None)
        assert EFFECT.parameters(line, SAID, spring) == {}

    @pytest.mark.parametrize(
        ("slopes", "words"),
        [
            ((2.0, 1.0, 2.0), "It hardens to both ends."),
            ((0.4, 1.0, 0.5), "It softens to both ends."),
            ((-2.0, -1.0, -2.0), "It hardens to both ends."),
            ((2.0, 1.0, 1.01), "It hardens to the low end."),
            ((0.5, 1.0, 2.0), "It softens to the low end and hardens to the high end."),
            ((1.01, 1.0, 0.99), ""),
        ],
    )
    def test_shape_in_words(self, slopes, words):
        parts = {f"inverse steady-state gain of u, {k}": (v, 0.02) for k, v in enumerate(slopes)}
        assert EFFECT.shape(parts) == words
        assert EFFECT.shape({}) == ""

    def test_differences_within_two_errors_are_none(self):
        parts = {f"inverse steady-state gain of u, {k}": (1.0 + k, 0.5) for k in range(3)}
        assert EFFECT.shape(parts) == ""
        sharper = {label: (mean, 0.3) for label, (mean, _) in parts.items()}
        assert EFFECT.shape(sharper) == "It softens to the low end and hardens to the high end."


def test_the_loop_names_a_spring(spring):
    linear = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), spring[:350], method="map", workers=1,
                     progress=False)  # fmt: skip
    report = dgp.close_loop(
        linear, spring, max_rounds=1, workers=1, progress=False,
        effects=[e for e in dgp.effects.CATALOGUE
                 if e.name in ("nonlinear feedback", "output nonlinearity")],
    )  # fmt: skip
    assert [effect.name for effect in report.effects] == ["nonlinear feedback"]
    assert report.effects[0].ties == ()
    assert report.effects[0].sentence.endswith("It hardens to both ends.")
    assert report.after["rmse"] < 0.3 * report.before["rmse"]


def carried(seed, n=400, strength=0.8):
    """Heat, flow and temperature of x' = 1 + w - x + u (strength x + 0.2); noise of 2 %."""
    rng = np.random.default_rng(seed)
    w = np.repeat(rng.standard_normal(n // 5), 5)
    u = np.repeat(np.clip(0.5 * rng.standard_normal(n // 8), -0.9, 0.9), 8)
    x, y = 1.0, np.empty(n)
    for k in range(n):
        y[k] = x
        for _ in range(10):
            x += 0.01 * (1.0 + w[k] - x + u[k] * (strength * x + 0.2))
    y += 0.02 * y.std() * rng.standard_normal(n)
    return dgp.Record(0.1 * np.arange(n), np.column_stack([w, u]), y[:, None],
                      input_names=("heat", "flow"), time_unit="s")  # fmt: skip


class TestProducts:
    """A flow that carries heat with it: an input times the output."""

    @pytest.mark.parametrize("one_step", [True, False])
    def test_they_are_found_in_free_runs_and_one_step_ahead(self, one_step):
        """Functions of the temperature alone say little of it."""
        record = carried(0)
        fit = dgp.fit(
            dgp.LinearDynamicGP(2, pairs=1), record[:250], method="map", workers=1, progress=False
        )
        r = residuals.residuals_of(fit, record, settings=SETTINGS)
        r = dataclasses.replace(r, linear=one_step)
        found = nonlinear_feedback(r, SETTINGS)
        assert found.p_value < 1e-6
        assert found.where["products"] == 1.0
        still = nonlinear_feedback(dataclasses.replace(r, inputs=r.inputs[:, :1]), SETTINGS)
        assert still.p_value > 1e4 * found.p_value
        assert still.where["products"] < 1.0
        none = nonlinear_feedback(dataclasses.replace(r, inputs=r.inputs[:, :0]), SETTINGS)
        assert none.where["products"] == 0.0

    def test_poles_where_an_input_is_low_and_where_it_is_high(self):
        """Rates of 1 - 0.8 u, of which u varies from -0.9 to 0.9."""
        record = carried(1, 800)
        model = with_products(dgp.LinearDynamicGP(2, pairs=1, process_noise=False))
        fit = dgp.fit(model, record, method="map", restarts=2, workers=1, progress=False)
        found = EFFECT.parameters(fit, None, record)
        assert list(found) == [
            f"decay rate of the dominant mode at {end} flow [1/s]" for end in ("low", "high")
        ]
        low, high = np.quantile(record.inputs[:, 1], (0.02, 0.98))
        for (mean, sd), u in zip(found.values(), (low, high), strict=True):
            assert 0.0 < sd < 0.15
            assert abs(mean - (1.0 - 0.8 * u)) < 3.0 * sd
        assert EFFECT.shape(found) == ""
        wet = dgp.Record(record.time, record.inputs[:, :1], record.outputs, input_names=("heat",),
                         extra={"flow": record.inputs[:, 1]}, time_unit="s")  # fmt: skip
        more = with_products(with_channel(dgp.LinearDynamicGP(1, pairs=1), Recorded("flow")))
        other = dgp.fit(more, wet, method="map", restarts=1, steps=2, workers=1, progress=False)
        assert all("flow" in one or "heat" in one for one in EFFECT.parameters(other, None, wet))
        both = SimpleNamespace(model=with_feedback(model), scaling=fit.scaling)
        assert EFFECT.parameters(both, None, record) == {}

    @pytest.mark.parametrize("hidden", [False, True])
    def test_rates_are_those_of_the_matrix_with_the_input_held(self, hidden):
        record = make_record(1, missing=False)
        model = with_products(dgp.LinearDynamicGP(1, pairs=2), hidden=hidden).scaled_to(record)
        values = {k: v.unsqueeze(0) for k, v in values_at(model, 0).items()}
        system = model.system(values, model.scaling)
        fit = SimpleNamespace(model=model, scaling=model.scaling, draws=values, method="svi",
                              system_at=lambda _: system)  # fmt: skip
        found = EFFECT.parameters(fit, None, record)
        modes = system.layer("g").modes
        poles, F, C = modes.poles[0].numpy(), modes.B[0, :, -1].numpy(), modes.C[0].numpy()
        C = np.atleast_2d(C)[-1]
        low, high = np.quantile(record.inputs[:, 0], (0.02, 0.98))
        for (mean, sd), u in zip(found.values(), (low, high), strict=True):
            u = float(((u - model.scaling.input_offset) / model.scaling.input_scale)[0])
            A = np.diag(np.concatenate([poles, poles.conj()]))
            A = A + u * np.outer(np.r_[F, F.conj()], np.r_[C, C.conj()])
            # Of the step response to what comes back, by the modes that are there at its end.
            roots, V = np.linalg.eig(A)
            share = np.r_[C, C.conj()] @ V * np.linalg.solve(V, np.r_[F, F.conj()]) / roots
            steady = np.r_[C, C.conj()] @ np.linalg.solve(A, np.r_[F, F.conj()])
            assert share.sum() == pytest.approx(steady)
            assert mean == pytest.approx(-roots[np.abs(share).argmax()].real)
            assert sd == 0.0
