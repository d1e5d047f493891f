"""Inputs that follow the output."""

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from pyro_dynogp.effects.feedback import feedback
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.series import check_rate, residuals
from tests.effects.scenes import closed_loop


class TestFeedback:
    def test_loop_is_found_and_its_input_named(self):
        for s in range(3):
            other, own = feedback(closed_loop(s), SETTINGS, seed=s)
            assert (own.where["channel"], other.where["channel"]) == ("u2", "u1")
            assert own.p_value < 1e-4
            assert other.p_value > 1e-3
            assert "after 0.5 s" in own.sentence

    def test_an_input_that_is_computed_from_output_and_set_point(self):
        """Whatever follows of the noise; the set point is named, and settings decide."""
        record = closed_loop(0)
        n = len(record.output)
        reference = 2.0 * record.inputs[:, 1] + np.append(0.0, record.output[:-1])
        walk = np.random.default_rng(5).standard_normal(n).cumsum()
        known = replace(record, candidates={"walk": walk, "reference": reference})
        exact, *others = feedback(known, SETTINGS)
        assert exact.where == {"channel": "u2", "set point": "reference"}
        assert exact.p_value < 1e-100
        assert "'u2' is computed from 'speed' and 'reference'" in exact.sentence
        assert [one.where for one in others] == [{"channel": "u1"}, {"channel": "u2"}]
        assert len(feedback(record, SETTINGS)) == 2  # without the reference it is not
        strict = replace(SETTINGS, controller=1e-300)
        assert len(feedback(known, strict)) == 2

    def test_dynamics_that_the_model_lacks_are_no_feedback(self):
        def slower(t, mean, u):
            return lfilter([0.0, 0.1], [1.0, -0.9], mean)

        check_rate([feedback(residuals(s, effect=slower), SETTINGS)[0].p_value for s in range(30)])
