import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter

from pyro_dynogp.statistics.omnibus import beyond_catalogue, structure_left
from pyro_dynogp.statistics.responses import responses
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.series import check_rate, in_other_units, residuals, share


def test_level_is_kept():
    series = (residuals(s, 150, deviation=0.02) for s in range(100))
    check_rate([structure_left(r, SETTINGS, 0.05, seed=s)[0] for s, r in enumerate(series)])


def test_level_is_kept_in_what_a_model_was_fitted_to():
    """Least squares take their part of the noise; what they leave follows nothing more for it."""
    p_values = []
    for seed in range(100):
        r = residuals(1000 + seed, 150)
        columns = np.column_stack([responses(r.inputs, r.step, r.time, constants=4), np.ones(150)])
        weights = np.linalg.lstsq(columns, r.output, rcond=None)[0]
        p_values.append(
            beyond_catalogue(dataclasses.replace(r, mean=columns @ weights), SETTINGS).p_value
        )
    check_rate(p_values)


def test_nothing_left_is_said():
    p_value, sentence = structure_left(residuals(3, 400), SETTINGS, 0.05)
    assert p_value > 0.05
    assert sentence.startswith("No structure is left")


@pytest.mark.parametrize(
    ("effect", "said"),
    [
        (lambda t, mean, u: 0.3 * mean**2, "follows inputs"),
        (lambda t, mean, u: 0.5 * lfilter([0.0, 0.2], [1.0, -0.9], u[:, 0]), "follows inputs"),
        (lambda t, mean, u: 2.0 * (t > 100.0), "follows inputs, other channels or time"),
        (lambda t, mean, u: share(u[:, 0] * np.roll(u[:, 0], 6), 0.3), "products of inputs"),
        (lambda t, mean, u: 0.8 * np.sin(t / 16.0) * mean, "a response that changes"),
    ],
)
def test_missing_terms_are_seen(effect, said):
    p_value, sentence = structure_left(residuals(0, 400, pole=0.5, effect=effect), SETTINGS, 0.05)
    assert p_value < 0.01
    assert said in sentence


def test_candidate_is_seen():
    w = lfilter([1.0], [1.0, -0.9], np.random.default_rng(9).standard_normal(400))
    r = residuals(0, 400, pole=0.5, effect=lambda *_: 0.4 * w)
    assert structure_left(dataclasses.replace(r, candidates={"wind": w}), SETTINGS, 0.05)[0] < 0.01


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda v: lfilter([1.0], [1.0, -0.5], v), "depend on earlier ones"),
        (lambda v: v**3, "not normal"),
        (lambda v: v * np.linspace(0.3, 2.0, len(v)), "the size of one-step errors"),
    ],
)
def test_noise_is_seen(change, said):
    r = residuals(0, 400)
    p_value, sentence = structure_left(
        dataclasses.replace(r, innovations=change(r.innovations)), SETTINGS, 0.05
    )
    assert p_value < 0.01
    assert said in sentence


def test_units_do_not_matter():
    r = residuals(0, 300, inputs=2)
    assert structure_left(in_other_units(r), SETTINGS, 0.05)[0] == pytest.approx(
        structure_left(r, SETTINGS, 0.05)[0], rel=1e-6
    )


def test_missing_samples_and_too_few():
    r = residuals(0, 400, pole=0.5, effect=lambda t, mean, u: 0.3 * mean**2)
    output = np.where(np.arange(400) % 20 == 3, np.nan, r.output)
    assert structure_left(dataclasses.replace(r, output=output), SETTINGS, 0.05)[0] < 0.01
    with pytest.raises(ValueError, match="30"):
        structure_left(dataclasses.replace(r, held_out=np.arange(400) > 380), SETTINGS, 0.05)


def test_the_model_without_process_noise_shows_what_it_took_up():
    r = residuals(3, 400)
    plain = residuals(3, 400, effect=lambda t, mean, u: share(u[:, 0] * np.roll(u[:, 0], 6), 0.3))
    assert structure_left(r, SETTINGS, 0.05)[0] > 0.05
    assert structure_left(r, SETTINGS, 0.05, plain=plain)[0] < 0.01
