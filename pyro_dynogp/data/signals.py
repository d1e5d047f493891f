"""Pure functions of a signal: static shapes, backlash, delay. Arrays (n,) in and out."""

from __future__ import annotations

import numpy as np
from numba import njit

from pyro_dynogp.support.compiled import OPTIONS
from pyro_dynogp.support.errors import invalid


def held(signal: np.ndarray) -> np.ndarray:
    """A signal (n,) whose missing values are the last known one (before any: the first)."""
    signal = np.asarray(signal, dtype=float)
    known = np.flatnonzero(np.isfinite(signal))
    if not len(known):
        return np.zeros_like(signal)
    last = np.searchsorted(known, np.arange(len(signal)), side="right") - 1
    return signal[known[np.maximum(last, 0)]]


@njit(**OPTIONS)
def _play(u: np.ndarray, half: float) -> np.ndarray:
    z = np.empty_like(u)
    last = u[0]
    for i in range(len(u)):
        if u[i] - half > last:
            last = u[i] - half
        elif u[i] + half < last:
            last = u[i] + half
        z[i] = last
    return z


def play(u: np.ndarray, width: float) -> np.ndarray:
    """Backlash: z_t = min(max(z_(t-1), u_t - width/2), u_t + width/2), z in the middle at first.

    Args:
        u: (n,) [unit of u], at least one sample.
        width: full width of the play [unit of u].

    Raises:
        ValueError: where the width is negative.

    Source: Visintin, Differential Models of Hysteresis (1994), the play operator.
    """
    if width < 0:
        raise invalid("width", expected="zero or more", got=f"{width}")
    return np.asarray(_play(held(u), 0.5 * width))


def dead_zone(u: np.ndarray, low: float, high: float) -> np.ndarray:
    """Zero from `low` to `high`, beyond them the distance to the nearer one [unit of u].

    Raises:
        ValueError: where `low` is above `high`.
    """
    _ordered(low, high)
    return u - np.clip(u, low, high)


def clip(u: np.ndarray, low: float, high: float) -> np.ndarray:
    """The signal, no lower than `low` and no higher than `high` [unit of u].

    Raises:
        ValueError: where `low` is above `high`.
    """
    _ordered(low, high)
    return np.clip(u, low, high)


def _ordered(low: float, high: float) -> None:
    if low > high:
        raise invalid("low", expected=f"no more than high = {high}", got=f"{low}")


def scaled(u: np.ndarray) -> np.ndarray:
    """Less its median, over its interquartile range's standard deviation: units cancel.

    A signal that rests at one value more than half of the time is scaled by its standard deviation.
    """
    u = held(u)
    low, middle, high = np.quantile(u, [0.25, 0.5, 0.75])
    sd = float(u.std())
    scale = (high - low) / 1.349
    scale = scale if scale > 0.1 * sd else sd
    return (u - middle) / scale if scale > 0 else np.zeros_like(u)


def hermite(u: np.ndarray) -> np.ndarray:
    """Probabilists' Hermite polynomials He2 (even) and He3 (odd) of the scaled signal, (n, 2)."""
    x = scaled(u)
    return np.column_stack([x**2 - 1.0, x**3 - 3.0 * x])


def hinges(u: np.ndarray, knots: int = 5) -> np.ndarray:
    """Distance above each of K quantiles of the signal, zero below: (n, K) [unit of u].

    With the signal itself they span all piecewise linear functions with these knots.
    """
    u = held(u)
    at = np.quantile(u, np.arange(1, knots + 1) / (knots + 1))
    return np.maximum(u[:, None] - at, 0.0)


def delayed(u: np.ndarray, time: np.ndarray, delay: float) -> np.ndarray:
    """A held signal `delay` later: its mean from t_k - delay to t_(k+1) - delay.

    That is what a system sees on average from one sample to the next, exact at any fraction of a
    step and for irregular ones. Before the beginning the first value is held, after the end the
    last one; the last step is as long as the one before.

    Args:
        u: (n,), constant from each time to the next. time: (n,) increasing [time unit].
        delay: [time unit]; below zero it comes earlier.

    Raises:
        ValueError: where there are fewer than two samples, or times do not increase.
    """
    u = held(u)
    if len(time) < 2 or not (np.diff(time) > 0).all():
        raise invalid("time", expected="two or more increasing values", got=f"{len(time)} values")
    edges = np.append(time, 2.0 * time[-1] - time[-2]) - time[0]
    # Of what is above the first value: the integral of a large constant would cost digits.
    above = u - u[0]
    integral = np.concatenate([[0.0], np.cumsum(above * np.diff(edges))])
    shifted = edges - delay
    area = np.interp(shifted, edges, integral) + above[-1] * np.maximum(shifted - edges[-1], 0.0)
    return u[0] + np.diff(area) / np.diff(edges)


def shifted(signal: np.ndarray, time: np.ndarray, delay: float) -> np.ndarray:
    """A continuous signal (n,) `delay` later, linear between samples; the ends are held."""
    return np.interp(time - delay, time, held(signal))
