"""Predictive checks: statistics by definition, false alarms as promised, wrong dynamics found."""

import re

import numpy as np
import pytest
from scipy import stats

import pyro_dynogp as dgp
from pyro_dynogp.criticism import statistics
from pyro_dynogp.criticism.predictive_checks import predictive_checks
from pyro_dynogp.criticism.statistics import STATISTICS

from .known import measured, predicted


def refused(*parts):
    return pytest.raises(ValueError, match=".*".join(map(re.escape, parts)))


def test_false_alarms_are_as_rare_as_promised():
    alarms, single = 0, []
    for seed in range(150):
        made = predicted(80, correlation=0.8, samples=99, seed=seed)
        result = predictive_checks(made, measured(80, correlation=0.8, seed=seed))
        alarms += bool(result.stands_out.any())
        single.append(result.p_value)
        assert (result.p_adjusted >= result.p_value.min() / 2).all()
    low, high = stats.binom.ppf([0.0005, 0.9995], 150, 0.05)
    assert low <= alarms <= high
    # Each p-value by itself is uniform; of continuous statistics at most 10 % are below 0.1.
    low, high = stats.binom.ppf([0.0005, 0.9995], 150, 0.1)
    for j, name in enumerate(result.statistics):
        hits = (np.array(single)[:, j] <= 0.1 + 1e-9).sum()
        assert hits <= high
        assert hits >= low or name == "crossings of the mean"  # ties make it conservative


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"correlation": 0.3}, "autocorrelation, lag 1"),
        # The known mean makes most of the standard deviation, but little of the increments.
        ({"correlation": 0.8, "scale": 0.5}, "largest absolute increment"),
        ({"correlation": 0.8, "bias": 2.0}, "mean"),
        ({"correlation": 0.3}, "log power, 0.25 to 0.5 cycles/sample"),
    ],
)
def test_wrong_dynamics_stand_out(wrong, name):
    found = 0
    for seed in range(10):
        made = predicted(300, samples=199, seed=seed, **wrong)
        result = predictive_checks(made, measured(300, correlation=0.8, seed=seed))
        found += result.stands_out[result.statistics.index(name)]
        if result.stands_out.any():
            assert "stand out" in result.verdict or "stands out" in result.verdict
            worst = int(np.argmin(result.p_adjusted))
            assert result.statistics[worst] in result.verdict
    assert found >= 9


def test_statistics_by_their_definitions():
    rng = np.random.default_rng(0)
    time, y = np.arange(100.0), rng.normal(size=100) + 5
    value = {name: f(time, y) for name, f in STATISTICS.items()}
    assert value["mean"] == y.mean()
    assert value["standard deviation"] == y.std()
    assert (value["minimum"], value["maximum"]) == (y.min(), y.max())
    assert value["largest absolute increment"] == np.abs(np.diff(y)).max()
    sign = np.sign(y - y.mean())
    assert value["crossings of the mean"] == (sign[1:] * sign[:-1] < 0).sum()
    c = y - y.mean()
    for k in (1, 5):
        expected = np.mean(c[k:] * c[:-k]) / np.mean(c**2)
        assert value[f"autocorrelation, lag {k}"] == pytest.approx(expected)
    d = np.diff(y) - np.diff(y).mean()
    expected = np.mean(d[1:] * d[:-1]) / np.mean(d**2)
    assert value["autocorrelation of increments, lag 1"] == pytest.approx(expected)
    # A sine of amplitude 2 has all its power n (2/2)^2 at its own frequency.
    sine = 2.0 * np.sin(2 * np.pi * 0.05 * time)
    power = 10 ** statistics.log_power(time, sine, 0.04, 0.05)
    assert power == pytest.approx(100.0)


