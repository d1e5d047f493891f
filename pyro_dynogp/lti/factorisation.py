r"""Compiled O(n) Cholesky factorisation of a semiseparable covariance, and its reverse mode.

A row ``n`` of the covariance belongs to one time and one output. With the real modal state
``x = [Re xi; Im xi]`` of ``J = 2P`` entries, the covariance below the diagonal is

    K[n, m] = h_n' Phi(n <- m) g_m,        n after m,

where ``h`` reads an output from the state, ``g`` is the covariance of the state with that output,
and ``Phi`` is a product of per-step propagators. A propagator is block diagonal: pair ``j`` is
multiplied by the complex number ``phi_j = exp(lambda_j d)``, kept here as ``(phi_re, phi_im)``.

Every array is float64 and has one leading batch axis. ``step[n]`` is the index into the distinct
steps, or -1 where the state does not move (first row, other outputs of the same time). A row with
infinite noise variance is a missing sample: its gain is zero.

The recursions stay in the local frame of each row (no absolute phase), so that accuracy does not
depend on the length of the record. The recursion for ``factor`` is the Cholesky factorisation of a
semiseparable matrix (Foreman-Mackey et al. 2017, AJ 154:220) in Kalman-filter coordinates; adjoints
recompute the state from checkpoints, so that memory stays near O(n J).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from pyro_dynogp.lti.arithmetic import (
    SEGMENT,
    add_outer,
    add_step_gradient,
    copy,
    dot,
    move,
    rotate_columns,
    rotate_rows,
    times,
)
from pyro_dynogp.support.compiled import BORROWING, OPTIONS


@njit(**BORROWING)
def _use_row(S, h, g, k0, v, s, e):
    """Explained covariance S after a row's sample; e is written, the variance p returned."""
    times(S, h, s)
    p = k0 - dot(h, s)
    for i in range(s.shape[0]):
        e[i] = g[i] - s[i]
    add_outer(S, 1.0 / (p + v), e, e)
    return p


@njit(**BORROWING)
def factor_row(S, re, im, k, h, g, k0, v, s, e):
    """Advance the explained covariance S over one row; e is written, the variance p returned."""
    move(S, re, im, k)
    return _use_row(S, h, g, k0, v, s, e)


@njit(**OPTIONS)
def factor(re, im, step, out, h, g, k0, v, S0):
    """Predictive covariances e (B, N, J) and variances p (B, N), and the last S (B, J, J).

    S is the part of the state covariance that the rows so far explain; the Cholesky factor is
    L = I + strict lower part of h' Phi w with w = e / d, and D = diag(d), d = p + v.
    """
    batch, n = v.shape
    J = h.shape[2]
    e = np.empty((batch, n, J))
    p = np.empty((batch, n))
    S_end = S0.copy()
    s = np.empty(J)
    for b in range(batch):
        S = S_end[b]
        for i in range(n):
            o = out[i]
            p[b, i] = factor_row(
                S, re[b], im[b], step[i], h[b, o], g[b, o], k0[b, o], v[b, i], s, e[b, i]
            )
    return e, p, S_end


class _Rows(NamedTuple):
    """The rows of one batch element, or the gradients by them: arrays as in `factor`."""

    re: np.ndarray
    im: np.ndarray
    step: np.ndarray
    out: np.ndarray
    h: np.ndarray
    g: np.ndarray
    k0: np.ndarray
    v: np.ndarray


class _Segment(NamedTuple):
    """Of each row of a segment: S before its sample, e, and 1 / d."""

    before: np.ndarray
    errors: np.ndarray
    inverse: np.ndarray


@njit(**BORROWING)
def _factor_segment(first, last, rows, S, s, kept):
    """Advance S over rows first..last - 1 and keep what a `_Segment` has."""
    for i in range(first, last):
        m = i - first
        o = rows.out[i]
        move(S, rows.re, rows.im, rows.step[i])
        copy(S, kept.before[m])
        p = _use_row(S, rows.h[o], rows.g[o], rows.k0[o], rows.v[i], s, kept.errors[m])
        kept.inverse[m] = 1.0 / (p + rows.v[i])


