"""Serial structure of one-step errors: process noise, and inputs that follow the output."""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from pyro_dynogp.data.signals import held
from pyro_dynogp.statistics.autoregression import fitted_filter
from pyro_dynogp.statistics.bootstrap import projector, spanning
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.scan import tail_probability
from pyro_dynogp.statistics.shares_of_inputs import own
from pyro_dynogp.support.errors import invalid

REPLICATES = 400
# Numbers of lags that are looked at together; no more than a fifth of the samples.
WINDOWS = (1, 2, 4, 8, 16, 32)
# Of future inputs: a controller answers within as many samples.
AHEAD = (1, 2, 4, 8, 16)


def held_out_innovations(residuals: Residuals) -> np.ndarray:
    """Standardised one-step errors (n,) where held out, NaN elsewhere.

    Raises:
        ValueError: where fewer than 30 are known.
    """
    v = np.where(residuals.held_out, residuals.innovations, np.nan)
    v = np.where(np.isfinite(v), v, np.nan)
    count = int(np.isfinite(v).sum())
    if count < 30:
        raise invalid("residuals", expected="at least 30 held-out innovations", got=str(count))
    return v


def one_step_sd(residuals: Residuals) -> float:
    """Standard deviation of what an autoregression leaves of the residual [output]."""
    x = residuals.residual
    return float(np.nanstd(fitted_filter(x)(x)))


def autocorrelation(x: np.ndarray, lags: int) -> tuple[np.ndarray, np.ndarray]:
    """Of series (R, n) with the same missing samples: (R, lags) for lags 1, 2, ..., and pairs.

    The mean is removed; pairs (lags,) is the number of pairs that both are there.
    """
    there = np.isfinite(x[0])
    y = np.where(there, x - np.nanmean(x, axis=1, keepdims=True), 0.0)
    length = next_fast_len(x.shape[1] + lags, real=True)
    products = irfft(np.abs(rfft(y, length)) ** 2, length)[:, : lags + 1]
    pairs = np.round(irfft(np.abs(rfft(there.astype(float), length)) ** 2, length))[: lags + 1]
    variance = np.maximum(products[:, :1] / pairs[0], 1e-300)
    return (products[:, 1:] / np.maximum(pairs[1:], 1.0)) / variance, pairs[1:]


