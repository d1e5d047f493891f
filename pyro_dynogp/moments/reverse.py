"""Reverse mode of the moment-matching filter, compiled: the gradient of the log-density.

The filter keeps the state at the first sample of each segment; within a segment it is run again.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from pyro_dynogp.lti.arithmetic import SEGMENT, dot, times
from pyro_dynogp.moments.filtering import inner, seen, width
from pyro_dynogp.moments.layout import FLOOR, workspace
from pyro_dynogp.moments.measured_function import function_adjoint
from pyro_dynogp.moments.noise import noise_adjoint
from pyro_dynogp.moments.segments import replay, restore, room
from pyro_dynogp.moments.state import move_adjoint, update
from pyro_dynogp.moments.static_layer import append_adjoint
from pyro_dynogp.support.compiled import OPTIONS, WITHIN


@njit(**WITHIN)
def _measure_adjoint(time, track, layout, values, bars, m, P, m_bar, P_bar, c_bar, work, kept):
    """Reverse of `measure`: m and P go back to what they were, bars change in place."""
    A = m.shape[0]
    alphas, betas = track.alphas[time], track.betas[time]
    for o in range(values.y.shape[1] - 1, -1, -1):
        if math.isnan(values.y[time, o]):
            continue
        h = seen(o, layout, values)[:A]
        c = kept.C[o]
        update(P, m, c, -alphas[o], -betas[o])
        times(P_bar, c, c_bar)
        beta_bar = -dot(c, c_bar)
        alpha_bar = dot(c, m_bar)
        for j in range(A):
            c_bar[j] = alphas[o] * m_bar[j] - 2.0 * betas[o] * c_bar[j]
        # Gradients by the mean and the variance of h'a.
        y = values.y[time, o] - values.y_offset[time, o]
        R = values.R[time, o]
        if layout.measured >= 0:
            row = layout.g_start[layout.measured]
            centre = dot(h, m) + values.offset[time, row]
            p = max(dot(h, c), 0.0) + FLOOR
            y_bar, R_bar, centre_bar, s_bar = function_adjoint(
                layout.measured, y, R, centre, p, layout, values, bars, work, alpha_bar, beta_bar
            )
            bars.offset[time, row] += centre_bar
            h_bar = bars.G[row]
        else:
            y_bar, s_bar, R_bar = noise_adjoint(
                y - dot(h, m),
                dot(h, c),
                R,
                layout.share,
                layout.multiple,
                1.0,
                alpha_bar,
                beta_bar,
            )
            centre_bar = -y_bar
            h_bar = bars.H[o]
        bars.R[time, o] += R_bar
        bars.y_offset[time, o] -= y_bar
        bars.y[time, o] += y_bar
        for j in range(A):
            c_bar[j] += s_bar * h[j]
            h_bar[j] += s_bar * c[j] + centre_bar * m[j]
            m_bar[j] += centre_bar * h[j]
        for j in range(A):
            t = c_bar[j]
            hj = 0.5 * h[j]
            for i in range(A):
                h_bar[i] += P[j, i] * t
                P_bar[j, i] += 0.5 * t * h[i] + hj * c_bar[i]


@njit(**OPTIONS)
def run_adjoint(layout, values, bars, track):
    """Gradient of the log-density that `run` returns, added to bars."""
    n = layout.step.shape[0]
    N = values.m0.shape[0]
    A = width(layout, values)
    S = inner(layout)
    m = np.zeros(A)
    P = np.zeros((A, A))
    m_bar = np.zeros(A)
    P_bar = np.zeros((A, A))
    work = workspace(layout, values)
    T = np.empty((N, A))
    T_bar = np.empty((N, A))
    c_bar = np.empty(A)
    kept = room(values, A)
    for segment in range(track.means.shape[0] - 1, -1, -1):
        first = segment * SEGMENT
        last = min(n, first + SEGMENT)
        m[:N] = track.means[segment]
        P[:N, :N] = track.covariances[segment]
        replay(first, last, S, track, layout, values, m, P, T, c_bar, work, kept)
        for time in range(last - 1, first - 1, -1):
            restore(time, time - first, S, track, layout, values, m, P, work, kept)
            if time < n - 1:
                k = layout.step[time + 1]
                if k >= 0:
                    move_adjoint(k, layout, values, bars, m, P, m_bar, P_bar, T, T_bar)
            _measure_adjoint(
                time, track, layout, values, bars, m, P, m_bar, P_bar, c_bar, work, kept
            )
            for i in range(S - 1, -1, -1):
                append_adjoint(i, time, layout, values, bars, m, P, m_bar, P_bar, work)
                start = N + layout.f_start[i]
                for a in range(start, start + layout.outputs[i]):
                    m_bar[a] = 0.0
                    for j in range(A):
                        P_bar[a, j] = 0.0
                        P_bar[j, a] = 0.0
    for j in range(N):
        bars.m0[j] += m_bar[j]
        for i in range(N):
            bars.P0[j, i] += P_bar[j, i]
    return bars
