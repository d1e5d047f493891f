r"""An output that is a function of one signal, y = f(g) + e, inside the filter, compiled.

What the sample says of g ~ N(c, p) is not Gaussian: where f is flat it says nothing, where f folds
it speaks for two places. The update is that of the exact first two moments of g given y,

    l = log int N(g; c, p) N(y; f(g), v(g) + R) dg,   alpha = dl/dc,   beta = -d^2 l/dc^2,

and all else follows since it is jointly Gaussian with g: m <- m + Cov(a, g) alpha, and so on. Joint
moments of g and f(g), which serve inside a cascade, would have flat and steep parts share what the
sample says.

The integral: N(c, p) is the sum of Gaussians at xi_q = SPACING q of standard deviation SPREAD, in
units of sqrt(p), with Gaussian weights (Alspach & Sorenson 1972, IEEE TAC 17(4):439). To each of
them f is its regression line, with what a line leaves as noise, all by Gauss-Hermite quadrature of
three nodes, which are the component's own and the second neighbours. That is exact for a linear f,
and good for others however small R is: no node has to meet the peak of the likelihood.

The noise is a mixture of Gaussians, as in `noise`. v is the function's own variance.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from pyro_dynogp.moments.functions import cubic, cubic_weights, place
from pyro_dynogp.support.compiled import BORROWING, OPTIONS

# The sum reproduces a Gaussian's density to 1e-7 up to five standard deviations. With this SPREAD
# the nodes sqrt(3) SPREAD beside a component's are the second neighbours.
SPACING, REACH = 0.2, 33
SPREAD = 2.0 * SPACING / math.sqrt(3.0)
# Logarithm of the least weight beside the largest: less would be lost in rounding.
_LEAST = -40.0
NODES = SPACING * np.arange(-REACH, REACH + 1.0)
COUNT = len(NODES)
_SQUARE = SPREAD * SPREAD


def _log_weights(variance: float) -> np.ndarray:
    """Of a normal distribution's values at the nodes, adding up to one."""
    density = -0.5 * NODES**2 / variance
    return density - np.log(np.exp(density).sum())


# Of the components, and of the standard normal distribution itself.
LOG_WEIGHTS = _log_weights(1.0 - _SQUARE)
STANDARD = np.exp(_log_weights(1.0))
_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


@njit(**OPTIONS)
def bench(components):
    """Work arrays of the following functions.

    Returns:
        (COUNT + 4,) the function at all nodes and two more on either side; (3, COUNT) mean,
        variance beside the line, and slope by xi of each component; (COUNT, components) weights;
        gradients by the first two.
    """
    return (
        np.empty(COUNT + 4),
        np.empty((3, COUNT)),
        np.empty((COUNT, components)),
        np.empty(COUNT + 4),
        np.empty((3, COUNT)),
    )


@njit(**BORROWING)
def _ruler(i, values, centre, root):
    """First node and distance of nodes in spacings of the table's grid, from its first point."""
    scale = 1.0 / values.spacing[i]
    stride = root * SPACING * scale
    return (centre - values.low[i]) * scale - stride * (REACH + 2), stride


@njit(**BORROWING)
def _evaluate(i, layout, values, centre, root, work):
    """Static layer i at the nodes centre + root xi, and each component's regression line."""
    mean = values.table_mean[layout.f_start[i]]
    variance = values.table_variance[layout.f_start[i]]
    f, at = work.curve, work.at
    start, stride = _ruler(i, values, centre, root)
    for j in range(COUNT + 4):
        k, u, _ = place(start + stride * j, mean.shape[0])
        f[j] = cubic(mean, k, u)[0]
        if 2 <= j < COUNT + 2:
            at[1, j - 2] = max(cubic(variance, k, u)[0], 0.0)
    for q in range(COUNT):
        bend = f[q] - 2.0 * f[q + 2] + f[q + 4]
        at[0, q] = f[q + 2] + bend / 6.0
        at[1, q] += bend * bend / 18.0
        at[2, q] = (f[q + 4] - f[q]) / (4.0 * SPACING)


