"""Tests of what was added on the last block, of the model before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.context import SearchContext
from pyro_dynogp.discrepancy.search import Found
from pyro_dynogp.effects.base import Effect
from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.support.parallel import parallel_map

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit


def last_tests(
    found: Sequence[Found],
    fits: Sequence[Fit],
    whole: Record,
    sealed: np.ndarray,
    rounds: SearchContext,
) -> dict[str, tuple[float, float]]:
    """Smallest p-value of each effect's tests on block C, of the model before and after.

    Effects for which one of the models leaves too little to test are left out: a free run that
    grows without bound has no residuals.
    """
    effects = list({f.effect.name: f.effect for f in found}.values())
    if not effects:
        return {}
    residuals = [rounds.residuals(one, whole, sealed) for one in fits]

    def smallest(task: tuple[Effect, list[Residuals]]) -> float:
        effect, parts = task
        try:
            found = [effect.detect(part, rounds.settings, seed=rounds.seed) for part in parts]
        except ValueError:  # too few samples
            return math.nan
        # There may be nothing left to test.
        return min((one.p_value for several in found for one in several), default=1.0)

    tasks = [(effect, parts) for effect in effects for parts in residuals]
    p = parallel_map(
        smallest, tasks, workers=rounds.workers, progress=rounds.progress, description="last tests"
    )
    pairs = {effect.name: (p[2 * k], p[2 * k + 1]) for k, effect in enumerate(effects)}
    return {name: pair for name, pair in pairs.items() if not any(map(math.isnan, pair))}
