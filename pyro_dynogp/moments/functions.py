r"""Compiled evaluation of static functions inside a recursion, with derivatives.

Three forms. A function of one channel is a table on an even grid, interpolated by cubic convolution
(Keys 1981, IEEE ASSP 29:1153; the parameter -1/2), held at its ends: any kernel fits, since the
table is computed outside. A function of several channels is an expansion in a radial kernel,

    f_e(z) = constant_e + slope_e . z + sum_m weight_em kappa(r_m),
    r_m^2 = sum_c ((z_c - Z_mc) s_c)^2,

or the products of each of its first k channels with each other one, form PRODUCT + k,

    f_(i, j)(z) = constant_(i, j) + slope_(i, j) . z + z_i z_(k + j),

or, form HYSTERESIS, with v = z_1 - Z_11 and w = z_2 - Z_12,

    f(z) = constant + slope . z + |v| w + weight_11 v |w|.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit

from pyro_dynogp.support.compiled import BORROWING

# Forms of a static function.
TABLE = 0
KERNELS = {"rbf": 1, "matern12": 2, "matern32": 3, "matern52": 4}
HYSTERESIS = 7
PRODUCT = 8


@njit(**BORROWING)
def cubic_weights(u, weight, slope):
    """Weights of the four grid values around a point, and their derivatives by u in [0, 1]."""
    square = u * u
    cube = square * u
    weight[0] = -0.5 * cube + square - 0.5 * u
    weight[1] = 1.5 * cube - 2.5 * square + 1.0
    weight[2] = -1.5 * cube + 2.0 * square + 0.5 * u
    weight[3] = 0.5 * (cube - square)
    slope[0] = -1.5 * square + 2.0 * u - 0.5
    slope[1] = 4.5 * square - 5.0 * u
    slope[2] = -4.5 * square + 4.0 * u + 0.5
    slope[3] = 1.5 * square - u


@njit(**BORROWING)
def place(t, count):
    """Where t, in spacings from the grid's first point, lies: first of four values, u, inside.

    u: in [0, 1], from the second of the four. inside: 1, or 0 beyond the ends and where t is NaN.
    """
    last = count - 2.0
    inside = 1.0
    if not t > 1.0:
        t = 1.0
        inside = 0.0
    elif t > last:
        t = last
        inside = 0.0
    first = min(int(t), count - 3)
    return first - 1, t - first, inside


@njit(**BORROWING)
def between(table, first, u):
    """Value at u between the second and the third of four values of a table, from `first` on."""
    a = table[first]
    b = table[first + 1]
    c = table[first + 2]
    d = table[first + 3]
    square = a - 2.5 * b + 2.0 * c - 0.5 * d
    cube = 1.5 * (b - c) + 0.5 * (d - a)
    return b + u * (0.5 * (c - a) + u * (square + u * cube))


@njit(**BORROWING)
def locate(z, low, scale, count, weight, slope):
    """Index of the first of four grid values for z; derivatives by z, zero beyond the ends.

    scale: one over the spacing.
    """
    first, u, inside = place((z - low) * scale, count)
    cubic_weights(u, weight, slope)
    inside *= scale
    for i in range(4):
        slope[i] *= inside
    return first


@njit(**BORROWING)
def radial(form, square):
    """Value of kappa and its derivative by r^2, at r^2."""
    if form == 1:
        value = math.exp(-0.5 * square)
        return value, -0.5 * value
    r = math.sqrt(square + 1e-30)
    if form == 2:
        value = math.exp(-r)
        return value, -0.5 * value / r
    if form == 3:
        a = math.sqrt(3.0)
        value = math.exp(-a * r)
        return (1.0 + a * r) * value, -1.5 * value
    a = math.sqrt(5.0)
    value = math.exp(-a * r)
    return (1.0 + a * r + 5.0 / 3.0 * square) * value, -5.0 / 6.0 * (1.0 + a * r) * value


class Expansion(NamedTuple):
    """Numbers of one radial expansion of d channels and e outputs, or the gradients by them.

    Attributes:
        Z: (M, d). inverse: (d,). weight: (e, M). constant: (e,). slope: (e, d).
    """

    Z: np.ndarray
    inverse: np.ndarray
    weight: np.ndarray
    constant: np.ndarray
    slope: np.ndarray


@njit(**BORROWING)
def add_products(first, z, f):
    """Add to f (e,) the products of the first channels of z (d,) with the others."""
    others = z.shape[0] - first
    for i in range(first):
        for j in range(others):
            f[i * others + j] += z[i] * z[first + j]


@njit(**BORROWING)
def products_adjoint(first, z, f_bar, z_bar):
    """Add the gradient by z of the products to z_bar, given f_bar."""
    others = z.shape[0] - first
    for i in range(first):
        for j in range(others):
            z_bar[i] += f_bar[i * others + j] * z[first + j]
            z_bar[first + j] += f_bar[i * others + j] * z[i]


@njit(**BORROWING)
def add_hysteresis(z, part, f):
    """Add |v| w and a share of v |w| to f (1,); v and w are z (2,) less the first location."""
    v = z[0] - part.Z[0, 0]
    w = z[1] - part.Z[0, 1]
    f[0] += abs(v) * w + part.weight[0, 0] * v * abs(w)


@njit(**BORROWING)
def hysteresis_adjoint(z, part, f_bar, z_bar, bars):
    """Add the gradients by z, by the first location and by the share, given f_bar."""
    v = z[0] - part.Z[0, 0]
    w = z[1] - part.Z[0, 1]
    share = part.weight[0, 0]
    by_v = f_bar[0] * (np.sign(v) * w + share * abs(w))
    by_w = f_bar[0] * (abs(v) + share * v * np.sign(w))
    z_bar[0] += by_v
    z_bar[1] += by_w
    bars.Z[0, 0] -= by_v
    bars.Z[0, 1] -= by_w
    bars.weight[0, 0] += f_bar[0] * v * abs(w)


@njit(**BORROWING)
def expansion(form, z, part, f):
    """Write the outputs f (e,) of a radial expansion, or of products, at z (d,)."""
    e = f.shape[0]
    d = z.shape[0]
    for a in range(e):
        f[a] = part.constant[a]
        for c in range(d):
            f[a] += part.slope[a, c] * z[c]
    if form > PRODUCT:
        add_products(form - PRODUCT, z, f)
        return
    if form == HYSTERESIS:
        add_hysteresis(z, part, f)
        return
    for m in range(part.Z.shape[0]):
        square = 0.0
        for c in range(d):
            t = (z[c] - part.Z[m, c]) * part.inverse[c]
            square += t * t
        value, _ = radial(form, square)
        for a in range(e):
            f[a] += part.weight[a, m] * value


@njit(**BORROWING)
def expansion_adjoint(form, z, part, f_bar, z_bar, bars):
    """Add the gradients by z and by the parts of an expansion to z_bar and bars, given f_bar."""
    e = f_bar.shape[0]
    d = z.shape[0]
    inverse = part.inverse
    for a in range(e):
        bars.constant[a] += f_bar[a]
        for c in range(d):
            bars.slope[a, c] += f_bar[a] * z[c]
            z_bar[c] += f_bar[a] * part.slope[a, c]
    if form > PRODUCT:
        products_adjoint(form - PRODUCT, z, f_bar, z_bar)
        return
    if form == HYSTERESIS:
        hysteresis_adjoint(z, part, f_bar, z_bar, bars)
        return
    for m in range(part.Z.shape[0]):
        square = 0.0
        for c in range(d):
            t = (z[c] - part.Z[m, c]) * inverse[c]
            square += t * t
        value, derivative = radial(form, square)
        total = 0.0
        for a in range(e):
            bars.weight[a, m] += f_bar[a] * value
            total += f_bar[a] * part.weight[a, m]
        square_bar = 2.0 * total * derivative
        for c in range(d):
            difference = z[c] - part.Z[m, c]
            t = square_bar * inverse[c] * inverse[c] * difference
            z_bar[c] += t
            bars.Z[m, c] -= t
            bars.inverse[c] += square_bar * difference * difference * inverse[c]


def cubature(channels: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (2 d, d) and weights (2 d,) for the standard normal, exact to the third degree."""
    eye = math.sqrt(channels) * np.eye(channels)
    return np.concatenate([eye, -eye]), np.full(2 * channels, 0.5 / channels)


@lru_cache
def gauss_hermite(channels: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (Q, d) and weights (Q,) for the standard normal of d channels.

    One channel: 11 Gauss-Hermite nodes; two: 5 x 5; three and four: products of three nodes; from
    five on the third-degree cubature of 2 d nodes, whose cost does not grow exponentially.
    """
    if channels >= 5:
        return cubature(channels)
    count = {1: 11, 2: 5, 3: 3, 4: 3}[channels]
    x, w = np.polynomial.hermite_e.hermegauss(count)
    w = w / w.sum()
    nodes = np.stack([g.ravel() for g in np.meshgrid(*[x] * channels, indexing="ij")], -1)
    weights = np.prod(
        np.stack([g.ravel() for g in np.meshgrid(*[w] * channels, indexing="ij")], -1), -1
    )
    return nodes, weights
