"""Effects of time that are slow or sudden: drift, level shift. Periodic ones: `periodic`."""

from __future__ import annotations

import numpy as np

from pyro_dynogp.effects.periodic import periodic_disturbance
from pyro_dynogp.statistics.bootstrap import (
    Prepare,
    Score,
    columns_score,
    explained_by,
    log_ratio,
    projector,
    replicates,
    sieve,
    spanning,
)
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.shares_of_inputs import paths
from pyro_dynogp.statistics.time_pictures import instant, over_time, size_in_words
from pyro_dynogp.statistics.whitening import Whitener

__all__ = ["drift", "level_shift", "periodic_disturbance"]

# Cosines of a drift: the slowest runs once from one end to the other, the fastest four times.
SLOW = ((1,), (1, 2), (1, 2, 3, 4))
# Inputs beyond which a drift of gain is looked for in the mean as a whole only.
INPUTS = 4
# Share of the record at each end where no level shift is looked for: too short to tell a level.
END = 0.03
# Levels of a staircase that stands for any step while the first filter is fitted.
LEVELS = 8


def drift(residuals: Residuals, *, seed: int = 0) -> Evidence:
    """A slow change over the whole record, of the level or of a gain.

    The level changes by cosines of k half periods over the record, k = 1 to 4; a gain by the same
    cosines times the mean's deviation from its average, or times the share of one input.

    Args:
        residuals: of one output (n,). seed: of the replicates.

    Returns:
        where: form "additive" or "gain", channel (input or output whose gain drifts, "" for the
        level), time_scale (half a period of what dominates) [time unit].

    Raises:
        ValueError: where fewer than 30 samples are measured.

    Source: slow cosines as in Müller & Watson, Econometrica 76(5):979 (2008); the null by `sieve`.
    """
    r = residuals
    t = (r.time - r.time[0]) / (r.time[-1] - r.time[0])
    slow = np.cos(np.pi * t[:, None] * np.arange(1, SLOW[-1][-1] + 1))
    names, scaled = [""], [np.ones(len(r))]
    mean = r.mean - r.mean.mean()
    nuisance = mean[:, None]
    if mean.std() > 0:
        names, scaled = [*names, r.output_name], [*scaled, mean]
    if 2 <= len(r.input_names) <= INPUTS:
        shares = paths(r).shares
        nuisance = np.column_stack([nuisance, shares])
        names = [*names, *r.input_names]
        scaled = [*scaled, *(shares - shares.mean(0)).T]
    K = slow.shape[1]
    columns = np.concatenate([slow * s[:, None] for s in scaled], axis=1)
    variants = [np.array(k) - 1 + K * j for j in range(len(scaled)) for k in SLOW]
    found = sieve(
        r.residual,
        columns_score(columns, variants, spanning(nuisance), ~np.isfinite(r.residual)),
        np.array([len(v) for v in variants]),
        deviations=r.deviations,
        first=np.column_stack([columns, nuisance]),
        replicates=replicates(len(r), columns.shape[1]),
        seed=seed,
    )
    j, order = divmod(found.best, len(SLOW))
    # What the fitted effect is as a function of time alone, and the cosine that dominates there.
    basis = slow[:, [k - 1 for k in SLOW[order]]] * scaled[j][:, None]
    joined = np.column_stack([basis, np.ones(len(r))])
    weights = np.linalg.lstsq(joined, found.fitted, rcond=None)[0][:-1]
    k = float(np.square(weights) @ np.array(SLOW[order]) / max(np.square(weights).sum(), 1e-300))
    scale = float(r.time[-1] - r.time[0]) / max(k, 1.0)
    form = "gain" if names[j] else "additive"
    what = f"The gain of {names[j]!r}" if names[j] else f"The level of {r.output_name!r}"
    return Evidence(
        effect="drift",
        statistic=found.statistic,
        p_value=found.p_value,
        gain=found.gain,
        size=found.size,
        where={"form": form, "channel": names[j], "time_scale": scale},
        sentence=f"{what} drifts over about {scale:.3g} {r.time_unit}: "
        f"{size_in_words(r, found.size)}.",
        curve=over_time(r, found.fitted),
    )


