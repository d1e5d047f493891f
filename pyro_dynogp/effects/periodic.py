"""A sine of unknown period in the residual: a disturbance that no input explains."""

from __future__ import annotations

import numpy as np
from scipy.fft import fft, next_fast_len, rfft
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from pyro_dynogp.statistics.bootstrap import (
    Prepare,
    Score,
    explained_by,
    log_ratio,
    projector,
    replicates,
    sieve,
    spanning,
)
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.shares_of_inputs import own
from pyro_dynogp.statistics.time_pictures import size_in_words
from pyro_dynogp.statistics.whitening import Whitener
from pyro_dynogp.support.errors import invalid

# A period is at least this often in what is looked at; slower is drift. Grid of frequencies: so
# many for each 1 / duration.
CYCLES, OVERSAMPLING = 3.0, 4
HARMONICS = 4


def periodic_disturbance(residuals: Residuals, *, seed: int = 0) -> Evidence:
    """A sine of any period in the residual, beside what the inputs explain; all samples.

    Lines need length: what was fitted to is looked at, too. A fit can take part of a line up, not
    make one.

    Frequencies from three cycles in what is looked at to half the sampling rate, four for each
    1 / duration; the best is refined between its neighbours. Periods that fit the harmonics 2 to 4
    of it are named in the sentence.

    Args:
        residuals: of one output (n,), steps equal or multiples of one step.
        seed: of the replicates.

    Returns:
        where: period [time unit].

    Raises:
        ValueError: where fewer than 30 samples are measured, or steps are irregular.

    Source: harmonic F test, Thomson, Proc. IEEE 70(9):1055 (1982), with one taper, in the whitened
    residual; the largest over frequencies as in Fisher, Proc. R. Soc. A 125:54 (1929).
    """
    r = residuals
    at = _slots(r)
    n = int(at[-1]) + 1
    x = np.full(n, np.nan)
    x[at] = r.residual
    looked = np.flatnonzero(np.isfinite(x))
    span = int(looked[-1] - looked[0]) + 1 if len(looked) else 0
    if len(looked) < 30:
        raise invalid("residuals", expected="at least 30 measured samples", got=str(len(looked)))
    # Only what is looked at counts, so that the grid is no finer than it need be.
    x, kept = x[looked[0] : looked[-1] + 1], (at >= looked[0]) & (at <= looked[-1])
    beside = own(r)[kept]
    nuisance = np.zeros((span, beside.shape[1]))
    nuisance[at[kept] - looked[0]] = beside
    nuisance = spanning(nuisance)
    length = next_fast_len(OVERSAMPLING * span, real=True)
    bins = np.arange(int(np.ceil(CYCLES * length / span)), length // 2)
    lines = _lines(bins, length, nuisance, ~np.isfinite(x))
    deviations = np.zeros((len(r.deviations), span))
    deviations[:, at[kept] - looked[0]] = r.deviations[:, kept]
    found = sieve(
        x,
        lines,
        np.full(len(bins), 2.0),
        deviations=deviations,
        joint=True,
        replicates=replicates(span, 2 * nuisance.shape[1]),
        seed=seed,
    )
    frequency = _refined(found.whitener, x, nuisance, bins[found.best] / length, 1.0 / length)
    period = r.step / frequency
    effect, also = _harmonics(found.whitener, x, nuisance, frequency)
    size = float(np.sqrt(np.mean(effect**2)))
    more = f", with harmonics {', '.join(map(str, also))}" if also else ""
    return Evidence(
        effect="periodic disturbance",
        statistic=found.statistic,
        p_value=found.p_value,
        gain=found.gain,
        size=size,
        where={"period": period, "output": r.output_name, "time_unit": r.time_unit},
        sentence=f"A disturbance of {r.output_name!r} with a period of {period:.4g} {r.time_unit}"
        f"{more}: {size_in_words(r, size)}.",
        curve=_folded(r, x, effect, period),
    )


def _slots(r: Residuals) -> np.ndarray:
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


def _lines(bins: np.ndarray, length: int, nuisance: np.ndarray, missing: np.ndarray) -> Prepare:
    """Score of sines at frequencies bins / length [1 / step]: all by one Fourier transform.

    A filter makes of a sine a sine of the same frequency, so both span the same, and the
    residual's own past stands beside it as more columns of nuisance.
    """

    def prepare(whiten: Whitener) -> Score:
        p, n = whiten.order, len(missing)
        there = ~missing
        for k in range(1, p + 1):
            there[k:] &= ~missing[: n - k]
            there[:k] = False
        rows = np.flatnonzero(there)
        beside = spanning(nuisance[rows])
        mask = there.astype(float)
        double = fft(mask, length)[(2 * bins) % length]

        def parts(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            full = np.zeros((values.shape[1], n))
            full[:, rows] = values.T
            F = rfft(full, length, axis=1)[:, bins]
            return F.real, -F.imag

        def score(x: np.ndarray):
            past = [x[rows - k] for k in range(1, p + 1)]
            Q = np.linalg.qr(np.column_stack([beside, *past]))[0]
            e = x[rows] - Q @ (Q.T @ x[rows])
            C, S = parts(np.column_stack([e, Q]))
            c, s, C, S = C[0], S[0], C[1:], S[1:]
            cc = 0.5 * (len(rows) + double.real) - np.square(C).sum(0)
            ss = 0.5 * (len(rows) - double.real) - np.square(S).sum(0)
            cs = -0.5 * double.imag - (C * S).sum(0)
            determinant = cc * ss - cs**2
            usable = determinant > 1e-6 * len(rows) ** 2
            explained = (ss * c**2 - 2.0 * cs * c * s + cc * s**2) / np.where(
                usable, determinant, 1.0
            )
            samples = len(e) - Q.shape[1]
            gains = samples * log_ratio(np.where(usable, explained, 0.0), float(e @ e))

            def fit(j: int) -> tuple[np.ndarray, np.ndarray]:
                line = _wave(n, bins[j] / length)
                design = np.column_stack([*past, line[rows], nuisance[rows]])
                own_filter = Whitener(np.linalg.lstsq(design, x[rows], rcond=1e-9)[0][:p])
                return explained_by(own_filter, there[p:], line, nuisance, x)

            return gains, fit

        return score

    return prepare


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


def _refined(
    whiten: Whitener, x: np.ndarray, nuisance: np.ndarray, frequency: float, width: float
) -> float:
    """Frequency of largest gain within `width` of one on the grid [1 / step]."""
    there, Q, _ = projector(whiten, nuisance, ~np.isfinite(x))
    e = whiten(x)[there]
    e = e - Q @ (Q.T @ e)

    def left(f: float) -> float:
        w = whiten(_sine(len(x), f))[there]
        w = w - Q @ (Q.T @ w)
        return -float(e @ w @ np.linalg.lstsq(w, e, rcond=1e-9)[0])

    bounds = (max(frequency - width, 0.1 / len(x)), min(frequency + width, 0.5))
    return float(minimize_scalar(left, bounds=bounds, method="bounded").x)


def _harmonics(
    whiten: Whitener, x: np.ndarray, nuisance: np.ndarray, frequency: float
) -> tuple[np.ndarray, list[int]]:
    """The sine with those harmonics that explain more at 1 % (n,), and which they are."""
    there = np.isfinite(whiten(x))
    columns, also, n = _sine(len(x), frequency), list[int](), len(x)

    def total(columns: np.ndarray) -> float:
        joined = whiten(np.column_stack([columns, nuisance]))[there]
        e = whiten(x)[there]
        return float(np.square(e - joined @ np.linalg.lstsq(joined, e, rcond=1e-9)[0]).sum())

    known, last = int(there.sum()), total(columns)
    for h in range(2, HARMONICS + 1):
        if h * frequency >= 0.5:
            break
        more = np.column_stack([columns, _sine(n, h * frequency)])
        left = total(more)
        if chi2.sf(known * np.log(max(last, 1e-300) / max(left, 1e-300)), 2) < 0.01 / (
            HARMONICS - 1
        ):
            columns, last = more, left
            also.append(h)
    return explained_by(whiten, there, columns, nuisance, x)[0], also


def _folded(r: Residuals, x: np.ndarray, effect: np.ndarray, period: float) -> Curve:
    """Residual and effect over the phase, averaged in up to 24 bins."""
    phase = (np.arange(len(x)) * r.step) % period
    bins = np.minimum((phase / period * (B := int(np.clip(period / r.step, 4, 24)))), B - 1)
    bins = np.where(np.isfinite(x), bins, B).astype(int)
    count = np.bincount(bins, minlength=B + 1)[:B]
    shown, y = count > 0, np.nan_to_num(x - np.nanmean(x))

    def averaged(values: np.ndarray) -> np.ndarray:
        return (np.bincount(bins, values, minlength=B + 1)[:B] / np.maximum(count, 1))[shown]

    return Curve(
        x=averaged(phase),
        y=averaged(y),
        fitted=averaged(effect),
        x_label=f"time within the period [{r.time_unit}]",
        y_label=f"residual of {r.output_name} [{r.output_unit}]",
    )
