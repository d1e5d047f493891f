r"""One static layer inside the filter: Gaussian moments of f(g) joined to a Gaussian, compiled.

Given a ~ N(m, P) and g = G a + o, the layer appends f(g) to a. With p = G P G' = L L' and the nodes
xi_q of a quadrature for the standard normal,

    E f = sum w_q f(g_q),  g_q = E g + L xi_q,    Cov(a, f) = P G' L^{-T} sum w_q xi_q f(g_q)',
    Var f = sum w_q f(g_q) f(g_q)' - E f (E f)' + sum w_q diag(v(g_q)),

exact for a linear f, and positive semi-definite whatever f is. `v` is the variance of the function
itself given its inducing values. All gradients are written by hand.
"""

from __future__ import annotations

import math

from numba import njit

from pyro_dynogp.moments.functions import (
    TABLE,
    Expansion,
    between,
    expansion,
    expansion_adjoint,
    locate,
    place,
)
from pyro_dynogp.moments.layout import FLOOR
from pyro_dynogp.support.compiled import BORROWING, INLINED, WITHIN


@njit(**BORROWING)
def _cholesky(p, root):
    d = p.shape[0]
    for i in range(d):
        for j in range(i + 1):
            total = p[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i == j:
                root[i, i] = math.sqrt(max(total, 0.0) + FLOOR)
            else:
                root[i, j] = total / root[j, j]


@njit(**BORROWING)
def _cholesky_adjoint(d, root, root_bar, p_bar):
    """Write the gradient by p = L L': L^{-T} sym(tril(L' L_bar)) L^{-1}, its diagonal halved."""
    for c in range(d):
        for b in range(c + 1):
            total = 0.0
            for k in range(c, d):
                total += root[k, c] * root_bar[k, b]
            p_bar[c, b] = 0.5 * total
            p_bar[b, c] = 0.5 * total
    for c in range(d):  # columns: p_bar L^{-1}
        for b in range(d - 1, -1, -1):
            total = p_bar[c, b]
            for k in range(b + 1, d):
                total -= p_bar[c, k] * root[k, b]
            p_bar[c, b] = total / root[b, b]
    for b in range(d):  # rows: L^{-T} p_bar
        for c in range(d - 1, -1, -1):
            total = p_bar[c, b]
            for k in range(c + 1, d):
                total -= root[k, c] * p_bar[k, b]
            p_bar[c, b] = total / root[c, c]


@njit(**INLINED)
def expansion_of(i, layout, numbers):
    """The radial expansion of static layer i in `Values`, or the gradients by it."""
    d = layout.channels[i]
    first = layout.f_start[i]
    last = first + layout.outputs[i]
    return Expansion(
        numbers.Z[i, :, :d],
        numbers.inverse[i, :d],
        numbers.weight[first:last],
        numbers.constant[first:last],
        numbers.slope[first:last],
    )


@njit(**WITHIN)
def _project(i, time, layout, values, m, P, work):
    """Mean of g, its covariance W with a, and the root of its own: all to the work arrays."""
    d = layout.channels[i]
    g0 = layout.g_start[i]
    na = values.m0.shape[0] + layout.f_start[i]
    W, centre = work.W[i], work.centre[i]
    for c in range(d):
        G = values.G[g0 + c]
        centre[c] = values.offset[time, g0 + c]
        for j in range(na):
            centre[c] += G[j] * m[j]
        for k in range(na):
            total = 0.0
            for j in range(na):
                total += P[k, j] * G[j]
            W[k, c] = total
    p = work.square
    for c in range(d):
        for b in range(c + 1):
            total = 0.0
            for j in range(na):
                total += values.G[g0 + c, j] * W[j, b]
            p[c, b] = total
            p[b, c] = total
    _cholesky(p[:d, :d], work.root[i, :d, :d])


@njit(**WITHIN)
def _node(i, q, layout, work):
    """Write node q of layer i, centre + L xi_q, to work.z."""
    xi, z = layout.nodes[i, q], work.z
    for c in range(layout.channels[i]):
        z[c] = work.centre[i, c]
        for b in range(c + 1):
            z[c] += work.root[i, c, b] * xi[b]


@njit(**WITHIN)
def _average(i, layout, values, mean, block, work):
    """Write E f, Var f and work.cross = sum w xi f' of static layer i."""
    d = layout.channels[i]
    e = layout.outputs[i]
    f0 = layout.f_start[i]
    cross = work.cross[i]
    z = work.z
    for a in range(e):
        mean[a] = 0.0
        for b in range(e):
            block[a, b] = 0.0
        for c in range(d):
            cross[c, a] = 0.0
    grid = values.table_mean.shape[1]
    low, scale = values.low[i], 1.0 / values.spacing[i]
    for q in range(layout.node_count[i]):
        xi = layout.nodes[i, q]
        wq = layout.node_weight[i, q]
        _node(i, q, layout, work)
        f = work.f[i, q]
        if layout.form[i] == TABLE:
            k, u, _ = place((z[0] - low) * scale, grid)
            for a in range(e):
                f[a] = between(values.table_mean[f0 + a], k, u)
                block[a, a] += wq * between(values.table_variance[f0 + a], k, u)
        else:
            expansion(layout.form[i], z[:d], expansion_of(i, layout, values), f[:e])
        for a in range(e):
            mean[a] += wq * f[a]
            for c in range(d):
                cross[c, a] += wq * xi[c] * f[a]
    for q in range(layout.node_count[i]):
        wq = layout.node_weight[i, q]
        f = work.f[i, q]
        for a in range(e):
            for b in range(e):
                block[a, b] += wq * (f[a] - mean[a]) * (f[b] - mean[b])


@njit(**WITHIN)
def append(i, time, layout, values, m, P, work):
    """Append the outputs of static layer i to the mean m and covariance P, in place."""
    d = layout.channels[i]
    e = layout.outputs[i]
    na = values.m0.shape[0] + layout.f_start[i]
    _project(i, time, layout, values, m, P, work)
    _average(i, layout, values, m[na : na + e], P[na : na + e, na : na + e], work)
    W, root, gain, cross = work.W[i], work.root[i], work.gain[i], work.cross[i]
    # gain = L^{-T} cross
    for a in range(e):
        for c in range(d - 1, -1, -1):
            total = cross[c, a]
            for b in range(c + 1, d):
                total -= root[b, c] * gain[b, a]
            gain[c, a] = total / root[c, c]
        for k in range(na):
            total = 0.0
            for c in range(d):
                total += W[k, c] * gain[c, a]
            P[k, na + a] = total
            P[na + a, k] = total


@njit(**WITHIN)
def _gain_adjoint(i, na, layout, P_bar, work):
    """Gradients by cross, W and root through the regression gain; the others begin at zero."""
    d = layout.channels[i]
    e = layout.outputs[i]
    W, root, gain = work.W[i], work.root[i], work.gain[i]
    W_bar, root_bar, cross_bar = work.W_bar, work.root_bar, work.cross_bar
    W_bar[:na, :d] = 0.0
    root_bar[:d, :d] = 0.0
    work.centre_bar[:d] = 0.0
    for a in range(e):
        for c in range(d):
            total = 0.0
            for k in range(na):
                covariance_bar = 2.0 * P_bar[k, na + a]
                total += W[k, c] * covariance_bar
                W_bar[k, c] += covariance_bar * gain[c, a]
            cross_bar[c, a] = total
        # cross_bar = L^{-1} gain_bar
        for c in range(d):
            total = cross_bar[c, a]
            for b in range(c):
                total -= root[c, b] * cross_bar[b, a]
            cross_bar[c, a] = total / root[c, c]
    for j in range(d):
        for k in range(j + 1):
            for a in range(e):
                root_bar[j, k] -= gain[j, a] * cross_bar[k, a]


@njit(**WITHIN)
def _average_adjoint(i, layout, values, bars, m, m_bar, P_bar, work):
    """Reverse of `_average`: gradients by the function, and by centre and root of its input."""
    d = layout.channels[i]
    e = layout.outputs[i]
    f0 = layout.f_start[i]
    na = values.m0.shape[0] + f0
    z, z_bar, w4, s4 = work.z, work.z_bar, work.weight4, work.slope4
    f_bar = work.f_bar[:e]
    grid = values.table_mean.shape[1]
    low, scale = values.low[i], 1.0 / values.spacing[i]
    low_bar = 0.0
    spacing_bar = 0.0
    for q in range(layout.node_count[i]):
        xi = layout.nodes[i, q]
        wq = layout.node_weight[i, q]
        f = work.f[i, q]
        z_bar[:d] = 0.0
        _node(i, q, layout, work)
        for a in range(e):
            total = m_bar[na + a]
            for c in range(d):
                total += work.cross_bar[c, a] * xi[c]
            for b in range(e):
                total += 2.0 * P_bar[na + a, na + b] * (f[b] - m[na + b])
            f_bar[a] = wq * total
        if layout.form[i] == TABLE:
            k = locate(z[0], low, scale, grid, w4, s4)
            for a in range(e):
                v_bar = wq * P_bar[na + a, na + a]
                for b in range(4):
                    bars.table_mean[f0 + a, k + b] += f_bar[a] * w4[b]
                    bars.table_variance[f0 + a, k + b] += v_bar * w4[b]
                    z_bar[0] += s4[b] * (
                        f_bar[a] * values.table_mean[f0 + a, k + b]
                        + v_bar * values.table_variance[f0 + a, k + b]
                    )
            # The grid itself may move: f depends on (z - low) / spacing.
            low_bar -= z_bar[0]
            spacing_bar -= z_bar[0] * (z[0] - low) * scale
        else:
            part, part_bar = expansion_of(i, layout, values), expansion_of(i, layout, bars)
            expansion_adjoint(layout.form[i], z[:d], part, f_bar, z_bar[:d], part_bar)
        for c in range(d):
            work.centre_bar[c] += z_bar[c]
            for b in range(c + 1):
                work.root_bar[c, b] += z_bar[c] * xi[b]
    bars.low[i] += low_bar
    bars.spacing[i] += spacing_bar


@njit(**WITHIN)
def append_adjoint(i, time, layout, values, bars, m, P, m_bar, P_bar, work):
    """Reverse mode of `append`: m_bar and P_bar (symmetric) lose the layer's outputs, in place."""
    d = layout.channels[i]
    g0 = layout.g_start[i]
    na = values.m0.shape[0] + layout.f_start[i]
    _gain_adjoint(i, na, layout, P_bar, work)
    _average_adjoint(i, layout, values, bars, m, m_bar, P_bar, work)
    W, W_bar, centre_bar, p_bar = work.W[i], work.W_bar, work.centre_bar, work.square
    _cholesky_adjoint(d, work.root[i], work.root_bar, p_bar)
    # p = G W, centre = G m + offset, W = P G'.
    for c in range(d):
        G = values.G[g0 + c]
        G_bar = bars.G[g0 + c]
        bars.offset[time, g0 + c] += centre_bar[c]
        for j in range(na):
            total = centre_bar[c] * m[j]
            for b in range(d):
                total += p_bar[c, b] * W[j, b]
                W_bar[j, b] += G[j] * p_bar[c, b]
            m_bar[j] += centre_bar[c] * G[j]
            G_bar[j] += total
    for c in range(d):
        G = values.G[g0 + c]
        G_bar = bars.G[g0 + c]
        for j in range(na):
            wj = W_bar[j, c]
            gj = G[j]
            for k in range(na):
                G_bar[k] += wj * P[j, k]
                P_bar[j, k] += 0.5 * (wj * G[k] + gj * W_bar[k, c])
