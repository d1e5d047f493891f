"""What the compiled recursions do with one small matrix at a time, in place.

States are real, ``x = [Re xi; Im xi]`` of ``J = 2P`` entries; a propagator Phi multiplies pair
``j`` by the complex number ``phi_j``, kept as ``(re_j, im_j)``.
"""

from __future__ import annotations

from numba import njit

from pyro_dynogp.support.compiled import BORROWING

# Rows between checkpoints of an adjoint: its matrices stay in the processor's cache.
SEGMENT = 64


@njit(**BORROWING)
def rotate_columns(S, re, im):
    """S <- S Phi' in place."""
    pairs = re.shape[0]
    for i in range(S.shape[0]):
        for j in range(pairs):
            a = S[i, j]
            b = S[i, pairs + j]
            S[i, j] = re[j] * a - im[j] * b
            S[i, pairs + j] = im[j] * a + re[j] * b


@njit(**BORROWING)
def rotate_rows(S, re, im):
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
def dot(a, b):
    """Inner product."""
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@njit(**BORROWING)
def times(S, x, out):
    """Write S x to out (S symmetric: sums run down the columns, which vectorises)."""
    n = x.shape[0]
    for i in range(n):
        out[i] = 0.0
    for j in range(n):
        xj = x[j]
        if xj != 0.0:  # rows of outputs read few states
            for i in range(n):
                out[i] += S[j, i] * xj


@njit(**BORROWING)
def add_outer(S, a, x, y):
    """S <- S + a x y'."""
    n = x.shape[0]
    for i in range(n):
        c = a * x[i]
        for j in range(n):
            S[i, j] += c * y[j]


@njit(**BORROWING)
def copy(S, out):
    """Write S to out."""
    for i in range(S.shape[0]):
        for j in range(S.shape[1]):
            out[i, j] = S[i, j]


@njit(**BORROWING)
def move(S, re, im, k):
    """S <- Phi S Phi' over step k, where there is one."""
    if k >= 0:
        rotate_rows(S, re[k], im[k])
        rotate_columns(S, re[k], im[k])


@njit(**BORROWING)
def add_step_gradient(M, Q, re_bar, im_bar):
    """Gradient of <M, Phi Q'> with respect to the numbers phi: add it to re_bar and im_bar."""
    pairs = re_bar.shape[0]
    for i in range(pairs):
        k = pairs + i
        re_bar[i] += dot(M[i], Q[i]) + dot(M[k], Q[k])
        im_bar[i] += dot(M[k], Q[i]) - dot(M[i], Q[k])
