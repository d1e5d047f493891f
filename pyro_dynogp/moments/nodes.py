"""Nodes at which `measured_function` has a tabulated function, eight together; compiled.

Only the look-up in the table goes node by node.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from pyro_dynogp.lti.lanes import WIDTH, choose, get, put, splat
from pyro_dynogp.moments import function_lanes
from pyro_dynogp.support.compiled import BORROWING, OPTIONS

# The sum reproduces a Gaussian's density to 1e-7 up to five standard deviations. With this SPREAD
# the nodes sqrt(3) SPREAD beside a component's are the second neighbours.
SPACING, REACH = 0.2, 33
SPREAD = 2.0 * SPACING / math.sqrt(3.0)
COUNT = 2 * REACH + 1
SQUARE = SPREAD * SPREAD
# Vectors of components; those that fill the last one have no weight. The function is needed two
# nodes further on either side, with which it fills one vector more.
VECTORS = -(-COUNT // WIDTH)
MORE = VECTORS + 1
ROOM, WIDE = WIDTH * VECTORS, WIDTH * MORE
NODES = SPACING * (np.arange(float(ROOM)) - REACH)
PLACES = np.arange(float(WIDE))
OUTER = SPACING * (PLACES - (REACH + 2))


def _log_weights(variance: float) -> np.ndarray:
    """Of a normal distribution's values at the nodes, adding up to one."""
    density = np.where(np.arange(ROOM) < COUNT, -0.5 * NODES**2 / variance, -1e300)
    return np.asarray(density - np.log(np.exp(density).sum()))


# Of the components, and of the standard normal distribution itself.
LOG_WEIGHTS = _log_weights(1.0 - SQUARE)
STANDARD = np.exp(_log_weights(1.0))


class Bench(NamedTuple):
    """Work arrays of `measured_function`, as `bench` makes them."""

    curve: np.ndarray
    place: np.ndarray
    corner: np.ndarray
    at: np.ndarray
    weights: np.ndarray
    inverses: np.ndarray
    curve_bar: np.ndarray
    lanes: np.ndarray


@njit(**OPTIONS)
def bench(components):
    """Work arrays of the following functions, in whole vectors.

    Returns:
        Function at all nodes and two more on either side; of these nodes the first of four grid
        points, place between the second and the third, and 1 within the table; the four values of
        mean and variance there, or the gradients by them; of each component mean, variance beside
        the line, slope by xi; for each part of the noise weights, and inverse variances of y;
        gradients by the function, two and four nodes late, and by the variance; one vector.
    """
    return (
        np.zeros(WIDE),
        np.zeros((3, WIDE)),
        np.zeros((8, WIDE)),
        np.zeros((3, ROOM)),
        np.zeros((components, ROOM)),
        np.zeros((components, ROOM)),
        np.zeros((4, WIDE + WIDTH)),
        np.zeros(WIDTH),
    )


@njit(**BORROWING)
def locate(low, spacing, count, centre, sd, place):
    """Write where the nodes centre + sd xi lie on the grid, as `functions.place` has it."""
    scale = 1.0 / spacing
    stride = sd * SPACING * scale
    start = splat((centre - low) * scale - stride * (REACH + 2))
    one = splat(1.0)
    end = splat(count - 2.0)
    for v in range(MORE):
        t = start + splat(stride) * get(PLACES, v)
        inside = choose(t - end, splat(0.0), choose(t - one, one, splat(0.0)))
        first, u = function_lanes.locate(t, count)
        put(place, v, first)
        put(place, MORE + v, u)
        put(place, 2 * MORE + v, inside)


@njit(**BORROWING)
def take(mean, variance, place, corner):
    """Write the four values of the tables around each node; those of the variance two places on."""
    for j in range(WIDE):
        k = int(place[0, j])
        for b in range(4):
            corner[b, j] = mean[k + b]
    for j in range(ROOM):
        k = int(place[0, j + 2])
        for b in range(4):
            corner[4 + b, j] = variance[k + b]


@njit(**BORROWING)
def cubic(corner, v, u):
    """Value of what `functions.cubic_weights` has, and its derivative by u.

    v: vector of the first of four rows.
    """
    a = get(corner, v)
    b = get(corner, MORE + v)
    c = get(corner, 2 * MORE + v)
    d = get(corner, 3 * MORE + v)
    one, square, cube = function_lanes.powers(a, b, c, d)
    value = b + u * (one + u * (square + u * cube))
    return value, one + u * (splat(2.0) * square + u * splat(3.0) * cube)


@njit(**BORROWING)
def corner_bars(corner, v, u, bar):
    """Write the gradients by the four values of a cubic over these; its own is `bar`."""
    square = u * u
    cube = square * u
    half = splat(0.5)
    put(corner, v, bar * (square - half * (cube + u)))
    put(corner, MORE + v, bar * (splat(1.5) * cube - splat(2.5) * square + splat(1.0)))
    put(corner, 2 * MORE + v, bar * (splat(2.0) * square - splat(1.5) * cube + half * u))
    put(corner, 3 * MORE + v, bar * (half * (cube - square)))
