"""Calibration: exact under the null, powerful against wrong predictions, parts that add up."""

import dataclasses
import re

import numpy as np
import pytest
from scipy import stats

import pyro_dynogp as dgp
from pyro_dynogp.criticism.calibration import calibration
from pyro_dynogp.criticism.crps import climatological, hersbach, quantile_members
from pyro_dynogp.criticism.envelope import envelope
from pyro_dynogp.criticism.probability_integral import pit_curves

from .known import measured, predicted, series

EDGES = np.linspace(0.0, 1.0, 11)


def refused(*parts):
    return pytest.raises(ValueError, match=".*".join(map(re.escape, parts)))


def within_chance(hits, trials, probability):
    """Whether a number of hits is inside the central 99.9 % of the binomial distribution."""
    low, high = stats.binom.ppf([0.0005, 0.9995], trials, probability)
    return low <= hits <= high


# The test under the null


@pytest.mark.parametrize("correlation", [0.0, 0.95])
def test_rejections_of_a_true_prediction_are_as_rare_as_promised(correlation):
    rng = np.random.default_rng(11)
    p = []
    for _ in range(400):
        pit = stats.norm.cdf(series(rng, 200, 100, correlation))
        p.append(pit_curves(pit[0], pit[1:], EDGES, 0.95).p_value)
    p = np.array(p)
    # With 199 replicates these levels are attained exactly.
    for level in (0.05, 0.2, 0.5):
        assert within_chance((p <= level + 1e-9).sum(), 400, level)


def test_the_whole_way_from_the_prediction_with_draws_of_different_levels():
    """Samples of one draw share its level, as parameter uncertainty makes them."""
    levels = np.linspace(-1.0, 1.0, 5)
    rejected = 0
    for seed in range(150):
        made = predicted(80, correlation=0.9, draws=5, samples=99, seed=seed)
        record = measured(80, correlation=0.9, levels=levels, seed=seed)
        rejected += int(not calibration(made, record).calibrated[0])
    assert within_chance(rejected, 150, 0.05)


def test_the_uniform_band_for_independent_values_would_reject_a_true_simulation():
    """What the joint samples are there for."""
    rng = np.random.default_rng(3)
    pit = stats.norm.cdf(series(rng, 100, 200, 0.95))
    assert np.mean([stats.kstest(row, "uniform").pvalue < 0.05 for row in pit]) > 0.5


# Power


@pytest.mark.parametrize("correlation", [0.0, 0.9])
@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"scale": 0.5}, "too narrow"),
        ({"scale": 2.0}, "too wide"),
        ({"bias": 1.0}, "biased upwards"),
        ({"bias": -1.0}, "biased downwards"),
    ],
)
def test_wrong_predictions_are_rejected_and_named(correlation, wrong, words):
    rejected = named = 0
    for seed in range(20):
        made = predicted(500, correlation=correlation, samples=99, seed=seed, **wrong)
        result = calibration(made, measured(500, correlation=correlation, seed=seed))
        rejected += int(not result.calibrated[0])
        named += words in result.verdict
    assert rejected >= (20 if correlation == 0 else 17)
    assert named >= rejected - 2


def test_verdicts_say_what_is_wrong_with_which_output():
    record = measured(400, n_y=2)
    made = predicted(400, n_y=2)
    first = predicted(400, n_y=2, scale=0.5)
    mixed = dataclasses.replace(
        made,
        noise_variance=np.stack([first.noise_variance[..., 0], made.noise_variance[..., 1]], -1),
        component_variance=np.stack(
            [first.component_variance[..., 0], made.component_variance[..., 1]], -1
        ),
        sampler=lambda: np.stack([first.samples[..., 0], made.samples[..., 1]], -1),
    )
    result = calibration(mixed, record)
    level, flow = result.verdict.split("\n")
    assert level.startswith("level: too narrow (PIT scores spread 2.")
    assert re.search(r"ECDF above \(levels 0\.0.*and below .*coverage below", level)
    assert flow.startswith("flow: no sign of miscalibration")
    assert f"{100 * result.coverage[18, 0]:.0f} % of 400 samples" in level
    assert result.calibrated.tolist() == [False, True]
    assert "biased" not in level


