r"""What the filter says about layers and outputs: smoothed trajectories, predictions, last state.

The smoother runs backwards with the gradient lambda and the negative Hessian Lambda of the
log-density of later data by the state (Bryson & Frazier 1963): the smoothed mean is m + P lambda
and the covariance P - P Lambda P. Nothing is inverted, so that layers without process noise, whose
covariance is singular, are no special case. Static layers act through their regression gain.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from pyro_dynogp.lti.arithmetic import SEGMENT, dot, times
from pyro_dynogp.moments.filtering import before_data, enter, inner, measure, seen, width
from pyro_dynogp.moments.layout import FLOOR, workspace
from pyro_dynogp.moments.measured_function import (
    function_density,
    function_given,
    function_moments,
)
from pyro_dynogp.moments.noise import noise_terms
from pyro_dynogp.moments.segments import replay, restore, room
from pyro_dynogp.moments.state import step_back, update
from pyro_dynogp.moments.static_layer import append
from pyro_dynogp.support.compiled import BORROWING, OPTIONS, WITHIN


@njit(**WITHIN)
def _quadratic(P, h, c):
    times(P, h, c)
    return dot(h, c)


@njit(**WITHIN)
def _noise_free(time, o, layout, values, centre, p, work):
    """Mean and variance of an output without its noise.

    centre, p: mean and variance of the filtered part of what the output is measured through.
    """
    if layout.measured >= 0:
        i = layout.measured
        at = centre + values.offset[time, layout.g_start[i]]
        mean, variance = function_moments(i, at, max(p, 0.0) + FLOOR, layout, values, work)
    else:
        mean, variance = centre, p
    return mean + values.y_offset[time, o], variance


@njit(**BORROWING)
def _predict(time, o, layout, values, centre, p, work, found):
    """Write what `_noise_free` returns, and the log-density of the measured output.

    Evaluates a measured function once for both.
    """
    found[0], found[1] = _noise_free(time, o, layout, values, centre, p, work)
    y = values.y[time, o] - values.y_offset[time, o]
    R = values.R[time, o]
    if layout.measured >= 0:
        l = function_density(y, R, layout, work)
    else:
        l, _, _ = noise_terms(y - centre, p, R, layout.share, layout.multiple)
    found[2] = np.nan if math.isnan(y) else l


@njit(**BORROWING)
def _predict_all(time, layout, values, m, P, c, work, found):
    """What `_predict` writes, of all outputs of a sample, to found (3, n, n_y)."""
    for o in range(values.y.shape[1]):
        h = seen(o, layout, values)[: m.shape[0]]
        p = _quadratic(P, h, c)
        _predict(time, o, layout, values, dot(h, m), p, work, found[:, time, o])


@njit(**OPTIONS)
def predict_ahead(layout, values, horizon):
    """Of outputs given data up to `horizon` before: mean, variance, log-density (n, n_y).

    Mean and variance are those of the noise-free outputs; the log-density, that of the measured
    ones, is NaN where they are missing. Earlier targets than `horizon` are predicted from the first
    state without data.
    """
    n = layout.step.shape[0]
    n_y = values.y.shape[1]
    N = values.m0.shape[0]
    A = width(layout, values)
    S = inner(layout)
    found = np.empty((3, n, n_y))
    m, P = before_data(values, A)
    ahead_m = m.copy()
    ahead_P = P.copy()
    work = workspace(layout, values)
    T = np.empty((N, A))
    c = np.empty(A)
    alphas = np.empty(n_y)
    betas = np.empty(n_y)
    for target in range(min(horizon, n)):  # no data yet
        if target > 0:
            enter(target, layout, values, ahead_m, ahead_P, T)
        for i in range(S):
            append(i, target, layout, values, ahead_m, ahead_P, work)
        _predict_all(target, layout, values, ahead_m, ahead_P, c, work, found)
    for time in range(n - horizon):
        if time > 0:
            enter(time, layout, values, m, P, T)
        for i in range(S):
            append(i, time, layout, values, m, P, work)
        measure(time, layout, values, m, P, c, work, alphas, betas)
        ahead_m[:] = m
        ahead_P[:] = P
        for target in range(time + 1, time + horizon + 1):
            enter(target, layout, values, ahead_m, ahead_P, T)
            for i in range(S):
                append(i, target, layout, values, ahead_m, ahead_P, work)
        target = time + horizon
        _predict_all(target, layout, values, ahead_m, ahead_P, c, work, found)
    return found[0], found[1], found[2]


@njit(**BORROWING)
def _before_outputs(time, track, layout, values, bar, L, m, P, t, work, kept, cavity):
    """Take lambda (A,) and Lambda (A, A) back over the outputs of a sample, undone in m and P.

    Writes to cavity (3, n, n_y) mean and variance of each noise-free output given all data but its
    own sample, and the sample's log-density; not where cavity is empty. The information of later
    data does not depend on what the filter knew before: with q = c'Lambda c and l = c'lambda after
    the update, the Woodbury identity gives the mean m + (l + alpha q)/(1 + beta q) and the variance
    s - q/(1 + beta q) before it.
    """
    A = bar.shape[0]
    alphas, betas = track.alphas[time], track.betas[time]
    for o in range(values.y.shape[1] - 1, -1, -1):
        if math.isnan(values.y[time, o]):
            continue
        h = seen(o, layout, values)[:A]
        c = kept.C[o]
        update(P, m, c, -alphas[o], -betas[o])
        along = dot(c, bar)
        times(L, c, t)
        q = dot(c, t)
        shrink = 1.0 / (1.0 + betas[o] * q)
        if cavity.size > 0:
            _predict(
                time,
                o,
                layout,
                values,
                dot(h, m) + shrink * (along + alphas[o] * q),
                max(dot(h, c) - shrink * q, 0.0),
                work,
                cavity[:, time, o],
            )
        for j in range(A):
            bar[j] += (alphas[o] - betas[o] * along) * h[j]
        both = betas[o] * (1.0 + betas[o] * q)
        for j in range(A):
            for k in range(A):
                L[j, k] += both * h[j] * h[k] - betas[o] * (h[j] * t[k] + t[j] * h[k])


@njit(**BORROWING)
def _before_layer(i, layout, values, bar, L, work, row):
    """Take lambda and Lambda back over static layer i: its outputs lean on what they come from."""
    N = values.m0.shape[0]
    A = bar.shape[0]
    na = N + layout.f_start[i]
    for a in range(layout.outputs[i]):
        q = na + a
        for j in range(na):
            row[j] = 0.0
            for c in range(layout.channels[i]):
                row[j] += work.gain[i, c, a] * values.G[layout.g_start[i] + c, j]
        for j in range(na):
            bar[j] += row[j] * bar[q]
        bar[q] = 0.0
        # Later outputs of the same layer keep their entries until it is their turn.
        for k in range(A):
            t = L[q, k]
            for j in range(na):
                L[j, k] += row[j] * t
        for k in range(A):
            t = L[k, q]
            for j in range(na):
                L[k, j] += row[j] * t
        for k in range(A):
            L[q, k] = 0.0
            L[k, q] = 0.0


@njit(**OPTIONS)
def smooth(layout, values, rows, track):
    """Smoothed mean (n, A) of [x; f] and variance (n, r) of the rows (r, A) of it.

    track: what `filtering.run` kept.
    """
    cavity = np.empty((3, 0, values.y.shape[1]))
    S = layout.channels.shape[0]
    return _backwards(layout, values, S, rows, track, cavity)


@njit(**OPTIONS)
def leave_one_out(layout, values, track):
    """What `predict_ahead` returns, of each output given all data but its own sample.

    NaN where the sample is missing. Exact for linear cascades with Gaussian noise.
    """
    rows = np.empty((0, width(layout, values)))
    cavity = np.full((3, values.y.shape[0], values.y.shape[1]), np.nan)
    _backwards(layout, values, inner(layout), rows, track, cavity)
    return cavity[0], cavity[1], cavity[2]


@njit(**OPTIONS)
def _backwards(layout, values, S, rows, track, cavity):
    """What `smooth` returns; writes what `leave_one_out` does to cavity, unless that is empty.

    S: how many static layers are appended. rows: (r, A) of the state and these.
    """
    n = layout.step.shape[0]
    N = values.m0.shape[0]
    A = rows.shape[1]
    mean = np.empty((n, A))
    variance = np.empty((n, rows.shape[0]))
    m = np.zeros(A)
    P = np.zeros((A, A))
    bar = np.zeros(A)
    L = np.zeros((A, A))
    work = workspace(layout, values)
    T = np.empty((N, A))
    moved = np.empty((N, A))
    c = np.empty(A)
    t = np.empty(A)
    kept = room(values, A)
    for segment in range(track.means.shape[0] - 1, -1, -1):
        first = segment * SEGMENT
        last = min(n, first + SEGMENT)
        m[:N] = track.means[segment]
        P[:N, :N] = track.covariances[segment]
        replay(first, last, S, track, layout, values, m, P, T, c, work, kept)
        for time in range(last - 1, first - 1, -1):
            restore(time, time - first, S, track, layout, values, m, P, work, kept)
            if time < n - 1 and layout.step[time + 1] >= 0:
                k = layout.step[time + 1]
                step_back(values.re[k], values.im[k], values.gamma[k], bar, L, moved)
            times(P, bar, c)
            for j in range(A):
                mean[time, j] = m[j] + c[j]
            for row in range(rows.shape[0]):
                times(P, rows[row], c)
                variance[time, row] = max(dot(rows[row], c) - _quadratic(L, c, t), 0.0)
            _before_outputs(time, track, layout, values, bar, L, m, P, t, work, kept, cavity)
            for i in range(S - 1, -1, -1):
                _before_layer(i, layout, values, bar, L, work, t)
    return mean, variance


@njit(**OPTIONS)
def innovate(layout, values):
    """Innovations y - E[y], their variances and log-densities (n, n_y), one step ahead.

    Outputs of one time follow one another. NaN where missing.
    """
    n = layout.step.shape[0]
    n_y = values.y.shape[1]
    N = values.m0.shape[0]
    A = width(layout, values)
    found = np.full((3, n, n_y), np.nan)
    m, P = before_data(values, A)
    work = workspace(layout, values)
    T = np.empty((N, A))
    c = np.empty(A)
    for time in range(n):
        enter(time, layout, values, m, P, T)
        for i in range(inner(layout)):
            append(i, time, layout, values, m, P, work)
        for o in range(n_y):
            if math.isnan(values.y[time, o]):
                continue
            h = seen(o, layout, values)[:A]
            p = _quadratic(P, h, c)
            mean, variance = _noise_free(time, o, layout, values, dot(h, m), p, work)
            R = values.R[time, o]
            y = values.y[time, o] - values.y_offset[time, o]
            if layout.measured >= 0:
                l, alpha, beta = function_given(y, R, max(p, 0.0) + FLOOR, layout, work)
            else:
                l, alpha, beta = noise_terms(y - dot(h, m), p, R, layout.share, layout.multiple)
            found[0, time, o] = values.y[time, o] - mean
            found[1, time, o] = variance + R
            found[2, time, o] = l
            update(P, m, c, alpha, beta)
    return found[0], found[1], found[2]
