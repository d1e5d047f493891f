"""A library of regressors of a residual, and the group of them that a LASSO takes.

The library has no frequencies of its own: beside signals and functions of them it has a line,
steps, and the periods of the calendar.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numba
import numpy as np
import pandas as pd
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Name of an effect, and the channel that it comes from where there is one.
Group = tuple[str, str | None]
Said = tuple[Group, ...]
# Lags of signals in the library, and of functions of them; steps on a grid of as many parts.
LINEAR, CURVED, STEPS = 10, 3, 40
PENALTIES, LEAST_PENALTY = 40, 0.03
FORMS: Mapping[str, Callable[[Array], Array]] = {
    "square": np.square, "cube": lambda x: x**3, "absolute": np.abs, "sign": np.sign
}  # fmt: skip
DAY = 86_400.0
# Period [s] and its harmonics; a Monday that all of them are counted from.
CALENDAR = ((DAY, 4), (7.0 * DAY, 3), (365.25 * DAY, 2))
MONDAY = pd.Timestamp("2000-01-03")


@dataclass(frozen=True, eq=False)
class Library:
    """Regressors (n, p), the group of each, and which rows of the record they are."""

    columns: Array
    groups: tuple[Group, ...]
    first: int


def library(
    inputs: Array,
    simulated: Array,
    extra: Mapping[str, Array],
    stamps: pd.DatetimeIndex | None = None,
) -> Library:
    """Regressors of a record without its first samples, of which not all lags are there.

    Args:
        inputs: (n, n_u). simulated: (n,) output by the model. extra: channels (n,).
        stamps: for sines of the calendar; without them there are none.
    """
    n = len(inputs)
    found: list[tuple[Group, Array]] = []

    def lagged(group: str, x: Array, lags: range, channel: str | None = None) -> None:
        found.extend(((group, channel), np.roll(x, k)) for k in lags)

    for u in _standardised(inputs).T:
        lagged("unmodelled dynamics", u, range(LINEAR + 1))
        for form in FORMS.values():
            lagged("input nonlinearity", form(u), range(CURVED + 1))
    y = _standardised(simulated[:, None])[:, 0]
    lagged("unmodelled dynamics", y, range(LINEAR + 1))
    for form in FORMS.values():
        lagged("output nonlinearity", form(y), range(1))
        lagged("nonlinear feedback", form(y), range(1, CURVED + 1))
    for name, x in extra.items():
        known = np.asarray(pd.Series(x).ffill().bfill().fillna(0.0), dtype=np.float64)
        lagged("extra input", known, range(LINEAR + 1), name)
    count = np.arange(n, dtype=float)
    found.append((("drift", None), count))
    for part in range(1, STEPS):
        found.append((("level shift", None), (count >= part * n / STEPS).astype(float)))
    if stamps is not None:
        local = pd.DatetimeIndex(stamps.tz_localize(None))
        seconds = ((local - MONDAY) / pd.Timedelta(seconds=1)).to_numpy()
        for period, harmonics in CALENDAR:
            for k in range(1, harmonics + 1):
                angle = 2.0 * np.pi * k * seconds / period
                found += [(("calendar", None), np.sin(angle)), (("calendar", None), np.cos(angle))]
    columns = np.column_stack([x for _, x in found])[LINEAR:]
    return Library(columns, tuple(group for group, _ in found), LINEAR)


def _standardised(x: Array) -> Array:
    x = x - x.mean(0)
    sd = x.std(0)
    return x / np.where(sd > 0, sd, 1.0)


@numba.njit
def lasso_path(G: Array, c: Array, penalties: Array) -> Array:
    """Coefficients (len(penalties), p) by coordinate descent.

    Args:
        G: (p, p) X'X / n of standardised columns. c: (p,) X'y / n. penalties: falling.
    """
    b, Gb = np.zeros(len(c)), np.zeros(len(c))
    path = np.zeros((len(penalties), len(c)))
    for k, penalty in enumerate(penalties):
        for _ in range(10_000):
            largest = 0.0
            for j in range(len(c)):
                rho = c[j] - Gb[j] + G[j, j] * b[j]
                new = np.sign(rho) * max(abs(rho) - penalty, 0.0) / G[j, j]
                change = new - b[j]
                if change != 0.0:
                    Gb += change * G[j]
                    b[j] = new
                    largest = max(largest, abs(change))
            if largest < 1e-6 * penalties[0]:
                break
        path[k] = b
    return path


def lasso(X: Array, y: Array) -> Array:
    """Coefficients (p,) on standardised columns of the subset that the LASSO and a BIC choose.

    Subsets along the path are fitted by least squares, and the one with the least extended BIC is
    taken (Chen & Chen, Biometrika 95(3):759, 2008, with gamma 1): the plain BIC, made for a few
    regressors, takes one of a hundred by chance in most records.
    """
    n, y = len(y), y - y.mean()
    varying = np.flatnonzero(X.std(0) > 1e-9 * (1.0 + np.abs(X).max(0)))
    S = _standardised(X[:, varying])
    G, c, power = S.T @ S / n, S.T @ y / n, float(y @ y) / n
    out = np.zeros(X.shape[1])
    largest = float(np.abs(c).max())
    if power <= 0.0 or largest <= 0.0:
        return out
    penalties = largest * np.geomspace(1.0, LEAST_PENALTY, PENALTIES)
    best, chosen = n * math.log(power), np.zeros(len(c))
    for b in lasso_path(G, c, penalties):
        active = np.flatnonzero(b)
        k = len(active)
        if not 0 < k <= n // 5:
            continue
        fitted = np.linalg.lstsq(S[:, active], y, rcond=None)[0]
        error = y - S[:, active] @ fitted
        subsets = math.lgamma(len(c) + 1) - math.lgamma(k + 1) - math.lgamma(len(c) - k + 1)
        bic = n * math.log(max(float(error @ error) / n, 1e-300)) + k * math.log(n) + 2.0 * subsets
        if bic < best:
            best, chosen = bic, np.zeros(len(c))
            chosen[active] = fitted
    out[varying] = chosen
    return out


def largest_group(found: Library, e: Array) -> Said:
    """The group that explains most of a residual (n,) of the record; none where none is chosen."""
    y = e[found.first :]
    known = np.isfinite(y)
    X, y = found.columns[known], y[known]
    b = lasso(X, y)
    if not b.any():
        return ()
    S, y = _standardised(X), y - y.mean()
    shares: dict[Group, float] = {}
    for j in np.flatnonzero(b):
        group = found.groups[j]
        shares[group] = shares.get(group, 0.0) + float(b[j] * (S[:, j] @ y) / (y @ y))
    return (max(shares, key=lambda group: shares[group]),)
