"""A level that jumps at one instant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.channels import Step
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Effect, number_of
from pyro_dynogp.models.variants import Model, with_channel
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import evidence, instant, over_time
from pyro_dynogp.statistics.prewhitening import (
    Projection,
    Score,
    Scored,
    Variants,
    log_ratio,
    prewhitened,
    spanning,
)
from pyro_dynogp.statistics.settings import LoopSettings

# Levels of a staircase that stands for any step while the first filter is fitted.
LEVELS = 8


def level_shift(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """A step of the output's level at any instant, looked for in the whole record.

    Returns:
        where: time (of the first sample at the new level) [time unit], size [output].

    Source: largest F statistic over the instant, Andrews, Econometrica 61(4):821 (1993), in the
    whitened residual, as level shifts in Chen & Liu, JASA 88(421):284 (1993).
    """
    r = residuals
    x = r.residual
    ends = max(int(settings.step_margin * len(r)), 5)
    places = np.arange(ends, len(r) - ends)
    # No slow responses of the inputs here: they would claim a step at almost any instant.
    nuisance = spanning(np.column_stack([r.mean, r.inputs]))
    stairs = np.eye(LEVELS)[np.arange(len(r)) * LEVELS // len(r)]
    scan = prewhitened(
        x,
        _steps(places),
        nuisance,
        r.deviations,
        settings,
        first=np.column_stack([stairs, nuisance]),
        seed=seed,
    )
    at = int(places[scan.best])
    size = float(scan.fitted[at] - scan.fitted[at - 1])
    way = "up" if size > 0 else "down"
    return evidence(
        "level shift",
        scan,
        {"time": float(r.time[at]), "size": size},
        f"The level of {r.output_name!r} steps {way} by {abs(size):.3g} {r.output_unit} "
        f"at {instant(r, at)}.",
        over_time(r, scan.fitted),
    )


def _steps(places: np.ndarray) -> Variants:
    r"""Steps at all places.

    A step is a sum of pulses. The filter makes of a pulse its coefficients c = (1, -a), so the
    product of a series with a whitened step is the sum, from the end, of its products with c.
    """

    def prepare(under: Projection) -> Score:
        p, n = under.whiten.order, len(under.missing)
        c = np.concatenate([[1.0], -under.whiten.coefficients])
        phi = np.cumsum(c)

        def pulses(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
            """Sum over k of weights_k values_(s+k) for s in 0..n-1; values (m, ...) on rows."""
            full = np.zeros((n + p, *values.shape[1:]))
            full[p:n][under.rows] = values
            return np.sum([w * full[k : n + k] for k, w in enumerate(weights)], axis=0)

        def steps(values: np.ndarray) -> np.ndarray:
            return np.cumsum(pulses(values, c)[::-1], axis=0)[::-1][places]

        ones = np.ones(int(under.rows.sum()))
        later = np.cumsum(pulses(ones, np.array([1.0]))[::-1])[::-1]
        norm = (phi[-1] ** 2 * later + pulses(ones, phi**2 - phi[-1] ** 2))[places]
        left = norm - np.square(steps(under.Q)).sum(1)
        usable = left > 1e-6 * norm

        def score(x: np.ndarray) -> Scored:
            e = under(x)
            b = steps(e)
            explained = np.where(usable, b**2 / np.where(usable, left, 1.0), 0.0)
            gains = len(e) * log_ratio(explained, float(e @ e))

            def fit(j: int) -> tuple[np.ndarray, np.ndarray]:
                step = (np.arange(n) >= places[j]).astype(float)
                return under.with_nuisance(under.fit(step[:, None], x), x)

            return gains, fit

        return score

    return Variants(prepare, np.ones(len(places)))


class LevelShift(Effect):
    """A level that jumps at one instant."""

    name = "level shift"
    family = "time"
    localised = True
    test = staticmethod(level_shift)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A step at the instant."""
        return [with_channel(model, Step(number_of(evidence, "time")))]
