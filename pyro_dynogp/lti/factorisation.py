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


@njit(**BORROWING)
def _factor_segment(b, first, last, re, im, step, out, h, g, k0, v, S, s, before, errors, inverse):
    """Advance S over rows first..last - 1 and keep of each: S before its sample, e and 1 / d."""
    for i in range(first, last):
        m = i - first
        o = out[i]
        move(S, re[b], im[b], step[i])
        copy(S, before[m])
        p = _use_row(S, h[b, o], g[b, o], k0[b, o], v[b, i], s, errors[m])
        inverse[m] = 1.0 / (p + v[b, i])


@njit(**BORROWING)
def _factor_row_adjoint(
    b,
    i,
    m,
    out,
    h,
    g,
    e_bar,
    p_bar,
    before,
    errors,
    inverse,
    bar,
    s,
    t,
    h_bar,
    g_bar,
    k0_bar,
    v_bar,
):
    """Reverse of a row's sample: gradients are added, `bar` is then that before the sample."""
    o = out[i]
    ei = errors[m]
    times(bar, ei, t)
    through_d = -dot(ei, t) * inverse[m] * inverse[m]
    pb = p_bar[b, i] + through_d
    v_bar[b, i] = through_d
    k0_bar[b, o] += pb
    for j in range(s.shape[0]):
        eb = e_bar[b, i, j] + 2.0 * inverse[m] * t[j]
        g_bar[b, o, j] += eb
        h_bar[b, o, j] -= pb * (g[b, o, j] - ei[j])
        s[j] = -eb - pb * h[b, o, j]  # adjoint of s = S h
    times(before[m], s, t)
    for j in range(s.shape[0]):
        h_bar[b, o, j] += t[j]
    add_outer(bar, 0.5, s, h[b, o])
    add_outer(bar, 0.5, h[b, o], s)


@njit(**BORROWING)
def _factor_step_adjoint(
    b, k, m, re, im, back, start, before, errors, inverse, bar, Q, re_bar, im_bar
):
    """Reverse of a row's step k. start: S before the segment."""
    # Q' = Phi S_previous, S_previous after the update of the row before.
    if m > 0:
        copy(before[m - 1], Q)
        add_outer(Q, inverse[m - 1], errors[m - 1], errors[m - 1])
    else:
        copy(start, Q)
    rotate_columns(Q, re[b, k], im[b, k])
    for j in range(Q.shape[0]):
        for l in range(Q.shape[0]):
            Q[j, l] *= 2.0
    add_step_gradient(bar, Q, re_bar[b, k], im_bar[b, k])
    rotate_rows(bar, re[b, k], back[b, k])
    rotate_columns(bar, re[b, k], back[b, k])


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
    before = np.empty((length, J, J))  # S after moving to the row, before using its sample
    errors = np.empty((length, J))
    inverse = np.empty(length)
    S = np.empty((J, J))
    Q = np.empty((J, J))
    s = np.empty(J)
    t = np.empty(J)
    for b in range(batch):
        S[:] = S0[b]
        for segment in range(segments):
            starts[segment] = S
            first = segment * length
            last = min(n, first + length)
            _factor_segment(
                b, first, last, re, im, step, out, h, g, k0, v, S, s, before, errors, inverse
            )
        bar = S0_bar[b]
        for segment in range(segments - 1, -1, -1):
            first = segment * length
            last = min(n, first + length)
            start = starts[segment]
            S[:] = start
            _factor_segment(
                b, first, last, re, im, step, out, h, g, k0, v, S, s, before, errors, inverse
            )
            for i in range(last - 1, first - 1, -1):
                m = i - first
                _factor_row_adjoint(
                    b, i, m, out, h, g, e_bar, p_bar, before, errors, inverse, bar, s, t,
                    h_bar, g_bar, k0_bar, v_bar,
                )  # fmt: skip
                if step[i] >= 0:
                    _factor_step_adjoint(
                        b, step[i], m, re, im, back, start, before, errors, inverse, bar, Q,
                        re_bar, im_bar,
                    )  # fmt: skip
    return re_bar, im_bar, h_bar, g_bar, k0_bar, v_bar, S0_bar
