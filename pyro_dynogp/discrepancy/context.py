"""What the rounds of closing a loop have in common: data, residuals, tests, and the time taken."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pyro_dynogp.criticism.comparison import block_standard_error
from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.blocks import Blocks
from pyro_dynogp.discrepancy.decision import Confirmed, confirm
from pyro_dynogp.discrepancy.held_out import certain, forecast_density, forecast_errors, without
from pyro_dynogp.discrepancy.residuals import free_run_of, residuals_of
from pyro_dynogp.discrepancy.search import Found, look, rated
from pyro_dynogp.discrepancy.stretches import latest, shared
from pyro_dynogp.effects import Effect
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.variants import (
    used_channels,
    with_process_noise,
    without_process_noise,
)
from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.omnibus import Beyond, beyond_catalogue, structure_left
from pyro_dynogp.statistics.settings import LoopSettings

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit


class Stopwatch:
    """Seconds by stage, and whether a limit of all of them together has passed."""

    def __init__(self, limit: float | None = None) -> None:
        self.seconds: dict[str, float] = {}
        self.limit = limit
        self._begin = self._last = time.perf_counter()

    def late(self) -> bool:
        """Whether more than the limit has passed since the watch was made."""
        return self.limit is not None and time.perf_counter() - self._begin > self.limit

    def stop(self, stage: str) -> None:
        """Add the time since the last stop to a stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now


@dataclass(frozen=True, eq=False)
class Tested:
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


@dataclass(frozen=True)
class Left:
    """What tests say of whether anything is left.

    Attributes:
        said: in words, of what is; empty where nothing is.
        p_values: of the omnibus test of each output, paid for by their number; NaN where it cannot
            be tested, none where single effects have answered.
        untested: in words, why an output was not tested for anything else.
    """

    said: tuple[str, ...] = ()
    p_values: tuple[float, ...] = ()
    untested: tuple[str, ...] = ()


