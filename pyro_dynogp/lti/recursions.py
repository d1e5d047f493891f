r"""Compiled O(n) recursions of the semiseparable algebra, on plain arrays.

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

from pyro_dynogp._compiled_cache import BORROWING, OPTIONS

# Rows between checkpoints of an adjoint: its matrices stay in the processor's cache.
_SEGMENT = 64


@njit(**BORROWING)
def _rotate_columns(S, re, im):
    """S <- S Phi' in place."""
    pairs = re.shape[0]
    for i in range(S.shape[0]):
        for j in range(pairs):
            a = S[i, j]
            b = S[i, pairs + j]
            S[i, j] = re[j] * a - im[j] * b
            S[i, pairs + j] = im[j] * a + re[j] * b


@njit(**BORROWING)
def _rotate_rows(S, re, im):
    """S <- Phi S in place."""
    pairs = re.shape[0]
    for i in range(pairs):
        r = re[i]
        q = im[i]
        for j in range(S.shape[1]):
            a = S[i, j]
            b = S[pairs + i, j]
            S[i, j] = r * a - q * b
            S[pairs + i, j] = q * a + r * b


@njit(**BORROWING)
def _dot(a, b):
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@njit(**BORROWING)
def _times(S, x, out):
    """Write S x to out (S symmetric: sums run down the columns, which vectorises)."""
    n = x.shape[0]
    for i in range(n):
        out[i] = 0.0
    for j in range(n):
        xj = x[j]
        for i in range(n):
            out[i] += S[j, i] * xj


@njit(**BORROWING)
def _add_outer(S, a, x, y):
    """S <- S + a x y'."""
    n = x.shape[0]
    for i in range(n):
        c = a * x[i]
        for j in range(n):
            S[i, j] += c * y[j]


@njit(**BORROWING)
def _copy(S, out):
    for i in range(S.shape[0]):
        for j in range(S.shape[1]):
            out[i, j] = S[i, j]


@njit(**BORROWING)
def _move(S, re, im, k):
    """S <- Phi S Phi' over step k, where there is one."""
    if k >= 0:
        _rotate_rows(S, re[k], im[k])
        _rotate_columns(S, re[k], im[k])


@njit(**BORROWING)
def _use_row(S, h, g, k0, v, s, e):
    """Explained covariance S after a row's sample; e is written, the variance p returned."""
    _times(S, h, s)
    p = k0 - _dot(h, s)
    for i in range(s.shape[0]):
        e[i] = g[i] - s[i]
    _add_outer(S, 1.0 / (p + v), e, e)
    return p


@njit(**BORROWING)
def _factor_row(S, re, im, k, h, g, k0, v, s, e):
    """Advance the explained covariance S over one row; e is written, the variance p returned."""
    _move(S, re, im, k)
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
            p[b, i] = _factor_row(
                S, re[b], im[b], step[i], h[b, o], g[b, o], k0[b, o], v[b, i], s, e[b, i]
            )
    return e, p, S_end


@njit(**BORROWING)
def _add_step_gradient(M, Q, re_bar, im_bar):
    """Gradient of <M, Phi Q'> with respect to the numbers phi: add it to re_bar and im_bar."""
    pairs = re_bar.shape[0]
    for i in range(pairs):
        k = pairs + i
        re_bar[i] += _dot(M[i], Q[i]) + _dot(M[k], Q[k])
        im_bar[i] += _dot(M[k], Q[i]) - _dot(M[i], Q[k])


@njit(**BORROWING)
def _factor_segment(b, first, last, re, im, step, out, h, g, k0, v, S, s, before, errors, inverse):
    """Advance S over rows first..last - 1 and keep of each: S before its sample, e and 1 / d."""
    for i in range(first, last):
        m = i - first
        o = out[i]
        _move(S, re[b], im[b], step[i])
        _copy(S, before[m])
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
    _times(bar, ei, t)
    through_d = -_dot(ei, t) * inverse[m] * inverse[m]
    pb = p_bar[b, i] + through_d
    v_bar[b, i] = through_d
    k0_bar[b, o] += pb
    for j in range(s.shape[0]):
        eb = e_bar[b, i, j] + 2.0 * inverse[m] * t[j]
        g_bar[b, o, j] += eb
        h_bar[b, o, j] -= pb * (g[b, o, j] - ei[j])
        s[j] = -eb - pb * h[b, o, j]  # adjoint of s = S h
    _times(before[m], s, t)
    for j in range(s.shape[0]):
        h_bar[b, o, j] += t[j]
    _add_outer(bar, 0.5, s, h[b, o])
    _add_outer(bar, 0.5, h[b, o], s)


