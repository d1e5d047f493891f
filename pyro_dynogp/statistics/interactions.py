r"""Responses that no linear time-invariant system has, for the test whether anything is left.

A smooth system departs from a linear one first by its response to products of inputs at two times
(the second-order kernel of its Volterra series), one that changes by responses whose size or shape
is another at another time. Each is looked for along the path that the model itself has: a product
u_i(t) u_j(t - d), or an input times a slow function of time, takes the place of an input.

Source: Schetzen, The Volterra and Wiener Theories of Nonlinear Systems (1980), ch. 3; Priestley,
Non-linear and Non-stationary Time Series Analysis (1988), ch. 3.
"""

from __future__ import annotations

import itertools

import numpy as np

from pyro_dynogp.data.signals import delayed
from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.responses import filtered, standardised
from pyro_dynogp.statistics.shares_of_inputs import looked_at, paths

# Delays between the factors of a product, from one step to a share of what is looked at, and to
# so many steps.
DELAYS, SHARE, LONGEST = 8, 0.15, 60
# Cycles of slow cosines and sines over what is looked at, each of so many samples at least.
COSINES, SINES, SLOW = tuple(0.5 * k for k in range(1, 9)), (1.0, 2.0, 3.0, 4.0), 75
# Inputs that are multiplied: those that do most.
INPUTS = 3


def interactions(residuals: Residuals) -> list[np.ndarray]:
    """Columns (n, K) of each variant: standardised, zero where a signal does not move.

    Args:
        residuals: of one output; inputs without gaps.

    Returns:
        For each product and each changing signal: as it is, through a first-order lag of the
        mean's own correlation time, and in the place of each of the (most effective) inputs.
    """
    r = residuals
    path = paths(r) if r.inputs.shape[1] else None
    shares = np.zeros(0) if path is None else path.shares.std(axis=0)
    leading = np.argsort(-shares, kind="stable")[:INPUTS]
    inputs = [u for u in standardised(r.inputs[:, np.sort(leading)]).T if u.any()]
    lag = _correlation_time(r.mean) * r.step

    def block(signal: np.ndarray) -> np.ndarray:
        column = signal[:, None]
        slow = filtered(column, r.step, r.time, np.array([-1.0 / lag]), lags=0)[:, 0]
        ways = [] if path is None else [path(int(j), column) for j in leading[:2]]
        return standardised(np.column_stack([slow, *ways]))

    moving = [*inputs, *standardised(r.mean[:, None]).T]
    return [block(signal) for signal in _products(inputs, r) + _changing(moving, r)]


def _products(inputs: list[np.ndarray], r: Residuals) -> list[np.ndarray]:
    """Of two inputs, or of one at two times; squares are no part of it."""
    longest = np.clip(SHARE * looked_at(r), 2, LONGEST)
    steps = np.unique(np.round(np.geomspace(1, longest, DELAYS)).astype(int))
    both = [a * b for a, b in itertools.combinations(inputs, 2)]
    past = [delayed(b, r.time, d * r.step) for b in inputs for d in steps]
    return both + [a * b for a, b in itertools.product(inputs, past)]


def _changing(signals: list[np.ndarray], r: Residuals) -> list[np.ndarray]:
    """Signals times slow waves over the stretch that is looked at."""
    looked = r.time[r.held_out]
    s = np.clip((r.time - looked[0]) / (looked[-1] - looked[0]), 0.0, 1.0)
    most = max(looked_at(r) / SLOW, 0.5)
    waves = [np.cos(2.0 * np.pi * k * s) for k in COSINES if k <= most]
    waves += [np.sin(2.0 * np.pi * k * s) for k in SINES if k <= most]
    return [signal * wave for signal in signals if signal.any() for wave in waves]


def _correlation_time(mean: np.ndarray) -> int:
    """Steps until the autocorrelation of a signal (n,) falls below one half, at least one."""
    x = mean - mean.mean()
    n = len(x)
    power = np.abs(np.fft.rfft(x, 2 * n)) ** 2
    correlation = np.fft.irfft(power)[:n]
    below = np.flatnonzero(correlation < 0.5 * correlation[0])
    return max(int(below[0]) if len(below) else 1, 1)
