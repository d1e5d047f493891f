"""What the rounds of closing a loop have in common: data, residuals, tests, and the time taken."""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pyro_dynogp.criticism.comparison import block_standard_error
from pyro_dynogp.discrepancy.blocks import Blocks, shared
from pyro_dynogp.discrepancy.confirm import Confirmed, certain, confirm
from pyro_dynogp.discrepancy.effects import Effect
from pyro_dynogp.discrepancy.evidence import Residuals
from pyro_dynogp.discrepancy.extend import (
    used_channels,
    without_process_noise,
)
from pyro_dynogp.discrepancy.gate import Beyond, beyond_catalogue, structure_left
from pyro_dynogp.discrepancy.refits import quick_fit
from pyro_dynogp.discrepancy.residuals import residuals_of
from pyro_dynogp.discrepancy.search import Found, look, merged
from pyro_dynogp.discrepancy.trials import forecast_density, forecast_errors, without
from pyro_dynogp.record import Record

if TYPE_CHECKING:
    from pyro_dynogp.inference.result import Fit

# Families of effects that go with inputs.
OF_INPUTS = ("paths", "shapes")
# An effect is doubtful where what no effect of the catalogue does gains so many times as much, and
# the effect is not seen beside it. (Where the effect is what was missing that gains at most as
# much, as products of an input resemble its square, and nothing once it is added.)
FAR = 2.0


