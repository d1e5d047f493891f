"""Simulation-based calibration, the short form of the benchmark's."""

import numpy as np

from tests.benchmarks.calibration import KEPT, _rank, simulate_ranks, uniformity


def test_ranks_of_a_few_replicates_are_not_skewed():
    ranks = simulate_ranks(4, samples=30, thin=1, seed=3)
    assert len(ranks) == 11
    spread = np.sqrt(((KEPT + 1) ** 2 - 1) / 12 / 4)
    for name, values in ranks.items():
        assert ((values >= 0) & (values <= KEPT)).all()
        assert abs(values.mean() - KEPT / 2) < 4 * spread, name


def test_uniformity_accepts_uniform_and_rejects_skewed_ranks():
    rng = np.random.default_rng(0)
    accepted = [uniformity(rng.integers(KEPT + 1, size=200)) for _ in range(200)]
    assert 0.01 < np.mean(np.array(accepted) < 0.05) < 0.11
    overconfident = np.clip(np.round(rng.normal(KEPT / 2, 9, 200)), 0, KEPT).astype(int)
    assert uniformity(overconfident) < 1e-4


def test_ties_are_broken_at_random():
    draws = np.full(KEPT, 2.0)
    ranks = [_rank(draws, 2.0, seed) for seed in range(400)]
    assert uniformity(np.array(ranks)) > 1e-3
    assert _rank(np.arange(KEPT) * 1.0, 4.5, 0) == 5
