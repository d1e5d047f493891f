"""Is there any structure left at all? The question before any effect is named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from pyro_dynogp.data.signals import held, hermite
from pyro_dynogp.statistics.bootstrap import Scan, batches, tail_probability
from pyro_dynogp.statistics.detecting import looked
from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.interactions import interactions
from pyro_dynogp.statistics.prewhitening import free_columns, prewhitened, spanning
from pyro_dynogp.statistics.responses import responses, standardised
from pyro_dynogp.statistics.serial import held_out_innovations, portmanteau
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import input_columns, looked_at


def structure_left(
    residuals: Residuals,
    settings: LoopSettings,
    level: float,
    *,
    plain: Residuals | None = None,
    seed: int = 0,
) -> tuple[float, str]:
    """Test whether anything is left in a residual, in five ways.

    1. Held-out one-step errors depend on earlier ones; 2. so does their size; 3. their
    distribution is not normal; 4. the held-out residual follows linear responses of inputs or
    candidates, of their squares and cubes, or slow functions of time; 5. it follows products of
    inputs at two times, or responses that change with time (`interactions`). Each is calibrated by
    simulation or permutation; the smallest of the five p-values is paid for by Sidak's formula,
    which is exact where they are independent and safe where they go together.

    Args:
        residuals: of one output (n,). settings: thresholds.
        level: below which the sentence says that structure is left.
        plain: those that the fifth way looks at, by default the same: process noise takes up what
            it looks for, so a loop gives those of the model without, and gives it what the model
            was fitted to as well. There a residual is smaller than the noise, never larger by more
            than chance, which makes a test safe.
        seed: of the simulated nulls.

    Returns:
        Probability of as much structure where there is none, and a sentence.

    Raises:
        ValueError: where too few held-out samples are measured.

    Source: 1: Ljung & Box, Biometrika 65(2):297 (1978); 2: McLeod & Li, J. Time Series Analysis
    4(4):269 (1983); 3: Anderson & Darling, JASA 49(268):765 (1954); Sidak, JASA 62(318):626 (1967).
    """
    r = residuals
    v = held_out_innovations(r, settings)
    ways = {
        "one-step errors depend on earlier ones": portmanteau(v, settings, seed, signs=True)[1],
        "the size of one-step errors depends on that of earlier ones": portmanteau(
            np.abs(v - np.nanmean(v)), settings, seed + 1
        )[1],
        "one-step errors are not normal": _not_normal(v[np.isfinite(v)], settings, seed),
        "the residual follows inputs, other channels or time": _follows(r, settings, seed),
        "the residual follows products of inputs at two times, or a response that changes": (
            beyond_catalogue(r if plain is None else plain, settings, seed).p_value
        ),
    }
    smallest = min(ways.values())
    p_value = float(-np.expm1(len(ways) * np.log1p(-min(smallest, 1.0 - 1e-12))))
    if p_value >= level:
        return p_value, f"No structure is left in {r.output_name!r} (p = {p_value:.2g})."
    seen = [way for way, p in ways.items() if len(ways) * p < level]
    seen = seen or [min(ways, key=lambda way: ways[way])]
    return (
        p_value,
        f"Structure is left in {r.output_name!r} (p = {p_value:.2g}): {'; '.join(seen)}.",
    )


def _not_normal(v: np.ndarray, settings: LoopSettings, seed: int) -> float:
    """Probability of as large an Anderson-Darling statistic, mean and variance estimated."""

    def drawn(generator: np.random.Generator, size: int) -> np.ndarray:
        return _anderson_darling(generator.standard_normal((size, len(v))))

    null = np.concatenate(list(batches(drawn, settings.replicates, [seed, 2])))
    return tail_probability(np.log(null), float(np.log(_anderson_darling(v[None]))[0]), settings)


def _anderson_darling(x: np.ndarray) -> np.ndarray:
    """Statistics (R,) of samples (R, m), standardised by their own mean and deviation."""
    m = x.shape[1]
    z = np.sort((x - x.mean(1, keepdims=True)) / x.std(1, ddof=1, keepdims=True), axis=1)
    weights = (2.0 * np.arange(1, m + 1) - 1.0) / m
    return -m - (stats.norm.logcdf(z) + stats.norm.logsf(z[:, ::-1])) @ weights


def _follows(r: Residuals, settings: LoopSettings, seed: int) -> float:
    """Probability of as much that inputs, candidates, their powers or time explain."""
    each = looked_at(r) // (16 * max(len(r.input_names) + len(r.candidates), 1))
    constants = int(np.clip(each, 1, 4))
    blocks = [input_columns(r), _slow(r)]
    for signal in [r.mean, *r.inputs.T, *r.candidates.values()]:
        u = held(signal)
        if np.std(u) > 0:
            blocks.append(responses(hermite(u), r.step, r.time, constants=constants))
    for signal in r.candidates.values():
        blocks.append(responses(held(signal), r.step, r.time, constants=constants))
    return _explained(r, blocks, settings, seed).p_value


@dataclass(frozen=True, eq=False)
class Beyond:
    """What no effect of the catalogue does, in one residual.

    Attributes:
        p_value: probability of as much where there is none. gain: in log-likelihood [nats].
        fitted: (n,) what it explains of the residual [output].
    """

    p_value: float
    gain: float
    fitted: np.ndarray


def beyond_catalogue(residuals: Residuals, settings: LoopSettings, seed: int = 0) -> Beyond:
    """Test for products of inputs at two times, and responses that change: see `interactions`.

    Args:
        residuals: of one output (n,). settings: thresholds. seed: of the simulated null.

    Raises:
        ValueError: where too few held-out samples are measured.
    """
    blocks = interactions(residuals)
    if not blocks:
        return Beyond(1.0, 0.0, np.zeros(len(residuals)))
    scan = _explained(residuals, blocks, settings, seed)
    return Beyond(scan.p_value, scan.gain, scan.fitted)


def _slow(r: Residuals) -> np.ndarray:
    """Slow functions of time (n, 4)."""
    t = (r.time - r.time[0]) / (r.time[-1] - r.time[0])
    return np.cos(np.pi * t[:, None] * np.arange(1, 5))


def _explained(
    r: Residuals, blocks: Sequence[np.ndarray], settings: LoopSettings, seed: int
) -> Scan:
    """Test whether one of several blocks of columns explains a residual."""
    x = looked(r)
    ends = np.cumsum([b.shape[1] for b in blocks])
    places = [np.arange(e - b.shape[1], e) for b, e in zip(blocks, ends, strict=True)]
    columns = standardised(np.column_stack(blocks))
    variants, none = free_columns(columns, places), spanning(columns[:, :0])
    return prewhitened(x, variants, none, r.deviations, settings, first=_slow(r), seed=seed)