@njit(**BORROWING)
def _weigh(y, R, share, multiple, at, weights):
    """Turn log weights of all components into weights given y; the log of their sum."""
    top = -np.inf
    K = share.shape[0]
    for k in range(K):
        log_share = math.log(share[k])
        for q in range(COUNT):
            r = y - at[0, q]
            S = at[2, q] * at[2, q] * _SQUARE + at[1, q] + R * multiple[k]
            t = LOG_WEIGHTS[q] + log_share - 0.5 * r * r / S
            weights[q, k] = t
            top = max(top, t)
    total = 0.0
    for q in range(COUNT):
        for k in range(K):
            t = weights[q, k] - top
            if t > _LEAST:
                S = at[2, q] * at[2, q] * _SQUARE + at[1, q] + R * multiple[k]
                weights[q, k] = math.exp(t) / math.sqrt(S)
                total += weights[q, k]
            else:
                weights[q, k] = 0.0
    scale = 1.0 / total
    for q in range(COUNT):
        for k in range(K):
            weights[q, k] *= scale
    return top + math.log(total)


@njit(**BORROWING)
def _given_output(q, y, noise, at):
    """Component q given y: inverse variance of y, regression of xi on y, mean and variance of xi.

    noise: variance of the measurement noise.
    """
    slope = at[2, q]
    inverse = 1.0 / (slope * slope * _SQUARE + at[1, q] + noise)
    along = _SQUARE * slope * inverse
    return inverse, along, NODES[q] + along * (y - at[0, q]), _SQUARE * (1.0 - along * slope)


@njit(**BORROWING)
def _moments(y, R, multiple, at, weights):
    """Mean and variance of xi given y."""
    K = multiple.shape[0]
    mean = 0.0
    second = 0.0
    for q in range(COUNT):
        for k in range(K):
            weight = weights[q, k]
            if weight > 0.0:
                _, _, first, spread = _given_output(q, y, R * multiple[k], at)
                mean += weight * first
                second += weight * (spread + first * first)
    # No variance is lost in rounding that matters: 1 - variance is what counts.
    variance = second - mean * mean
    return mean, variance


@njit(**BORROWING)
def function_terms(i, y, R, centre, p, layout, values, work):
    """Value l, alpha = dl/dc and beta = -d^2 l/dc^2 of the log-density of y = f(g) + e.

    Args:
        i: static layer f. y: measured, without the output's known part. R: variance of the noise.
        centre, p: mean c and variance of g.
    """
    _evaluate(i, layout, values, centre, math.sqrt(p), work)
    return function_given(y, R, p, layout, work)


@njit(**BORROWING)
def function_adjoint(i, y, R, centre, p, layout, values, bars, work, alpha_bar, beta_bar):
    """Reverse of `function_terms` where l counts once: adds to bars of the function.

    Returns:
        Gradients by y, R, centre and p.
    """
    root = math.sqrt(p)
    _evaluate(i, layout, values, centre, root, work)
    at, weights = work.at, work.weights
    _weigh(y, R, layout.share, layout.multiple, at, weights)
    mean, variance = _moments(y, R, layout.multiple, at, weights)
    beta = (1.0 - variance) / p
    # variance = second - mean^2
    second_bar = -beta_bar / p
    mean_bar = alpha_bar / root - 2.0 * mean * second_bar
    p_bar = -0.5 * alpha_bar * mean / (p * root) - beta_bar * beta / p
    R_bar = 0.0
    y_bar = 0.0
    work.at_bar[:] = 0.0
    f_bar, v_bar, slope_bar = work.at_bar[0], work.at_bar[1], work.at_bar[2]
    K = layout.multiple.shape[0]
    level = mean_bar * mean + second_bar * (variance + mean * mean)  # what weights have in common
    for q in range(COUNT):
        r = y - at[0, q]
        s = at[2, q]
        for k in range(K):
            weight = weights[q, k]
            if weight == 0.0:
                continue
            inverse, along, first, spread = _given_output(q, y, R * layout.multiple[k], at)
            term_bar = weight * (
                1.0 + mean_bar * first + second_bar * (spread + first * first) - level
            )
            first_bar = weight * (mean_bar + 2.0 * second_bar * first)
            spread_bar = weight * second_bar
            along_bar = first_bar * r - spread_bar * _SQUARE * s
            S_bar = (0.5 * term_bar * (r * r * inverse - 1.0) - along_bar * along) * inverse
            r_bar = first_bar * along - term_bar * r * inverse
            slope_bar[q] += _SQUARE * (along_bar * inverse - spread_bar * along + 2.0 * S_bar * s)
            v_bar[q] += S_bar
            R_bar += S_bar * layout.multiple[k]
            f_bar[q] -= r_bar
            y_bar += r_bar
    centre_bar, root_bar = _evaluate_adjoint(i, layout, values, bars, centre, root, work)
    return y_bar, R_bar, centre_bar, p_bar + 0.5 * root_bar / root


