"""The one null: replicates against theory, their bias, the fitted tail, the result."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from pyro_dynogp.statistics.autoregression import Whitener, fitted_filter
from pyro_dynogp.statistics.bootstrap import (
    SLOWEST,
    Noise,
    batches,
    noise_of,
    radius,
    scanned,
    tail_probability,
)
from tests.discrepancy.made import SETTINGS, coloured

NONE = np.zeros((0, 300))


def white(count=400, seed=0):
    return np.random.default_rng(seed).standard_normal(count)


def replicates(noise, count=400, seed=1):
    return np.concatenate(list(noise.replicates(count, seed)))


def test_replicates_have_the_autocovariance_of_the_filter():
    """Of a second-order autoregression, by Yule and Walker's equations; stationary throughout."""
    a1, a2 = 1.2, -0.6
    noise = noise_of(np.array([a1, a2]), white(), 0, np.zeros(300, dtype=bool), NONE)
    x = replicates(noise, 2000)
    rho1 = a1 / (1.0 - a2)
    variance = noise.errors.var() / (1.0 - a1 * rho1 - a2 * (a1 * rho1 + a2))
    assert x.var() == pytest.approx(variance, rel=0.02)
    assert np.mean(x[:, 1:] * x[:, :-1]) == pytest.approx(variance * rho1, rel=0.03)
    assert x[:, :20].var() == pytest.approx(x[:, -20:].var(), rel=0.06)


def test_errors_are_centred_and_scaled_by_their_degrees_of_freedom():
    e = white() + 3.0
    e[5] = np.nan
    noise = noise_of(np.zeros(0), e, 39, np.zeros(300, dtype=bool), NONE)
    assert len(noise.errors) == 399
    assert noise.errors.mean() == pytest.approx(0.0, abs=1e-12)
    assert noise.errors.var() == pytest.approx(np.nanvar(e) * 399 / 360)


def test_missing_samples_and_deviations():
    missing = np.arange(300) % 7 == 0
    deviations = 10.0 * np.eye(3).repeat(100, axis=1)
    with_them = Noise(np.array([0.5]), white(), missing, deviations)
    without = dataclasses.replace(with_them, deviations=NONE)
    added = replicates(with_them) - replicates(without)
    assert (np.isnan(added) == missing).all()
    added = added[:, ~missing]
    # Each replicate has one of the deviations, all about as often, and its own errors as before.
    which = np.argmin([[np.abs(x - d[~missing]).max() for d in deviations] for x in added], axis=1)
    np.testing.assert_allclose(added, deviations[which][:, ~missing], atol=1e-9)
    assert stats.chisquare(np.bincount(which)).pvalue > 1e-3


def test_the_same_seed_makes_the_same_replicates_however_many():
    noise = Noise(np.array([0.5]), white(), np.zeros(300, dtype=bool), NONE)
    np.testing.assert_array_equal(replicates(noise, 130, 4)[:70], replicates(noise, 70, 4))
    assert (replicates(noise, 70, 4) != replicates(noise, 70, 5)).any()
    sizes = [len(b) for b in batches(lambda generator, size: np.zeros(size), 130, 0)]
    assert sizes == [10, 10, 20, 40, 50]


def test_a_bias_that_is_known_is_taken_out():
    noise = Noise(np.array([0.7]), white(), np.zeros(300, dtype=bool), NONE)
    found = noise.unbiased(lambda batch: [np.array([0.6, -0.02])] * len(batch), 100, 0)
    np.testing.assert_allclose(found.coefficients, [0.8, 0.02])
    # No more of it than leaves the filter stable: a = 0.7 + 0.05 k, in steps.
    far = noise.unbiased(lambda batch: [np.array([0.0])] * len(batch), 100, 0)
    np.testing.assert_allclose(far.coefficients, [0.7 + 0.4 * 0.7])
    assert radius(far.coefficients) <= SLOWEST < 0.7 + 0.45 * 0.7


