"""What other tools say of the same residuals, in the words of the catalogue.

- Bands: autocorrelation of the residual, and its correlation with the inputs, beside bands of 99 %
  at 25 lags, as MATLAB's ``resid`` draws them. Past inputs: plant model. Later ones: feedback.
- Indicators: an impulse and a step for every sample, in the manner of ``gets::isat``.
- LASSO: a library of regressors; the group that explains most of the residual names the effect.

The residual is that one step ahead. Each tool gives names at the level that its users take, and
the first two also at a level of 5 % for all that they look at together.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats

import pyro_dynogp as dgp
from tests.benchmarks.naming_lasso import Said, largest_group, library

Array = NDArray[np.float64]
BAND, LAGS, FAMILY = 0.01, 25, 0.05
# Of the variance that cross-correlations have beside white residuals.
LEAST_VARIANCE = 0.1
# What each tool says, in the catalogue's words.
WORDS = {
    "noise model": "process noise",
    "plant model": "unmodelled dynamics",
    "feedback": "feedback",
    "steps": "level shift",
    "outliers": "heavy tails",
}


def autocorrelations(e: Array, lags: int = LAGS) -> Array:
    """Of a residual (n,) at lags 1, 2, ..., over their standard deviation if it is white."""
    e = e - e.mean()
    size = max(float(e @ e), 1e-300)
    found = [float(e[k:] @ e[:-k]) / size for k in range(1, lags + 1)]
    return np.sqrt(len(e)) * np.array(found)


def cross_correlations(e: Array, u: Array, lags: int = LAGS) -> Array:
    """Of a residual and an input (n,), over their standard deviation if they are independent.

    At lags -25 to 25, by which the residual comes later. The variance is that of Ljung, System
    Identification, 2nd ed., 16.6: products of both autocorrelations, summed over lags.
    """
    e, u = e - e.mean(), u - u.mean()
    size = math.sqrt(float(e @ e) * float(u @ u))
    if size <= 0.0:
        return np.zeros(2 * lags + 1)
    n = len(e)
    both = float(autocorrelations(e, lags) @ autocorrelations(u, lags)) / n
    variance = max(1.0 + 2.0 * both, LEAST_VARIANCE)
    later = [float(e[k:] @ u[: n - k]) for k in range(lags + 1)]
    sooner = [float(e[: n - k] @ u[k:]) for k in range(lags, 0, -1)]
    return np.sqrt(n / variance) * np.array(sooner + later) / size


def bands(e: Array, inputs: Array, level: float = BAND, family: bool = False) -> tuple[str, ...]:
    """Which of "noise model", "plant model" and "feedback" the correlations ask for.

    Args:
        e: (n,) residual. inputs: (n, n_u).
        level: of one lag, or of all that is looked at together where `family` is True.
    """
    count = LAGS + (2 * LAGS + 1) * inputs.shape[1] if family else 1
    limit = float(stats.norm.isf(0.5 * level / count))
    found = {"noise model": bool((np.abs(autocorrelations(e)) > limit).any())}
    for u in inputs.T:
        z = np.abs(cross_correlations(e, u))
        found["plant model"] = found.get("plant model", False) or bool((z[LAGS:] > limit).any())
        found["feedback"] = found.get("feedback", False) or bool((z[:LAGS] > limit).any())
    return tuple(name for name, is_so in found.items() if is_so)


@dataclass(frozen=True)
class Indicators:
    """What is kept: first samples of new levels, and single samples."""

    steps: tuple[int, ...]
    impulses: tuple[int, ...]


def indicators(e: Array, level: float) -> Indicators:
    """Steps and impulses of a residual (n,), each by t-tests at a level.

    Steps first: those of one half of the record at once, which the other half judges, then of the
    other half, then what both have kept together. A level that lasts a sample is an impulse.
    Impulses are judged beside those levels in the same way, by halves and together.
    """
    n = len(e)
    half = n // 2
    near = selected_steps(e, range(1, half + 1), level)
    far = selected_steps(e, range(half, n), level)
    steps = selected_steps(e, sorted({*near, *far}), level)
    starts = np.array([0, *steps, n])
    single = {int(k) for k in starts[:-1][np.diff(starts) == 1]}
    rest = np.array([k for k in range(n) if k not in single])
    # Without single samples a step may be none any more.
    moved = sorted({int(np.searchsorted(rest, k)) for k in steps} - {0, len(rest)})
    steps = [int(rest[k]) for k in selected_steps(e[rest], moved, level)]
    means = np.zeros(n)
    edges = [0, *steps, n]
    for first, last in itertools.pairwise(edges):
        means[first:last] = e[[k for k in range(first, last) if k not in single]].mean()
    return Indicators(tuple(steps), _impulses(e - means, single, len(edges) - 1, level))


def selected_steps(e: Array, steps: Sequence[int] | range, level: float) -> list[int]:
    """First samples of levels, of those given, after backward elimination by t-tests."""
    starts = np.array([0, *steps])
    counts = np.diff([*starts, len(e)]).astype(float)
    means = np.add.reduceat(e, starts) / counts
    rss = float(e @ e) - float(counts @ means**2)
    while len(starts) > 1:
        degrees = len(e) - len(starts)
        weights = counts[:-1] * counts[1:] / (counts[:-1] + counts[1:])
        costs = weights * np.diff(means) ** 2
        least = int(np.argmin(costs))
        limit = float(stats.t.isf(0.5 * level, degrees))
        if costs[least] > limit**2 * max(rss, 1e-300) / degrees:
            break
        rss += float(costs[least])
        total = counts[least] + counts[least + 1]
        means[least] = (counts[least : least + 2] @ means[least : least + 2]) / total
        counts[least] = total
        starts, counts, means = (np.delete(x, least + 1) for x in (starts, counts, means))
    return [int(k) for k in starts[1:]]


def _impulses(r: Array, given: set[int], levels: int, level: float) -> tuple[int, ...]:
    """Single samples of deviations from `levels` levels (n,), beside those `given`."""

    def far(judged: Array, by: Array, degrees: int) -> Array:
        sd = math.sqrt(max(float(r[by] @ r[by]), 1e-300) / degrees)
        return judged[np.abs(r[judged]) > stats.t.isf(0.5 * level, degrees) * sd]

    rest = np.array([k for k in range(len(r)) if k not in given])
    first, second = np.array_split(rest, 2)
    found = {*given}
    for judged, by in ((first, second), (second, first)):
        found |= {int(k) for k in far(judged, by, max(len(by) - levels, 1))}
    last = np.array([k for k in range(len(r)) if k not in found])
    kept = far(np.array(sorted(found), dtype=int), last, max(len(last) - levels, 1))
    return tuple(int(k) for k in kept)


def peers(
    e: Array,
    inputs: Array,
    simulated: Array,
    extra: Mapping[str, Array],
    stamps: pd.DatetimeIndex | None = None,
) -> dict[str, Said]:
    """What each tool says of a residual (n,), NaN where it is missing: names with channels."""
    known = np.isfinite(e)
    r, u = e[known], inputs[known]
    found: dict[str, Said] = {
        "bands of 99 %": _in_words(bands(r, u)),
        "bands, 5 % together": _in_words(bands(r, u, FAMILY, family=True)),
    }
    for name, level in (("indicators at 1 / n", 1.0), ("indicators, 5 % together", 0.5 * FAMILY)):
        kept = indicators(r, level / len(r))
        named = [word for word, those in (("steps", kept.steps), ("outliers", kept.impulses)) if
                 those]  # fmt: skip
        found[name] = _in_words(named)
    return found | {"LASSO": largest_group(library(inputs, simulated, extra, stamps), e)}


def _in_words(said: Sequence[str]) -> Said:
    return tuple((WORDS[one], None) for one in said)


def peers_of(fit: dgp.Fit, record: dgp.Record, training: int) -> dict[str, dict[str, Any]]:
    """What each tool says of a fit, by tool and part of the record, as JSON has it.

    Of several outputs each is looked at, and all that is said counts. Errors are over their
    standard deviation, as the first ones, of an unknown state, are large.
    """
    residuals = fit.innovations(record)
    simulated = fit.simulate(record).mean
    out: dict[str, dict[str, Any]] = {}
    for part, length in (("training part", training), ("whole record", len(record))):
        extra = {name: x[:length] for name, x in record.extra.items()}
        stamps = None if record.timestamps is None else record.timestamps[:length]
        said: dict[str, list[tuple[str, str | None]]] = {}
        for j in range(record.n_outputs):
            given = residuals[:length, j], record.inputs[:length], simulated[:length, j]
            for name, new in peers(*given, extra, stamps).items():
                said.setdefault(f"{name}, {part}", []).extend(new)
        for name, pairs in said.items():
            once = list(dict.fromkeys(pairs))
            out[name] = {"named": [a for a, _ in once], "channels": [b for _, b in once]}
    return out
