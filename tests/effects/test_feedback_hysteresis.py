"""A hysteresis in feedback: what the test of nonlinear feedback sees of it, and its name."""

from types import SimpleNamespace

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.discrepancy import residuals
from pyro_dynogp.effects import nonlinear_feedback as effect
from pyro_dynogp.models.feedback_variants import with_feedback, with_hysteresis, with_products
from tests.benchmarks.feedback_plants import simulate_bouc_wen
from tests.discrepancy.made import SETTINGS


@pytest.mark.parametrize("pairs", [2, 1])
def test_its_columns_gain_most_where_the_model_has_a_state_for_it(monkeypatch, pairs):
    scans = []

    def lasting(r, variants, *rest):
        scans.append((scan(r, variants, *rest), [v.shape[1] for v in variants]))
        return scans[-1][0]

    scan = effect.lasting
    monkeypatch.setattr(effect, "lasting", lasting)
    record = simulate_bouc_wen(3, noise_ratio=0.02, training_samples=900).train
    fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=pairs), record[:500], method="map", workers=1,
                  progress=False)  # fmt: skip
    r = residuals.residuals_of(fit, record, settings=SETTINGS)
    found = effect.nonlinear_feedback(r, SETTINGS)
    (free, widths), (ahead, _) = scans
    # Shapes of two or three signals, eight each, the hysteresis, and the product with the input.
    assert len(free.gains) == (26 if pairs == 2 else 17)
    assert len(ahead.gains) == (18 if pairs == 2 else 17)
    if pairs == 2:
        assert found.p_value < 1e-3
        assert int(np.argmax(free.gains)) == 24
        assert widths[24] == 2 * widths[0]


def test_its_parts_are_products_without_a_line():
    rng = np.random.default_rng(0)
    rate, signal = rng.standard_normal((2, 500))
    found = effect._hysteretic(3.0 * rate - 1.0, 0.1 * signal + 7.0)
    c = np.sqrt(2.0 / np.pi)
    v, w = ((x - x.mean()) / x.std() for x in (rate, signal))
    for part, expected in zip(found.T, ((abs(v) - c) * w, (abs(w) - c) * v), strict=True):
        assert np.corrcoef(part, expected)[0, 1] == pytest.approx(1.0)
        assert part.std() == pytest.approx(1.0)


def test_what_is_said_of_it():
    evidence = SimpleNamespace(where={"output": "y"}, sentence="A nonlinear function of 'y'.")
    past = (
        "It depends on the past: a hysteresis of two signals of the dynamics of 'y' that are not "
        "measured acts back on them."
    )
    said = effect.NonlinearFeedbackOfOutput().sentence
    model = with_hysteresis(dgp.LinearDynamicGP(1, pairs=2))
    assert said(evidence, model) == past
    assert said(evidence, with_feedback(model)) == f"{evidence.sentence} {past}"
    product = "Inputs times 'y' act back on its dynamics."
    assert said(evidence, with_products(model)) == f"{past} {product}"
    assert said(evidence, with_feedback(dgp.LinearDynamicGP(1))) == evidence.sentence
