"""A friction that acts on a velocity while the position is measured, found from a line."""

import pytest

import pyro_dynogp as dgp
from pyro_dynogp.effects.nonlinear_feedback import NonlinearFeedbackOfOutput
from tests.prediction.test_feedback import rubbed


@pytest.fixture(scope="module")
def report():
    record, _, _ = rubbed(600, 0)
    base = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record[:400], method="map", workers=1,
                   progress=False)  # fmt: skip
    effects = (NonlinearFeedbackOfOutput(),)
    return dgp.close_loop(base, record, effects=effects, seed=0, max_rounds=1, workers=1,
                          progress=False)  # fmt: skip


def test_the_effect_is_named_with_the_signal_that_it_acts_on(report):
    (found,) = report.effects
    assert found.name == "nonlinear feedback"
    assert found.sentence.startswith("A nonlinear function of a signal of the dynamics of 'y'")
    (wire, layer), *_ = report.fit.model.dynamic
    assert (wire.feedback, layer.hidden) == (("step_of_hidden",), 1)  # Coulomb's


def test_errors_fall_to_a_fraction(report):
    assert report.after["rmse"] < 0.3 * report.before["rmse"]
    assert report.after["crps"] < 0.3 * report.before["crps"]
    assert report.after["coverage_95"] > 0.85
