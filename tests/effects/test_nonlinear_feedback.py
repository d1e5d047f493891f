"""A function of the output that acts back on the dynamics: its test."""

import dataclasses

import numpy as np
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp.discrepancy import residuals
from pyro_dynogp.effects.dead_time import dead_time
from pyro_dynogp.effects.nonlinear_feedback import (
    NonlinearFeedbackOfOutput,
    nonlinear_feedback,
)
from pyro_dynogp.effects.output_nonlinearity import output_nonlinearity
from tests.discrepancy.made import SETTINGS, coloured, residuals_of, within_chance
from tests.effects.springs import COUPLED, POLE, STEP, coupled, pushed, sprung

EFFECT = NonlinearFeedbackOfOutput()


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
        u, y = self.governed(1, 1.0)
        record = dgp.Record(STEP * np.arange(len(u)), u[:, None], y[:, None])
        fit = dgp.fit(
            dgp.LinearDynamicGP(1, pairs=1), record[:200], method="map", workers=1, progress=False
        )
        r = residuals.residuals_of(fit, record, settings=SETTINGS)
        p = nonlinear_feedback(r, SETTINGS).p_value
        order = np.random.default_rng(0).permutation(len(r))
        blind = dataclasses.replace(r, innovations=r.innovations[order])
        assert p < 1e-4 * nonlinear_feedback(blind, SETTINGS).p_value < 1e-8
        # Functions that a model has err beyond their data: no second test, and one p-value.
        first, alone = (nonlinear_feedback(dataclasses.replace(one, linear=False), SETTINGS).p_value
                        for one in (r, blind))  # fmt: skip
        assert first == alone > 1e4 * p

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
