"""Static functions of `functions` at one node each of eight points; compiled."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from pyro_dynogp.lti.lanes import (
    WIDTH,
    below,
    choose,
    exponential,
    gather,
    get,
    magnitude,
    put,
    root,
    splat,
)
from pyro_dynogp.moments.functions import HYSTERESIS, PRODUCT
from pyro_dynogp.support.compiled import BORROWING, WITHIN

# Number of each point.
PLACES = np.arange(float(WIDTH))


@njit(**WITHIN)
def locate(t, count):
    """Where t, in spacings from the first point of a grid, lies, as `functions.place`.

    The first of four grid points, and how far behind the second.
    """
    one = splat(1.0)
    end = splat(count - 2.0)
    t = choose(t - end, end, choose(t - one, t, one))
    first = below(t)
    first = choose(first - splat(count - 3.0), splat(count - 3.0), first)
    return first - one, t - first


@njit(**WITHIN)
def powers(a, b, c, d):
    """Coefficients of u, u^2 and u^3 of the curve through b and c, between four grid values."""
    half = splat(0.5)
    square = a - splat(2.5) * b + splat(2.0) * c - half * d
    return half * (c - a), square, splat(1.5) * (b - c) + half * (d - a)


@njit(**WITHIN)
def cubic(table, f, first, u):
    """Values of function f of each point's table (WIDTH, E, grid), as `functions.between`."""
    E, grid = table.shape[1], table.shape[2]
    one = splat(1.0)
    at = get(PLACES, 0) * splat(float(E * grid)) + splat(float(f * grid)) + first
    a = gather(table, at)
    b = gather(table, at + one)
    c = gather(table, at + one + one)
    d = gather(table, at + one + one + one)
    line, square, cube = powers(a, b, c, d)
    return b + u * (line + u * (square + u * cube))


@njit(**WITHIN)
def radial(form, square):
    """Value of kappa at r^2, as `functions.radial`."""
    if form == 1:
        return exponential(splat(-0.5) * square)
    r = root(square + splat(1e-30))
    if form == 2:
        return exponential(splat(0.0) - r)
    one = splat(1.0)
    if form == 3:
        a = splat(math.sqrt(3.0))
        return (one + a * r) * exponential(splat(0.0) - a * r)
    a = splat(math.sqrt(5.0))
    return (one + a * r + splat(5.0 / 3.0) * square) * exponential(splat(0.0) - a * r)


@njit(**BORROWING)
def add_products(leading, d, first, z, f):
    """Add to f, from `first` on, the products of the leading channels of z (d) with the others."""
    others = d - leading
    for i in range(leading):
        for j in range(others):
            at = first + i * others + j
            put(f, at, get(f, at) + get(z, i) * get(z, leading + j))


@njit(**BORROWING)
def expand(form, i, d, e, f0, first, values, z, f):
    """Write the outputs of the expansion of static layer i at z (d) to f, from `first` on.

    d, e: its channels and outputs. f0: its first output among all. values: in lanes.
    """
    M, most = values.Z.shape[1], values.Z.shape[2]
    for a in range(e):
        total = get(values.constant, f0 + a)
        for c in range(d):
            total = total + get(values.slope, (f0 + a) * most + c) * get(z, c)
        put(f, first + a, total)
    if form > PRODUCT:
        add_products(form - PRODUCT, d, first, z, f)
        return
    if form == HYSTERESIS:
        v = get(z, 0) - get(values.Z, i * M * most)
        w = get(z, 1) - get(values.Z, i * M * most + 1)
        share = get(values.weight, f0 * M)
        put(f, first, get(f, first) + magnitude(v) * w + share * v * magnitude(w))
        return
    for m in range(M):
        square = splat(0.0)
        for c in range(d):
            off = get(z, c) - get(values.Z, (i * M + m) * most + c)
            t = off * get(values.inverse, i * most + c)
            square = square + t * t
        value = radial(form, square)
        for a in range(e):
            put(f, first + a, get(f, first + a) + get(values.weight, (f0 + a) * M + m) * value)
