r"""Covariances that compiled innovations begin with, at many points, and their gradients.

Of each point, with the formulas of `covariance` and of `models.past_inputs`:

    q_oa = sum_b H_ab conj(C_ob) + M_ab C_ob,
    H_ab = -L_a L_b^H / (lambda_a + conj lambda_b),   M_ab = -L_a L_b^T / (lambda_a + lambda_b),

the covariance of mode a with output o, and what the first state is less certain of than the
stationary one, because the inputs before the record are unknown (B_a the gains of all inputs, m how
long inputs are alike):

    X_ab = B_a B_b^H / (lambda_a conj lambda_b) - 2 m B_a B_b^H / (lambda_a + conj lambda_b),
    Y_ab = B_a B_b^T / (lambda_a lambda_b)      - 2 m B_a B_b^T / (lambda_a + lambda_b).

A pole at zero is an integrator: nothing drives it here, and its own X and Y are a given level.
Bars are derivatives by the real part plus i times those by the imaginary part, as torch has them.
"""

from __future__ import annotations

from numba import njit

from pyro_dynogp.support.compiled import BORROWING, WITHIN


@njit(**WITHIN)
def product(x, y, point, a, b, turned):
    """Sum over columns of x_a conj(y_b), or of x_a y_b."""
    total = 0.0j
    for m in range(x.shape[2]):
        total += x[point, a, m] * (y[point, b, m].conjugate() if turned else y[point, b, m])
    return total


@njit(**WITHIN)
def apart(x):
    """One in place of zero."""
    return 1.0 + 0.0j if x == 0 else x


@njit(**WITHIN)
def inverse(x):
    """1 / x; infinite or NaN at zero, where complex division would raise."""
    square = x.real * x.real + x.imag * x.imag
    return complex(x.real / square, -x.imag / square)


@njit(**BORROWING)
def initial_covariances(poles, B, C, L, shared, memory, level, q, start):
    """Write q (k, n_y, P) and the upper triangles of -X and -Y, real and imaginary parts in turn.

    Args: poles (k, P), B (k, P, n_u), C (k, n_y, P) and L (k, P, n_l), complex. shared: whether
        all modes see the same noise. memory: m. level: X and Y of an integrator by itself.
        start: (k, 2 P (P + 1)).
    """
    P = poles.shape[1]
    for point in range(poles.shape[0]):
        for o in range(C.shape[1]):
            for a in range(P):
                q[point, o, a] = 0.0
        k = 0
        for a in range(P):
            for b in range(a, P):
                la = poles[point, a]
                lb = poles[point, b]
                s = la + lb.conjugate()
                t = la + lb
                if shared or a == b:
                    H = -product(L, L, point, a, b, True) * inverse(apart(s))
                    M = -product(L, L, point, a, b, False) * inverse(apart(t))
                    for o in range(C.shape[1]):
                        ca = C[point, o, a]
                        cb = C[point, o, b]
                        q[point, o, a] += H * cb.conjugate() + M * cb
                        if b > a:
                            q[point, o, b] += (H * ca).conjugate() + M * ca
                X = 0.0j
                Y = 0.0j
                if la != 0 and lb != 0:
                    w = product(B, B, point, a, b, True)
                    X = w * (inverse(la * lb.conjugate()) - 2.0 * memory * inverse(s))
                    w = product(B, B, point, a, b, False)
                    Y = w * (inverse(la * lb) - 2.0 * memory * inverse(t))
                elif a == b:
                    X += level
                    Y += level
                start[point, k] = -X.real
                start[point, k + 1] = -X.imag
                start[point, k + 2] = -Y.real
                start[point, k + 3] = -Y.imag
                k += 4


@njit(**BORROWING)
def reverse_initial_covariances(
    poles, B, C, L, shared, memory, q_bar, start_bar, poles_bar, B_bar, C_bar, L_bar
):
    """Add the gradients of `initial_covariances`; those of integrators have no meaning."""
    P = poles.shape[1]
    for point in range(poles.shape[0]):
        k = 0
        for a in range(P):
            for b in range(a, P):
                la = poles[point, a]
                lb = poles[point, b]
                s = inverse(apart(la + lb.conjugate()))
                t = inverse(apart(la + lb))
                s_bar = 0.0j
                t_bar = 0.0j
                if shared or a == b:
                    H = -product(L, L, point, a, b, True) * s
                    M = -product(L, L, point, a, b, False) * t
                    H_bar = 0.0j
                    M_bar = 0.0j
                    for o in range(C.shape[1]):
                        ca = C[point, o, a]
                        cb = C[point, o, b]
                        bar = q_bar[point, o, a]
                        H_bar += bar * cb
                        M_bar += bar * cb.conjugate()
                        C_bar[point, o, b] += bar.conjugate() * H + bar * M.conjugate()
                        if b > a:
                            bar = q_bar[point, o, b]
                            H_bar += (bar * ca).conjugate()
                            M_bar += bar * ca.conjugate()
                            C_bar[point, o, a] += (bar * H).conjugate() + bar * M.conjugate()
                    s_bar -= H_bar * (H * s).conjugate()
                    t_bar -= M_bar * (M * t).conjugate()
                    spread(L, L_bar, point, a, b, -H_bar * s.conjugate(), -M_bar * t.conjugate())
                X_bar = complex(-start_bar[point, k], -start_bar[point, k + 1])
                Y_bar = complex(-start_bar[point, k + 2], -start_bar[point, k + 3])
                k += 4
                if la != 0 and lb != 0:
                    w = product(B, B, point, a, b, True)
                    v = product(B, B, point, a, b, False)
                    x = inverse(la * lb.conjugate())
                    y = inverse(la * lb)
                    X_w = (x - 2.0 * memory * s).conjugate()
                    Y_v = (y - 2.0 * memory * t).conjugate()
                    spread(B, B_bar, point, a, b, X_bar * X_w, Y_bar * Y_v)
                    s_bar += X_bar * (2.0 * memory * w * (s * s)).conjugate()
                    t_bar += Y_bar * (2.0 * memory * v * (t * t)).conjugate()
                    x_bar = -X_bar * (w * (x * x)).conjugate()
                    y_bar = -Y_bar * (v * (y * y)).conjugate()
                    poles_bar[point, a] += x_bar * lb + y_bar * lb.conjugate()
                    poles_bar[point, b] += x_bar.conjugate() * la + y_bar * la.conjugate()
                poles_bar[point, a] += s_bar + t_bar
                poles_bar[point, b] += s_bar.conjugate() + t_bar


@njit(**WITHIN)
def spread(x, x_bar, point, a, b, turned_bar, plain_bar):
    """Add what bars of `product`, turned and plain, say of the columns of x."""
    for m in range(x.shape[2]):
        xa = x[point, a, m]
        xb = x[point, b, m]
        x_bar[point, a, m] += turned_bar * xb + plain_bar * xb.conjugate()
        x_bar[point, b, m] += turned_bar.conjugate() * xa + plain_bar * xa.conjugate()
