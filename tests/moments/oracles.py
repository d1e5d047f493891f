"""The same filter, smoother and predictions in plain dense numpy: textbook forms, no recursions.

Written from the definitions: static moments by sums over the nodes with the inverse of the input's
covariance, Kalman updates of all outputs of a sample at once, and the smoother of Rauch, Tung and
Striebel, which inverts the predicted covariance (the package's, of Bryson and Frazier, does not).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pyro_dynogp.moments.functions import KERNELS, TABLE


def keys(s):
    """Kernel of cubic convolution with parameter -1/2 (Keys 1981)."""
    s = np.abs(s)
    near = 1.5 * s**3 - 2.5 * s**2 + 1.0
    far = -0.5 * s**3 + 2.5 * s**2 - 4.0 * s + 2.0
    return np.where(s <= 1.0, near, np.where(s < 2.0, far, 0.0))


def interpolate(table, low, spacing, z):
    """Values (m,) at z of a table (count,), held beyond the second and the last but one point."""
    t = np.clip((np.asarray(z) - low) / spacing, 1.0, len(table) - 2.0)
    return keys(t[:, None] - np.arange(len(table))) @ table


def kappa(form, r2):
    """Radial kernels of unit variance."""
    r = np.sqrt(r2)
    return {
        "rbf": lambda: np.exp(-r2 / 2),
        "matern12": lambda: np.exp(-r),
        "matern32": lambda: (1 + np.sqrt(3) * r) * np.exp(-np.sqrt(3) * r),
        "matern52": lambda: (1 + np.sqrt(5) * r + 5 * r2 / 3) * np.exp(-np.sqrt(5) * r),
    }[form]()


def evaluate(layout, values, i, z):
    """Mean (m, e) and variance (m, e) of static function i at points z (m, d)."""
    own = slice(layout.f_start[i], layout.f_start[i + 1])
    if layout.form[i] == TABLE:
        place = (values.low[i], values.spacing[i], z[:, 0])
        return tuple(
            np.stack([interpolate(row, *place) for row in table[own]], -1)
            for table in (values.table_mean, values.table_variance)
        )
    d = z.shape[1]
    name = {v: k for k, v in KERNELS.items()}[int(layout.form[i])]
    scaled = (z[:, None] - values.Z[i][None, :, :d]) * values.inverse[i, :d]
    f = kappa(name, (scaled**2).sum(-1)) @ values.weight[own].T
    f = f + values.constant[own] + z @ values.slope[own, :d].T
    return f, np.zeros_like(f)


def moments(layout, values, i, time, m, P):
    """Mean and covariance of [a; f] from those of a: static layer i appended."""
    rows = slice(layout.g_start[i], layout.g_start[i + 1])
    G = values.G[rows, : len(m)]
    centre, W = G @ m + values.offset[time, rows], P @ G.T
    p = G @ W + 1e-12 * np.eye(len(G))
    count = layout.node_count[i]
    w = layout.node_weight[i, :count]
    z = centre + layout.nodes[i, :count, : len(G)] @ np.linalg.cholesky(p).T
    f, variance = evaluate(layout, values, i, z)
    mean = w @ f
    cross = W @ np.linalg.solve(p, (w[:, None] * (z - centre)).T @ f)
    block = (w[:, None] * (f - mean)).T @ (f - mean) + np.diag(w @ variance)
    return np.concatenate([m, mean]), np.block([[P, cross], [cross.T, block]])


def linearised(layout, values, i, time, m, P):
    """The same by a first-order expansion at the mean, as in an extended Kalman filter."""
    rows = slice(layout.g_start[i], layout.g_start[i + 1])
    G = values.G[rows, : len(m)]
    centre = G @ m + values.offset[time, rows]
    h = 1e-5
    points = centre + h * np.concatenate([np.zeros((1, len(G))), np.eye(len(G)), -np.eye(len(G))])
    f, variance = evaluate(layout, values, i, points)
    d = len(G)
    slope = (f[1 : d + 1] - f[d + 1 :]).T / (2 * h) @ G
    cross = P @ slope.T
    block = slope @ cross + np.diag(variance[0])
    return np.concatenate([m, f[0]]), np.block([[P, cross], [cross.T, block]])


def propagator(values, k):
    """F = [Phi gamma] of step k, or of none."""
    N, E = values.gamma.shape[1:]
    if k < 0:
        return np.eye(N, N + E), np.zeros((N, N))
    a, b = np.diag(values.re[k]), np.diag(values.im[k])
    return np.hstack([np.block([[a, -b], [b, a]]), values.gamma[k]]), values.Q[k]


def log_normal(r, S):
    return -0.5 * (r @ np.linalg.solve(S, r) + np.linalg.slogdet(S)[1] + len(r) * np.log(2 * np.pi))


@dataclass
class Filtered:
    """What the filter passes through: [x; f] before and after the outputs of each sample."""

    log_density: float = 0.0
    before: list = field(default_factory=list)
    after: list = field(default_factory=list)


def observe(values, time, m, P, noise):
    """All outputs of a sample at once; one by one for mixture noise (share, multiple)."""
    seen = np.flatnonzero(~np.isnan(values.y[time]))
    if not len(seen):
        return 0.0, m, P
    if noise is None:
        H = values.H[seen]
        r = values.y[time, seen] - H @ m - values.y_offset[time, seen]
        S = H @ P @ H.T + np.diag(values.R[time, seen])
        K = np.linalg.solve(S, H @ P).T
        return log_normal(r, S), m + K @ r, P - K @ S @ K.T
    total = 0.0
    for o in seen:
        h = values.H[o]
        r = values.y[time, o] - h @ m - values.y_offset[time, o]
        s = h @ P @ h + values.R[time, o] * noise[1]
        weight = noise[0] * np.exp(-0.5 * r**2 / s) / np.sqrt(2 * np.pi * s)
        total += np.log(weight.sum())
        weight = weight / weight.sum()
        gains = (P @ h)[:, None] / s  # a Kalman filter for each component, then their mixture
        means = m[:, None] + gains * r
        m = means @ weight
        within = P - np.outer(P @ h, P @ h) * (weight / s).sum()
        P = within + ((means - m[:, None]) * weight) @ (means - m[:, None]).T
    return total, m, P


def run(layout, values, static=moments):
    """Filter forwards over the record."""
    mixture = None if len(layout.share) == 1 else (layout.share, layout.multiple)
    out = Filtered()
    m, P = values.m0, values.P0
    for time, k in enumerate(layout.step):
        if time and k >= 0:
            F, Q = propagator(values, k)
            m, P = F @ out.after[-1][0], F @ out.after[-1][1] @ F.T + Q
        elif time:
            N = len(values.m0)
            m, P = out.after[-1][0][:N], out.after[-1][1][:N, :N]
        for i in range(len(layout.channels)):
            m, P = static(layout, values, i, time, m, P)
        out.before.append((m, P))
        l, m, P = observe(values, time, m, P, mixture)
        out.log_density += l
        out.after.append((m, P))
    return out


def smooth(layout, values, filtered):
    """Smoothed mean (n, A) and covariance (n, A, A) of [x; f] (Rauch, Tung & Striebel 1965)."""
    N = len(values.m0)
    m, P = filtered.after[-1]
    means, covariances = [m], [P]
    for time in range(len(layout.step) - 2, -1, -1):
        F, _ = propagator(values, layout.step[time + 1])
        m_after, P_after = filtered.after[time]
        m_next, P_next = (x[:N] if x.ndim == 1 else x[:N, :N] for x in filtered.before[time + 1])
        gain = np.linalg.solve(P_next, F @ P_after).T
        P = P_after + gain @ (P[:N, :N] - P_next) @ gain.T
        m = m_after + gain @ (m[:N] - m_next)
        means.append(m)
        covariances.append(P)
    return np.array(means[::-1]), np.array(covariances[::-1])


def ahead(layout, values, filtered, horizon):
    """Mean and variance (n, n_y) of noise-free outputs, data ending `horizon` samples before."""
    n, N = len(layout.step), len(values.m0)
    means, variances = [], []
    for target in range(n):
        start = target - horizon
        if start >= 0:
            m, P = filtered.after[start]
        else:
            start, m, P = -1, values.m0, values.P0
        for time in range(start + 1, target + 1):
            if time and layout.step[time] >= 0:
                F, Q = propagator(values, layout.step[time])
                m, P = F @ m, F @ P @ F.T + Q
            else:
                m, P = m[:N], P[:N, :N]
            for i in range(len(layout.channels)):
                m, P = moments(layout, values, i, time, m, P)
        means.append(values.H @ m + values.y_offset[target])
        variances.append(np.diag(values.H @ P @ values.H.T))
    return np.array(means), np.array(variances)