@njit(**BORROWING)
def _evaluate_adjoint(i, layout, values, bars, centre, root, work):
    """Reverse of `_evaluate`, of work.at_bar: adds to bars; gradients by centre and root."""
    f, curve_bar, w4, s4 = work.curve, work.curve_bar, work.weight4, work.slope4
    f_bar, v_bar, slope_bar = work.at_bar[0], work.at_bar[1], work.at_bar[2]
    curve_bar[:] = 0.0
    for q in range(COUNT):
        bend = f[q] - 2.0 * f[q + 2] + f[q + 4]
        bend_bar = f_bar[q] / 6.0 + v_bar[q] * bend / 9.0
        slope = slope_bar[q] / (4.0 * SPACING)
        curve_bar[q] += bend_bar - slope
        curve_bar[q + 2] += f_bar[q] - 2.0 * bend_bar
        curve_bar[q + 4] += bend_bar + slope
    centre_bar = 0.0
    mean_row = values.table_mean[layout.f_start[i]]
    variance_row = values.table_variance[layout.f_start[i]]
    mean_bars = bars.table_mean[layout.f_start[i]]
    variance_bars = bars.table_variance[layout.f_start[i]]
    start, stride = _ruler(i, values, centre, root)
    scale = 1.0 / values.spacing[i]
    spacing_bar = 0.0
    root_bar = 0.0
    for j in range(COUNT + 4):
        own_bar = v_bar[j - 2] if 2 <= j < COUNT + 2 else 0.0
        if curve_bar[j] == 0.0 and own_bar == 0.0:
            continue  # no component near by has any weight
        t = start + stride * j
        k, u, inside = place(t, mean_row.shape[0])
        _, slope = cubic(mean_row, k, u)
        t_bar = curve_bar[j] * slope
        cubic_weights(u, w4, s4)
        for b in range(4):
            mean_bars[k + b] += curve_bar[j] * w4[b]
        variance, slope = cubic(variance_row, k, u)
        if variance > 0.0:  # where a negative one was cut off there is no gradient
            t_bar += own_bar * slope
            for b in range(4):
                variance_bars[k + b] += own_bar * w4[b]
        # t = (centre + root xi - low) / spacing; the grid itself may move.
        z_bar = t_bar * inside * scale
        centre_bar += z_bar
        spacing_bar -= z_bar * t
        root_bar += z_bar * SPACING * (j - REACH - 2)
    bars.low[i] -= centre_bar
    bars.spacing[i] += spacing_bar
    return centre_bar, root_bar


@njit(**BORROWING)
def function_given(y, R, p, layout, work):
    """What `function_terms` returns, at the c and p of the last `function_moments`."""
    root = math.sqrt(p)
    at, weights = work.at, work.weights
    l = _weigh(y, R, layout.share, layout.multiple, at, weights)
    mean, variance = _moments(y, R, layout.multiple, at, weights)
    return l - _HALF_LOG_2PI, mean / root, (1.0 - variance) / p


@njit(**BORROWING)
def function_density(y, R, layout, work):
    """Its value l alone."""
    return _weigh(y, R, layout.share, layout.multiple, work.at, work.weights) - _HALF_LOG_2PI


@njit(**BORROWING)
def function_moments(i, centre, p, layout, values, work):
    """Mean and variance of f(g) for g ~ N(centre, p)."""
    _evaluate(i, layout, values, centre, math.sqrt(p), work)
    f, at = work.curve, work.at
    mean = 0.0
    for q in range(COUNT):
        mean += STANDARD[q] * f[q + 2]
    variance = 0.0
    for q in range(COUNT):
        off = f[q + 2] - mean
        bend = f[q] - 2.0 * f[q + 2] + f[q + 4]
        variance += STANDARD[q] * (off * off + at[1, q] - bend * bend / 18.0)
    return mean, variance
