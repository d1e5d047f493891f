"""Compiled O(n) products and solutions with a triangular semiseparable matrix.

Arrays as in `factorisation`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pyro_dynogp.lti.arithmetic import rotate_rows
from pyro_dynogp.support.compiled import BORROWING, OPTIONS


@njit(**BORROWING)
def _advance(F, re, im, k):
    """F <- Phi F in place, F (J, R)."""
    if k >= 0:
        rotate_rows(F, re[k], im[k])


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
                rotate_rows(F, re[b, step[i]], back[b, step[i]])
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
                rotate_rows(F, re[b, k], back[b, k])
    return re_bar, im_bar, h_bar, w_bar
