"""How large an effect is in the output of a machine, by what a linear model cannot explain.

Sizes are root mean squares over the record of a change of the output [output]:

- PLAIN: of the difference that the effect makes, less its mean. For shifts, drifts, periodic
  disturbances and undeclared inputs, which no response of the inputs explains but by chance.
- BEYOND LAGS: of what is left of that difference by least squares on a constant and lags of the
  recorded input, up to five times the slowest time constant, a fifth of the record at most, without
  combinations of lags below 1e-4 of the largest. Where the machine without the effect is linear,
  this is what a long linear model leaves of the output. For nonlinearities, calendars and shifted
  clocks.
- BEYOND ORDER: of what is left of the output by the best linear system of the order that the model
  to start from has. For dead time and unmodelled dynamics, which a long linear model would explain.
- INTEGRAL: of what is left of the output by the same least squares as BEYOND LAGS; without the
  integrator another quantity is measured, so that there is no difference.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from tests.discrepancy.machine_inputs import Array
from tests.discrepancy.machine_planting import (
    BEYOND_LAGS,
    BEYOND_ORDER,
    INTEGRAL,
    Ground,
    Planting,
    limited,
    run,
)
from tests.discrepancy.machine_rigs import LEAD, Rig

LAGS, SHARE = 5.0, 5
# Of smooth inputs, combinations of lags that are smaller than this are none that a model could use.
WEAKEST = 1e-4
# Of the search for a system of some order.
ITERATIONS, EVALUATIONS, LARGEST_POLE = 25, 30, 0.9995


def rms(x: Array) -> Array:
    """Root mean square (n_y,) of the rows of x (n, n_y)."""
    return np.asarray(np.sqrt(np.mean(np.square(x), axis=0)))


def number_of_lags(rig: Rig) -> int:
    """Lags of the long linear model."""
    return int(min(np.ceil(LAGS * rig.memory), rig.samples // SHARE))


def beyond_lags(rig: Rig, u: Array, change: Array) -> Array:
    """What is left (n, n_y) of a change by least squares on lags of the inputs u (total, n_u)."""
    lags, x = number_of_lags(rig), u - u.mean(axis=0)
    rows = LEAD + np.arange(rig.samples)[:, None] - np.arange(lags + 1)
    columns = np.column_stack([np.ones(rig.samples), x[rows].reshape(rig.samples, -1) / x.std()])
    weights = np.linalg.lstsq(columns, change, rcond=WEAKEST)[0]
    return np.asarray(change - columns @ weights)


def beyond_order(rig: Rig, u: Array, y: Array, order: int) -> Array:
    """Output (n,) of the best linear system of an order, with feedthrough and a constant.

    Least squares over the denominator, for each of which the numerator follows by linear least
    squares; from the best of the iterations of Steiglitz and McBride (IEEE Trans. Automatic Control
    10:461, 1965), and from the machine's own poles.

    Args:
        rig: the machine. u: (total, 1) input. y: (n,) output. order: of the system.
    """
    x, level = u[:, 0] - u[:, 0].mean(), float(y.mean())
    own = np.exp(rig.system.rates * rig.step)
    denominators = [_stable(np.poly(np.resize(own, order)).real[1:])]
    for _ in range(ITERATIONS):
        denominators.append(_equation_error(x, y - level, denominators[-1]))

    def left(denominator: Array) -> Array:
        return np.asarray(y - _fitted(x, y, _stable(denominator)))

    losses = [float(np.square(left(a)).sum()) for a in denominators]
    starts = [denominators[0], denominators[int(np.argmin(losses))]]
    found = [least_squares(left, a, max_nfev=EVALUATIONS, xtol=1e-6, ftol=1e-6) for a in starts]
    return np.asarray(y - min(found, key=lambda f: float(f.cost)).fun)


def _late(x: Array, lags: range) -> list[Array]:
    return [np.concatenate([np.zeros(k), x[: len(x) - k]]) for k in lags]


def _stable(denominator: Array) -> Array:
    """Coefficients (order,) of a denominator with its roots moved into a circle below one."""
    roots = np.roots([1.0, *denominator])
    if (np.abs(roots) <= LARGEST_POLE).all():
        return denominator
    inside = roots * np.minimum(1.0, LARGEST_POLE / np.maximum(np.abs(roots), 1e-12))
    return np.asarray(np.poly(inside).real[1:])


def _fitted(x: Array, y: Array, denominator: Array) -> Array:
    """Output (n,) of the best system with that denominator for the input x (total,)."""
    base, n = lfilter([1.0], [1.0, *denominator], x), len(y)
    late = [column[-n:] for column in _late(base, range(len(denominator) + 1))]
    columns = np.column_stack([np.ones(n), *late])
    columns /= np.abs(columns).max(axis=0)
    return np.asarray(columns @ np.linalg.lstsq(columns, y, rcond=1e-12)[0])


def _equation_error(x: Array, y: Array, denominator: Array) -> Array:
    """The next denominator: least squares of the difference equation, filtered by the last one."""
    order, n = len(denominator), len(y)
    filtered, output = (lfilter([1.0], [1.0, *denominator], signal) for signal in (x, y))
    inputs = [column[-n:] for column in _late(filtered, range(order + 1))]
    outputs = [-column for column in _late(output, range(1, order + 1))]
    settled = slice(min(60, n // 4), None)  # the filter of the output starts at rest
    columns = np.column_stack([*outputs, *inputs, np.ones(n)])[settled]
    return _stable(np.linalg.lstsq(columns, output[settled], rcond=1e-12)[0][:order])


def relative_size(base: Ground, planting: Planting, amount: float) -> Array:
    """Size (n_y,) of one effect alone over the standard deviation of the output without it."""
    rig = planting.prepare(base.rig, amount) if planting.prepare else base.rig
    made = run(rig, [(planting, amount)])
    if planting.measure == INTEGRAL:
        return np.asarray(rms(beyond_lags(rig, made.u, made.output)) / made.output.std(axis=0))
    if planting.measure == BEYOND_ORDER:
        best = beyond_order(rig, made.u, made.linear[:, 0], 2 * rig.pairs)[:, None]
        change = (rig.curve(made.linear) - rig.curve(best)) if rig.curve else made.linear - best
        return np.asarray(rms(change) / base.sd)
    output = limited(made.output, [(planting, amount)])
    without = base.output
    if planting.recorded:
        without = run(replace(rig, u=made.u)).output
    change = output - without
    if planting.measure == BEYOND_LAGS:
        return np.asarray(rms(beyond_lags(rig, made.u, change)) / base.sd)
    return np.asarray(rms(change - change.mean(axis=0)) / base.sd)
