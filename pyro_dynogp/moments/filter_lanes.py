r"""The filter's predictions one step ahead for points in lanes, forward only; compiled.

The recursion of `smoothing.innovate`, operation by operation, for eight points at a time: what
differences over many points (Gauss-Newton, Fisher matrices) and densities of many draws need.
Only the look-up in tables, and outputs that are a function of a signal, go point by point.

The numbers of a group of points are `Values` whose arrays are lanes, the last axis being the point:
all but tables (WIDTH, E, grid), which are looked up point by point, and y, which the points share.
"""

from __future__ import annotations

import math

from numba import njit

from pyro_dynogp.lti.lanes import exponential, get, larger, put, root, splat
from pyro_dynogp.moments.filtering import inner
from pyro_dynogp.moments.function_lanes import cubic, expand, locate
from pyro_dynogp.moments.functions import TABLE
from pyro_dynogp.moments.lane_room import project_row, update, weighted
from pyro_dynogp.moments.layout import FLOOR
from pyro_dynogp.moments.measured_lanes import measure_function
from pyro_dynogp.support.compiled import BORROWING, WITHIN


@njit(**WITHIN)
def _enter(k, N, A, values, used, own):
    """Move the state over step k, as `state.move`."""
    P, T, m = own.P, own.T, own.m
    E = A - N
    pairs = N // 2
    for j in range(pairs):
        a = get(values.re, k * pairs + j)
        b = get(values.im, k * pairs + j)
        q = pairs + j
        for i in range(A):
            x = get(P, j * A + i)
            w = get(P, q * A + i)
            put(T, j * A + i, a * x - b * w)
            put(T, q * A + i, b * x + a * w)
        x = get(m, j)
        w = get(m, q)
        put(m, j, a * x - b * w)
        put(m, q, b * x + a * w)
    for j in range(N):
        for f in range(E):
            if used.gamma[k, j, f]:
                t = get(values.gamma, (k * N + j) * E + f)
                for i in range(A):
                    put(T, j * A + i, get(T, j * A + i) + t * get(P, (N + f) * A + i))
                put(m, j, get(m, j) + t * get(m, N + f))
    for i in range(N):
        for j in range(pairs):
            a = get(values.re, k * pairs + j)
            b = get(values.im, k * pairs + j)
            q = pairs + j
            x = get(T, i * A + j)
            w = get(T, i * A + q)
            put(P, i * A + j, a * x - b * w + get(values.Q, (k * N + i) * N + j))
            put(P, i * A + q, b * x + a * w + get(values.Q, (k * N + i) * N + q))
        for j in range(N):
            for f in range(E):
                if used.gamma[k, j, f]:
                    t = get(values.gamma, (k * N + j) * E + f)
                    put(P, i * A + j, get(P, i * A + j) + get(T, i * A + N + f) * t)


@njit(**WITHIN)
def _project(i, time, layout, A, values, used, own):
    """Mean of a layer's input, its covariance W with a, and the root of its own."""
    d = layout.channels[i]
    first = layout.g_start[i]
    D = used.G.shape[0]
    na = values.m0.shape[0] + layout.f_start[i]
    for c in range(d):
        seen = used.G[first + c]
        row = (first + c) * A
        mean = get(values.offset, time * D + first + c)
        for j in range(na):
            if seen[j]:
                mean = mean + get(values.G, row + j) * get(own.m, j)
        put(own.centre, c, mean)
        for k in range(na):
            put(own.W, k * d + c, weighted(values.G, row, seen, own.P, k * A, 1, na))
        for b in range(c + 1):
            total = weighted(values.G, row, seen, own.W, b, d, na)
            put(own.square, c * d + b, total)
            put(own.square, b * d + c, total)
    for c in range(d):
        for b in range(c + 1):
            total = get(own.square, c * d + b)
            for k in range(b):
                total = total - get(own.root, c * d + k) * get(own.root, b * d + k)
            if c == b:
                put(own.root, c * d + c, root(larger(total, splat(0.0)) + splat(FLOOR)))
            else:
                put(own.root, c * d + b, total / get(own.root, b * d + b))


@njit(**WITHIN)
def _average(i, layout, A, values, used, own):
    """Write E f to m, Var f to P and sum w xi f' of static layer i."""
    d = layout.channels[i]
    e = layout.outputs[i]
    f0 = layout.f_start[i]
    na = values.m0.shape[0] + f0
    for a in range(e):
        put(own.m, na + a, splat(0.0))
        for b in range(e):
            put(own.P, (na + a) * A + na + b, splat(0.0))
        for c in range(d):
            put(own.cross, c * e + a, splat(0.0))
    for q in range(layout.node_count[i]):
        weight = splat(layout.node_weight[i, q])
        for c in range(d):
            z = get(own.centre, c)
            for b in range(c + 1):
                z = z + get(own.root, c * d + b) * splat(layout.nodes[i, q, b])
            put(own.z, c, z)
        if layout.form[i] == TABLE:
            low = get(values.low, i)
            scale = splat(1.0) / get(values.spacing, i)
            first, u = locate((get(own.z, 0) - low) * scale, values.table_mean.shape[2])
            for a in range(e):
                put(own.f, q * e + a, cubic(values.table_mean, f0 + a, first, u))
                if used.variance[f0 + a]:
                    at = (na + a) * A + na + a
                    more = cubic(values.table_variance, f0 + a, first, u)
                    put(own.P, at, get(own.P, at) + weight * more)
        else:
            expand(layout.form[i], i, d, e, f0, q * e, values, own.z, own.f)
        for a in range(e):
            f = get(own.f, q * e + a)
            put(own.m, na + a, get(own.m, na + a) + weight * f)
            for c in range(d):
                along = splat(layout.node_weight[i, q] * layout.nodes[i, q, c])
                put(own.cross, c * e + a, get(own.cross, c * e + a) + along * f)
    for q in range(layout.node_count[i]):
        weight = splat(layout.node_weight[i, q])
        for a in range(e):
            off = weight * (get(own.f, q * e + a) - get(own.m, na + a))
            for b in range(e):
                at = (na + a) * A + na + b
                other = get(own.f, q * e + b) - get(own.m, na + b)
                put(own.P, at, get(own.P, at) + off * other)