@dataclass(eq=False)
class SearchContext:
    """One after the other on the same data, with the same options.

    Attributes:
        data: blocks. names: of candidate channels.
        seed, level, tries, effects, workers, progress, settings: as of `close_loop`.
        late: says whether the time limit has passed; None for none.
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
    settings: LoopSettings
    late: Callable[[], bool] | None = None
    held_out: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.held_out = self.data.held_out

    @property
    def looked_at(self) -> np.ndarray:
        """Samples (n,) whose residuals are tested: those held out, or all where none is."""
        return self.held_out if self.held_out.any() else np.ones_like(self.held_out)

    @property
    def gate(self) -> float:
        """Level of each of the two answers to whether anything is left: that of both, halved."""
        return self.level * self.settings.gate

    def residuals(self, fit: Fit, record: Record, held_out: np.ndarray) -> list[Residuals]:
        """Of every output, with the candidates that the model does not use."""
        taken = used_channels(fit.model)
        free = [name for name in self.names if name not in taken]
        run = free_run_of(fit, record, held_out=held_out, seed=self.seed, settings=self.settings)
        return [
            residuals_of(
                fit,
                record,
                held_out=held_out,
                candidates=free,
                output=a,
                seed=self.seed,
                settings=self.settings,
                run=run,
            )
            for a in range(record.n_outputs)
        ]

    def look(self, fit: Fit, known: Collection[str], plain: Fit | None = None) -> Tested:
        """Residuals, and evidence of all effects but those that are known.

        What goes with inputs is looked for in all known data, and in what the model leaves without
        its process noise, which takes up what inputs do. (A residual of what was fitted is nearer
        to zero than the noise; tests on it err on the safe side.) What goes with time or is noise
        is looked for in block B, which the fit has not seen: it follows both.

        Args:
            fit: of the model so far. known: names of effects that it has.
            plain: fit without process noise, where there is one already.
        """
        residuals = self.residuals(fit, self.data.known, self.looked_at)
        plain = self.plain(fit) if plain is None else plain
        left = residuals
        if plain is not fit:
            left = self.residuals(plain, self.data.known, self.looked_at)
        everywhere = np.ones(len(self.data.known), dtype=bool)
        whole = [replace(one, held_out=everywhere) for one in left]
        effects = [e for e in self.effects if not (e.once and e.name in known)]
        of_inputs = [e for e in effects if e.acts_on == "inputs"]
        others = [e for e in effects if e not in of_inputs]
        found, notes = [], []
        for where, some in ((whole, of_inputs), (residuals, others)):
            seen, skipped = look(
                where,
                some,
                self.settings,
                seed=self.seed,
                workers=self.workers,
                progress=self.progress,
            )
            found += [(one.effect, one.evidence) for one in seen]
            notes += skipped
        return Tested(residuals, whole, rated(found), notes)

    def plain(self, fit: Fit) -> Fit:
        """Fit without process noise, to the same data; the fit itself where it has none."""
        model = without_process_noise(fit.model)
        if model == fit.model:
            return fit
        return self.refit(fit, model)

    def refit(self, fit: Fit, model: Model) -> Fit:
        """Mode of a model that extends that of a fit, on what is not held out."""
        training = without(self.data.known, self.held_out)
        return refit(fit, training, model=model, run=Run(self.seed, workers=1))

    def hiding(self, fit: Fit, plain: Fit) -> str:
        """In words, that the model forecasts held-out data better without its process noise.

        Empty where it does not.
        """
        if plain is fit:
            return ""
        record, held_out = self.data.known, self.held_out
        errors, densities = [], []
        for one in (fit, plain):
            error, sd = (x[held_out] for x in forecast_errors(one, record, held_out))
            errors.append(error)
            densities.append(forecast_density(error, sd))
        gain = (densities[1] - densities[0])[~record.missing[held_out]]
        if not certain(gain, self.settings):
            return ""
        before, after = (np.sqrt(np.nanmean(error**2, axis=0)) for error in errors)
        rmse = "; ".join(
            f"{name} {a:.3g} -> {b:.3g}"
            for name, a, b in zip(record.output_names, before, after, strict=True)
        )
        return (
            f"forecasts held-out data better without its process noise (elpd {gain.sum():+.1f} +- "
            f"{block_standard_error(gain)[0]:.1f} nats, RMSE of {rmse})"
        )

    def with_process_noise(self, fit: Fit) -> Fit | None:
        """Fit with process noise, to the same data; None where that costs forecasts still."""
        noisy = self.refit(fit, with_process_noise(fit.model))
        return None if self.hiding(noisy, fit) else noisy

    def confirm(self, chosen: Any, current: Fit, number: int, weighed: bool) -> Confirmed:
        """Refit what is chosen in a round, and judge it; see `decision.confirm`."""
        return confirm(
            chosen, current, self.data.known, self.held_out, number=number,
            seed=self.seed, level=self.level, settings=self.settings, workers=self.workers,
            progress=self.progress, late=self.late, weighed=weighed,
        )  # fmt: skip

    def beyond(self, residuals: Sequence[Residuals]) -> list[Beyond]:
        """What no effect of the catalogue does in each output, nothing where that is not certain.

        Gains are zero there, and so is what is fitted; also where too few samples are measured.
        """
        tests = [self._beyond(one) for one in residuals]
        return [
            one if one.p_value * len(tests) <= self.gate
            else Beyond(one.p_value, 0.0, np.zeros_like(one.fitted))
            for one in tests
        ]  # fmt: skip

    def _beyond(self, residuals: Residuals) -> Beyond:
        try:
            return beyond_catalogue(residuals, self.settings, self.seed)
        except ValueError:  # too few samples are measured
            return Beyond(1.0, 0.0, np.zeros(len(residuals)))

    def doubtful(
        self, winner: Found, residuals: Sequence[Residuals], beyond: Sequence[Beyond]
    ) -> bool:
        """Whether what no effect of the catalogue does explains far more, and what the effect does.

        Where the effect is what was missing that gains at most as much, as products of an input
        resemble its square, and nothing once it is added.

        Args:
            winner: the effect. residuals: of every output, of the model without it.
            beyond: of each output.
        """
        if max(one.gain for one in beyond) <= self.settings.outside * winner.evidence.gain:
            return False
        if winner.effect.score == "one step":  # innovations do not tell what would be left
            return True
        rest = [
            replace(one, output=one.output - other.fitted)
            for one, other in zip(residuals, beyond, strict=True)
        ]
        # From the channel it was found in.
        found, _ = look(rest, [winner.effect], self.settings, seed=self.seed, workers=1)
        channel = winner.evidence.where.get("channel")
        again = [f.evidence for f in found if f.evidence.where.get("channel") == channel]
        return all(one.p_value > self.level for one in again)

    def hold_out_less(self, winner: Found) -> bool:
        """Give parts of B to the fit where an effect begins there; whether that was needed."""
        if not winner.effect.localised or (self.held_out != self.data.held_out).any():
            return False
        begin = latest([winner.evidence], self.data.known)
        if begin < int(np.argmax(self.held_out)):
            return False
        self.held_out = shared(self.held_out, self.settings.stretches, begin)
        return True

    def left(self, looked: Tested) -> Left:
        """What is left: by tests of single effects, all paid for, or else by the omnibus test."""
        named: dict[str, float] = {}
        for one in looked.found:  # an effect has several pieces of evidence, the best one first
            if one.q_value <= self.gate:
                named.setdefault(one.effect.name, one.q_value)
        if named:
            rates = ", ".join(f"{name} ({q:.2g})" for name, q in named.items())
            return Left((f"Residual tests are evidence for (false discovery rate): {rates}.",))
        p_values, said, untested = [], [], []
        for own, other in zip(looked.residuals, looked.whole, strict=True):
            p, words = np.nan, ""
            try:
                p, words = structure_left(
                    own, self.settings, self.level, plain=other, seed=self.seed
                )
            except ValueError as error:  # where no fit has seen them too few samples are measured
                untested.append(
                    f"Whether anything else is left in {own.output_name!r} was not tested: {error}"
                )
            p_values.append(float(np.minimum(p * len(looked.residuals), 1.0)))
            if p_values[-1] <= self.gate:
                said.append(words)
        return Left(tuple(said), tuple(p_values), tuple(untested))

    def explained(self, fit: Fit, known: Collection[str]) -> bool:
        """Whether a model leaves nothing once it is fitted to all known data, block B as well.

        What poles and gains do that were badly known before B looks like structure there. Tests on
        what was fitted err on the safe side, but what a model cannot follow is left in all data.

        Args:
            fit: of the model to what is not held out. known: names of effects that it has.
        """
        whole = replace(self)
        whole.held_out = np.zeros_like(self.held_out)
        again = whole.refit(fit, replace(fit.model, scaling=None))
        return not whole.left(whole.look(again, known)).said
