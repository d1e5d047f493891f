"""Forecasts of later parts of a training record by refits to what came before them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from pyro_dynogp.criticism.finding import Finding
from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.prediction.predict import forecast
from pyro_dynogp.support.parallel import parallel_map

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted

# Shares of the record between which it is cut: two refits, each forecasts up to the next cut.
CUTS = (0.6, 0.8, 1.0)
# Fewest samples of the shortest record of which parts are left out.
FEWEST = 60
# Share of samples inside the 95 % interval from which forecasts do not hold, and the probability of
# as few, were they right, from which that is no chance.
HOLDS, CHANCE = 0.8, 0.05
# Joint samples that say what chance is.
SAMPLES = 400
NAME = "forecasts"


@dataclass(frozen=True, eq=False)
class Stretch:
    """A forecast of a part of a record.

    Attributes:
        inside: number of measured outputs in their central 95 % interval. count: of all.
        chance: (S,) the same number for joint samples of the forecast in their place.
    """

    inside: int
    count: int
    chance: np.ndarray


@dataclass(frozen=True)
class Held:
    """What 95 % intervals hold of the samples.

    Attributes:
        share: of samples inside. p_value: probability of as few, were the forecasts right.
        right: whether nothing is evidence against the forecasts.
    """

    share: float
    p_value: float
    right: bool


def forecast_findings(fit: Fitted, *, seed: int = 0, progress: bool = False) -> list[Finding]:
    """Whether forecasts hold, from within the training record (leave-future-out).

    The model is fitted again, by the same method, to the first 60 and the first 80 % of every
    record, and forecasts the 20 % that follow from the state at their beginning. They do not hold
    where the 95 % interval has less than 80 % of the samples, and as few are improbable were the
    forecasts right: joint samples in the place of the outputs say so, whose errors go together in a
    free run. Those of models with functions go together too little: the share alone decides.

    Source: leave-future-out validation (Buerkner, Gabry & Vehtari, J. Stat. Comput. Simul. 90(14):
    2499, 2020).

    Args:
        fit: the fit. seed: of joint samples. progress: whether to show a bar.
    """
    shortest = min(len(record) for record in fit.records)
    if not fit.collapsed or fit.method == "nuts":
        text = "not checked: the model would have to be sampled again; see calibration()"
        return [Finding(NAME, np.nan, None, text)]
    if shortest < FEWEST:
        text = f"not checked: {FEWEST} samples or more are needed, there are {shortest}"
        return [Finding(NAME, np.nan, None, text)]
    found = parallel_map(
        partial(_ahead, fit, seed), list(pairwise(CUTS)), workers=1, progress=progress,
        description=NAME,
    )  # fmt: skip
    for some in found:
        if isinstance(some, str):
            return [Finding(NAME, np.nan, None, some)]
    stretches = [one for some in found for one in some if isinstance(one, Stretch)]
    return [_finding(stretches, fit.model.is_linear)] if stretches else []


def _ahead(fit: Fitted, seed: int, ends: tuple[float, float]) -> list[Stretch] | str:
    """Forecasts between two shares of every record, or why there are none."""
    cut, end = ends
    past = [record[: int(cut * len(record))] for record in fit.records]
    future = [record[int(cut * len(record)) : int(end * len(record))] for record in fit.records]
    try:
        again = refit(fit, past, run=Run(fit.seed, workers=1))
        return [
            stretch_of(again, before, after, seed)
            for before, after in zip(past, future, strict=True)
            if np.isfinite(after.outputs).any(0).all()
        ]
    except ValueError as error:  # as where an input is constant before the cut
        return f"not checked: the first {100 * cut:.0f} % cannot be fitted alone ({error})"


def stretch_of(fit: Fitted, past: Record, future: Record, seed: int) -> Stretch:
    """The forecast of a part from what came before it, against what was measured there."""
    predicted = forecast(fit, past, future, samples=SAMPLES, seed=seed)
    low, high = predicted.quantile(0.025), predicted.quantile(0.975)
    y = future.outputs
    there = np.isfinite(y)
    both = np.concatenate([y[None], predicted.samples])
    inside = ((low <= both) & (both <= high) & there).sum((1, 2))
    return Stretch(int(inside[0]), int(there.sum()), inside[1:])


def held_by(stretches: Sequence[Stretch], known: bool, chance: float = CHANCE) -> Held:
    """Whether intervals hold their share of the samples.

    Args:
        stretches: forecasts of the same parameters.
        known: whether errors of joint samples go together as they should, as of linear models.
        chance: probability of as few from which that is no chance.
    """
    count = sum(one.count for one in stretches)
    inside = sum(one.inside for one in stretches)
    as_few = (np.sum([one.chance for one in stretches], axis=0) <= inside).sum()
    p = float((1 + as_few) / (1 + len(stretches[0].chance)))
    share = inside / count
    return Held(share, p, share >= HOLDS or (known and p >= chance))


def _finding(stretches: list[Stretch], known: bool) -> Finding:
    """What stretches say; `known`: see `held_by`."""
    held = held_by(stretches, known)
    each = " and ".join(f"{100 * one.inside / one.count:.0f} %" for one in stretches)
    text = (
        f"of later parts by refits to what came before: the 95 % interval holds {each} of the "
        f"samples"
    )
    text += f" (as few by chance: p = {held.p_value:.2g})" if known else ""
    if not held.right:
        text += (
            ". Free runs and forecasts are not to be trusted: see what the model lacks "
            "(close_loop), or try another structure"
        )
    return Finding(NAME, held.share, held.right, text, HOLDS)