@njit(**BORROWING)
def _factor_step_adjoint(
    b, k, m, re, im, back, start, before, errors, inverse, bar, Q, re_bar, im_bar
):
    """Reverse of a row's step k. start: S before the segment."""
    # Q' = Phi S_previous, S_previous after the update of the row before.
    if m > 0:
        _copy(before[m - 1], Q)
        _add_outer(Q, inverse[m - 1], errors[m - 1], errors[m - 1])
    else:
        _copy(start, Q)
    _rotate_columns(Q, re[b, k], im[b, k])
    for j in range(Q.shape[0]):
        for l in range(Q.shape[0]):
            Q[j, l] *= 2.0
    _add_step_gradient(bar, Q, re_bar[b, k], im_bar[b, k])
    _rotate_rows(bar, re[b, k], back[b, k])
    _rotate_columns(bar, re[b, k], back[b, k])


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
    length = _SEGMENT
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


@njit(**BORROWING)
def _advance(F, re, im, k):
    """F <- Phi F in place, F (J, R)."""
    if k >= 0:
        _rotate_rows(F, re[k], im[k])


@njit(**OPTIONS)
def lower(re, im, step, out, h, w, X, solve):
    """Strictly lower product M X, or the solution Z of (I + M) Z = X, M = tril(h' Phi w, -1)."""
    batch, n, R = X.shape
    J = h.shape[2]
    Z = np.empty_like(X)
    F = np.empty((J, R))
    for b in range(batch):
        F[:] = 0.0
        for i in range(n):
            _advance(F, re[b], im[b], step[i])
            o = out[i]
            for r in range(R):
                Z[b, i, r] = 0.0
            for j in range(J):
                hj = h[b, o, j]
                for r in range(R):
                    Z[b, i, r] += hj * F[j, r]
            if solve:
                for r in range(R):
                    Z[b, i, r] = X[b, i, r] - Z[b, i, r]
            for j in range(J):
                wj = w[b, i, j]
                for r in range(R):
                    F[j, r] += wj * (Z[b, i, r] if solve else X[b, i, r])
    return Z


@njit(**OPTIONS)
def upper(re, im, step, out, h, w, X, solve):
    """Transposed twin of `lower`: M' X, or the solution Z of (I + M)' Z = X."""
    batch, n, R = X.shape
    J = h.shape[2]
    Z = np.empty_like(X)
    F = np.empty((J, R))
    back = -im
    for b in range(batch):
        F[:] = 0.0
        for i in range(n - 1, -1, -1):
            o = out[i]
            for r in range(R):
                Z[b, i, r] = 0.0
            for j in range(J):
                wj = w[b, i, j]
                for r in range(R):
                    Z[b, i, r] += wj * F[j, r]
            if solve:
                for r in range(R):
                    Z[b, i, r] = X[b, i, r] - Z[b, i, r]
            for j in range(J):
                hj = h[b, o, j]
                for r in range(R):
                    F[j, r] += hj * (Z[b, i, r] if solve else X[b, i, r])
            if step[i] >= 0:
                _rotate_rows(F, re[b, step[i]], back[b, step[i]])
    return Z


@njit(**OPTIONS)
def lower_gradient(re, im, step, out, h, w, X, Z_bar):
    """Gradients of <Z_bar, M X> with respect to re, im, h and w."""
    batch, n, R = X.shape
    J = h.shape[2]
    pairs = J // 2
    re_bar = np.zeros_like(re)
    im_bar = np.zeros_like(im)
    h_bar = np.zeros_like(h)
    w_bar = np.empty_like(w)
    after = np.empty((n, J, R))  # state after the row's own sample was added
    F = np.empty((J, R))
    back = -im
    for b in range(batch):
        F[:] = 0.0
        for i in range(n):
            _advance(F, re[b], im[b], step[i])
            o = out[i]
            for j in range(J):
                total = 0.0
                for r in range(R):
                    total += F[j, r] * Z_bar[b, i, r]
                    F[j, r] += w[b, i, j] * X[b, i, r]
                h_bar[b, o, j] += total
            after[i] = F
        F[:] = 0.0
        for i in range(n - 1, -1, -1):
            o = out[i]
            for j in range(J):
                total = 0.0
                for r in range(R):
                    total += F[j, r] * X[b, i, r]
                    F[j, r] += h[b, o, j] * Z_bar[b, i, r]
                w_bar[b, i, j] = total
            k = step[i]
            if k >= 0:
                if i > 0:
                    for j in range(pairs):
                        total_re = 0.0
                        total_im = 0.0
                        for r in range(R):
                            a = after[i - 1, j, r]
                            c = after[i - 1, pairs + j, r]
                            total_re += F[j, r] * a + F[pairs + j, r] * c
                            total_im += F[pairs + j, r] * a - F[j, r] * c
                        re_bar[b, k, j] += total_re
                        im_bar[b, k, j] += total_im
                _rotate_rows(F, re[b, k], back[b, k])
    return re_bar, im_bar, h_bar, w_bar


