"""Arrays of the filter in lanes: what is in use, scratch, and sums over rows; compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from pyro_dynogp.lti.lanes import WIDTH, get, put, splat
from pyro_dynogp.support.compiled import WITHIN


class InUse(NamedTuple):
    """What is not zero at every point: the rest is passed over.

    Attributes:
        variance: (E,) of functions. G: (D, A), H: (n_y, A), gamma: (k, N, E), as of `Values`.
    """

    variance: np.ndarray
    G: np.ndarray
    H: np.ndarray
    gamma: np.ndarray


class Room(NamedTuple):
    """Work arrays of lanes.

    m (A), P (A A), T (N A), c (A); of one static layer centre (d), W (A d), own covariance (d d)
    and its root (d d), a node (d), f (Q e), cross and gain (d e); what a point is given (4).
    """

    m: np.ndarray
    P: np.ndarray
    T: np.ndarray
    c: np.ndarray
    centre: np.ndarray
    W: np.ndarray
    square: np.ndarray
    root: np.ndarray
    z: np.ndarray
    f: np.ndarray
    cross: np.ndarray
    gain: np.ndarray
    given: np.ndarray


def room(states: int, outputs: int, channels: int, widest: int, nodes: int) -> Room:
    """Arrays for one group.

    Args:
        states: N. outputs: E, of all static layers. channels, widest: most inputs and outputs of
            one of them. nodes: most nodes.
    """
    A, d, e = states + outputs, channels, widest
    sizes = (A, A * A, states * A, A, d, A * d, d * d, d * d, d, nodes * e, d * e, d * e, 4)
    return Room(*(np.zeros((max(size, 1), WIDTH)) for size in sizes))


@njit(**WITHIN)
def weighted(row, first, used, x, start, stride, count):
    """Sum of row[first + j] x[start + j stride] over the entries j of a row that are in use."""
    total = splat(0.0)
    for j in range(count):
        if used[j]:
            total = total + get(row, first + j) * get(x, start + j * stride)
    return total


@njit(**WITHIN)
def project_row(rows, place, used, A, own):
    """Mean and variance of what a row of `rows` (rows, A) sees; its covariance with a goes to c."""
    first = place * A
    for i in range(A):
        put(own.c, i, weighted(rows, first, used, own.P, i, A, A))
    p = weighted(rows, first, used, own.c, 0, 1, A)
    return weighted(rows, first, used, own.m, 0, 1, A), p


@njit(**WITHIN)
def update(A, alpha, beta, own):
    """M <- m + alpha c, P <- P - beta c c', as `state.update`."""
    for i in range(A):
        c = get(own.c, i)
        put(own.m, i, get(own.m, i) + alpha * c)
        t = beta * c
        for j in range(A):
            at = i * A + j
            put(own.P, at, get(own.P, at) - t * get(own.c, j))
