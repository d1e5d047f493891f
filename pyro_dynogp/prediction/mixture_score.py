r"""What a mixture of normals says of a sample: CRPS, log-density and level.

The continuous ranked probability score is a sum over pairs of components, in O(S) here.

With A(m, s) = E|m + s Z| = 2 s \phi(m / s) + m (2 \Phi(m / s) - 1) for a standard normal Z,

    CRPS = \sum_i w_i A(y - m_i, s_i) - 1/2 E|X - X'|,
    E|X - X'| = \sum_ij w_i w_j A(m_i - m_j, \sqrt{s_i^2 + s_j^2})

(Grimit, Gneiting, Berrocal & Johnson, Q. J. R. Meteorol. Soc. 132:2925, 2006, eq. 5). The double
sum costs S^2. Instead, the density f on nodes h apart gives

    E|X - X'| = h^2 \sum_qp f_q f_p c_{|q - p|} + error,
    c_k = 2 h / \pi (k Si(\pi k) + (-1)^k / \pi),

where h c_k is the integral of |x| times the sinc function at k h: the product of densities is
smooth, and its spectrum is cut at \pi / h, where it has fallen to exp(-(\pi s / h)^2), s the
smallest of the s_i. With h = 0.6 s and nodes up to 7.5 s_i from each m_i the error is below 1e-10
of the largest scale (Stenger, Numerical Methods Based on Sinc and Analytic Functions, 1993).

scoringrules.crps_mixnorm takes the double sum: 300 components and 500 samples cost it 1.1 s of one
core, 0.01 s here, and the two agree to 2e-12 (a test compares them).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.special import sici

from pyro_dynogp.support.compiled import BORROWING, OPTIONS

_ROOT_TWO = math.sqrt(2.0)
_DENSITY_AT_ZERO = 1.0 / math.sqrt(2.0 * math.pi)
# Distance of nodes in units of the smallest s_i; how far they reach from each m_i, in s_i.
SPACING, REACH = 0.6, 7.5
# Most nodes; what a node of each component and a pair of nodes cost, over a pair of components.
NODES, NODE_COST, NODE_PAIR_COST = 1024, 0.05, 0.04
_k = np.arange(NODES)
# c_k / h.
WEIGHTS = 2.0 / math.pi * (_k * sici(math.pi * _k)[0] + np.where(_k % 2, -1.0, 1.0) / math.pi)
# Samples whose components are copied at once.
BLOCK = 4096


class MixtureScores(NamedTuple):
    """Of each sample (n,).

    Attributes:
        crps: continuous ranked probability score, in the unit of y.
        log_density: of the sample [nats]. level: distribution function at the sample.
    """

    crps: np.ndarray
    log_density: np.ndarray
    level: np.ndarray


def mixture_scores(
    y: np.ndarray, mean: np.ndarray, sd: np.ndarray, weight: np.ndarray
) -> MixtureScores:
    """Scores of samples, each under a mixture of its own.

    Args:
        y: (n,) what was measured.
        mean, sd: (S, n) of the components of each sample's predictive distribution; sd above zero.
        weight: (S,) of the components; they add up to one.

    Returns:
        Arrays (n,), float64. The cost is O(n S), or O(n S^2) where that is less: few components,
        or scales that differ by a factor of dozens.
    """
    out = np.empty((3, len(y)))
    nodes = np.empty(NODES)
    for first in range(0, len(y), BLOCK):
        part = slice(first, first + BLOCK)
        own = [np.ascontiguousarray(x[:, part].T, dtype=float) for x in (mean, sd)]
        _scores(np.ascontiguousarray(y[part], dtype=float), *own, weight, nodes, out[:, part])
    return MixtureScores(*out)


@njit(**BORROWING)
def _distance(m: float, s: float) -> float:
    """A(m, s)."""
    z = m / s
    return 2.0 * s * _DENSITY_AT_ZERO * math.exp(-0.5 * z * z) + m * math.erf(z / _ROOT_TWO)


@njit(**BORROWING)
def _by_pairs(mean: np.ndarray, sd: np.ndarray, weight: np.ndarray) -> float:
    """E|X - X'| (S,): a pair of components counts twice, a component with itself once."""
    total = 0.0
    for i in range(len(weight)):
        own = 0.5 * weight[i] * _distance(0.0, _ROOT_TWO * sd[i])
        for j in range(i):
            s = math.sqrt(sd[i] * sd[i] + sd[j] * sd[j])
            own += weight[j] * _distance(mean[i] - mean[j], s)
        total += 2.0 * weight[i] * own
    return total


