"""What closing the loop came to."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pyro_dynogp.statistics.evidence import Curve, Evidence
from pyro_dynogp.support.errors import PATH
from pyro_dynogp.support.shown import shown
from pyro_dynogp.support.writing import write_text

if TYPE_CHECKING:
    from pyro_dynogp.data.record import Record
    from pyro_dynogp.fitting import Fit
    from pyro_dynogp.models.description import Part
    from pyro_dynogp.prediction.prediction import Prediction

Decision = Literal["accepted", "tie", "nearly", "rejected", "undecided", "not tried", "reported"]
# What became of a test.
Outcome = Decision | Literal["not significant"]
# The outcome where what was found does harm on the last block.
KEPT = "effects named, model kept"
WORSE_WITH = "with it the model does worse on the last block"
WITHOUT_NOISE = "the model forecasts better without its process noise, and is now without it"
RELY_ON_BEFORE = (
    "with them the model does worse on the last block. Rely on the model before (report.fit), not "
    "on the extended one (report.extended)."
)


@shown
@dataclass(repr=False, frozen=True, eq=False)
class Attempt:
    """One effect that was considered in one round.

    Attributes:
        round: number, from 1. evidence: of the test. q_value: false discovery rate at which it
            passes among all tests of the round.
        decision: what became of it; "nearly" where it is rejected by little, and "undecided" where
            the time limit came first. reason: why, in words.
        gain, gain_error: elpd of held-out data after less before, and its block standard error
            [nats]; NaN where it was not refitted.
        seconds: that refits took.
    """

    round: int
    evidence: Evidence
    q_value: float
    decision: Decision
    reason: str
    gain: float = np.nan
    gain_error: float = np.nan
    seconds: float = 0.0

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.evidence.effect

    @property
    def channel(self) -> str:
        """Name of the channel that the effect comes from or acts on, "" where it has none."""
        return str(self.evidence.where.get("channel", ""))

    @property
    def output(self) -> str:
        """Name of the output whose residual was tested, "" where that is not known."""
        return self.evidence.output


@dataclass(frozen=True)
class EffectTest:
    """One test of one round, whatever came of it.

    Attributes:
        round: number, from 1. effect: name. output: whose residual was tested.
        place: the channel, or else the instant, period, frequency or form that suits best; "" for
            none.
        p_value: probability of as much where the effect is absent, paid for by the number of
            outputs. q_value: false discovery rate among all tests of the round; of "any structure",
            which is asked by itself where no effect is certain, the p-value.
        decision: what became of it, as of an `Attempt`; or "not significant".
    """

    round: int
    effect: str
    output: str
    place: str
    p_value: float
    q_value: float
    decision: Outcome


@shown
@dataclass(repr=False, frozen=True, eq=False)
class FoundEffect:
    """An effect that was added to the model, or one that is only reported (feedback).

    Attributes:
        name: of the effect. sentence: what it is, with its size, in the units of the record.
        p_value: of the test that named it. q_value: false discovery rate.
        gain, gain_error: elpd of held-out data after less before [nats].
        size: root mean square of what it does to the output [output].
        parameters: posterior of what the block has learnt: mean and standard deviation by name.
        block: the model's block, in words. curve: the evidence.
        ties: names of effects that explain the data as well.
        experiment: which experiment would tell them apart, "" without ties.
        last_block: scores on block C of the model with this effect and those before; empty of what
            is only reported.
        kept: whether `LoopResult.fit` has it; False where it does harm on block C.
    """

    name: str
    sentence: str
    p_value: float
    q_value: float
    gain: float
    gain_error: float
    size: float
    parameters: Mapping[str, tuple[float, float]]
    block: str
    curve: Curve | None
    ties: tuple[str, ...] = ()
    experiment: str = ""
    last_block: Mapping[str, float] = field(default_factory=dict)
    kept: bool = True


@shown
@dataclass(repr=False, frozen=True, eq=False)
class LoopResult:
    """Result of `close_loop`.

    Attributes:
        effects: accepted, in the order in which they were added; then what is only reported.
        outcome: "effects added", "nothing missing", "structure left, cause unknown", "effects
            added, structure left"; "effects named, model kept" where the extended model does
            clearly worse on block C; "search ended early" and "effects added, search ended early"
            where the time limit was passed first.
        before, after: scores on the sealed block C of the model given and of the extended one, both
            fitted to A and B: rmse, mae, nrmse, crps, coverage_50, coverage_95.
        elpd_gain, elpd_gain_error: elpd on C after less before, block standard error [nats].
        fit: the fit to rely on, of A and B: `extended`, but `base` where that does better on C.
        base: the model given, fitted to A and B.
        extended: the model with the effects that were accepted, fitted to A and B, without those at
            the end that do harm on C; with all of them where `fit` is `base`, which is `extended`
            where nothing was added.
        attempts: all that was considered. tests: every test of every round, most probable effects
            first. left: what structure is left at the end, in words; empty where none is.
        warnings: sentences for the reader. data: which part was for what.
        last_block_tests: smallest p-value on C of the tests for each accepted effect, before and
            after, by effect.
        sealed: block C. known: blocks A and B.
        forecast_before, forecast_after: of C by `base` and `extended`.
        model_before, model_after: those models in words, part by part.
        seconds: by stage.
        noise_dropped: whether nothing was added, and `extended` is the model given without its
            process noise, which forecasts held-out data better so.
    """

    effects: tuple[FoundEffect, ...]
    outcome: str
    before: Mapping[str, float]
    after: Mapping[str, float]
    elpd_gain: float
    elpd_gain_error: float
    fit: Fit
    base: Fit
    extended: Fit
    attempts: tuple[Attempt, ...]
    tests: tuple[EffectTest, ...]
    left: tuple[str, ...]
    warnings: tuple[str, ...]
    data: str
    last_block_tests: Mapping[str, tuple[float, float]]
    sealed: Record
    known: Record
    forecast_before: Prediction
    forecast_after: Prediction
    model_before: tuple[Part, ...]
    model_after: tuple[Part, ...]
    seconds: Mapping[str, float] = field(default_factory=dict)
    noise_dropped: bool = False

    @property
    def model_kept(self) -> bool:
        """Whether `fit` is the model before, as the extended one does clearly worse on block C."""
        return self.outcome == KEPT

    def to_dict(self) -> dict[str, Any]:
        """Everything but the fits and predictions, as JSON has it."""
        return {
            "outcome": self.outcome,
            "effects": [_plain(one) for one in self.effects],
            "before": dict(self.before),
            "after": dict(self.after),
            "elpd_gain": self.elpd_gain,
            "elpd_gain_error": self.elpd_gain_error,
            "model_kept": self.model_kept,
            "noise_dropped": self.noise_dropped,
            "last_block_tests": {k: list(pair) for k, pair in self.last_block_tests.items()},
            "attempts": [
                _plain(one) | {"channel": one.channel, "output": one.output}
                for one in self.attempts
            ],
            "tests": [_plain(one) for one in self.tests],
            "left": list(self.left),
            "warnings": list(self.warnings),
            "data": self.data,
            "model_before": [str(part) for part in self.model_before],
            "model_after": [str(part) for part in self.model_after],
            "seconds": dict(self.seconds),
        }

    def to_json(self, path: str | Path) -> None:
        """Write `to_dict` to a file; numbers that are not finite become null.

        Raises:
            ValueError: where the file cannot be written; what was there before is there.
        """
        PATH.check("path", path)
        text = json.dumps(_finite(self.to_dict()), indent=1, allow_nan=False)
        write_text(path, text + "\n", "The report")

    def __str__(self) -> str:
        lines = [self.headline]
        for k, one in enumerate(self.effects, 1):
            lines.append(f"{k}. {one.name}: {one.sentence}")
            lines += [f"   {name}: {mean:.4g} +- {sd:.2g}" for name, (mean, sd) in
                      one.parameters.items()]  # fmt: skip
            if self.said_of_last_block(one):
                lines.append(f"   {self.said_of_last_block(one)}")
            if one.ties:
                lines.append(f"   {one.name} or {', '.join(one.ties)}: {one.experiment}")
        lines.append(self.data)
        for name in self.before:
            pair = f"before {self.before[name]:.4g}, after {self.after[name]:.4g}"
            lines.append(f"{name:<12} {pair}")
        gain, error = self.elpd_gain, self.elpd_gain_error
        lines.append(f"elpd         after less before {gain:.1f} +- {error:.1f} nats")
        return "\n".join([*lines, *self.left, *self.warnings])

    @property
    def headline(self) -> str:
        """The outcome as a sentence; where what was added does harm, which model to rely on."""
        said = f"{self.outcome[:1].upper()}{self.outcome[1:]}"
        if self.model_kept:
            return f"{said}: {RELY_ON_BEFORE}"
        if self.left_out:
            return f"{said}; {' and '.join(self.left_out)} named, but left out: {WORSE_WITH}."
        if self.noise_dropped:
            return f"{said}; {WITHOUT_NOISE}."
        return f"{said}."

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of effects that do harm on block C, and that `fit` is without."""
        return tuple(one.name for one in self.effects if not one.kept)

    def said_of_last_block(self, effect: FoundEffect) -> str:
        """The error on block C from effect to effect, in words; empty where there is one alone."""
        added = [one for one in self.effects if one.last_block]
        if len(added) < 2 or effect not in added:
            return ""
        place = added.index(effect)
        before = added[place - 1].last_block["rmse"] if place else self.before["rmse"]
        said = f"RMSE on the last block from {before:.3g} to {effect.last_block['rmse']:.3g}"
        return said if effect.kept or self.model_kept else f"{said}; left out of report.fit"


def _plain(one: Any) -> Any:
    """Dataclasses, arrays and mappings as JSON has them."""
    if isinstance(one, Attempt | EffectTest | FoundEffect | Evidence | Curve):
        return {name: _plain(getattr(one, name)) for name in one.__dataclass_fields__}
    if isinstance(one, np.ndarray):
        return one.tolist()
    if isinstance(one, Mapping):
        return {str(k): _plain(v) for k, v in one.items()}
    if isinstance(one, Sequence) and not isinstance(one, str):
        return [_plain(v) for v in one]
    if isinstance(one, np.generic):
        return one.item()
    return one


def _finite(one: Any) -> Any:
    """With null for numbers that JSON does not have."""
    if isinstance(one, dict):
        return {k: _finite(v) for k, v in one.items()}
    if isinstance(one, list):
        return [_finite(v) for v in one]
    if isinstance(one, float) and not np.isfinite(one):
        return None
    return one
