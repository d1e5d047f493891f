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

Eight nodes are computed together, see `lti.lanes`: only the look-up in the table and the sums of
gradients by its entries go node by node.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from pyro_dynogp.lti.lanes import WIDTH, choose, exponential, get, larger, put, root, splat, total
from pyro_dynogp.moments.nodes import (
    LOG_WEIGHTS,
    MORE,
    NODES,
    OUTER,
    ROOM,
    SPACING,
    SQUARE,
    STANDARD,
    VECTORS,
    WIDE,
    corner_bars,
    cubic,
    locate,
    take,
)
from pyro_dynogp.support.compiled import BORROWING, WITHIN

_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class Curve(NamedTuple):
    """A tabulated function: first point and spacing of the grid, mean and variance (grid,) there.

    Attributes:
        low, spacing, mean, variance.
    """

    low: float
    spacing: float
    mean: np.ndarray
    variance: np.ndarray


@njit(**WITHIN)
def curve_of(i, layout, values):
    """That of static layer i."""
    f = layout.f_start[i]
    return Curve(values.low[i], values.spacing[i], values.table_mean[f], values.table_variance[f])


@njit(**WITHIN)
def _evaluate(curve, centre, sd, work):
    """The function at the nodes centre + sd xi, and each component's regression line."""
    f, place, at, corner = work.curve, work.place, work.at, work.corner
    locate(curve.low, curve.spacing, curve.mean.shape[0], centre, sd, place)
    take(curve.mean, curve.variance, place, corner)
    for v in range(MORE):
        value, _ = cubic(corner, v, get(place, MORE + v))
        put(f, v, value)
    middle, last, share = f[2:], f[4:], place[1, 2:]
    for v in range(VECTORS):
        own, _ = cubic(corner, 4 * MORE + v, get(share, v))
        a = get(f, v)
        b = get(middle, v)
        c = get(last, v)
        bend = a - splat(2.0) * b + c
        put(at, v, b + bend * splat(1.0 / 6.0))
        put(at, VECTORS + v, larger(own, splat(0.0)) + bend * bend * splat(1.0 / 18.0))
        put(at, 2 * VECTORS + v, (c - a) * splat(0.25 / SPACING))


@njit(**BORROWING)
def _given_output(v, y, inverse, at):
    """Components of vector v given y: regression of xi on y, mean and variance of xi.

    inverse: of the variance of y.
    """
    slope = get(at, 2 * VECTORS + v)
    along = splat(SQUARE) * slope * inverse
    first = get(NODES, v) + along * (splat(y) - get(at, v))
    return along, first, splat(SQUARE) * (splat(1.0) - along * slope)


@njit(**WITHIN)
def _weigh(y, R, share, multiple, work):
    """Weights of all components given y, which `scale` makes add up to one.

    Returns:
        Logarithm of the density of y beside that of a constant, scale, mean and variance of xi.
    """
    at, weights, inverses = work.at, work.weights, work.inverses
    most = splat(-np.inf)
    for k in range(share.shape[0]):
        level = splat(math.log(share[k]))
        noise = splat(R * multiple[k])
        for v in range(VECTORS):
            r = splat(y) - get(at, v)
            slope = get(at, 2 * VECTORS + v)
            S = slope * slope * splat(SQUARE) + get(at, VECTORS + v) + noise
            t = get(LOG_WEIGHTS, v) + level - splat(0.5) * r * r / S
            put(inverses, k * VECTORS + v, splat(1.0) / S)
            put(weights, k * VECTORS + v, t)
            most = larger(t, most)
    put(work.lanes, 0, most)
    top = -np.inf
    for b in range(WIDTH):
        top = max(top, work.lanes[b])
    weighed = splat(0.0)
    mean = splat(0.0)
    second = splat(0.0)
    for k in range(share.shape[0]):
        for v in range(VECTORS):
            inverse = get(inverses, k * VECTORS + v)
            weight = exponential(get(weights, k * VECTORS + v) - splat(top)) * root(inverse)
            _, first, spread = _given_output(v, y, inverse, at)
            put(weights, k * VECTORS + v, weight)
            weighed = weighed + weight
            mean = mean + weight * first
            second = second + weight * (spread + first * first)
    whole = total(weighed)
    scale = 1.0 / whole
    average = scale * total(mean)
    # No variance is lost in rounding that matters: 1 - variance is what counts.
    variance = scale * total(second) - average * average
    return top + math.log(whole) - _HALF_LOG_2PI, scale, average, variance


