"""Ranks of true values: uniform for exact posteriors, rejected with the right words for others."""

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.multitest import multipletests

from pyro_dynogp.criticism.rank_results import judged
from pyro_dynogp.criticism.ranks import holm, rank_of, uniformity

L = 99


def normal_means(replicates, *, width=1.0, bias=0.0, seed=0):
    """Ranks of mu ~ N(0, 1), seen five times in noise of sd one, under N(mean, sd) of mu given y.

    Conjugate, so that the exact posterior has width 1 and bias 0.
    """
    rng = np.random.default_rng(seed)
    sd = 1.0 / np.sqrt(6.0)
    ranks = []
    for _ in range(replicates):
        mu = rng.standard_normal()
        y = mu + rng.standard_normal(5)
        draws = y.sum() / 6.0 + sd * (bias + width * rng.standard_normal(L))
        ranks.append(rank_of(draws, mu, rng))
    return np.array(ranks)


def test_the_exact_posterior_is_calibrated():
    found = judged({"mu": normal_means(200), "nu": normal_means(200, seed=1)}, L, method="exact")
    assert found.calibrated
    assert found.verdict.startswith("No sign of miscalibration of 2 quantities over 200 simulated")
    assert min(found.p_chi_square.values()) > 0.05
    assert min(found.p_ecdf.values()) > 0.05


@pytest.mark.parametrize(
    ("departure", "words"),
    [
        ({"width": 0.6}, "too narrow"),
        ({"width": 1.8}, "too wide"),
        ({"bias": 0.5}, "too high"),
        ({"bias": -0.5}, "too low"),
    ],
)
def test_other_posteriors_are_called_what_they_are(departure, words):
    ranks = {"right": normal_means(100, seed=3), "wrong": normal_means(100, **departure)}
    found = judged(ranks, L, method="wrong")
    assert not found.calibrated
    assert found.miscalibrated == ("wrong",)
    assert found.tests["wrong"].shape[0] == f"posterior {words}"
    assert f"wrong (posterior {words}" in found.verdict
    frame = found.to_frame()
    assert words in frame.loc["wrong", "finding"]
    assert frame.loc["right", "finding"] == ""
    band = found.tests["wrong"].band
    ecdf = found.tests["wrong"].ecdf
    assert ((ecdf < band.low) | (ecdf > band.high)).any()


def test_false_alarms_are_as_rare_as_stated():
    """Over sets of five quantities at 5 %, few replicates and draws, where ranks tie."""
    rng = np.random.default_rng(0)
    alarms = []
    for _ in range(100):
        ranks = {str(k): rng.integers(0, 20, 24) for k in range(5)}
        tests = uniformity(ranks, 19, seed=int(rng.integers(1 << 30)))
        alarms.append(holm(np.array([one.p_value for one in tests.values()])).min() <= 0.05)
    assert np.mean(alarms) < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 100)


def test_chi_square_agrees_with_its_large_sample_form():
    ranks = np.random.default_rng(4).integers(0, 100, 1000)
    counts = np.histogram(ranks, np.arange(-0.5, 100, 10))[0]
    exact = stats.chisquare(counts).pvalue
    assert uniformity({"x": ranks}, 99)["x"].p_chi_square == pytest.approx(exact, abs=0.04)


def test_holm():
    adjusted = holm(np.array([0.04, 0.01, 0.5, 0.02]))
    np.testing.assert_allclose(adjusted, [0.08, 0.04, 0.5, 0.06])
    np.testing.assert_allclose(holm(np.array([0.9, 0.8])), [1.0, 1.0])
    p = np.random.default_rng(0).uniform(size=40) ** 3
    np.testing.assert_allclose(holm(p), multipletests(p, method="holm")[1], rtol=1e-12)


def test_ties_with_the_truth_are_broken_at_random():
    rng = np.random.default_rng(0)
    ranks = [rank_of(np.full(19, 2.0), 2.0, rng) for _ in range(400)]
    assert stats.chisquare(np.bincount(ranks, minlength=20)).pvalue > 1e-3
    assert rank_of(np.arange(19.0), 4.5, rng) == 5


def test_a_site_kept_at_a_point_is_found():
    """Ranks 0 and L alone: no posterior at all."""
    ranks = np.random.default_rng(0).integers(0, 2, 40) * L
    assert judged({"x": ranks}, L, method="point").tests["x"].shape[0] == "posterior too narrow"


def test_failures_are_counted_and_said():
    found = judged(
        {"mu": normal_means(40)}, L, method="m",
        failures=("ValueError: a", "ValueError: a", "RuntimeError: b"),
    )  # fmt: skip
    assert found.replicates == 43
    assert "3 of 43 replicates failed and count nowhere" in found.verdict
    assert "2 times ValueError: a; RuntimeError: b" in found.verdict
    assert found.verdict in str(found)
