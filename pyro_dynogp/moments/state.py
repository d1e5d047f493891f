"""Steps of a joint Gaussian N(m, P), in place: what a measurement and what time changes; compiled.

States are real parts before imaginary ones; a step multiplies pair j by the complex number
``re_j + i im_j``.
"""

from __future__ import annotations

from numba import njit

from pyro_dynogp.support.compiled import BORROWING, WITHIN


@njit(**BORROWING)
def update(P, m, c, alpha, beta):
    """M <- m + alpha c, P <- P - beta c c'."""
    n = c.shape[0]
    for i in range(n):
        m[i] += alpha * c[i]
        t = beta * c[i]
        for j in range(n):
            P[i, j] -= t * c[j]


@njit(**BORROWING)
def step_covariance(re, im, gamma, P, T):
    """Write F P to T (N, A): covariance of the state one step on with the joint Gaussian before.

    F = [Phi gamma] takes [x; f] to the next state.
    """
    N, A = T.shape
    pairs = N // 2
    for j in range(pairs):
        a = re[j]
        b = im[j]
        k = pairs + j
        for i in range(A):
            T[j, i] = a * P[j, i] - b * P[k, i]
            T[k, i] = b * P[j, i] + a * P[k, i]
    for j in range(N):
        for f in range(A - N):
            t = gamma[j, f]
            if t != 0.0:
                for i in range(A):
                    T[j, i] += t * P[N + f, i]


@njit(**BORROWING)
def step_back(re, im, gamma, m_bar, P_bar, T_bar):
    """M_bar <- F' m_bar, P_bar <- F' P_bar F (symmetric), in place: derivatives by the step before.

    They are given by the first N entries, and fill all A. T_bar (N, A) is scratch: P_bar F.
    """
    N, A = T_bar.shape
    E = A - N
    pairs = N // 2
    for i in range(N):
        for j in range(pairs):
            q = pairs + j
            x = P_bar[i, j]
            w = P_bar[i, q]
            T_bar[i, j] = re[j] * x + im[j] * w
            T_bar[i, q] = re[j] * w - im[j] * x
        for f in range(E):
            total = 0.0
            for j in range(N):
                total += P_bar[i, j] * gamma[j, f]
            T_bar[i, N + f] = total
    for f in range(E):
        for i in range(A):
            total = 0.0
            for j in range(N):
                total += gamma[j, f] * T_bar[j, i]
            P_bar[N + f, i] = total
        total = 0.0
        for j in range(N):
            total += gamma[j, f] * m_bar[j]
        m_bar[N + f] = total
    for j in range(pairs):
        q = pairs + j
        for i in range(A):
            P_bar[j, i] = re[j] * T_bar[j, i] + im[j] * T_bar[q, i]
            P_bar[q, i] = re[j] * T_bar[q, i] - im[j] * T_bar[j, i]
        x = m_bar[j]
        m_bar[j] = re[j] * x + im[j] * m_bar[q]
        m_bar[q] = re[j] * m_bar[q] - im[j] * x


@njit(**BORROWING)
def move(re, im, gamma, Q, m, P, T):
    """State mean and covariance one step on, in place in the first N entries of m and P.

    T (N, A) is scratch: on return T = F P with F = [Phi gamma], for the old P.
    """
    N, A = T.shape
    E = A - N
    pairs = N // 2
    step_covariance(re, im, gamma, P, T)
    for j in range(pairs):
        k = pairs + j
        x = m[j]
        m[j] = re[j] * x - im[j] * m[k]
        m[k] = im[j] * x + re[j] * m[k]
    for j in range(N):
        for f in range(E):
            t = gamma[j, f]
            if t != 0.0:
                m[j] += t * m[N + f]
    for i in range(N):
        for j in range(pairs):
            k = pairs + j
            x = T[i, j]
            w = T[i, k]
            P[i, j] = re[j] * x - im[j] * w + Q[i, j]
            P[i, k] = im[j] * x + re[j] * w + Q[i, k]
        for j in range(N):
            for f in range(E):
                P[i, j] += T[i, N + f] * gamma[j, f]


@njit(**WITHIN)
def move_adjoint(k, layout, values, bars, m, P, m_bar, P_bar, T, T_bar):
    """Reverse of `move` over step k: m, P are those before it; the bars change in place."""
    re = values.re[k]
    im = values.im[k]
    gamma = values.gamma[k]
    N, A = T.shape
    pairs = N // 2
    for i in range(N):
        for j in range(N):
            bars.Q[k, i, j] += P_bar[i, j]
    step_covariance(re, im, gamma, P, T)
    # F_bar = m_bar m' + 2 P_bar F P = m_bar m' + 2 P_bar T; P_bar is symmetric.
    for j in range(pairs):
        q = pairs + j
        bars.re[k, j] += m_bar[j] * m[j] + m_bar[q] * m[q]
        bars.im[k, j] += m_bar[q] * m[j] - m_bar[j] * m[q]
    for i in range(N):
        for j in range(pairs):
            q = pairs + j
            x = 2.0 * P_bar[i, j]
            w = 2.0 * P_bar[i, q]
            bars.re[k, j] += x * T[i, j] + w * T[i, q]
            bars.im[k, j] += w * T[i, j] - x * T[i, q]
    for f in range(A - N):
        for j in range(N):
            total = m_bar[j] * m[N + f]
            for i in range(N):
                total += 2.0 * P_bar[j, i] * T[i, N + f]
            bars.gamma[k, j, f] += total
    step_back(re, im, gamma, m_bar, P_bar, T_bar)
