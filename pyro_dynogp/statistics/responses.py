r"""What linear dynamics may do with a signal: a bank of filters.

Filters of a signal u that is held from each sample to the next, started at rest at its mean:

    x_(k+1) = exp(\lambda d_k) x_k + (exp(\lambda d_k) - 1) / \lambda u_k,    d_k = t_(k+1) - t_k,

which is exact at any step. Real rates \lambda = -1 / \tau with time constants \tau spaced evenly
on a logarithmic scale span smooth responses of unknown poles (Laguerre and Kautz bases do the same
with one pole: Wahlberg, IEEE Trans. Automatic Control 36(5):551, 1991).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pyro_dynogp.data.signals import delayed, held
from pyro_dynogp.support.compiled import OPTIONS
from pyro_dynogp.support.errors import invalid


@njit(**OPTIONS)
def _states(u: np.ndarray, steps: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """States (n, c, P), complex, of each rate for each signal (n, c)."""
    n, c = u.shape
    P = len(rates)
    x = np.zeros((n, c, P), dtype=np.complex128)
    phi = np.empty(P, dtype=np.complex128)
    last = -1.0
    for i in range(1, n):
        if steps[i - 1] != last:
            last = steps[i - 1]
            for p in range(P):
                phi[p] = np.exp(rates[p] * last)
        for j in range(c):
            for p in range(P):
                # The gain at rest is one for a real rate: |lambda| scales.
                gamma = (phi[p] - 1.0) / rates[p] * np.abs(rates[p])
                x[i, j, p] = phi[p] * x[i - 1, j, p] + gamma * u[i - 1, j]
    return x


def time_constants(step: float, time: np.ndarray, count: int) -> np.ndarray:
    """From one step to a fifth of the record, evenly on a logarithmic scale, (count,) [time]."""
    longest = max((time[-1] - time[0]) / 5.0, 2.0 * step)
    return np.geomspace(step, longest, count)


def filtered(
    signals: np.ndarray, step: float, time: np.ndarray, rates: np.ndarray, lags: int = 1
) -> np.ndarray:
    """Signals (n, c) through each filter, (n, c, K): as is, later by steps, then one per rate.

    A complex rate gives two columns, the real and the imaginary part of its state; K = 1 + lags +
    real rates + 2 complex rates. Units are those of the signal; a constant comes out as zero.

    Args:
        signals: (n, c); missing values are held. step: [time unit]. time: (n,) [time unit].
        rates: (P,) real or complex, with negative real parts [1 / time unit].
        lags: 1, 2, ... steps.

    Raises:
        ValueError: where a rate does not decay, or times do not increase.
    """
    rates = np.asarray(rates, dtype=complex)
    if not (rates.real < 0).all():
        raise invalid("rates", expected="negative real parts", got=f"{rates.real.max():.3g}")
    u = np.asarray(signals, dtype=float)
    u = np.column_stack([held(s) for s in u.T]) if u.shape[1] else u
    u = u - u.mean(0)
    later = [np.column_stack([delayed(s, time, k * step) for s in u.T]) for k in range(1, lags + 1)]
    # Rounding makes every step of a regular record another one: one propagator serves them all.
    steps = step * np.round(np.diff(time) / step, 6)
    x = _states(u, steps, rates)
    turning = rates.imag != 0
    parts = [x[:, :, ~turning].real, x[:, :, turning].real, x[:, :, turning].imag]
    return np.concatenate([np.stack([u, *later], axis=2), *parts], axis=2)


def standardised(columns: np.ndarray) -> np.ndarray:
    """Columns (n, m) with mean zero and standard deviation one; a constant one becomes zero."""
    columns = columns - columns.mean(0)
    sd = columns.std(0)
    return columns / np.where(sd > 0, sd, 1.0)


def responses(
    signals: np.ndarray, step: float, time: np.ndarray, *, constants: int = 6, lags: int = 1
) -> np.ndarray:
    """What linear dynamics of unknown poles may make of signals.

    Args:
        signals: (n, c) [any units], held from each sample to the next; missing ones too.
        step: sampling step [time unit]. time: (n,) increasing [time unit].
        constants: number of time constants, from one step to a fifth of the record.
        lags: number of steps by which the signal itself may come later.

    Returns:
        (n, c * K) with K = 1 + lags + constants, signal by signal: direct path, lags, first-order
        responses; all causal, each with mean zero and standard deviation one.

    Raises:
        ValueError: where times do not increase, or there are no two samples.
    """
    signals = np.asarray(signals, dtype=float)
    signals = signals[:, None] if signals.ndim == 1 else signals
    if not signals.shape[1]:
        return np.zeros((len(signals), 0))
    rates = -1.0 / time_constants(step, time, constants)
    columns = filtered(signals, step, time, rates, lags)
    return standardised(columns.reshape(len(signals), -1))
