r"""The moment-matching filter over a record, compiled; one batch element.

The state x (N,) of all dynamic layers, real parts before imaginary ones, has zero mean without data
(known inputs act through offsets). At each sample: static layers append their outputs to x; every
measured output updates the joint Gaussian, as `noise` says; the state moves on, x <- Phi x +
gamma f + noise. Where the output is a function of one signal, the update is that of
`measured_function`, and the function need not be appended.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from pyro_dynogp.lti.arithmetic import SEGMENT, dot, times
from pyro_dynogp.moments.layout import FLOOR, workspace
from pyro_dynogp.moments.measured_function import function_terms
from pyro_dynogp.moments.noise import noise_terms
from pyro_dynogp.moments.state import move, update
from pyro_dynogp.moments.static_layer import append
from pyro_dynogp.support.compiled import BORROWING, INLINED, OPTIONS, WITHIN


class Track(NamedTuple):
    """What a run keeps for what goes backwards through the record.

    Attributes:
        means: (segments, N) and covariances: (segments, N, N), the state before the outputs of each
            segment's first sample.
        alphas, betas: (n, n_y) by which each output changed the state; zero where it is missing.
    """

    means: np.ndarray
    covariances: np.ndarray
    alphas: np.ndarray
    betas: np.ndarray


@njit(**WITHIN)
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


@njit(**WITHIN)
def output_terms(time, o, layout, values, m, P, c, work):
    """Write the covariance c of a with what output o is measured through; l, alpha and beta."""
    h = seen(o, layout, values)[: m.shape[0]]
    times(P, h, c)
    y = values.y[time, o] - values.y_offset[time, o]
    R = values.R[time, o]
    if layout.measured >= 0:
        centre = dot(h, m) + values.offset[time, layout.g_start[layout.measured]]
        p = max(dot(h, c), 0.0) + FLOOR
        return function_terms(layout.measured, y, R, centre, p, layout, values, work)
    return noise_terms(y - dot(h, m), dot(h, c), R, layout.share, layout.multiple)


@njit(**WITHIN)
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
def before_data(values, A):
    """Mean (A,) and covariance (A, A) of [x; f] at the first sample, nothing appended yet."""
    N = values.m0.shape[0]
    m = np.zeros(A)
    P = np.zeros((A, A))
    m[:N] = values.m0
    P[:N, :N] = values.P0
    return m, P


@njit(**OPTIONS)
def run(layout, values):
    """Log-density of a record, its `Track`, and the last state.

    The last one, (A,) and (A, A), is that of [x; f] given all data.
    """
    n = layout.step.shape[0]
    N = values.m0.shape[0]
    A = width(layout, values)
    segments = (n + SEGMENT - 1) // SEGMENT
    means = np.empty((segments, N))
    covariances = np.empty((segments, N, N))
    m, P = before_data(values, A)
    work = workspace(layout, values)
    T = np.empty((N, A))
    c = np.empty(A)
    alphas = np.zeros((n, values.y.shape[1]))
    betas = np.zeros((n, values.y.shape[1]))
    total = 0.0
    for time in range(n):
        enter(time, layout, values, m, P, T)
        if time % SEGMENT == 0:
            means[time // SEGMENT] = m[:N]
            covariances[time // SEGMENT] = P[:N, :N]
        for i in range(inner(layout)):
            append(i, time, layout, values, m, P, work)
        total += measure(time, layout, values, m, P, c, work, alphas[time], betas[time])
    last_m = np.zeros(values.G.shape[1])
    last_P = np.zeros((last_m.shape[0], last_m.shape[0]))
    last_m[:A] = m
    last_P[:A, :A] = P
    for i in range(inner(layout), layout.channels.shape[0]):
        append(i, n - 1, layout, values, last_m, last_P, work)
    return total, Track(means, covariances, alphas, betas), last_m, last_P
