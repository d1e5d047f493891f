"""Open the last block, once, and put a report together."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pyro_dynogp.criticism.comparison import block_standard_error
from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.decision import Confirmed
from pyro_dynogp.discrepancy.held_out import one_step_density
from pyro_dynogp.discrepancy.parameters import parameters_of
from pyro_dynogp.discrepancy.result import KEPT, FoundEffect
from pyro_dynogp.discrepancy.search import Found
from pyro_dynogp.discrepancy.state import SearchState
from pyro_dynogp.effects.base import Effect, experiment
from pyro_dynogp.models.description import describe, in_words
from pyro_dynogp.prediction.records import joined
from pyro_dynogp.prediction.scores import scores
from pyro_dynogp.report.last_block_bands import said_of_bands
from pyro_dynogp.report.last_tests import last_tests
from pyro_dynogp.report.report import Report
from pyro_dynogp.statistics.settings import LoopSettings

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit

SCORES = ("rmse", "mae", "nrmse", "crps", "coverage_50", "coverage_95")


def report_of(fits: Sequence[Fit], course: SearchState, warnings: Sequence[str]) -> Report:
    """Open block C, once.

    Args:
        fits: last fits of the model as given, with the first effect, with the first two, and so on;
            or of the model as given, and of that without its process noise.
        course: what the rounds came to. warnings: what else is to be known.
    """
    rounds, watch, accepted = course.rounds, course.watch, course.accepted
    data = rounds.data
    forecasts = [one.forecast(data.known, data.sealed, seed=rounds.seed) for one in fits]
    measured = [{k: _mean(v) for k, v in scores(f, data.sealed).items() if k in SCORES}
                for f in forecasts]  # fmt: skip
    whole = joined(data.known, data.sealed)
    sealed = np.zeros(len(whole), dtype=bool)
    sealed[len(data.known) :] = True
    densities = [one_step_density(one, whole)[sealed] for one in fits]
    there = np.isfinite(densities[0])

    def compared(after: int, before: int) -> Compared:
        gain = densities[after][there] - densities[before][there]
        error = block_standard_error(gain)[0]
        return Compared(measured[before], measured[after], float(gain.sum()), error,
                        rounds.settings)  # fmt: skip

    count = len(fits) - 1
    kept = without_harm(count, compared)
    # Where nothing is kept the extended model is the one with everything, for comparison.
    last = kept or len(accepted)
    base, extended, change = fits[0], fits[last], compared(last, 0)
    said = change.disagreement
    without_noise = course.dropped and kept > 0
    left = course.left_without if without_noise else course.rest.said
    share = measured[kept]["coverage_95"]
    left += said_of_bands(fits[kept], data.known, data.sealed, share, seed=rounds.seed)
    if course.dropped:
        said = [compared(1, 0).of_noise(without_noise), *said]
    elif kept < count:
        names = [found.effect.name for found, _ in accepted[kept:]]
        said = [compared(count, kept).left_out(names) if kept else change.harm, *said]
    watch.stop("scores of the last block")
    tests = last_tests([f for f, _ in accepted], (base, extended), whole, sealed, rounds)
    watch.stop("residual tests of the last block")
    effects = [
        replace(
            _effect(found, one, fits[max(k, last)], data.known, rounds.effects),
            last_block=measured[k], kept=k <= kept,
        )
        for k, (found, one) in enumerate(accepted, 1)
    ]  # fmt: skip
    watch.stop("numbers of the effects")
    return Report(
        effects=(*effects, *(_only_reported(f) for f in course.reported)),
        outcome=_outcome(course, left, harm=last > kept),
        before=measured[0],
        after=measured[last],
        elpd_gain=change.gain,
        elpd_gain_error=change.error,
        fit=fits[kept],
        base=base,
        extended=extended,
        attempts=tuple(course.attempts),
        tests=tuple(course.tests),
        left=left,
        noise_dropped=without_noise,
        warnings=(*said, *warnings),
        data=data.sentence,
        last_block_tests=tests,
        sealed=data.sealed,
        known=data.known,
        forecast_before=forecasts[0],
        forecast_after=forecasts[last],
        model_before=describe(base.model),
        model_after=describe(extended.model),
        seconds=dict(watch.seconds),
    )


def without_harm(count: int, compared: Callable[[int, int], Compared]) -> int:
    """How many effects, in order, the fit to rely on has: no model before does clearly better.

    Args:
        count: of all effects. compared: the model with so many effects with that with fewer.
    """
    for after in range(count, 0, -1):
        if not any(compared(after, before).does_harm for before in range(after)):
            return after
    return 0


@dataclass(frozen=True)
class Compared:
    """Scores of the last block with and without what was added.

    Attributes:
        before, after: scores of the forecasts [output].
        gain, error: in log density, with its block standard error [nats].
        settings: what counts as worse.
    """

    before: Mapping[str, float]
    after: Mapping[str, float]
    gain: float
    error: float
    settings: LoopSettings

    @property
    def better(self) -> bool:
        """Whether forecasts are better by both scores."""
        return self._ratios[1] < 1.0

    @property
    def less_likely(self) -> bool:
        """Whether log density is lost for certain."""
        return self.gain < -self.settings.worse_errors * self.error

    @property
    def does_harm(self) -> bool:
        """Whether what was added makes the model do worse on the last block.

        It does where the RMSE or the CRPS of its forecasts is more than `settings.worse` times that
        before and the other is not better by as much, or where it loses more log density than
        `settings.worse_errors` standard errors and does not forecast better by both scores:
        densities one step ahead fall, too, where process noise has gone that made up for what was
        missing.
        """
        least, most = self._ratios
        worse = most > self.settings.worse and least * self.settings.worse > 1.0
        return worse or (self.less_likely and not self.better)

    @property
    def _ratios(self) -> tuple[float, float]:
        """Scores after over those before, the smaller one first."""
        tiny = float(np.finfo(float).tiny)  # a score may be zero
        names = "rmse", "crps"
        least, most = sorted((self.after[k] + tiny) / (self.before[k] + tiny) for k in names)
        return least, most

    @property
    def _change(self) -> str:
        scores = ", ".join(
            f"{name.upper()} {self.before[name]:.3g} -> {self.after[name]:.3g}"
            for name in ("rmse", "crps")
        )
        return f"{scores}, elpd {self.gain:+.1f} +- {self.error:.1f} nats"

    def of_noise(self, dropped: bool) -> str:
        """In words, what the model without process noise does, and whether the fit is that one."""
        which = (
            "without its process noise. Its bands are those of parameters and measurement noise"
            if dropped
            else "as it was given"
        )
        return (
            f"Without process noise the last block is forecast so ({self._change}): report.fit is "
            f"the model {which}."
        )

    @property
    def harm(self) -> str:
        """In words, that all that was added does harm."""
        return (
            f"What was added does harm on the last block ({self._change}): what held-out data "
            f"support need not last. Rely on the model before, which report.fit is; "
            f"report.extended is the extended one. Look at its residuals there, and confirm what "
            f"was named on another record before you use it."
        )

    def left_out(self, names: Sequence[str]) -> str:
        """In words, that the last effects do harm, and that the fit is without them."""
        them, said = "it" if len(names) == 1 else "them", " and ".join(names)
        return (
            f"{said[:1].upper()}{said[1:]} would do harm on the last block ({self._change}): "
            f"report.fit and report.extended are the model before {them}. Confirm what was named "
            f"on another record before you use it."
        )

    @property
    def disagreement(self) -> list[str]:
        """In words, that scores disagree and which to go by; nothing where that is harm."""
        if self.does_harm:
            return []
        found = []
        if self._ratios[1] > self.settings.worse:
            found.append(f"Scores of the last block disagree ({self._change}): {self._apart}")
        if self.less_likely and self.better:
            found.append(
                f"Scores of the last block disagree: forecasts are better with what was added, one "
                f"step ahead the model before is more likely (elpd {self.gain:+.1f} +- "
                f"{self.error:.1f} nats). Take the extended model (report.fit) for simulation and "
                f"forecasts; one step ahead report.base."
            )
        return found

    @property
    def _apart(self) -> str:
        """In words, what it means that the RMSE is better and the CRPS worse, or the reverse."""
        if self.after["rmse"] < self.before["rmse"]:
            return (
                "with what was added the largest errors are smaller, but forecasts with their "
                "bands are worse. Take the extended model (report.fit) for its means alone; for "
                "bands report.base."
            )
        return (
            "with what was added most forecasts and their bands are better, but the largest errors "
            "are larger. Take the extended model (report.fit), unless large errors cost most: then "
            "report.base."
        )


def _outcome(course: SearchState, left: Sequence[str], *, harm: bool) -> str:
    if harm:
        return KEPT
    if course.early:
        return "effects added, search ended early" if course.accepted else "search ended early"
    if course.accepted:
        return "effects added, structure left" if left else "effects added"
    return "structure left, cause unknown" if left else "nothing missing"


def _effect(
    found: Found,
    confirmed: Confirmed,
    extended: Fit,
    record: Record,
    effects: Collection[Effect],
) -> FoundEffect:
    attempt = confirmed.attempt
    assert attempt is not None
    assert confirmed.model is not None
    own = [one for one in confirmed.model.channels if one not in confirmed.before.channels]
    parts = [in_words(one) for one in own] or describe(confirmed.model)
    parameters = parameters_of(extended, own, record)
    parameters |= found.effect.parameters(extended, found.evidence, record)
    sentence = found.effect.sentence(found.evidence, confirmed.model)
    return FoundEffect(
        name=found.effect.name,
        sentence=f"{sentence} {found.effect.shape(parameters)}".rstrip(),
        p_value=found.evidence.p_value,
        q_value=found.q_value,
        gain=attempt.gain,
        gain_error=attempt.gain_error,
        size=found.evidence.size,
        parameters=parameters,
        block="; ".join(map(str, parts)),
        curve=found.evidence.curve,
        ties=confirmed.ties,
        experiment=experiment(found.effect.name, confirmed.ties, effects),
    )


def _only_reported(found: Found) -> FoundEffect:
    return FoundEffect(
        name=found.effect.name,
        sentence=found.evidence.sentence,
        p_value=found.evidence.p_value,
        q_value=found.q_value,
        gain=0.0,
        gain_error=0.0,
        size=found.evidence.size,
        parameters={},
        block="",
        curve=found.evidence.curve,
    )


def _mean(value: Any) -> float:
    """A score, averaged over outputs where there are several."""
    return float(np.mean(value))