def level_shift(residuals: Residuals, *, seed: int = 0) -> Evidence:
    """A step of the output's level at any instant, looked for in the whole record.

    Args:
        residuals: of one output (n,). seed: of the replicates.

    Returns:
        where: time (of the first sample at the new level) [time unit], size [output].

    Raises:
        ValueError: where fewer than 30 samples are measured.

    Source: largest F statistic over the instant, Andrews, Econometrica 61(4):821 (1993), in the
    whitened residual, as level shifts in Chen & Liu, JASA 88(421):284 (1993).
    """
    r = residuals
    x = r.residual
    ends = max(int(END * len(r)), 5)
    places = np.arange(ends, len(r) - ends)
    # No slow responses of the inputs here: they would claim a step at almost any instant.
    nuisance = spanning(np.column_stack([r.mean, r.inputs]))
    found = sieve(
        x,
        _steps(places, nuisance, ~np.isfinite(x)),
        np.ones(len(places)),
        deviations=r.deviations,
        first=np.column_stack([np.eye(LEVELS)[np.arange(len(r)) * LEVELS // len(r)], nuisance]),
        replicates=replicates(len(r), 2 * nuisance.shape[1]),
        seed=seed,
    )
    at = int(places[found.best])
    size = float(found.fitted[at] - found.fitted[at - 1])
    way = "up" if size > 0 else "down"
    return Evidence(
        effect="level shift",
        statistic=found.statistic,
        p_value=found.p_value,
        gain=found.gain,
        size=found.size,
        where={"time": float(r.time[at]), "size": size},
        sentence=f"The level of {r.output_name!r} steps {way} by {abs(size):.3g} {r.output_unit} "
        f"at {instant(r, at)}.",
        curve=over_time(r, found.fitted),
    )


def _steps(places: np.ndarray, nuisance: np.ndarray, missing: np.ndarray) -> Prepare:
    r"""Score of steps at all places.

    A step is a sum of pulses. The filter makes of a pulse its coefficients c = (1, -a), so the
    product of a series with a whitened step is the sum, from the end, of its products with c.
    """

    def prepare(whiten: Whitener) -> Score:
        there, Q, _ = projector(whiten, nuisance, missing)
        p, n = whiten.order, len(missing)
        c = np.concatenate([[1.0], -whiten.coefficients])
        phi = np.cumsum(c)

        def pulses(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
            """Sum over k of weights_k values_(s+k) for s in 0..n-1; values (m, ...) on rows."""
            full = np.zeros((n + p, *values.shape[1:]))
            full[p:n][there] = values
            return np.sum([w * full[k : n + k] for k, w in enumerate(weights)], axis=0)

        def steps(values: np.ndarray) -> np.ndarray:
            return np.cumsum(pulses(values, c)[::-1], axis=0)[::-1][places]

        ones = np.ones(int(there.sum()))
        later = np.cumsum(pulses(ones, np.array([1.0]))[::-1])[::-1]
        own_norm = phi[-1] ** 2 * later + pulses(ones, phi**2 - phi[-1] ** 2)
        beside = steps(Q)
        norm = own_norm[places]
        left = norm - np.square(beside).sum(1)
        usable = left > 1e-6 * norm

        def score(x: np.ndarray):
            e0 = whiten(x)[there]
            q = Q.T @ e0
            e = e0 - Q @ q
            b = steps(e)
            explained = np.where(usable, b**2 / np.where(usable, left, 1.0), 0.0)
            gains = len(e) * log_ratio(explained, float(e @ e))

            def fit(j: int) -> tuple[np.ndarray, np.ndarray]:
                step = (np.arange(n) >= places[j]).astype(float)
                return explained_by(whiten, there, step[:, None], nuisance, x)

            return gains, fit

        return score

    return prepare
