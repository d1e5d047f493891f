"""Other tools on the same residuals find what they should, and reject at their level."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from scipy.signal import lfilter

from tests.benchmarks.naming_lasso import LINEAR, lasso, lasso_path, library
from tests.benchmarks.naming_peers import (
    autocorrelations,
    bands,
    cross_correlations,
    indicators,
    peers,
    selected_steps,
)

RECORDS, SAMPLES = 200, 200


def within(count: int, total: int, share: float) -> bool:
    """Whether a count is one that such a share gives but for one time in ten thousand."""
    low, high = stats.binom.interval(0.9999, total, share)
    return bool(low <= count <= high)


def white(seed: int, n: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """A residual and an input that have nothing to do with each other."""
    rng = np.random.default_rng(seed)
    return rng.standard_normal(n), rng.standard_normal((n, 1))


def beyond(lags: range) -> float:
    """Share of correlations beyond the limit of 1 %; at long lags they are of fewer samples."""
    known = (SAMPLES - np.abs(np.array(lags))) / SAMPLES
    return float(np.mean(2.0 * stats.norm.sf(stats.norm.isf(0.005) / np.sqrt(known))))


def test_white_residuals_are_rejected_at_the_level():
    """Lags and samples beyond their limits are as many as the level says."""
    lags = crossing = impulses = together = 0
    steps = some = 0
    for seed in range(RECORDS):
        e, u = white(seed)
        lags += int((np.abs(autocorrelations(e)) > stats.norm.isf(0.005)).sum())
        crossing += int((np.abs(cross_correlations(e, u[:, 0])) > stats.norm.isf(0.005)).sum())
        together += bool(bands(e, u, 0.05, family=True))
        kept = indicators(e, 1.0 / SAMPLES)
        impulses += len(kept.impulses)
        steps += len(kept.steps)
        some += bool(indicators(e, 0.025 / SAMPLES).steps)
    assert within(lags, 25 * RECORDS, beyond(range(1, 26)))
    assert within(crossing, 51 * RECORDS, beyond(range(-25, 26)))
    assert stats.binom.sf(together - 1, RECORDS, 0.05) > 1e-4
    assert within(impulses, SAMPLES * RECORDS, 1.0 / SAMPLES)
    # Backward elimination keeps the largest of many steps: about twice its level.
    assert within(steps, SAMPLES * RECORDS, 2.2 / SAMPLES)
    assert stats.binom.sf(some - 1, RECORDS, 0.05) > 1e-4


def test_correlations_are_those_of_their_definitions():
    e, u = white(1, 60)
    x, v = e - e.mean(), u[:, 0] - u.mean()
    expected = sum(x[t] * x[t - 3] for t in range(3, 60)) / (x @ x) * np.sqrt(60)
    assert autocorrelations(e)[2] == pytest.approx(expected)
    found = cross_correlations(e, u[:, 0])
    later = sum(x[t] * v[t - 4] for t in range(4, 60))
    sooner = sum(x[t] * v[t + 4] for t in range(56))
    assert found[25 + 4] / found[25 - 4] == pytest.approx(later / sooner)


def test_bands_find_each_kind():
    e, u = white(3, 600)
    assert bands(lfilter([1.0], [1.0, -0.5], e), u) == ("noise model",)
    late = e + 0.4 * np.roll(u[:, 0], 3)
    assert "plant model" in bands(late, u)
    assert "feedback" not in bands(late, u, 0.05, family=True)
    assert bands(e, np.column_stack([np.roll(e, 2)]), 0.05, family=True) == ("feedback",)


def test_indicators_find_a_shift_and_outliers():
    e, _ = white(5, 300)
    e[180:] += 4.0
    e[[40, 260]] += 9.0
    kept = indicators(e, 0.025 / 300)
    assert [k for k in kept.steps if abs(k - 180) <= 2]
    assert len(kept.steps) == 1
    assert {40, 260} <= set(kept.impulses)
    assert len(kept.impulses) <= 3


def test_steps_are_those_of_least_squares():
    """The t-value that decides is that of a regression on step indicators."""
    e, _ = white(8, 40)
    e[25:] += 1.2
    X = np.column_stack([np.ones(40), np.arange(40) >= 25])
    beta, rss = np.linalg.lstsq(X, e, rcond=None)[:2]
    t = beta[1] / np.sqrt(rss[0] / 38 * np.linalg.inv(X.T @ X)[1, 1])
    p = 2.0 * stats.t.sf(abs(t), 38)
    assert selected_steps(e, [25], 1.01 * p) == [25]
    assert selected_steps(e, [25], 0.99 * p) == []


def test_lasso_path_meets_its_conditions():
    """Kuhn and Tucker: gradients are the penalty where a coefficient is in, and smaller else."""
    rng = np.random.default_rng(0)
    X = rng.standard_normal((80, 12))
    X = (X - X.mean(0)) / X.std(0)
    y = X[:, 2] - 0.5 * X[:, 7] + rng.standard_normal(80)
    G, c = X.T @ X / 80, X.T @ y / 80
    for penalty, b in zip([0.5, 0.1], lasso_path(G, c, np.array([0.5, 0.1])), strict=True):
        gradient = c - G @ b
        assert b.any()
        assert np.abs(gradient[b != 0] - penalty * np.sign(b[b != 0])).max() < 1e-4
        assert np.abs(gradient).max() < penalty + 1e-4


def test_lasso_names_the_group():
    rng = np.random.default_rng(4)
    n = 400
    u = lfilter([1.0], [1.0, -0.8], rng.standard_normal((n, 1)), axis=0)
    y = lfilter([0.3], [1.0, -0.7], u[:, 0])
    extra = {"a": np.cumsum(rng.standard_normal(n)), "b": rng.standard_normal(n)}
    stamps = pd.date_range("2024-01-01", periods=n, freq="h", tz="Europe/Berlin")
    e = rng.standard_normal(n)
    hour = 2.0 * np.pi * stamps.hour.to_numpy() / 24.0
    cases = {
        ("input nonlinearity", None): np.square(u[:, 0]) / np.var(u),
        ("output nonlinearity", None): (y / y.std()) ** 3 / 3.0,
        ("extra input", "b"): np.roll(extra["b"], 2),
        ("drift", None): np.arange(n) / 100.0,
        ("level shift", None): np.where(np.arange(n) >= 250, 2.0, 0.0),
        ("calendar", None): np.sin(hour),
        ("unmodelled dynamics", None): np.roll(u[:, 0], 4),
    }
    for group, added in cases.items():
        said = peers(e + added, u, y, extra, stamps)
        assert said["LASSO"] == (group,), group
    chance = sum(
        lasso(library(u, y, extra).columns, rng.standard_normal(n - LINEAR)).any()
        for _ in range(RECORDS)
    )
    assert stats.binom.sf(chance - 1, RECORDS, 0.02) > 1e-4
