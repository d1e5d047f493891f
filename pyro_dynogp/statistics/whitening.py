"""Whitening of residuals, and of what may explain them, by one autoregressive filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from pyro_dynogp.support.compiled import OPTIONS

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
        flat = np.ascontiguousarray(x, dtype=float).reshape(-1)
        width = flat.size // max(len(x), 1)
        return _filtered(self.coefficients, flat, width).reshape(-1, *x.shape[1:])


# Numbers that stay in the processor's nearest memory while all coefficients go over them.
BLOCK = 1024


@njit(**OPTIONS)
def _filtered(a: np.ndarray, x: np.ndarray, width: int) -> np.ndarray:
    """Rows of `width` numbers, one after the other, filtered."""
    p = len(a)
    out = x[p * width :].copy()
    for begin in range(0, len(out), BLOCK):
        block = out[begin : begin + BLOCK]
        for k in range(p):
            shift = begin + (p - 1 - k) * width
            past = x[shift : shift + len(block)]
            for i in range(len(block)):
                block[i] -= a[k] * past[i]
    return out
