"""The filter run again within a segment, for what goes backwards through a record; compiled.

The filter keeps the state at the first sample of each segment alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from pyro_dynogp.lti.arithmetic import SEGMENT, copy, times
from pyro_dynogp.moments.filtering import enter, measure, output_terms, seen
from pyro_dynogp.moments.state import update
from pyro_dynogp.moments.static_layer import append
from pyro_dynogp.support.compiled import BORROWING, OPTIONS


class Kept(NamedTuple):
    """What is kept of each sample of a segment.

    Attributes:
        m: (SEGMENT, N) and P: (SEGMENT, N, N), the state before the sample's outputs.
        alphas, betas: (SEGMENT, n_y) of the outputs. C: (n_y, A) covariances, of one sample.
    """

    m: np.ndarray
    P: np.ndarray
    alphas: np.ndarray
    betas: np.ndarray
    C: np.ndarray


@njit(**OPTIONS)
def room(values, A):
    """Work arrays of the following functions."""
    N = values.m0.shape[0]
    n_y = values.y.shape[1]
    return Kept(
        np.empty((SEGMENT, N)),
        np.empty((SEGMENT, N, N)),
        np.zeros((SEGMENT, n_y)),
        np.zeros((SEGMENT, n_y)),
        np.zeros((n_y, A)),
    )


@njit(**BORROWING)
def replay(first, last, layers, layout, values, m, P, T, c, work, kept):
    """Run the filter over samples first..last - 1, from their state in m and P.

    layers: how many static layers are appended. c (A,) and T (N, A) are scratch.
    """
    N = values.m0.shape[0]
    for time in range(first, last):
        k = time - first
        if time > first:
            enter(time, layout, values, m, P, T)
        for j in range(N):
            kept.m[k, j] = m[j]
        copy(P[:N, :N], kept.P[k])
        if time < last - 1:
            for i in range(layers):
                append(i, time, layout, values, m, P, work)
            measure(time, layout, values, m, P, c, work, kept.alphas[k], kept.betas[k])


@njit(**BORROWING)
def restore(time, k, at_end, layers, layout, values, m, P, work, kept):
    """Bring back m and P after the outputs of sample `time`, the k-th of its segment.

    at_end: whether it is the segment's last one, whose outputs `replay` has not used.
    """
    N = values.m0.shape[0]
    for j in range(N):
        m[j] = kept.m[k, j]
    copy(kept.P[k], P[:N, :N])
    for i in range(layers):
        append(i, time, layout, values, m, P, work)
    alpha, beta, C = kept.alphas[k], kept.betas[k], kept.C
    for o in range(values.y.shape[1]):
        if math.isnan(values.y[time, o]):
            continue
        if at_end:
            _, alpha[o], beta[o] = output_terms(time, o, layout, values, m, P, C[o], work)
        else:
            times(P, seen(o, layout, values)[: m.shape[0]], C[o])
        update(P, m, C[o], alpha[o], beta[o])