@njit(**WITHIN)
def function_terms(i, y, R, centre, p, layout, values, work):
    """Value l, alpha = dl/dc and beta = -d^2 l/dc^2 of the log-density of y = f(g) + e.

    Args:
        i: static layer f. y: measured, without the output's known part. R: variance of the noise.
        centre, p: mean c and variance of g.
    """
    _evaluate(curve_of(i, layout, values), centre, math.sqrt(p), work)
    return function_given(y, R, p, layout, work)


@njit(**WITHIN)
def function_adjoint(i, y, R, centre, p, layout, values, bars, work, alpha_bar, beta_bar):
    """Reverse of `function_terms` where l counts once: adds to bars of the function.

    Returns:
        Gradients by y, R, centre and p.
    """
    sd = math.sqrt(p)
    _evaluate(curve_of(i, layout, values), centre, sd, work)
    _, scale, mean, variance = _weigh(y, R, layout.share, layout.multiple, work)
    beta = (1.0 - variance) / p
    # variance = second - mean^2
    second_bar = -beta_bar / p
    mean_bar = alpha_bar / sd - 2.0 * mean * second_bar
    p_bar = -0.5 * alpha_bar * mean / (p * sd) - beta_bar * beta / p
    # What the weights have in common goes with their sum.
    level = 1.0 - mean_bar * mean - second_bar * (variance + mean * mean)
    y_bar, R_bar = _weigh_adjoint(y, layout.multiple, scale, mean_bar, second_bar, level, work)
    centre_bar, sd_bar = _evaluate_adjoint(i, layout, values, bars, centre, sd, work)
    return y_bar, R_bar, centre_bar, p_bar + 0.5 * sd_bar / sd


@njit(**WITHIN)
def _weigh_adjoint(y, multiple, scale, mean_bar, second_bar, level, work):
    """Write the gradients by function and variance; gradients by y and R are returned."""
    at, bars = work.at, work.curve_bar
    early, middle, late = bars[0, 4:], bars[1, 4:], bars[2, 4:]
    f, f2, f4 = work.curve, work.curve[2:], work.curve[4:]
    square = splat(SQUARE)
    two = splat(2.0)
    half = splat(0.5)
    first_order = splat(mean_bar)
    second_order = splat(second_bar)
    y_bar = splat(0.0)
    R_bar = splat(0.0)
    for v in range(VECTORS):
        r = splat(y) - get(at, v)
        s = get(at, 2 * VECTORS + v)
        f_bar = splat(0.0)
        v_bar = splat(0.0)
        slope_bar = splat(0.0)
        for k in range(multiple.shape[0]):
            inverse = get(work.inverses, k * VECTORS + v)
            weight = splat(scale) * get(work.weights, k * VECTORS + v)
            along, first, spread = _given_output(v, y, inverse, at)
            term = first_order * first + second_order * (spread + first * first) + splat(level)
            term_bar = weight * term
            first_bar = weight * (first_order + two * second_order * first)
            spread_bar = weight * second_order
            along_bar = first_bar * r - spread_bar * square * s
            gained = half * term_bar * (r * r * inverse - splat(1.0))
            S_bar = (gained - along_bar * along) * inverse
            r_bar = first_bar * along - term_bar * r * inverse
            slope_bar = slope_bar + square * (
                along_bar * inverse - spread_bar * along + two * S_bar * s
            )
            v_bar = v_bar + S_bar
            R_bar = R_bar + S_bar * splat(multiple[k])
            f_bar = f_bar - r_bar
        y_bar = y_bar - f_bar
        bend = get(f, v) - two * get(f2, v) + get(f4, v)
        bend_bar = f_bar * splat(1.0 / 6.0) + v_bar * bend * splat(1.0 / 9.0)
        slope = slope_bar * splat(0.25 / SPACING)
        put(early, v, bend_bar - slope)
        put(middle, v, f_bar - two * bend_bar)
        put(late, v, bend_bar + slope)
        put(bars[3], v, v_bar)
    return total(y_bar), total(R_bar)


