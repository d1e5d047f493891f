"""Compiled simulation of the filter's problem, sample by sample: one draw of states and functions.

Where static outputs come back to earlier layers no layer can be drawn as a whole before the next.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pyro_dynogp.lti.arithmetic import dot
from pyro_dynogp.moments.functions import TABLE, between, place
from pyro_dynogp.moments.functions import expansion as expand
from pyro_dynogp.moments.static_layer import expansion_of
from pyro_dynogp.support.compiled import BORROWING, OPTIONS


@njit(**BORROWING)
def _evaluate(i, time, layout, values, a, z):
    """Write the outputs of static layer i to a = [x; f]."""
    d, e = layout.channels[i], layout.outputs[i]
    f0 = layout.f_start[i]
    first = values.m0.shape[0] + f0
    for c in range(d):
        row = layout.g_start[i] + c
        z[c] = values.offset[time, row] + dot(values.G[row], a)
    if layout.form[i] != TABLE:
        expand(layout.form[i], z[:d], expansion_of(i, layout, values), a[first : first + e])
        return
    count = values.table_mean.shape[1]
    k, u, _ = place((z[0] - values.low[i]) * (1.0 / values.spacing[i]), count)
    for j in range(e):
        a[first + j] = between(values.table_mean[f0 + j], k, u)


@njit(**OPTIONS)
def step_through(layout, values, first, kicks, root, rows):
    """Rows (R, A) of a = [x; f] at every sample: (n, R).

    Args:
        layout, values: as the filter's; functions are the means in them, noise is not looked at.
        first: (N,) state at the first sample. kicks: (n, N) standard normals of the steps that lead
            to each sample, or (0, N) for no process noise.
        root: (k, N, N) square roots of the process noise of each distinct step.
    """
    n = layout.step.shape[0]
    N, A = values.m0.shape[0], values.G.shape[1]
    out = np.empty((n, rows.shape[0]))
    a = np.zeros(A)
    x = np.empty(N)
    z = np.empty(max(1, values.slope.shape[1]))
    a[:N] = first
    half = N // 2
    for time in range(n):
        k = layout.step[time]
        if k >= 0:
            for j in range(half):
                x[j] = values.re[k, j] * a[j] - values.im[k, j] * a[half + j]
                x[half + j] = values.im[k, j] * a[j] + values.re[k, j] * a[half + j]
            for j in range(N):
                x[j] += dot(values.gamma[k, j], a[N:])
                if kicks.shape[0] > 0:
                    x[j] += dot(root[k, j], kicks[time])
            a[:N] = x
        for i in range(layout.channels.shape[0]):
            _evaluate(i, time, layout, values, a, z)
        for r in range(rows.shape[0]):
            out[time, r] = dot(rows[r], a)
    return out