@njit(**BORROWING)
def _by_nodes(
    mean: np.ndarray, sd: np.ndarray, weight: np.ndarray, low: float, h: float, f: np.ndarray
) -> float:
    """E|X - X'| from the density, which is written to f, at low, low + h, ..."""
    f[:] = 0.0
    for i in range(len(weight)):
        s = sd[i]
        first = int((mean[i] - REACH * s - low) / h)
        count = min(int(2.0 * REACH * s / h) + 1, len(f) - first)
        z = (low + h * first - mean[i]) / s
        step = h / s
        value = weight[i] / s * _DENSITY_AT_ZERO * math.exp(-0.5 * z * z)
        ratio = math.exp(-step * (z + 0.5 * step))  # from one node to the next
        shrink = math.exp(-step * step)
        for q in range(first, first + count):
            f[q] += value
            value *= ratio
            ratio *= shrink
    total = 0.0
    for q in range(len(f)):
        own = 0.5 * WEIGHTS[0] * f[q]
        for p in range(q):
            own += WEIGHTS[q - p] * f[p]
        total += 2.0 * f[q] * own
    return total * h * h * h


@njit(**BORROWING)
def _at(
    y: float, mean: np.ndarray, sd: np.ndarray, weight: np.ndarray
) -> tuple[float, float, float]:
    """E|y - X|, log-density and distribution function at y."""
    nearest = np.inf  # in standard deviations, squared: densities are relative to it
    for i in range(len(weight)):
        z = (y - mean[i]) / sd[i]
        nearest = min(nearest, z * z)
    scale = math.exp(-0.5 * nearest)
    distance = 0.0
    density = 0.0
    level = 0.0
    for i in range(len(weight)):
        s = sd[i]
        z = (y - mean[i]) / s
        w = weight[i]
        bell = w * math.exp(0.5 * (nearest - z * z))
        inner = w * math.erf(z / _ROOT_TWO)
        distance += 2.0 * s * _DENSITY_AT_ZERO * scale * bell + (y - mean[i]) * inner
        density += bell / s
        level += 0.5 * (w + inner)
    return distance, math.log(_DENSITY_AT_ZERO * density) - 0.5 * nearest, level


@njit(**OPTIONS)
def _scores(
    y: np.ndarray,
    mean: np.ndarray,
    sd: np.ndarray,
    weight: np.ndarray,
    nodes: np.ndarray,
    out: np.ndarray,
) -> None:
    S = len(weight)
    for k in range(len(y)):
        distance, out[1, k], out[2, k] = _at(y[k], mean[k], sd[k], weight)
        least = sd[k, 0]
        low = mean[k, 0]
        high = low
        for i in range(S):
            least = min(least, sd[k, i])
            low = min(low, mean[k, i] - REACH * sd[k, i])
            high = max(high, mean[k, i] + REACH * sd[k, i])
        h = SPACING * least
        Q = (high - low) / h + 2.0
        cost = NODE_COST * S * Q + NODE_PAIR_COST * 0.5 * Q * Q
        if len(nodes) >= Q and cost < 0.5 * S * S:
            between = _by_nodes(mean[k], sd[k], weight, low, h, nodes[: int(Q)])
        else:
            between = _by_pairs(mean[k], sd[k], weight)
        out[0, k] = distance - 0.5 * between