@njit(**BORROWING)
def _information_row(info, re, back, k, h, e, inverse, u):
    """Move the information matrix of later rows across one row; return e' info e (before)."""
    _times(info, e, u)
    kappa = _dot(e, u)
    for j in range(u.shape[0]):
        u[j] *= inverse
    c = kappa * inverse * inverse + inverse
    _add_outer(info, -1.0, u, h)
    _add_outer(info, -1.0, h, u)
    _add_outer(info, c, h, h)
    _move(info, re, back, k)
    return kappa


@njit(**OPTIONS)
def later_information(re, im, step, out, h, e, d):
    """kappa_n = e_n' Lambda_n e_n, Lambda_n the information of the rows after n on the state at n.

    The backward recursion of the Bryson-Frazier smoother. With it [C^{-1}]_nn = 1/d + kappa/d^2.
    """
    batch, n = d.shape
    J = h.shape[2]
    kappa = np.empty((batch, n))
    info = np.empty((J, J))
    u = np.empty(J)
    back = -im
    for b in range(batch):
        info[:] = 0.0
        for i in range(n - 1, -1, -1):
            kappa[b, i] = _information_row(
                info, re[b], back[b], step[i], h[b, out[i]], e[b, i], 1.0 / d[b, i], u
            )
    return kappa


@njit(**OPTIONS)
def later_information_adjoint(re, im, step, out, h, e, d, kappa_bar):
    """Reverse mode of `later_information`: gradients for re, im, h, e and d."""
    batch, n = d.shape
    J = h.shape[2]
    re_bar = np.zeros_like(re)
    im_bar = np.zeros_like(im)
    h_bar = np.zeros_like(h)
    e_bar = np.zeros_like(e)
    d_bar = np.zeros_like(d)
    length = _SEGMENT
    segments = (n + length - 1) // length
    ends = np.empty((segments, J, J))  # information after the last row of each segment
    later = np.empty((length, J, J))
    info = np.empty((J, J))
    moved = np.empty((J, J))
    bar = np.empty((J, J))
    u = np.empty(J)
    t = np.empty(J)
    back = -im
    for b in range(batch):
        info[:] = 0.0
        for i in range(n - 1, -1, -1):
            if (i + 1) % length == 0 or i == n - 1:
                ends[i // length] = info
            o = out[i]
            _information_row(info, re[b], back[b], step[i], h[b, o], e[b, i], 1.0 / d[b, i], u)
        bar[:] = 0.0
        for segment in range(segments):
            first = segment * length
            last = min(n, first + length)
            info[:] = ends[segment]
            for i in range(last - 1, first - 1, -1):
                later[i - first] = info
                o = out[i]
                _information_row(info, re[b], back[b], step[i], h[b, o], e[b, i], 1.0 / d[b, i], u)
            for i in range(first, last):
                o = out[i]
                Lambda = later[i - first]
                inverse = 1.0 / d[b, i]
                ei = e[b, i]
                hi = h[b, o]
                _times(Lambda, ei, u)
                kappa = _dot(ei, u)
                c = kappa * inverse * inverse + inverse
                k = step[i]
                if k >= 0:
                    # moved = information at the row, own sample included; Phi' moved Phi leaves it
                    moved[:] = Lambda
                    _add_outer(moved, -inverse, u, hi)
                    _add_outer(moved, -inverse, hi, u)
                    _add_outer(moved, c, hi, hi)
                    # gradient of <bar, Phi' moved Phi>: 2 <moved Phi bar, Phi>
                    _rotate_columns(bar, re[b, k], im[b, k])
                    for j in range(J):
                        for l in range(J):
                            moved[j, l] *= 2.0
                    _add_step_gradient(moved, bar, re_bar[b, k], im_bar[b, k])
                    _rotate_rows(bar, re[b, k], im[b, k])
                # own = Lambda - (u h' + h u') / d + c h h', adjoint `bar`
                _times(bar, hi, t)
                hbh = _dot(hi, t)
                ubh = _dot(u, t)
                # gradient with respect to h
                _times(bar, u, info[0])
                for j in range(J):
                    h_bar[b, o, j] += 2.0 * c * t[j] - 2.0 * inverse * info[0, j]
                # kappa enters through c as well as through the output
                kb = kappa_bar[b, i] + hbh * inverse * inverse
                d_bar[b, i] += 2.0 * ubh * inverse * inverse
                d_bar[b, i] -= hbh * (2.0 * kappa * inverse + 1.0) * inverse * inverse
                # u = Lambda e, adjoint -2 t / d; kappa = e' Lambda e
                for j in range(J):
                    t[j] *= -2.0 * inverse
                _times(Lambda, t, info[0])
                for j in range(J):
                    e_bar[b, i, j] += info[0, j] + 2.0 * kb * u[j]
                _add_outer(bar, 0.5, t, ei)
                _add_outer(bar, 0.5, ei, t)
                _add_outer(bar, kb, ei, ei)
    return re_bar, im_bar, h_bar, e_bar, d_bar
