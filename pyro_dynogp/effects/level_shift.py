"""A level that jumps at one instant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.channels import Step
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Effect, number_of
from pyro_dynogp.models.variants import Model, with_channel
from pyro_dynogp.statistics.bootstrap import (
    Prepare,
    Score,
    Scored,
    explained_by,
    log_ratio,
    projector,
    replicates,
    sieve,
    spanning,
)
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.time_pictures import instant, over_time
from pyro_dynogp.statistics.whitening import Whitener

# Share of the record at each end where no level shift is looked for: too short to tell a level.
END = 0.03
# Levels of a staircase that stands for any step while the first filter is fitted.
LEVELS = 8


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

        def score(x: np.ndarray) -> Scored:
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


class LevelShift(Effect):
    """A level that jumps at one instant."""

    name = "level shift"
    family = "time"
    localised = True
    test = staticmethod(level_shift)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A step at the instant."""
        return [with_channel(model, Step(number_of(evidence, "time")))]
