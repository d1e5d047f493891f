r"""The moment-matching filter over a record and its reverse mode, compiled; one batch element.

The state x (N,) of all dynamic layers, real parts before imaginary ones, has zero mean without data
(known inputs act through offsets). At each sample: static layers append their outputs to x; every
measured output updates the joint Gaussian; the state moves on, x <- Phi x + gamma f + noise. Where
the output is a function of one signal, the update is that of `measured_function`, and the function
need not be appended.

The noise of an output is a mixture of Gaussians of variances R multiple_k (one component: Gaussian
noise; several: Student-t). With residual r and variance s of the noise-free output, the update is
that of the exact first two moments,

    m <- m + c alpha,  P <- P - beta c c',  alpha = -dl/dr,  beta = -d^2 l/dr^2,
    l = log sum_k share_k N(r; 0, s + R multiple_k),  c = Cov(a, output).

Memory: the state is kept at the first sample of each segment and recomputed within.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from pyro_dynogp._compiled_cache import BORROWING, INLINED, OPTIONS
from pyro_dynogp.moments.blocks import FLOOR, Values, append, append_adjoint, workspace
from pyro_dynogp.moments.measured_function import function_adjoint, function_terms

SEGMENT = 64
_LOG_2PI = math.log(2.0 * math.pi)


@njit(**BORROWING)
def _log_term(r, S, share):
    return math.log(share) - 0.5 * math.log(S) - 0.5 * r * r / S


@njit(**BORROWING)
def _noise_weights(r, s, R, share, multiple):
    """Largest logarithm of the components' densities, sum beside it, E 1/S and E 1/S^2 by them."""
    K = share.shape[0]
    top = -np.inf
    for k in range(K):
        top = max(top, _log_term(r, s + R * multiple[k], share[k]))
    total = 0.0
    first = 0.0
    second = 0.0
    for k in range(K):
        S = s + R * multiple[k]
        inverse = 1.0 / S
        weight = math.exp(_log_term(r, S, share[k]) - top)
        total += weight
        first += weight * inverse
        second += weight * inverse * inverse
    return top, total, first / total, second / total


@njit(**BORROWING)
def noise_terms(r, s, R, share, multiple):
    """Value l, alpha = -dl/dr and beta = -d^2 l/dr^2 of the log-density of a residual."""
    top, total, first, second = _noise_weights(r, s, R, share, multiple)
    beta = first - r * r * (second - first * first)
    return top + math.log(total) - 0.5 * _LOG_2PI, r * first, beta


@njit(**BORROWING)
def noise_adjoint(r, s, R, share, multiple, l_bar, alpha_bar, beta_bar):
    """Gradients of `noise_terms` by r, s and R."""
    top, total, first, second = _noise_weights(r, s, R, share, multiple)
    r_bar = alpha_bar * first - 2.0 * beta_bar * r * (second - first * first)
    first_bar = alpha_bar * r + beta_bar * (1.0 + 2.0 * r * r * first)
    second_bar = -beta_bar * r * r
    mean_bar = first_bar * first + second_bar * second
    s_bar = 0.0
    R_bar = 0.0
    for k in range(share.shape[0]):
        S = s + R * multiple[k]
        a = 1.0 / S
        weight = math.exp(_log_term(r, S, share[k]) - top) / total
        inverse_bar = weight * (first_bar + 2.0 * second_bar * a)
        term_bar = weight * (first_bar * a + second_bar * a * a - mean_bar + l_bar)
        S_bar = -a * a * inverse_bar + 0.5 * a * term_bar * (r * r * a - 1.0)
        r_bar -= term_bar * r * a
        s_bar += S_bar
        R_bar += S_bar * multiple[k]
    return r_bar, s_bar, R_bar