@njit(**WITHIN)
def _append(i, time, layout, A, values, used, own):
    """Append the outputs of static layer i to mean and covariance, as `static_layer.append`."""
    d = layout.channels[i]
    e = layout.outputs[i]
    na = values.m0.shape[0] + layout.f_start[i]
    _project(i, time, layout, A, values, used, own)
    _average(i, layout, A, values, used, own)
    for a in range(e):
        for c in range(d - 1, -1, -1):
            total = get(own.cross, c * e + a)
            for b in range(c + 1, d):
                total = total - get(own.root, b * d + c) * get(own.gain, b * e + a)
            put(own.gain, c * e + a, total / get(own.root, c * d + c))
        for k in range(na):
            total = splat(0.0)
            for c in range(d):
                total = total + get(own.W, k * d + c) * get(own.gain, c * e + a)
            put(own.P, k * A + na + a, total)
            put(own.P, (na + a) * A + k, total)


@njit(**WITHIN)
def _mixture(r, p, R, layout):
    """Density of a residual under noise of several Gaussians, as `noise.noise_terms`.

    That is a product of exp(-r^2 / 2 S), S being the widest one's variance, and of `total`: both,
    with E 1/S and E 1/S^2 by the components' weights.
    """
    square = splat(-0.5) * r * r
    widest = splat(1.0) / (p + R * splat(layout.multiple[0]))
    total = first = second = splat(0.0)
    for k in range(layout.share.shape[0]):
        inverse = splat(1.0) / (p + R * splat(layout.multiple[k]))
        power = exponential(square * (inverse - widest))
        weight = splat(layout.share[k]) * root(inverse) * power
        total = total + weight
        first = first + weight * inverse
        second = second + weight * inverse * inverse
    return square * widest, total, first / total, second / total


@njit(**WITHIN)
def _measure(time, o, layout, A, values, used, own, found):
    """Use one output; what `innovate_lanes` writes goes to `found`."""
    y = values.y
    n, n_y = y.shape
    mean, p = project_row(values.H, o, used.H[o], A, own)
    offset = get(values.y_offset, time * n_y + o)
    R = get(values.R, time * n_y + o)
    put(found, time * n_y + o, splat(y[time, o]) - (mean + offset))
    r = (splat(y[time, o]) - offset) - mean
    variance = p + R
    put(found, (n + time) * n_y + o, variance)
    if layout.share.shape[0] == 1:
        beta = splat(1.0) / variance
        alpha = r * beta
    else:
        power, total, first, second = _mixture(r, p, R, layout)
        put(found, (2 * n + time) * n_y + o, power)
        put(found, (3 * n + time) * n_y + o, total)
        beta = first - r * r * (second - first * first)
        alpha = r * first
    update(A, alpha, beta, own)


@njit(**BORROWING)
def innovate_lanes(layout, values, used, own, work, count, found):
    """Write innovations and their variances of one group to found (2, n, n_y, WIDTH).

    Under noise of several Gaussians, the widest first, found (4, ...) has the logarithm of a factor
    of each density, too, and the other factor but for 1 / sqrt(2 pi). Where the output is a
    function of a signal, found (3, ...) has the log-densities; of the first `count` points alone.
    `work` is a `Bench`. Nothing is written where y is missing.
    """
    n, n_y = values.y.shape
    N = values.m0.shape[0]
    A = used.H.shape[1]
    for j in range(A * A):
        put(own.P, j, splat(0.0))
    for j in range(A):
        put(own.m, j, splat(0.0))
    for j in range(N):
        put(own.m, j, get(values.m0, j))
        for i in range(N):
            put(own.P, j * A + i, get(values.P0, j * N + i))
    for time in range(n):
        k = layout.step[time]
        if k >= 0:
            _enter(k, N, A, values, used, own)
        for i in range(inner(layout)):
            _append(i, time, layout, A, values, used, own)
        for o in range(n_y):
            if math.isnan(values.y[time, o]):
                continue
            if layout.measured >= 0:
                measure_function(time, layout, A, values, used, own, work, count, found)
            else:
                _measure(time, o, layout, A, values, used, own, found)
