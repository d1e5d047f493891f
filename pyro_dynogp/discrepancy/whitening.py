"""Whitening of residuals, and of what may explain them, by one autoregressive filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Highest order that is tried.
ORDER = 24


@dataclass(frozen=True, eq=False)
class Whitener:
    """An autoregressive filter: w_t = x_t - sum_k a_k x_(t-k).

    Attributes:
        coefficients: (p,) a.
    """

    coefficients: np.ndarray

    @property
    def order(self) -> int:
        """p, which is also the number of leading samples that are lost."""
        return len(self.coefficients)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Filtered along the first dimension: (n, ...) to (n - p, ...); NaN spreads over p + 1."""
        p, n = self.order, len(x)
        out = x[p:].astype(float, copy=True)
        for k, a in enumerate(self.coefficients, start=1):
            out -= a * x[p - k : n - k]
        return out
