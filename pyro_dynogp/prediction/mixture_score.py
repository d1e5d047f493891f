r"""Continuous ranked probability score of a mixture of normals, in closed form.

With A(m, s) = E|m + s Z| = 2 s \phi(m / s) + m (2 \Phi(m / s) - 1) for a standard normal Z,

    CRPS = \sum_i w_i A(y - m_i, s_i)
           - 1/2 \sum_ij w_i w_j A(m_i - m_j, \sqrt{s_i^2 + s_j^2})

(Grimit, Gneiting, Berrocal & Johnson, Q. J. R. Meteorol. Soc. 132:2925, 2006, eq. 5).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from pyro_dynogp.support.compiled import OPTIONS

_ROOT_TWO = math.sqrt(2.0)
_DENSITY_AT_ZERO = 1.0 / math.sqrt(2.0 * math.pi)


def mixture_crps(y: np.ndarray, mean: np.ndarray, sd: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Score of each sample, in the unit of y.

    Args:
        y: (n,) what was measured.
        mean, sd: (S, n) of the components of each sample's predictive distribution; sd above zero.
        weight: (S,) of the components; they add up to one.

    Returns:
        (n,), float64. The cost is n S^2 / 2 evaluations of exp and erf, the memory that of mean.
    """
    by_sample = [np.ascontiguousarray(x.T, dtype=float) for x in (mean, sd)]
    return np.asarray(_scores(np.ascontiguousarray(y, dtype=float), *by_sample, weight))


@njit(**OPTIONS)
def _distance(m: float, s: float) -> float:
    """A(m, s)."""
    z = m / s
    return 2.0 * s * _DENSITY_AT_ZERO * math.exp(-0.5 * z * z) + m * math.erf(z / _ROOT_TWO)


@njit(**OPTIONS)
def _scores(y: np.ndarray, mean: np.ndarray, sd: np.ndarray, weight: np.ndarray) -> np.ndarray:
    out = np.empty(len(y))
    for k in range(len(y)):
        total = 0.0
        for i in range(len(weight)):
            m, s = mean[k, i], sd[k, i]
            # A pair of components counts twice, a component with itself once.
            pairs = 0.5 * weight[i] * _distance(0.0, _ROOT_TWO * s)
            for j in range(i):
                pairs += weight[j] * _distance(
                    m - mean[k, j], math.sqrt(s * s + sd[k, j] * sd[k, j])
                )
            total += weight[i] * (_distance(y[k] - m, s) - pairs)
        out[k] = total
    return out
