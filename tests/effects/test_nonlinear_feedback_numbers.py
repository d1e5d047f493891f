"""Numbers of what acts back on the dynamics: functions of the output, and products."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Recorded
from pyro_dynogp.discrepancy import residuals
from pyro_dynogp.effects.nonlinear_feedback import (
    NonlinearFeedbackOfOutput,
    nonlinear_feedback,
)
from pyro_dynogp.models.feedback_variants import with_feedback, with_products
from pyro_dynogp.models.system import DynamicSystem
from pyro_dynogp.models.variants import with_channel
from tests.discrepancy.made import SETTINGS
from tests.effects.heated import carried
from tests.effects.springs import STIFFNESS
from tests.models.closed_loops import make_record
from tests.models.test_known import values_at

EFFECT = NonlinearFeedbackOfOutput()
SAID = SimpleNamespace(sentence="What the test said.", where={"output": "x", "products": 0.6})


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
        # A function learnt from 600 samples with 2 % noise: a slope is that of an estimate.
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
        # The same formula by hand: rounding alone, as in the test below.
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