def test_gaps_and_short_series():
    time, y = np.arange(40.0), np.random.default_rng(1).normal(size=40)
    y[::2] = np.nan
    assert np.isnan(statistics.autocorrelation(time, y, 1))
    assert np.isfinite(statistics.autocorrelation(time, y, 2))
    assert np.isnan(statistics.autocorrelation(time, y, 50))
    assert np.isnan(statistics.largest_increment(time, y))
    assert np.isnan(statistics.increment_autocorrelation(time, y, 1))
    assert np.isnan(statistics.autocorrelation(time, np.ones(40), 1))
    assert np.isnan(statistics.log_power(time, np.ones(40), 0.0, 0.5))
    assert np.isnan(statistics.log_power(time, y, 0.0, 0.01))
    record = measured(40)
    outputs = record.outputs.copy()
    outputs[::2] = np.nan
    result = predictive_checks(predicted(40), record.with_outputs(outputs))
    assert ("autocorrelation, lag 1", "level") in result.left_out
    assert "autocorrelation, lag 2" in result.statistics
    assert len(result.left_out) + len(result.statistics) == len(STATISTICS)


def test_table_and_p_values_of_two_outputs():
    made, record = predicted(100, n_y=2), measured(100, n_y=2)
    result = predictive_checks(made, record, skip=7)
    frame = result.to_frame()
    assert len(frame) == 2 * len(STATISTICS)
    row = frame.loc[("flow", "maximum")]
    replicated = made.samples[:, 7:, 1].max(axis=1)
    observed = record.outputs[7:, 1].max()
    assert row["measured"] == observed
    assert row["replicated mean"] == pytest.approx(replicated.mean())
    assert row["replicated sd"] == pytest.approx(replicated.std())
    least = min((replicated >= observed).sum(), (replicated <= observed).sum())
    assert row["p"] == pytest.approx(min(1, 2 * (1 + least) / 201))
    units = dict(
        zip(zip(result.outputs, result.statistics, strict=True), result.units, strict=True)
    )
    assert units["flow", "mean"] == "m3/h"
    assert units["flow", "autocorrelation, lag 1"] == "-"
    assert units["level", "log power, 0 to 0.02 cycles/sample"] == "log10 m²"
    assert units["flow", "log power, 0 to 0.02 cycles/sample"] == "log10 (m3/h)²"
    assert result.verdict in str(result)


def test_own_statistics_see_time_and_masked_outputs():
    record = measured(60)
    y = record.outputs.copy()
    y[10:15] = np.nan
    seen = []

    def slope(time, y):
        seen.append((time, np.isnan(y).sum()))
        there = np.isfinite(y)
        value = np.polyfit(time[there], y[there], 1)[0]
        y[:] = 0.0  # must not reach the data
        return value

    wanted = {"slope": slope, "slope again": slope, "mean": STATISTICS["mean"]}
    result = predictive_checks(predicted(60), record.with_outputs(y), wanted, skip=2)
    assert result.statistics == ("slope", "slope again", "mean")
    np.testing.assert_array_equal(result.replicated[:, 0], result.replicated[:, 1])
    assert {missing for _, missing in seen} == {5}
    np.testing.assert_array_equal(seen[0][0], record.time[2:])
    assert result.units == ("", "", "m")
    assert result.observed[2] == np.nanmean(y[2:, 0])


def test_nothing_stands_out_in_a_typical_record():
    made = predicted(200)
    record = dgp.Record(made.time, None, made.samples[17], output_names=["level"])
    verdict = predictive_checks(made, record).verdict
    assert verdict.startswith("None of 16 statistics stands out at 5 %")
    assert "maxT" in verdict


def test_refuses():
    made, record = predicted(50), measured(50)
    with refused("skip", "0 to 49", "50"):
        predictive_checks(made, record, skip=50)
    with refused("prediction", "50 times"):
        predictive_checks(predicted(49), record)
    with refused("prediction", "S' >= 50", "(20, 50, 1)"):
        predictive_checks(predicted(50, samples=20), record)
    with refused("statistics", "a mapping", "{}"):
        predictive_checks(made, record, {})
    with refused("statistics", "functions of (time, y)", "'mean': 3"):
        predictive_checks(made, record, {"mean": 3})
    with refused("statistics['pair']", "one real number"):
        predictive_checks(made, record, {"pair": lambda time, y: y[:2]})
    with refused("statistics['word']", "one real number", "'high'"):
        predictive_checks(made, record, {"word": lambda time, y: "high"})
    with refused("statistics", "one statistic or more", "['none']", "too short"):
        predictive_checks(made, record, {"none": lambda time, y: np.nan})
    with refused("record", "measured samples of 'level'"):
        predictive_checks(made, record.with_outputs(np.full(50, np.nan)))