@njit(**BORROWING)
def dot(a, b):
    """Inner product."""
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@njit(**BORROWING)
def covary(P, h, c):
    """Write P h to c."""
    n = h.shape[0]
    for i in range(n):
        c[i] = 0.0
    for j in range(n):
        hj = h[j]
        if hj != 0.0:
            for i in range(n):
                c[i] += P[j, i] * hj


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
def move(re, im, gamma, Q, m, P, T):
    """State mean and covariance one step on, in place in the first N entries of m and P.

    T (N, A) is scratch: on return T = F P with F = [Phi gamma], for the old P.
    """
    N = gamma.shape[0]
    A = m.shape[0]
    E = A - N
    pairs = N // 2
    for j in range(pairs):
        a = re[j]
        b = im[j]
        k = pairs + j
        for i in range(A):
            T[j, i] = a * P[j, i] - b * P[k, i]
            T[k, i] = b * P[j, i] + a * P[k, i]
        x = m[j]
        m[j] = a * x - b * m[k]
        m[k] = b * x + a * m[k]
    for j in range(N):
        for f in range(E):
            t = gamma[j, f]
            if t != 0.0:
                m[j] += t * m[N + f]
                for i in range(A):
                    T[j, i] += t * P[N + f, i]
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


@njit(**BORROWING)
def enter(time, layout, values, m, P, T):
    """Move to sample `time`."""
    k = layout.step[time]
    if k >= 0:
        move(values.re[k], values.im[k], values.gamma[k], values.Q[k], m, P, T)


@njit(**INLINED)
def seen(o, layout, values):
    """Row (A,) of what output o is measured through: its own, or that of the function's input."""
    if layout.measured >= 0:
        return values.G[layout.g_start[layout.measured]]
    return values.H[o]


@njit(**BORROWING)
def output_terms(time, o, layout, values, m, P, c, work):
    """Write the covariance c of a with what output o is measured through; l, alpha and beta."""
    h = seen(o, layout, values)[: m.shape[0]]
    covary(P, h, c)
    y = values.y[time, o] - values.y_offset[time, o]
    R = values.R[time, o]
    if layout.measured >= 0:
        centre = dot(h, m) + values.offset[time, layout.g_start[layout.measured]]
        p = max(dot(h, c), 0.0) + FLOOR
        return function_terms(layout.measured, y, R, centre, p, layout, values, work)
    return noise_terms(y - dot(h, m), dot(h, c), R, layout.share, layout.multiple)


@njit(**BORROWING)
def measure(time, layout, values, m, P, c, work, alphas, betas):
    """Use the outputs of one sample; the sum of their log-densities is returned.

    alphas, betas: (n_y,), written to.
    """
    total = 0.0
    for o in range(values.y.shape[1]):
        if math.isnan(values.y[time, o]):
            continue
        l, alphas[o], betas[o] = output_terms(time, o, layout, values, m, P, c, work)
        total += l
        update(P, m, c, alphas[o], betas[o])
    return total


@njit(**BORROWING)
def inner(layout):
    """How many static layers the state, or an output's own row, needs."""
    return layout.measured if layout.measured >= 0 else layout.channels.shape[0]


@njit(**BORROWING)
def width(layout, values):
    """Length of [x; f] where only the static layers that `inner` counts are appended."""
    return values.m0.shape[0] + layout.f_start[inner(layout)]