def portmanteau(
    x: np.ndarray, seed: int, signs: bool = False
) -> tuple[float, float, int, np.ndarray]:
    """Test whether a series (n,), NaN where missing, has any autocorrelation.

    Args:
        x: the series. seed: of the null.
        signs: null by random signs in place of random order: the sizes stay where they are, so
            that noise whose size changes does not look autocorrelated.

    Returns:
        Largest standardised sum of squared autocorrelations over the windows of lags, its p-value,
        the window, and the autocorrelations (lags,) up to the last.

    Source: Ljung & Box, Biometrika 65(2):297 (1978), largest over windows; random signs: Wu, Annals
    of Statistics 14(4):1261 (1986).
    """
    known = np.flatnonzero(np.isfinite(x))
    windows = np.array([m for m in WINDOWS if m <= max(len(known) // 5, 1)])
    generator = np.random.default_rng(seed)

    def largest(series: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        r, pairs = autocorrelation(series, int(windows[-1]))
        sums = np.cumsum(pairs * r**2, axis=1)[:, windows - 1]
        z = (sums - windows) / np.sqrt(2.0 * windows)
        return z.max(1), z.argmax(1), r

    null = []
    centred = x - np.nanmean(x)
    # In batches: memory grows with the record.
    for _ in range(8):
        shuffled = np.full((REPLICATES // 8, len(x)), np.nan)
        if signs:
            shuffled[:, known] = generator.choice([-1.0, 1.0], (len(shuffled), len(known)))
            shuffled *= centred
        else:
            order = generator.permuted(np.tile(known, (len(shuffled), 1)), axis=1)
            shuffled[:, known] = x[order]
        null.append(largest(shuffled)[0])
    z, best, r = largest(x[None])
    p_value = tail_probability(np.concatenate(null), float(z[0]))
    return float(z[0]), p_value, int(windows[best[0]]), r[0]


def process_noise(residuals: Residuals, *, seed: int = 0) -> Evidence:
    """Disturbances that pass through dynamics: autocorrelated held-out one-step errors.

    Their null keeps their sizes in place, so that heteroscedastic noise does not look coloured.

    Args:
        residuals: of one output (n,). seed: of the random signs.

    Returns:
        where: time_constant of an autocorrelation c exp(-lag / time_constant) [time unit], zero
        where neighbours differ in sign. size: what the past tells of the one-step error [output].

    Raises:
        ValueError: where fewer than 30 held-out samples are measured.

    Source: `portmanteau`.
    """
    r = residuals
    v = held_out_innovations(r)
    statistic, p_value, window, rho = portmanteau(v, seed, signs=True)
    gain = 0.5 * float(np.isfinite(v).sum()) * float(np.square(rho[:window]).sum())
    decay, amplitude = _decay(rho)
    constant = -r.step / np.log(decay) if decay > 0 else 0.0
    whiten = fitted_filter(v)
    left = float(np.nanvar(whiten(v)) / max(np.nanvar(v), 1e-300))
    known = f"; their autocorrelation decays with a time constant of {constant:.3g} {r.time_unit}"
    lags = np.arange(1, len(rho) + 1)
    return Evidence(
        effect="process noise",
        statistic=statistic,
        p_value=p_value,
        gain=gain,
        size=one_step_sd(r) * float(np.sqrt(max(1.0 - left, 0.0))),
        where={"time_constant": float(constant)},
        sentence=f"One-step errors of {r.output_name!r} depend on earlier ones ({rho[0]:.2f} with "
        f"the one before){known if decay > 0 else ''}.",
        curve=Curve(
            x=lags * r.step,
            y=rho,
            fitted=amplitude * decay**lags,
            x_label=f"lag [{r.time_unit}]",
            y_label=f"autocorrelation of one-step errors of {r.output_name}",
        ),
    )


def _decay(rho: np.ndarray) -> tuple[float, float]:
    """Decay per step and amplitude of amplitude * decay^lag, least squares; zeros: none."""
    grid = np.linspace(0.01, 0.995, 198)
    shapes = grid[:, None] ** np.arange(1, len(rho) + 1)
    norm = np.square(shapes).sum(1)
    amplitude = shapes @ rho / norm
    gain = np.where(amplitude > 0, amplitude**2 * norm, 0.0)
    best = int(np.argmax(gain))
    return (float(grid[best]), float(amplitude[best])) if gain[best] > 0 else (0.0, 0.0)


def feedback(residuals: Residuals, *, seed: int = 0) -> list[Evidence]:
    """Inputs that follow the output: held-out residuals that foretell an input.

    The whitened residual, less what past inputs explain, against the next values of each input,
    less what its own past foretells; no causal effect of the input on the output does that. What
    they share at the same instant may be a direct path and does not count: a controller that
    answers within the sample is seen only as far as it goes on answering.

    Args:
        residuals: of one output (n,). seed: of the permutations.

    Returns:
        One for each input that varies. where: channel. size: part of the one-step error that the
        input repeats [output]. gain is of the input's future in the residual [nats].

    Raises:
        ValueError: where fewer than 30 held-out samples are measured.

    Source: cross-correlation at negative lags (Ljung, System Identification, 2nd ed., 16.6), both
    sides whitened (Haugh, JASA 71(354):378, 1976); largest over windows, null by permutation.
    """
    r = residuals
    x = np.where(r.held_out, r.residual, np.nan)
    whiten = fitted_filter(x)
    found = []
    for name, u in zip(r.input_names, r.inputs.T, strict=True):
        if np.std(held(u)) > 0:
            found.append(_followed(r, x, whiten, name, held(u), seed))
    return found


def _followed(r, x, whiten, name: str, u: np.ndarray, seed: int) -> Evidence:
    foretell = fitted_filter(u)
    n, K = len(u), AHEAD[-1]
    surprise = np.full(n, np.nan)
    surprise[foretell.order :] = foretell(u - u.mean())
    future = np.column_stack([np.append(surprise[k:], np.full(k, np.nan)) for k in range(1, K + 1)])
    missing = ~(np.isfinite(x) & np.isfinite(future).all(1))
    there, Q0, _ = projector(whiten, spanning(own(r)), missing)
    e = whiten(x)[there]
    F = future[whiten.order :][there]
    size = np.sqrt(np.square(F).sum(0))
    F = F / np.where(size > 0, size, 1.0)
    F = F - Q0 @ (Q0.T @ F)
    # Orthogonal in the order of the lags, so that sums over the first ones are those windows.
    Q, R = np.linalg.qr(F)
    Q = Q * (np.abs(np.diag(R)) > 1e-6)
    e0 = e - Q0 @ (Q0.T @ e)
    variance = max(float(e0 @ e0) / max(len(e) - Q0.shape[1], 1), 1e-300)
    generator = np.random.default_rng(seed)
    shuffled = np.stack([generator.permutation(e) for _ in range(REPLICATES)])
    if len(r.deviations):
        left = whiten(r.deviations.T)[there].T
        shuffled = shuffled + left[generator.integers(len(left), size=REPLICATES)]
    shuffled = shuffled - (shuffled @ Q0) @ Q0.T
    windows = np.array(AHEAD)

    def standardised(b: np.ndarray) -> np.ndarray:
        sums = np.cumsum(b**2, axis=-1)[..., windows - 1] / variance
        return (sums - windows) / np.sqrt(2.0 * windows)

    own_b = e0 @ Q
    z = standardised(own_b)
    null = standardised(shuffled @ Q).max(1)
    best = int(np.argmax(z))
    share = float(np.square(own_b[: windows[best]]).sum() / max(e0 @ e0, 1e-300))
    lags = np.arange(1, K + 1)
    correlation = (F.T @ e0) / np.maximum(np.sqrt(np.square(F).sum(0) * (e0 @ e0)), 1e-300)
    soonest = float(lags[int(np.argmax(np.abs(correlation[: windows[best]])))]) * r.step
    return Evidence(
        effect="feedback",
        statistic=float(z[best]),
        p_value=tail_probability(null, float(z[best])),
        gain=-0.5 * len(e) * float(np.log1p(-min(share, 1.0 - 1e-9))),
        size=float(np.sqrt(variance * share)),
        where={"channel": name},
        sentence=f"Input {name!r} follows the disturbances of {r.output_name!r}, most after "
        f"{soonest:.3g} {r.time_unit}: it is under feedback.",
        curve=Curve(
            x=lags * r.step,
            y=correlation,
            fitted=np.full(K, np.nan),
            x_label=f"time by which the input comes later [{r.time_unit}]",
            y_label=f"correlation of residual and {name}",
        ),
    )
