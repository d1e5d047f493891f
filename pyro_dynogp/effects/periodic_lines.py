"""Sines in a residual: their gains by Fourier transforms, refinement, harmonics."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.fft import fft, rfft
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from pyro_dynogp.statistics.autoregression import Whitener
from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.prewhitening import (
    Projection,
    Score,
    Scored,
    Variants,
    log_ratio,
    spanning,
)
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.support.errors import invalid

HARMONICS = 4


def slots(r: Residuals) -> np.ndarray:
    """Number of each sample (n,) on the clock of equal steps."""
    exact = (r.time - r.time[0]) / r.step
    at = np.round(exact).astype(int)
    if np.abs(exact - at).max() > 0.1 or (np.diff(at) < 1).any():
        raise invalid(
            "residuals",
            expected="equal steps, or multiples of one step",
            got="irregular ones",
            advice="Resample the record; missing samples may be NaN.",
        )
    return at


@dataclass(frozen=True, eq=False)
class _Beside:
    """What stands beside a line under filters of one order, the same for every series.

    Attributes:
        rows: (m,) samples that have all of their past. Q: (m, M) orthonormal basis of the nuisance.
        products: (3, J) of cosine and cosine, sine and sine, cosine and sine at each frequency,
            less what the nuisance explains of them.
    """

    rows: np.ndarray
    Q: np.ndarray
    products: np.ndarray


def lines(
    bins: np.ndarray,
    length: int,
    nuisance: np.ndarray,
    missing: np.ndarray,
    settings: LoopSettings,
) -> Variants:
    """Sines at frequencies bins / length [1 / step]: all by one Fourier transform.

    A filter makes of a sine a sine of the same frequency, so both span the same, and the
    residual's own past stands beside it as more columns of nuisance.

    Args:
        bins: (J,). nuisance: (n, M) from `spanning`. missing: (n,). settings: thresholds.
    """
    n = len(missing)

    def parts(rows: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sums of columns (m, K) times cosines and times sines, each (K, J)."""
        full = np.zeros((values.shape[1], n))
        full[:, rows] = values.T
        F = rfft(full, length, axis=1)[:, bins]
        return F.real, -F.imag

    def products(C: np.ndarray, S: np.ndarray) -> np.ndarray:
        """Of cosines and sines, as far as orthonormal columns with these sums explain them."""
        return np.array([np.square(C).sum(0), np.square(S).sum(0), (C * S).sum(0)])

    @cache
    def beside_order(p: int) -> _Beside:
        rows = Projection(Whitener(np.zeros(p)), nuisance, missing, settings).samples
        mask = np.zeros(n)
        mask[rows] = 1.0
        double = fft(mask, length)[(2 * bins) % length]
        every = 0.5 * np.array([len(rows) + double.real, len(rows) - double.real, -double.imag])
        Q = spanning(nuisance[rows])
        return _Beside(rows, Q, every - products(*parts(rows, Q)))

    def prepare(under: Projection) -> Score:
        p = under.whiten.order
        beside = beside_order(p)
        rows, Q = beside.rows, beside.Q

        def score(x: np.ndarray) -> Scored:
            past = np.column_stack([x[rows], *(x[rows - k] for k in range(1, p + 1))])
            left = past - Q @ (Q.T @ past)
            e, P = left[:, 0], np.linalg.qr(left[:, 1:])[0]
            e = e - P @ (P.T @ e)
            C, S = parts(rows, np.column_stack([e, P]))
            c, s = C[0], S[0]
            cc, ss, cs = beside.products - products(C[1:], S[1:])
            determinant = cc * ss - cs**2
            usable = determinant > 1e-6 * len(rows) ** 2
            explained = (ss * c**2 - 2.0 * cs * c * s + cc * s**2) / np.where(
                usable, determinant, 1.0
            )
            samples = len(e) - Q.shape[1] - p
            gains = samples * log_ratio(np.where(usable, explained, 0.0), float(e @ e))

            def fit(j: int) -> tuple[np.ndarray, np.ndarray]:
                line, beside_line = _wave(n, bins[j] / length), under
                if p:  # else there is no colour beside the line either
                    design = np.column_stack([past[:, 1:], line[rows], nuisance[rows]])
                    noise = Whitener(np.linalg.lstsq(design, past[:, 0], rcond=1e-9)[0][:p])
                    beside_line = Projection(noise, nuisance, missing, settings)
                return beside_line.with_nuisance(beside_line.fit(line, x), x)

            return gains, fit

        return score

    return Variants(prepare, np.full(len(bins), 2.0), joint=True)


def _sine(n: int, frequency: float) -> np.ndarray:
    """Cosine and sine (n, 2) of a frequency [1 / step]."""
    angle = 2.0 * np.pi * frequency * np.arange(n)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _wave(n: int, frequency: float) -> np.ndarray:
    """Sines of a frequency and its harmonics, and how they change with it (n, K).

    Of a strong line what a grid of frequencies misses, and what its harmonics are, would still look
    like colour, which a filter of high order explains.
    """
    shift = np.linspace(-1.0, 1.0, n)[:, None]
    # At half the sampling rate a sine is nothing, and next to it is nearly what a cosine becomes.
    inside = [h * frequency for h in range(1, HARMONICS + 1) if h * frequency < 0.5 - 2.0 / n]
    waves = [_sine(n, f) for f in inside] or [_sine(n, frequency)]
    return np.column_stack([*waves, *(shift * wave for wave in waves if inside)])


def refined(under: Projection, x: np.ndarray, frequency: float, width: float) -> float:
    """Frequency of largest gain within `width` of one on the grid [1 / step]."""
    e = under(x)

    def left(f: float) -> float:
        w = under(_sine(len(x), f))
        return -float(e @ w @ np.linalg.lstsq(w, e, rcond=1e-9)[0])

    bounds = (max(frequency - width, 0.1 / len(x)), min(frequency + width, 0.5))
    return float(minimize_scalar(left, bounds=bounds, method="bounded").x)


def harmonics(
    under: Projection, x: np.ndarray, frequency: float, level: float
) -> tuple[np.ndarray, list[int]]:
    """The sine with those harmonics that the data are certain of (n,), and which they are."""
    columns, also, n = _sine(len(x), frequency), list[int](), len(x)
    e = under(x)

    def total(columns: np.ndarray) -> float:
        w = under(columns)
        return float(np.square(e - w @ np.linalg.lstsq(w, e, rcond=1e-9)[0]).sum())

    last = total(columns)
    for h in range(2, HARMONICS + 1):
        if h * frequency >= 0.5:
            break
        more = np.column_stack([columns, _sine(n, h * frequency)])
        left = total(more)
        gain = len(e) * np.log(max(last, 1e-300) / max(left, 1e-300))
        if chi2.sf(gain, 2) < level / (HARMONICS - 1):
            columns, last = more, left
            also.append(h)
    effect = under.fit(columns, x)
    return effect - effect.mean(), also
