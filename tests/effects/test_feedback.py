"""Inputs that follow the output."""

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

    def test_dynamics_that_the_model_lacks_are_no_feedback(self):
        def slower(t, mean, u):
            return lfilter([0.0, 0.1], [1.0, -0.9], mean)

        check_rate([feedback(residuals(s, effect=slower), SETTINGS)[0].p_value for s in range(30)])