class Stopwatch:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def stop(self, stage: str) -> None:
        """Add the time since the last stop to a stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now


@dataclass(frozen=True, eq=False)
class Looked:
    """What a round sees.

    Attributes:
        residuals: of every output. whole: those of the model without its process noise, also of
            what it was fitted to: what no part of the model can follow is left there as well.
        found: evidence of all effects but those that are known. notes: what else there is to say.
    """

    residuals: Sequence[Residuals]
    whole: Sequence[Residuals]
    found: Sequence[Found]
    notes: Sequence[str]


@dataclass(eq=False)
class Rounds:
    """One after the other on the same data, with the same options.

    Attributes:
        data: blocks. names: of candidate channels.
        seed, level, tries, effects, workers, progress: as of `close_loop`.
        held_out: (n,) samples of the known blocks that no fit of a round sees.
    """

    data: Blocks
    names: Sequence[str]
    seed: int
    level: float
    tries: int
    effects: Sequence[Effect]
    workers: int | None
    progress: bool
    held_out: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.held_out = self.data.held_out

    @property
    def gate(self) -> float:
        """Level of each of the two answers to whether anything is left: that of both, halved."""
        return self.level / 2.0

    def residuals(self, fit: Fit, record: Record, held_out: np.ndarray) -> list[Residuals]:
        """Of every output, with the candidates that the model does not use."""
        taken = used_channels(fit.model)
        free = [name for name in self.names if name not in taken]
        return [
            residuals_of(fit, record, held_out=held_out, candidates=free, output=a, seed=self.seed)
            for a in range(record.n_outputs)
        ]

    def look(self, fit: Fit, known: Collection[str]) -> Looked:
        """Residuals, and evidence of all effects but those that are known.

        Process noise can take up what inputs do, and a simulation with it explains less than it
        could: what goes with inputs is looked for in the residuals of a fit without it, too.
        """
        residuals = others = self.residuals(fit, self.data.known, self.held_out)
        effects = [e for e in self.effects if not (e.once and e.name in known)]
        options: dict[str, Any] = {
            "seed": self.seed, "workers": self.workers, "progress": self.progress,
        }  # fmt: skip
        found, notes = look(residuals, effects, **options)
        plain = without_process_noise(fit.model)
        if plain != fit.model:
            structural = [e for e in effects if e.family in OF_INPUTS and e.score == "forecast"]
            training = without(self.data.known, self.held_out)
            again = quick_fit(plain, training, self.seed, fit)
            others = self.residuals(again, self.data.known, self.held_out)
            found = merged(found, look(others, structural, **options)[0])
            if not known:  # of the model as given
                notes += self.hiding(fit, again)
        everywhere = np.ones(len(self.data.known), dtype=bool)
        whole = [replace(one, held_out=everywhere) for one in others]
        return Looked(residuals, whole, found, notes)

    def hiding(self, fit: Fit, plain: Fit) -> list[str]:
        """In words, whether a model forecasts held-out data better without its process noise."""
        record, held_out = self.data.known, self.held_out
        errors, densities = [], []
        for one in (fit, plain):
            error, sd = (x[held_out] for x in forecast_errors(one, record, held_out))
            errors.append(error)
            densities.append(forecast_density(error, sd))
        gain = (densities[1] - densities[0])[~record.missing[held_out]]
        if not certain(gain):
            return []
        before, after = (np.sqrt(np.nanmean(error**2, axis=0)) for error in errors)
        rmse = "; ".join(
            f"{name} {a:.3g} -> {b:.3g}"
            for name, a, b in zip(record.output_names, before, after, strict=True)
        )
        return [
            "The model as given forecasts held-out data better without its process noise (elpd "
            f"{gain.sum():+.1f} +- {block_standard_error(gain)[0]:.1f} nats, RMSE of {rmse}): such "
            "noise can hide what is missing. Fit it with process_noise=False, and close the loop "
            "on that."
        ]

    def confirm(self, chosen: Any, current: Fit, number: int) -> Confirmed:
        """Refit what is chosen in a round, and judge it."""
        return confirm(
            chosen, current, self.data.known, self.held_out, number=number,
            seed=self.seed, level=self.level, workers=self.workers, progress=self.progress,
        )  # fmt: skip

    def beyond(self, residuals: Sequence[Residuals]) -> list[Beyond]:
        """What no effect of the catalogue does in each output, nothing where that is not certain.

        Gains are zero there, and so is what is fitted.
        """
        tests = [beyond_catalogue(one, seed=self.seed) for one in residuals]
        return [
            one if one.p_value * len(tests) <= self.gate
            else Beyond(one.p_value, 0.0, np.zeros_like(one.fitted))
            for one in tests
        ]  # fmt: skip

    def doubtful(
        self, winner: Found, residuals: Sequence[Residuals], beyond: Sequence[Beyond]
    ) -> bool:
        """Whether what no effect of the catalogue does explains far more, and what the effect does.

        Args:
            winner: the effect. residuals: of every output, of the model without it.
            beyond: of each output.
        """
        if max(one.gain for one in beyond) <= FAR * winner.evidence.gain:
            return False
        rest = [
            replace(one, output=one.output - other.fitted)
            for one, other in zip(residuals, beyond, strict=True)
        ]
        # From the channel it was found in; noise is seen in innovations, which stay as they are.
        found, _ = look(rest, [winner.effect], seed=self.seed, workers=1)
        channel = winner.evidence.where.get("channel")
        again = [f.evidence for f in found if f.evidence.where.get("channel") == channel]
        return all(one.p_value > self.level for one in again)

    def hold_out_less(self, winner: Found) -> bool:
        """Give parts of B to the fit where an effect begins there; whether that was needed."""
        if not winner.effect.localised or (self.held_out != self.data.held_out).any():
            return False
        begin = self.data.known.time[int(np.argmax(self.held_out))]
        if float(winner.evidence.where.get("time", -np.inf)) < begin:
            return False
        self.held_out = shared(self.held_out)
        return True

    def left(self, looked: Looked) -> tuple[str, ...]:
        """What is left, in words: empty where nothing is.

        By the tests of single effects, all paid for, or else by the omnibus test.
        """
        named: dict[str, float] = {}
        for one in looked.found:  # an effect has several pieces of evidence, the best one first
            if one.q_value <= self.gate:
                named.setdefault(one.effect.name, one.q_value)
        if named:
            rates = ", ".join(f"{name} ({q:.2g})" for name, q in named.items())
            return (f"Residual tests speak for (false discovery rate): {rates}.",)
        omnibus = [
            structure_left(one, other, seed=self.seed)
            for one, other in zip(looked.residuals, looked.whole, strict=True)
        ]
        return tuple(said for p, said in omnibus if p * len(omnibus) <= self.gate)
