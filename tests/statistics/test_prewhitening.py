"""The basis of what no variant of an effect may claim."""

from __future__ import annotations

import numpy as np
import pytest

from pyro_dynogp.statistics.prewhitening import spanning


@pytest.mark.parametrize("count", [20, 97, 380])
def test_a_constant_counts_once_and_what_depends_on_others_not_at_all(count: int) -> None:
    """A constant less its mean is rounding, which would be a second constant of unit size."""
    rng = np.random.default_rng(count)
    walk = np.cumsum(rng.standard_normal((count, 2)), axis=0)
    level = np.full(count, 1.0 / np.sqrt(count + 1.0))
    gap = walk[:, 0].copy()
    gap[3] = np.nan
    columns = np.column_stack([level, walk, 3.0 * walk[:, 0] - level, np.zeros(count), gap])
    Q = spanning(columns)
    assert Q.shape == (count, 4)
    # Directions are kept from 1e-6 of the largest on: rounding of means, 1e-16, is 1e-10 of those.
    np.testing.assert_allclose(Q.T @ Q, np.eye(4), atol=1e-10)
    np.testing.assert_allclose(Q @ (Q.T @ walk), walk, atol=1e-8 * np.abs(walk).max())
    assert spanning(np.zeros((count, 0))).shape == (count, 1)