def test_four_lumps_are_neither_a_bias_nor_a_width():
    made = predicted(2000)
    lumps = np.tile([-1.3, -0.5, 0.5, 1.3], 500)
    error = lumps / lumps.std()
    record = measured(2000).with_outputs(made.mean + error[:, None])
    assert "of another shape" in calibration(made, record).verdict


# What is computed


def test_curves_are_what_they_are_called():
    y = measured(300, correlation=0.5).outputs.copy()
    y[40:60] = np.nan
    record = measured(300).with_outputs(y)
    made = predicted(300, correlation=0.5, draws=3)
    result = calibration(made, record, skip=10)
    pit = made.probability_integral(y)
    pit[:10] = np.nan
    np.testing.assert_array_equal(result.pit, pit)
    there = pit[np.isfinite(pit)]
    assert result.counts.tolist() == [270]
    np.testing.assert_allclose(result.ecdf[:, 0], [(there <= u).mean() for u in result.levels])
    low, high = made.quantile([0.25, 0.75])
    inside = ((y > low) & (y < high))[np.isfinite(pit)].mean()
    assert result.coverage[9, 0] == pytest.approx(inside)
    scores = dgp.scores(made, record, skip=10)
    assert result.coverage[18, 0] == pytest.approx(scores["coverage_95"])
    assert result.sharpness["width_50"][0] == pytest.approx((high - low)[np.isfinite(pit)].mean())
    assert result.sharpness["sd"][0] == pytest.approx(made.sd[np.isfinite(pit)].mean())
    assert result.density.mean() == pytest.approx(1.0)
    z = stats.norm.ppf(there)
    assert result.location[0] == pytest.approx(z.mean() / z.std())
    text = str(result)
    assert result.verdict in text
    assert "200 joint samples" in text
    assert list(result.to_frame().index) == ["level"]


def test_skipped_and_missing_samples_have_no_say():
    made, record = predicted(200), measured(200)
    y = record.outputs.copy()
    y[:20] = 1e6
    wild = calibration(made, record.with_outputs(y), skip=20)
    y[:20] = np.nan
    missing = calibration(made, record.with_outputs(y))
    assert wild.p_value == missing.p_value
    np.testing.assert_array_equal(wild.low, missing.low)
    assert wild.crps.mean == missing.crps.mean


def test_band_is_left_exactly_where_the_p_value_says_so():
    rng = np.random.default_rng(2)
    inside = 0
    for _ in range(300):
        curves = np.cumsum(rng.standard_normal((100, 15)), axis=1)
        band = envelope(curves[0], curves[1:], 0.9)
        stays = bool(((curves[0] >= band.low) & (curves[0] <= band.high)).all())
        assert stays == (band.p_value > 0.1 + 1e-9)
        assert band.p_value == band.p_values.min()
        inside += stays
    assert within_chance(inside, 300, 0.9)


def test_band_holds_the_share_of_replicates_that_it_is_tuned_to():
    curves = np.cumsum(np.random.default_rng(4).exponential(size=(200, 20)), axis=1)
    band = envelope(curves[0], curves[1:], 0.95)
    inside = ((curves[1:] >= band.low) & (curves[1:] <= band.high)).all(axis=1).sum()
    assert inside == pytest.approx(190, abs=1)  # the 190th lies on the limit, up to rounding


def test_equal_replicates_are_no_departure():
    same = np.full((60, 4), 0.1)
    assert envelope(same[0], same[1:], 0.9).p_value == 1.0
    other = same.copy()
    other[0, 2] = 0.2
    assert envelope(other[0], other[1:], 0.9).p_value == pytest.approx(1 / 60)


