"""Arrays that the compiled filter works on: how layers are joined, their numbers, scratch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from pyro_dynogp.moments.nodes import bench
from pyro_dynogp.support.compiled import OPTIONS

# Added to the variance of a layer's input: a deterministic one is a Gaussian of this variance.
FLOOR = 1e-12


class Layout(NamedTuple):
    """Numbers that say how the layers are put together; none of them has a gradient.

    Attributes:
        step: (n,) index of the distinct step that leads to each sample, -1 for none.
        channels, outputs: (S,) inputs d and outputs e of each static layer.
        form: (S,) TABLE or a radial kernel.
        g_start, f_start: (S + 1,) where the layer's inputs and outputs start among all.
        nodes: (S, Q, d_max), node_weight: (S, Q), node_count: (S,).
        share, multiple: (K,) weights and variance multiples of the noise's Gaussian components,
            the widest first.
        measured: static layer, the last one, whose only output is the record's, a function of one
            signal (see `measured_function`); -1 where there is none.
    """

    step: np.ndarray
    channels: np.ndarray
    outputs: np.ndarray
    form: np.ndarray
    g_start: np.ndarray
    f_start: np.ndarray
    nodes: np.ndarray
    node_weight: np.ndarray
    node_count: np.ndarray
    share: np.ndarray
    multiple: np.ndarray
    measured: int


class Values(NamedTuple):
    """All numbers with a gradient, of one batch element. N states, A = N + all static outputs.

    Attributes:
        re, im: (k, N/2) propagators of the k distinct steps.
        Q: (k, N, N) process noise of each step. gamma: (k, N, E) held static outputs to state.
        m0: (N,), P0: (N, N) the state at the first sample.
        G: (D, A) inputs of static layers. offset: (n, D) their known part.
        table_mean, table_variance: (E, grid) of tabulated functions.
        low, spacing: (S,) first point and spacing of the grid.
        weight: (E, M), Z: (S, M, d_max), inverse: (S, d_max), constant: (E,), slope: (E, d_max):
            of radial expansions.
        H: (n_y, A) rows of the outputs. y_offset: (n, n_y) their known part.
        y: (n, n_y) measured, NaN where missing. R: (n, n_y) variance of the noise.
    """

    re: np.ndarray
    im: np.ndarray
    Q: np.ndarray
    gamma: np.ndarray
    m0: np.ndarray
    P0: np.ndarray
    G: np.ndarray
    offset: np.ndarray
    table_mean: np.ndarray
    table_variance: np.ndarray
    low: np.ndarray
    spacing: np.ndarray
    weight: np.ndarray
    Z: np.ndarray
    inverse: np.ndarray
    constant: np.ndarray
    slope: np.ndarray
    H: np.ndarray
    y_offset: np.ndarray
    y: np.ndarray
    R: np.ndarray


class Workspace(NamedTuple):
    """What static layers compute at one sample and their adjoints need again; S layers of them.

    Attributes:
        W: (S, A, d) covariance of a with g. centre: (S, d) mean of g. root: (S, d, d) L.
        f: (S, Q, e) function at the nodes. cross: (S, d, e) sum w xi f'. gain: (S, d, e)
            regression of f on g.
        square: (d, d) covariance of g, or the gradient by it.
        W_bar, centre_bar, root_bar, cross_bar, f_bar: gradients, of one layer at a time.
        z, z_bar: (d,) a node, and the gradient by it.
        weight4, slope4: (4,) of a table's interpolation.
        curve, place, corner, at, weights, inverses, curve_bar, lanes: of `measured_function`, as of
            `Bench`. (A bench in the workspace would be shorter, and makes gradients of a Wiener
            model take 1.4 times as long.)
    """

    W: np.ndarray
    centre: np.ndarray
    root: np.ndarray
    f: np.ndarray
    cross: np.ndarray
    gain: np.ndarray
    square: np.ndarray
    W_bar: np.ndarray
    centre_bar: np.ndarray
    root_bar: np.ndarray
    cross_bar: np.ndarray
    f_bar: np.ndarray
    z: np.ndarray
    z_bar: np.ndarray
    weight4: np.ndarray
    slope4: np.ndarray
    curve: np.ndarray
    place: np.ndarray
    corner: np.ndarray
    at: np.ndarray
    weights: np.ndarray
    inverses: np.ndarray
    curve_bar: np.ndarray
    lanes: np.ndarray


@njit(**OPTIONS)
def workspace(layout, values):
    """Work arrays for one run."""
    S, Q, d = layout.nodes.shape
    A = values.G.shape[1]
    e = 1
    for i in range(S):
        e = max(e, layout.outputs[i])
    curve, place, corner, at, weights, inverses, curve_bar, lanes = bench(layout.share.shape[0])
    return Workspace(
        np.zeros((S, A, d)),
        np.zeros((S, d)),
        np.zeros((S, d, d)),
        np.zeros((S, Q, e)),
        np.zeros((S, d, e)),
        np.zeros((S, d, e)),
        np.empty((d, d)),
        np.empty((A, d)),
        np.empty(d),
        np.empty((d, d)),
        np.empty((d, e)),
        np.empty(e),
        np.empty(d),
        np.empty(d),
        np.empty(4),
        np.empty(4),
        curve,
        place,
        corner,
        at,
        weights,
        inverses,
        curve_bar,
        lanes,
    )


def zero_bars(values: Values) -> Values:
    """Zeros of the shape of every value."""
    return Values(*(np.zeros_like(x) for x in values))
