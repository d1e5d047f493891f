"""The filter run again within a segment, for what goes backwards through a record; compiled.

The filter keeps the state at the first sample of each segment alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from pyro_dynogp.lti.arithmetic import SEGMENT, copy, times
from pyro_dynogp.moments.filtering import enter, seen
from pyro_dynogp.moments.state import update
from pyro_dynogp.moments.static_layer import append
from pyro_dynogp.support.compiled import OPTIONS, WITHIN


class Kept(NamedTuple):
    """What is kept of each sample of a segment.

    Attributes:
        m: (SEGMENT, N) and P: (SEGMENT, N, N), the state before the sample's outputs.
        C: (n_y, A) covariances of [x; f] with what the outputs are measured through, of one sample.
    """

    m: np.ndarray
    P: np.ndarray
    C: np.ndarray


@njit(**OPTIONS)
def room(values, A):
    """Work arrays of the following functions."""
    N = values.m0.shape[0]
    n_y = values.y.shape[1]
    return Kept(
        np.empty((SEGMENT, N)),
        np.empty((SEGMENT, N, N)),
        np.zeros((n_y, A)),
    )


@njit(**WITHIN)
def replay(first, last, layers, track, layout, values, m, P, T, c, work, kept):
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
            for o in range(values.y.shape[1]):
                if not math.isnan(values.y[time, o]):
                    times(P, seen(o, layout, values)[: m.shape[0]], c)
                    update(P, m, c, track.alphas[time, o], track.betas[time, o])


@njit(**WITHIN)
def restore(time, k, layers, track, layout, values, m, P, work, kept):
    """Bring back m and P after the outputs of sample `time`, the k-th of its segment."""
    N = values.m0.shape[0]
    for j in range(N):
        m[j] = kept.m[k, j]
    copy(kept.P[k], P[:N, :N])
    for i in range(layers):
        append(i, time, layout, values, m, P, work)
    for o in range(values.y.shape[1]):
        if not math.isnan(values.y[time, o]):
            times(P, seen(o, layout, values)[: m.shape[0]], kept.C[o])
            update(P, m, kept.C[o], track.alphas[time, o], track.betas[time, o])