def test_estimates_beside_a_bias_correction_are_right_on_average():
    """Filters of short series are too short-lived: less so than without the correction."""
    truth, plain, corrected = 0.9, [], []
    for seed in range(40):
        x = coloured(np.random.default_rng(seed), 80, truth)
        whiten = Whitener(np.array([x[1:] @ x[:-1] / (x[:-1] @ x[:-1])]))
        noise = noise_of(whiten.coefficients, whiten(x), 2, np.zeros(80, dtype=bool), NONE[:, :80])

        def estimated(batch):
            x = batch - batch.mean(1, keepdims=True)
            return ((x[:, 1:] * x[:, :-1]).sum(1) / np.square(x[:, :-1]).sum(1))[:, None]

        plain.append(estimated(x[None])[0, 0])
        start = dataclasses.replace(noise, coefficients=np.array([plain[-1]]))
        corrected.append(start.unbiased(estimated, 100, seed).coefficients[0])
    assert truth - np.mean(plain) > 0.03
    assert abs(truth - np.mean(corrected)) < 0.5 * (truth - np.mean(plain))


def test_the_tail_of_maxima_is_fitted():
    null = stats.gumbel_r.rvs(1.0, 0.5, size=4000, random_state=0)
    for value in (1.2, 2.0):
        exact = stats.gumbel_r.sf(value, 1.0, 0.5)
        assert tail_probability(null, value, SETTINGS) == pytest.approx(exact, rel=0.15)
    far = stats.gumbel_r.sf(8.0, 1.0, 0.5)
    assert tail_probability(null[:200], 8.0, SETTINGS) == pytest.approx(far, rel=3.0)
    assert tail_probability(np.ones(99), 2.0, SETTINGS) == 1 / 100
    assert tail_probability(np.ones(99), 0.5, SETTINGS) == 1.0


def test_the_best_variant_is_that_of_the_largest_standardised_gain():
    gains, degrees = np.array([20.0, 18.0]), np.array([8.0, 2.0])
    fitted, rows = np.arange(4.0), np.array([True, True, False, False])
    null = [np.array([[8.0, 2.0], [8.0, 12.0]])]
    scan = scanned(gains, degrees, null, lambda j: (j * fitted, Whitener(fitted)), rows, SETTINGS)
    assert scan.best == 1  # 16 over 2 against 12 over 4
    assert scan.statistic == 8.0
    assert scan.gain == 9.0
    assert scan.size == 0.5
    # Mean 2.5 and standard deviation 2.5 of the largest: 0 and 5.
    scale = 2.5 * np.sqrt(6.0) / np.pi
    expected = stats.gumbel_r.sf(8.0, 2.5 - np.euler_gamma * scale, scale)
    assert scan.p_value == pytest.approx(expected)


def test_a_null_ends_once_as_many_replicates_as_count_are_as_large():
    made = []

    def null(larger):
        for _ in range(4):
            z = np.zeros((50, 1))
            z[:larger] = 9.0
            made.append(len(z))
            yield z

    def scan(larger):
        made.clear()
        fit = np.zeros(5), Whitener(np.zeros(0))
        gains, degrees = np.array([4.0]), np.ones(1)
        rows = np.ones(5, dtype=bool)
        return scanned(gains, degrees, null(larger), lambda _: fit, rows, SETTINGS).p_value

    enough = SETTINGS.exceedances
    assert scan(enough) == pytest.approx((1 + enough) / 51)
    assert made == [50]
    assert scan(enough - 4) == pytest.approx((1 + 2 * (enough - 4)) / 101)
    assert made == [50, 50]
    scan(0)
    assert made == [50] * 4


def test_filters_of_series_have_the_coefficients_that_made_them():
    noise = Noise(np.array([1.2, -0.6]), white(), np.zeros(4000, dtype=bool), np.zeros((0, 4000)))
    (x,) = replicates(noise, 1)
    x[::11] = np.nan
    np.testing.assert_allclose(fitted_filter(x, SETTINGS).coefficients[:2], [1.2, -0.6], atol=0.1)
