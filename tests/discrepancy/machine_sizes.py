"""How large an effect is in the output of a machine, by what a linear model cannot explain.

Sizes are root mean squares over the record of a change of the output [output]:

- PLAIN: of the difference that the effect makes, less its mean. For shifts, drifts, periodic
  disturbances and undeclared inputs, which no response of the inputs explains but by chance.
- BEYOND LAGS: of what is left of that difference by least squares on a constant and lags of the
  recorded input, five times the slowest time constant, a fifth of the record at most. Where the
  machine without the effect is linear, this is what a long linear model leaves of the output. For
  nonlinearities, calendars and shifted clocks.
- BEYOND ORDER: of what is left of the output by the best linear system of the order that the model
  to start from has. For dead time and unmodelled dynamics, which a long linear model would explain.
- INTEGRAL: of what is left of the output by the same least squares as BEYOND LAGS; without the
  integrator another quantity is measured, so that there is no difference.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize
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
# Restarts of the search for poles, in multiples of the rates of the machine.
RATES = (1.0, 0.5)


def rms(x: Array) -> Array:
    """Root mean square (n_y,) of the rows of x (n, n_y)."""
    return np.asarray(np.sqrt(np.mean(np.square(x), axis=0)))


def number_of_lags(rig: Rig) -> int:
    """Lags of the long linear model."""
    return int(min(np.ceil(LAGS * rig.memory), rig.samples // SHARE))


def beyond_lags(rig: Rig, u: Array, change: Array) -> Array:
    """What is left (n, n_y) of a change by least squares on lags of the inputs u (total, n_u)."""
    lags = number_of_lags(rig)
    rows = LEAD + np.arange(rig.samples)[:, None] - np.arange(lags + 1)
    columns = np.column_stack([np.ones(rig.samples), u[rows].reshape(rig.samples, -1)])
    weights = np.linalg.lstsq(columns, change, rcond=1e-10)[0]
    return np.asarray(change - columns @ weights)


def beyond_order(rig: Rig, u: Array, y: Array, order: int) -> Array:
    """Output (n,) of the best linear system of an order, with feedthrough and a constant.

    Least squares over the poles, for each of which the zeros follow by linear least squares.

    Args:
        rig: the machine. u: (total, 1) input. y: (n,) output. order: of the system, even.
    """
    x, window = u[:, 0] - u[:, 0].mean(), slice(LEAD, None)
    count = order // 2

    def fitted(points: Array) -> Array:
        denominator = np.ones(1)
        # Pairs of poles within the unit circle: 1 - (1 + q) p z^-1 + q z^-2, with q in (0, 1).
        for a, b in points.reshape(count, 2):
            q, p = 0.999 / (1 + np.exp(-a)), 0.9995 * np.tanh(b)
            denominator = np.convolve(denominator, [1.0, -(1 + q) * p, q])
        base = lfilter([1.0], denominator, x)
        delayed = [np.concatenate([np.zeros(k), base[: len(base) - k]]) for k in range(order + 1)]
        columns = np.column_stack([np.ones(len(y)), *(z[window] for z in delayed)])
        columns /= np.sqrt(np.mean(np.square(columns), axis=0))
        return np.asarray(columns @ np.linalg.lstsq(columns, y, rcond=1e-12)[0])

    def loss(points: Array) -> float:
        return float(np.log(np.mean(np.square(y - fitted(points))) + 1e-14 * y.var()))

    starts = [_points(np.exp(rate * rig.system.rates * rig.step), count) for rate in RATES]
    options = {"maxfev": 120 * count, "xatol": 1e-3, "fatol": 1e-4}
    found = [minimize(loss, start, method="Nelder-Mead", options=options) for start in starts]
    return fitted(min(found, key=lambda f: float(f.fun)).x)


def _points(poles: np.ndarray, count: int) -> Array:
    """Parameters of pairs near the given poles, each of which stands for one pair."""
    chosen = sorted((p for p in poles if p.imag >= 0 and abs(p) < 0.9999), key=lambda p: -abs(p))
    chosen = (chosen * count)[:count]
    out = []
    for k, p in enumerate(chosen):
        q = float(np.clip(abs(p) ** 2 * (0.9 if p.imag == 0 else 1.0) ** (k + 1), 1e-3, 0.99))
        middle = float(np.clip(2 * p.real / (1 + q), -0.999, 0.999))
        out.append([np.log(q / (0.999 - q)), np.arctanh(middle / 0.9995)])
    return np.array(out).ravel()


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