@njit(**WITHIN)
def _evaluate_adjoint(i, layout, values, bars, centre, sd, work):
    """Reverse of `_evaluate`: adds to bars; gradients by centre and sd."""
    place, corner = work.place, work.corner
    # The function at a node is in the lines of its own component and of its second neighbours.
    early, middle, late = work.curve_bar[0, 4:], work.curve_bar[1, 2:], work.curve_bar[2]
    own, share, inside, outer = work.curve_bar[3], place[1, 2:], place[2, 2:], OUTER[2:]
    centre_bar = splat(0.0)
    sd_bar = splat(0.0)
    for v in range(MORE):
        u = get(place, MORE + v)
        bar = get(early, v) + get(middle, v) + get(late, v)
        _, slope = cubic(corner, v, u)
        z_bar = bar * slope * get(place, 2 * MORE + v)
        centre_bar = centre_bar + z_bar
        sd_bar = sd_bar + z_bar * get(OUTER, v)
        corner_bars(corner, v, u, bar)
    for v in range(VECTORS):
        u = get(share, v)
        variance, slope = cubic(corner, 4 * MORE + v, u)
        # Where a negative one was cut off there is no gradient.
        bar = choose(variance, get(own, v), splat(0.0))
        z_bar = bar * slope * get(inside, v)
        centre_bar = centre_bar + z_bar
        sd_bar = sd_bar + z_bar * get(outer, v)
        corner_bars(corner, 4 * MORE + v, u, bar)
    mean_bars = bars.table_mean[layout.f_start[i]]
    variance_bars = bars.table_variance[layout.f_start[i]]
    for j in range(WIDE):
        k = int(place[0, j])
        for b in range(4):
            mean_bars[k + b] += corner[b, j]
    for j in range(ROOM):
        k = int(place[0, j + 2])
        for b in range(4):
            variance_bars[k + b] += corner[4 + b, j]
    # Places on the grid are (centre + sd xi - low) / spacing; the grid itself may move.
    scale = 1.0 / values.spacing[i]
    by_centre = scale * total(centre_bar)
    by_sd = scale * total(sd_bar)
    bars.low[i] -= by_centre
    bars.spacing[i] -= scale * (by_centre * (centre - values.low[i]) + by_sd * sd)
    return by_centre, by_sd


@njit(**WITHIN)
def function_given(y, R, p, layout, work):
    """What `function_terms` returns, at the c and p of the last `function_moments`."""
    l, _, mean, variance = _weigh(y, R, layout.share, layout.multiple, work)
    return l, mean / math.sqrt(p), (1.0 - variance) / p


@njit(**WITHIN)
def function_density(y, R, layout, work):
    """Its value l alone."""
    l, _, _, _ = _weigh(y, R, layout.share, layout.multiple, work)
    return l


@njit(**WITHIN)
def function_moments(i, centre, p, layout, values, work):
    """Mean and variance of f(g) for g ~ N(centre, p), f being static layer i."""
    return moments_of(curve_of(i, layout, values), centre, p, work)


@njit(**WITHIN)
def moments_of(curve, centre, p, work):
    """Mean and variance of f(g) for g ~ N(centre, p)."""
    _evaluate(curve, centre, math.sqrt(p), work)
    early, f, late, at = work.curve, work.curve[2:], work.curve[4:], work.at
    first = splat(0.0)
    for v in range(VECTORS):
        first = first + get(STANDARD, v) * get(f, v)
    mean = total(first)
    second = splat(0.0)
    for v in range(VECTORS):
        off = get(f, v) - splat(mean)
        bend = get(early, v) - splat(2.0) * get(f, v) + get(late, v)
        own = off * off + get(at, VECTORS + v) - bend * bend * splat(1.0 / 18.0)
        second = second + get(STANDARD, v) * own
    return mean, total(second)