@njit(**OPTIONS)
def run(layout, values):
    """Log-density of a record, the state before each segment's first sample, and the last one.

    The last one, (A,) and (A, A), is that of [x; f] given all data.
    """
    n = layout.step.shape[0]
    N = values.m0.shape[0]
    A = width(layout, values)
    segments = (n + SEGMENT - 1) // SEGMENT
    means = np.empty((segments, N))
    covariances = np.empty((segments, N, N))
    m = np.zeros(A)
    P = np.zeros((A, A))
    m[:N] = values.m0
    P[:N, :N] = values.P0
    work = workspace(layout, values)
    T = np.empty((N, A))
    c = np.empty(A)
    alphas = np.empty(values.y.shape[1])
    betas = np.empty(values.y.shape[1])
    total = 0.0
    for time in range(n):
        enter(time, layout, values, m, P, T)
        if time % SEGMENT == 0:
            means[time // SEGMENT] = m[:N]
            covariances[time // SEGMENT] = P[:N, :N]
        for i in range(inner(layout)):
            append(i, time, layout, values, m, P, work)
        total += measure(time, layout, values, m, P, c, work, alphas, betas)
    last_m = np.zeros(values.G.shape[1])
    last_P = np.zeros((last_m.shape[0], last_m.shape[0]))
    last_m[:A] = m
    last_P[:A, :A] = P
    for i in range(inner(layout), layout.channels.shape[0]):
        append(i, n - 1, layout, values, last_m, last_P, work)
    return total, means, covariances, last_m, last_P


@njit(**BORROWING)
def _move_adjoint(k, layout, values, bars, m, P, m_bar, P_bar, T, T_bar):
    """Reverse of `move` over step k: m, P are those before it; the bars change in place."""
    re = values.re[k]
    im = values.im[k]
    gamma = values.gamma[k]
    N = gamma.shape[0]
    A = m.shape[0]
    E = A - N
    pairs = N // 2
    for i in range(N):
        for j in range(N):
            bars.Q[k, i, j] += P_bar[i, j]
    # T = F P, and T_bar = P_bar F (N, A).
    for j in range(pairs):
        q = pairs + j
        for i in range(A):
            T[j, i] = re[j] * P[j, i] - im[j] * P[q, i]
            T[q, i] = im[j] * P[j, i] + re[j] * P[q, i]
    for j in range(N):
        for f in range(E):
            t = gamma[j, f]
            if t != 0.0:
                for i in range(A):
                    T[j, i] += t * P[N + f, i]
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
    for f in range(E):
        for j in range(N):
            total = m_bar[j] * m[N + f]
            for i in range(N):
                total += 2.0 * P_bar[j, i] * T[i, N + f]
            bars.gamma[k, j, f] += total
    # P_bar <- F' P_bar F = F' T_bar, m_bar <- F' m_bar.
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
def _measure_adjoint(time, layout, values, bars, m, P, m_bar, P_bar, C, alphas, betas, c_bar, work):
    """Reverse of `measure`: m and P go back to what they were, bars change in place."""
    A = m.shape[0]
    for o in range(values.y.shape[1] - 1, -1, -1):
        if math.isnan(values.y[time, o]):
            continue
        h = seen(o, layout, values)[:A]
        c = C[o]
        update(P, m, c, -alphas[o], -betas[o])
        covary(P_bar, c, c_bar)
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
def run_adjoint(layout, values, bars, means, covariances):
    """Gradient of the log-density that `run` returns, added to bars."""
    n = layout.step.shape[0]
    n_y = values.y.shape[1]
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
    C = np.zeros((n_y, A))
    c_bar = np.empty(A)
    alphas = np.zeros((SEGMENT, n_y))
    betas = np.zeros((SEGMENT, n_y))
    before_m = np.empty((SEGMENT, N))
    before_P = np.empty((SEGMENT, N, N))
    for segment in range(means.shape[0] - 1, -1, -1):
        first = segment * SEGMENT
        last = min(n, first + SEGMENT)
        m[:N] = means[segment]
        P[:N, :N] = covariances[segment]
        for time in range(first, last):
            if time > first:
                enter(time, layout, values, m, P, T)
            before_m[time - first] = m[:N]
            before_P[time - first] = P[:N, :N]
            if time < last - 1:
                for i in range(S):
                    append(i, time, layout, values, m, P, work)
                measure(
                    time,
                    layout,
                    values,
                    m,
                    P,
                    c_bar,
                    work,
                    alphas[time - first],
                    betas[time - first],
                )
        for time in range(last - 1, first - 1, -1):
            m[:N] = before_m[time - first]
            P[:N, :N] = before_P[time - first]
            for i in range(S):
                append(i, time, layout, values, m, P, work)
            alpha = alphas[time - first]
            beta = betas[time - first]
            for o in range(n_y):
                if math.isnan(values.y[time, o]):
                    continue
                if time == last - 1:  # not measured above
                    _, alpha[o], beta[o] = output_terms(time, o, layout, values, m, P, C[o], work)
                else:
                    covary(P, seen(o, layout, values)[:A], C[o])
                update(P, m, C[o], alpha[o], beta[o])
            if time < n - 1:
                k = layout.step[time + 1]
                if k >= 0:
                    _move_adjoint(k, layout, values, bars, m, P, m_bar, P_bar, T, T_bar)
            _measure_adjoint(
                time, layout, values, bars, m, P, m_bar, P_bar, C, alpha, beta, c_bar, work
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


def zero_bars(values: Values) -> Values:
    """Zeros of the shape of every value."""
    return Values(*(np.zeros_like(x) for x in values))
