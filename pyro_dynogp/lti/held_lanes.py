r"""Samples less the response to held inputs, for points in lanes, and the gradient.

The recursion of `response` from rest,

    x_{k+1} = exp(lambda s) x_k + gamma B u_k,   gamma = s psi(lambda s),   psi(z) = (e^z - 1) / z,
    r_k     = y_k - 2 Re C x_k - D v_k - offset,

for eight points at a time. Arrays of lanes as `lanes` and `innovation_layout` have them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from pyro_dynogp.lti.lanes import WIDTH, choose, complex_exponential, get, put, splat
from pyro_dynogp.support.compiled import BORROWING, WITHIN

# psi by its series where |z|^2 is below this: (e^z - 1)/z would lose digits.
NEAR = 0.25
_PSI = tuple(1.0 / math.factorial(k + 1) for k in range(15, -1, -1))


class Signals(NamedTuple):
    """What all points share.

    step (n,): of each sample, -1 for none; length (m,): of the steps. driving (n, n_v): inputs of
    the modes; acting (n, n_d): inputs that act at once. outputs (n n_y,): y, sample by sample.
    """

    step: np.ndarray
    length: np.ndarray
    driving: np.ndarray
    acting: np.ndarray
    outputs: np.ndarray


class Gains(NamedTuple):
    """Of all groups (groups, ..., WIDTH): poles (2P), B (2 P n_v), C (2 n_y P), D (n_y (n_d + 1)).

    Pairs of real and imaginary part alternate. The last column of D is the offset.
    """

    poles: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray


class Response(NamedTuple):
    """Room for one group: phi and gamma of each step (2 m P) and what is said of them.

    states (2 (n or 1) P); bar (2P): of the state at hand; line (n_y): outputs of a sample.
    """

    phi: np.ndarray
    gamma: np.ndarray
    phi_bar: np.ndarray
    gamma_bar: np.ndarray
    states: np.ndarray
    bar: np.ndarray
    line: np.ndarray


def room(n: int, steps: int, P: int, n_y: int) -> Response:
    """Arrays of a group; n = 1 where no gradient is asked for."""
    each = 2 * steps * P
    sizes = (each, each, each, each, 2 * n * P, 2 * P, n_y)
    return Response(*(np.zeros((size, WIDTH)) for size in sizes))


@njit(**WITHIN)
def held(re, im, s):
    """exp(z) and gamma, real and imaginary parts, z = s (re + i im)."""
    a = re * s
    b = im * s
    pr, pi = complex_exponential(a, b)
    size = a * a + b * b
    one = splat(1.0)
    qr = ((pr - one) * a + pi * b) / size
    qi = (pi * a - (pr - one) * b) / size
    sr = splat(_PSI[0])
    si = splat(0.0)
    for k in range(1, len(_PSI)):
        t = sr * a - si * b + splat(_PSI[k])
        si = sr * b + si * a
        sr = t
    near = splat(NEAR) - size
    return pr, pi, s * choose(near, sr, qr), s * choose(near, si, qi)


@njit(**WITHIN)
def pushed(B, driving, i, j, P):
    """B_j u_i, real and imaginary part."""
    n_v = driving.shape[1]
    re = splat(0.0)
    im = splat(0.0)
    for m in range(n_v):
        u = splat(driving[i, m])
        re = re + get(B, 2 * (j * n_v + m)) * u
        im = im + get(B, 2 * (j * n_v + m) + 1) * u
    return re, im


@njit(**BORROWING)
def respond(g, gains, signals, own, residual):
    """Write the residuals (k, n n_y) of the points of group g; states where there is room."""
    poles = gains.poles[g]
    B = gains.B[g]
    C = gains.C[g]
    D = gains.D[g]
    P = poles.shape[0] // 2
    n, n_d = signals.acting.shape
    n_y = D.shape[0] // (n_d + 1)
    for k in range(signals.length.shape[0]):
        for j in range(P):
            at = 2 * (k * P + j)
            pr, pi, gr, gi = held(
                get(poles, 2 * j), get(poles, 2 * j + 1), splat(signals.length[k])
            )
            put(own.phi, at, pr)
            put(own.phi, at + 1, pi)
            put(own.gamma, at, gr)
            put(own.gamma, at + 1, gi)
    keep = own.states.shape[0] > 2 * P
    for j in range(2 * P):
        put(own.states, j, splat(0.0))
    now = 0
    for i in range(n):
        k = signals.step[i]
        before = now
        now = 2 * i * P if keep else 0
        for j in range(P):
            xr = get(own.states, before + 2 * j)
            xi = get(own.states, before + 2 * j + 1)
            if k >= 0:
                at = 2 * (k * P + j)
                vr, vi = pushed(B, signals.driving, i - 1, j, P)
                pr = get(own.phi, at)
                pi = get(own.phi, at + 1)
                gr = get(own.gamma, at)
                gi = get(own.gamma, at + 1)
                t = (pr * xr - pi * xi) + (gr * vr - gi * vi)
                xi = (pr * xi + pi * xr) + (gr * vi + gi * vr)
                xr = t
            put(own.states, now + 2 * j, xr)
            put(own.states, now + 2 * j + 1, xi)
        for o in range(n_y):
            total = splat(0.0)
            for j in range(P):
                at = 2 * (o * P + j)
                total = total + (
                    get(C, at) * get(own.states, now + 2 * j)
                    - get(C, at + 1) * get(own.states, now + 2 * j + 1)
                )
            total = total + total + get(D, o * (n_d + 1) + n_d)
            for m in range(n_d):
                total = total + get(D, o * (n_d + 1) + m) * splat(signals.acting[i, m])
            put(own.line, o, splat(signals.outputs[i * n_y + o]) - total)
        for lane in range(min(WIDTH, residual.shape[0] - g * WIDTH)):
            for o in range(n_y):
                residual[g * WIDTH + lane, i * n_y + o] = own.line[o, lane]


@njit(**WITHIN)
def add(array, k, x):
    """Add lanes to vector k of an array."""
    put(array, k, get(array, k) + x)


@njit(**BORROWING)
def reverse_respond(g, gains, signals, own, bars, residual_bar):
    """Write the gradients by the gains of group g to `bars`, from those (k, n n_y) by residuals.

    Args: own: as `respond` left it, with states. bars: of all groups, zeros before.
    """
    B = gains.B[g]
    C = gains.C[g]
    B_bar = bars.B[g]
    C_bar = bars.C[g]
    D_bar = bars.D[g]
    P = gains.poles.shape[1] // 2
    n, n_d = signals.acting.shape
    n_v = signals.driving.shape[1]
    n_y = D_bar.shape[0] // (n_d + 1)
    for j in range(2 * P):
        put(own.bar, j, splat(0.0))
    for k in range(own.phi.shape[0]):
        put(own.phi_bar, k, splat(0.0))
        put(own.gamma_bar, k, splat(0.0))
    for i in range(n - 1, -1, -1):
        for lane in range(WIDTH):
            point = min(g * WIDTH + lane, residual_bar.shape[0] - 1)
            for o in range(n_y):
                own.line[o, lane] = -residual_bar[point, i * n_y + o]
        for o in range(n_y):
            y_bar = get(own.line, o)
            add(D_bar, o * (n_d + 1) + n_d, y_bar)
            for m in range(n_d):
                add(D_bar, o * (n_d + 1) + m, y_bar * splat(signals.acting[i, m]))
            y_bar = y_bar + y_bar
            for j in range(P):
                at = 2 * (o * P + j)
                add(own.bar, 2 * j, y_bar * get(C, at))
                add(own.bar, 2 * j + 1, splat(0.0) - y_bar * get(C, at + 1))
                add(C_bar, at, y_bar * get(own.states, 2 * (i * P + j)))
                add(C_bar, at + 1, splat(0.0) - y_bar * get(own.states, 2 * (i * P + j) + 1))
        k = signals.step[i]
        if k < 0:
            continue
        for j in range(P):
            at = 2 * (k * P + j)
            mr = get(own.bar, 2 * j)
            mi = get(own.bar, 2 * j + 1)
            vr, vi = pushed(B, signals.driving, i - 1, j, P)
            add(own.gamma_bar, at, mr * vr + mi * vi)
            add(own.gamma_bar, at + 1, mi * vr - mr * vi)
            gr = get(own.gamma, at)
            gi = get(own.gamma, at + 1)
            for m in range(n_v):
                u = splat(signals.driving[i - 1, m])
                add(B_bar, 2 * (j * n_v + m), (gr * mr + gi * mi) * u)
                add(B_bar, 2 * (j * n_v + m) + 1, (gr * mi - gi * mr) * u)
            xr = get(own.states, 2 * ((i - 1) * P + j))
            xi = get(own.states, 2 * ((i - 1) * P + j) + 1)
            add(own.phi_bar, at, mr * xr + mi * xi)
            add(own.phi_bar, at + 1, mi * xr - mr * xi)
            pr = get(own.phi, at)
            pi = get(own.phi, at + 1)
            put(own.bar, 2 * j, pr * mr + pi * mi)
            put(own.bar, 2 * j + 1, pr * mi - pi * mr)
    reverse_steps(gains.poles[g], signals.length, own, bars.poles[g])


@njit(**BORROWING)
def reverse_steps(poles, length, own, poles_bar):
    """Gradients by poles of phi and of gamma, d gamma / d lambda = (s phi - gamma) / lambda."""
    P = poles.shape[0] // 2
    for k in range(length.shape[0]):
        s = splat(length[k])
        for j in range(P):
            at = 2 * (k * P + j)
            re = get(poles, 2 * j)
            im = get(poles, 2 * j + 1)
            sr = s * get(own.phi, at)
            si = s * get(own.phi, at + 1)
            br = get(own.phi_bar, at)
            bi = get(own.phi_bar, at + 1)
            add(poles_bar, 2 * j, sr * br + si * bi)
            add(poles_bar, 2 * j + 1, sr * bi - si * br)
            dr = sr - get(own.gamma, at)
            di = si - get(own.gamma, at + 1)
            size = re * re + im * im
            hr = (dr * re + di * im) / size
            hi = (di * re - dr * im) / size
            br = get(own.gamma_bar, at)
            bi = get(own.gamma_bar, at + 1)
            add(poles_bar, 2 * j, hr * br + hi * bi)
            add(poles_bar, 2 * j + 1, hr * bi - hi * br)