@njit(**BORROWING)
def _factor_row_adjoint(i, m, rows, bars, e_bar, p_bar, kept, bar, s, t):
    """Reverse of a row's sample: gradients are added, `bar` is then that before the sample."""
    o = rows.out[i]
    h, g, h_bar, g_bar = rows.h[o], rows.g[o], bars.h[o], bars.g[o]
    ei = kept.errors[m]
    inverse = kept.inverse[m]
    times(bar, ei, t)
    through_d = -dot(ei, t) * inverse * inverse
    pb = p_bar[i] + through_d
    bars.v[i] = through_d
    bars.k0[o] += pb
    for j in range(s.shape[0]):
        eb = e_bar[i, j] + 2.0 * inverse * t[j]
        g_bar[j] += eb
        h_bar[j] -= pb * (g[j] - ei[j])
        s[j] = -eb - pb * h[j]  # adjoint of s = S h
    times(kept.before[m], s, t)
    for j in range(s.shape[0]):
        h_bar[j] += t[j]
    add_outer(bar, 0.5, s, h)
    add_outer(bar, 0.5, h, s)


@njit(**BORROWING)
def _factor_step_adjoint(k, m, rows, bars, back, start, kept, bar, Q):
    """Reverse of a row's step k. start: S before the segment."""
    # Q' = Phi S_previous, S_previous after the update of the row before.
    if m > 0:
        copy(kept.before[m - 1], Q)
        add_outer(Q, kept.inverse[m - 1], kept.errors[m - 1], kept.errors[m - 1])
    else:
        copy(start, Q)
    rotate_columns(Q, rows.re[k], rows.im[k])
    for j in range(Q.shape[0]):
        for l in range(Q.shape[0]):
            Q[j, l] *= 2.0
    add_step_gradient(bar, Q, bars.re[k], bars.im[k])
    rotate_rows(bar, rows.re[k], back[k])
    rotate_columns(bar, rows.re[k], back[k])


@njit(**OPTIONS)
def factor_adjoint(re, im, step, out, h, g, k0, v, S0, e_bar, p_bar, S_end_bar):
    """Reverse mode of `factor`: gradients for re, im, h, g, k0, v, S0."""
    batch, n = v.shape
    J = h.shape[2]
    re_bar = np.zeros_like(re)
    im_bar = np.zeros_like(im)
    h_bar = np.zeros_like(h)
    g_bar = np.zeros_like(g)
    k0_bar = np.zeros_like(k0)
    v_bar = np.zeros_like(v)
    S0_bar = 0.5 * (S_end_bar + S_end_bar.transpose(0, 2, 1))  # S is symmetric
    back = -im  # Phi' has the conjugate numbers
    length = SEGMENT
    segments = (n + length - 1) // length
    starts = np.empty((segments, J, J))
    kept = _Segment(np.empty((length, J, J)), np.empty((length, J)), np.empty(length))
    S = np.empty((J, J))
    Q = np.empty((J, J))
    s = np.empty(J)
    t = np.empty(J)
    for b in range(batch):
        rows = _Rows(re[b], im[b], step, out, h[b], g[b], k0[b], v[b])
        bars = _Rows(re_bar[b], im_bar[b], step, out, h_bar[b], g_bar[b], k0_bar[b], v_bar[b])
        S[:] = S0[b]
        for segment in range(segments):
            starts[segment] = S
            first = segment * length
            last = min(n, first + length)
            _factor_segment(first, last, rows, S, s, kept)
        bar = S0_bar[b]
        for segment in range(segments - 1, -1, -1):
            first = segment * length
            last = min(n, first + length)
            start = starts[segment]
            S[:] = start
            _factor_segment(first, last, rows, S, s, kept)
            for i in range(last - 1, first - 1, -1):
                m = i - first
                _factor_row_adjoint(i, m, rows, bars, e_bar[b], p_bar[b], kept, bar, s, t)
                if step[i] >= 0:
                    _factor_step_adjoint(step[i], m, rows, bars, back[b], start, kept, bar, Q)
    return re_bar, im_bar, h_bar, g_bar, k0_bar, v_bar, S0_bar