def test_the_seed_chooses_among_many_samples():
    made, record = predicted(60, samples=900), measured(60)
    results = [calibration(made, record, seed=seed) for seed in (0, 0, 1)]
    assert results[0].replicates == 500
    np.testing.assert_array_equal(results[0].low, results[1].low)
    assert not np.array_equal(results[0].low, results[2].low)


# Score


@pytest.mark.parametrize("draws", [1, 6])
def test_crps_parts_add_up_to_the_score_of_the_prediction(draws):
    made, record = predicted(200, draws=draws), measured(200)
    crps = calibration(made, record).crps
    total = crps.miscalibration - crps.discrimination + crps.uncertainty
    np.testing.assert_allclose(crps.mean, total, rtol=1e-12)
    assert crps.mean[0] == pytest.approx(dgp.scores(made, record)["crps"], rel=0.005)


def test_ensemble_score_is_the_one_of_its_definition():
    rng = np.random.default_rng(5)
    x, y = np.sort(rng.normal(size=(12, 40)), axis=0), 1.5 * rng.normal(size=40)
    pairs = np.abs(x[:, None] - x[None]).mean(axis=(0, 1))
    expected = (np.abs(x - y).mean(axis=0) - 0.5 * pairs).mean()
    assert sum(hersbach(x, y)) == pytest.approx(expected, rel=1e-12)
    assert climatological(y) == pytest.approx(0.5 * np.abs(y[:, None] - y).mean(), rel=1e-12)


def test_recalibration_finds_nothing_in_a_true_prediction():
    record = measured(4000)
    true = calibration(predicted(4000, samples=60), record, level=0.9).crps
    wide = calibration(predicted(4000, samples=60, scale=2.0), record, level=0.9).crps
    assert true.miscalibration[0] < 3 * true.miscalibration_expected[0] < 0.01 * true.mean[0]
    assert wide.miscalibration[0] > 0.1 * wide.mean[0]
    assert wide.miscalibration[0] > 20 * wide.miscalibration_expected[0]
    assert true.mean_expected[0] == pytest.approx(1 / np.sqrt(np.pi), rel=0.01)  # of N(0, 1)


def test_quantile_members_are_the_quantiles():
    for draws in (1, 4):
        made = predicted(9, draws=draws)
        levels = (np.arange(99) + 0.5) / 99
        np.testing.assert_allclose(quantile_members(made), made.quantile(levels), atol=2e-3)


# Refusals and notes


def test_predictions_several_steps_ahead_carry_a_note():
    record = measured(60)
    for kind, noted in (("1-step prediction", False), ("4-step prediction", True)):
        result = calibration(predicted(60, kind=kind), record)
        assert ("up to 3 samples apart" in str(result)) == noted == bool(result.note)


def test_refuses():
    made, record = predicted(50), measured(50)
    with refused("prediction", "a Prediction", "ndarray", "fit.predict"):
        calibration(made.mean, record)
    with refused("record", "one Record", "list"):
        calibration(made, [record])
    with refused("prediction", "49 times", "50 times", "made for"):
        calibration(made, record[1:])
    with refused("other times of the same number"):
        calibration(made, dgp.Record(record.time + 1, None, record.outputs))
    with refused("record", "['level']", "['other']"):
        calibration(made, record.with_outputs(record.outputs, names=["other"], units=["m"]))
    for skip in (-1, 50, 1.5, True):
        with refused("skip", "0 to 49", repr(skip)):
            calibration(made, record, skip=skip)
    with refused("record", "measured samples of 'level'", "none"):
        calibration(made, record.with_outputs(np.full(50, np.nan)))
    for level in (0.0, 1.0, "high", np.nan):
        with refused("level", "between 0 and 1"):
            calibration(made, record, level=level)
    with refused("level", "at most 0.995", "more joint samples"):
        calibration(made, record, level=0.999)
    with refused("prediction", "S' >= 50", "(49, 50, 1)", "more joint samples"):
        calibration(predicted(50, samples=49), record)
    broken = dataclasses.replace(made, sampler=lambda: np.full((60, 50, 1), np.nan))
    with refused("prediction", "finite joint samples"):
        calibration(broken, record)
