"""Refits of a round: which are made, on which blocks, and how long they may go on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import joblib
import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.failures import TimeLimitError
from pyro_dynogp.discrepancy.judged import MORE, SPREAD, Judged, Kind, judge, kind_of
from pyro_dynogp.discrepancy.search import Candidate, Found
from pyro_dynogp.discrepancy.stretches import interleaved
from pyro_dynogp.discrepancy.trials import Ahead, Trial, Tried, run, with_substeps
from pyro_dynogp.fitting import Fit
from pyro_dynogp.inference.bayes_factor import VERY_STRONG, log_evidence_of
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.delays import comparable
from pyro_dynogp.models.feedback_variants import is_parametric
from pyro_dynogp.models.variants import Model, without_process_noise
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.support.parallel import parallel_map


@dataclass(eq=False)
class Refits:
    """Refits of a round, and what they say: each block is fitted once.

    Attributes:
        current: fit of the model that is extended, to what is not held out.
        record: blocks A and B. held_out: (n,) True in B.
        number: of the round. seed, settings, workers, progress, late: as of `confirm`.
        begin: sample where the last of the candidates of one instant happens, 0 for none.
        weighed: as of `confirm`.
        results: of the trials so far, by the models and how they are scored.
        evidences: of models that are fitted to all known data, by model and samples [nats].
        early: whether the time limit was passed with trials to go.
    """

    current: Fit
    record: Record
    held_out: np.ndarray
    number: int
    seed: int
    settings: LoopSettings
    workers: int | None
    progress: bool
    late: Callable[[], bool] | None = None
    begin: int = 0
    weighed: bool = False
    results: dict[tuple[str, Kind], Tried] = field(default_factory=dict)
    evidences: dict[tuple[str, int], float] = field(default_factory=dict)
    early: bool = False

    @cached_property
    def model(self) -> Model:
        """The model that is extended."""
        return replace(self.current.model, scaling=None)

    def trial(
        self,
        models: tuple[Model, ...],
        kind: Kind,
        found: Found | None,
        base: Fit | None = None,
    ) -> Trial:
        """Of variants of an effect; without one of the model itself, or of one that extends a fit.

        Args:
            models: the variants. kind: how they are scored. found: the effect, None for none.
            base: the fit to start from; None for that of the model itself.
        """
        where, score = kind
        known = self.current if found is None and base is None and where == "after" else None
        spread = interleaved(len(self.record), self.settings.folds, self.begin)
        folds = spread if where == "spread" else (self.held_out,)
        start = self.current if base is None else base
        plain = Trial(models, self.record, folds, start, self.seed, self.settings, score, fit=known)
        if found is None:
            return plain
        return replace(plain, refine=found.effect.refine, compared=found.effect.compared)

    def run(self, tasks: dict[Any, Trial], label: str) -> dict[Any, Tried]:
        """Results by key; with a time limit of as many trials at a time as workers, until then."""
        workers = self.workers or joblib.cpu_count()
        bar = f"{label}, round {self.number}"
        long = [key for key, trial in tasks.items() if trial.is_long]
        plain = [key for key in tasks if key not in long]
        step = max(len(plain) if self.late is None else workers, 1)
        done: dict[Any, Tried] = {}

        def is_late() -> bool:
            self.early = self.early or (self.late is not None and self.late())
            return self.early

        for begin in range(0, len(plain), step):
            if is_late():
                return done
            some = plain[begin : begin + step]
            trials = [tasks[key] for key in some]
            tried = parallel_map(
                run, trials, workers=self.workers, progress=self.progress, description=bar
            )
            done.update(zip(some, tried, strict=True))
        # Trials that take most of the time have all processors, one after the other.
        ahead = Ahead(workers, f"variants, round {self.number}" if self.progress else "", self.late)
        try:
            for key in long:
                if is_late():
                    break
                (done[key],) = parallel_map(lambda one: run(one, ahead), [tasks[key]], workers=1)
        except TimeLimitError:
            self.early = True
        return {key: done[key] for key in tasks if key in done}

    def judge(self, candidates: Sequence[Candidate]) -> list[Judged]:
        """Candidates, each against the model without it; those that were refitted in time."""
        # Two effects may be the same block of the model: it is fitted once.
        kinds = [kind_of(found) for found, _ in candidates]
        tasks = {("", kind): self.trial((self.model,), kind, None) for kind in kinds}
        for (found, variants), kind in zip(candidates, kinds, strict=True):
            tasks[repr(variants), kind] = self.trial(variants, kind, found)
        self._run_new(tasks, "refits")
        return [
            self.judged(found, kind, self.results[repr(variants), kind])
            for (found, variants), kind in zip(candidates, kinds, strict=True)
            if (repr(variants), kind) in self.results
        ]

    def judged(self, found: Found, kind: Kind, tried: Tried) -> Judged:
        """One candidate against the model without it."""
        base = self.results["", kind]
        return judge(found, kind, tried, base, self.number, self.settings)

    def against_refit(self, one: Judged) -> Judged:
        """A candidate that helps, against the model without it, refitted from where it ended.

        Models with functions have long ridges: whatever is added, a refit climbs along them, and
        forecasts change by tens of nats. What the model gains without the effect is no gain of it.
        """
        if not self.model.has_function or not self.judged(one.found, one.kind, one.tried).helps:
            return one  # the latter are confirmed together with another
        trial = self.trial((self.model,), one.kind, None, base=one.tried.fit)
        key = (f"without {one.tried.model!r}", one.kind)
        self._run_new({key: trial}, "refits without")
        tried = self.results.get(key)
        if tried is None or tried.failure:
            return one
        again = judge(one.found, one.kind, one.tried, tried, self.number, self.settings)
        if again.attempt.gain >= one.attempt.gain:
            return one
        reason = (
            f"{one.attempt.reason}; over the model without it, refitted, {again.attempt.reason}"
        )
        return replace(again, attempt=replace(again.attempt, reason=reason))

    def supported(self, one: Judged) -> Judged:
        """A candidate that helps, if all known data speak for it, once models are fitted to them.

        Where poles, gains or levels were badly known before block B, what is wrong there may look
        like a step or a drift, and the model with that forecasts better. What parameters learn from
        B is no effect. Evidence is Laplace's. (Effects of inputs are looked for in all data, and
        need none where tests are certain that something is missing.)
        """
        known = one.found.effect.acts_on == "inputs" and not self.weighed
        if known or one.tried.fit is None or not one.helps:
            return one
        return one if self.evidence(one) > VERY_STRONG else self._weighed(one, False)

    def by_evidence(self, judged: Sequence[Judged], level: float) -> list[Judged]:
        """Where nothing helps for certain, what nearly does helps if all known data speak for it.

        Where most of a gain comes from a few stretches of a short block its error is as large, of
        whatever is right; the residual is certain (see `unsure`) and evidence is very strong.
        Some need gain nothing for certain, as long as they gain (`_may_be_weighed`).
        Where no test is certain of anything (`weighed`) structure that nearly helps needs twice the
        evidence: it stands alone.
        """
        alone = self.weighed and all(one.kind[1] == "forecast" for one in judged)
        level = 1.0 if alone else min(level, self.settings.unsure)
        least = 2.0 * VERY_STRONG if alone else VERY_STRONG
        if any(one.helps for one in judged):
            return list(judged)
        return [
            self._weighed(one, True)
            if self._may_be_weighed(one, level) and self.evidence(one) > least
            else one
            for one in judged
        ]

    def _weighed(self, one: Judged, helps: bool) -> Judged:
        """A candidate that evidence has decided on."""
        gain = self.evidence(one)
        said = (
            f"fitted to all known data, the evidence for it is {gain:+.1f} nats"
            if np.isfinite(gain)
            else "could not be fitted to all known data"
        )
        parts = [part for part in one.attempt.reason.split("; ") if not part.endswith(MORE)]
        attempt = replace(one.attempt, reason="; ".join([*parts, said]))
        return replace(one, attempt=attempt, helps=helps)

    def evidence(self, one: Judged) -> float:
        """Of a candidate over the model without it, both fitted to all known data [nats].

        Of parametric functions both are without process noise, as forecasts are: it explains one
        step ahead what either model lacks, and where free runs speak against it one has none.
        Minus infinity where one of them cannot be fitted to them.
        """
        assert one.tried.fit is not None
        models = (self.model, one.tried.model)
        if self._adds_forms(one):
            models = (without_process_noise(self.model), without_process_noise(one.tried.model))
        same = comparable(self.record, models, self.settings.reach)
        pair = tuple(zip((self.current, one.tried.fit), models, strict=True))
        for fit, model in pair:
            if (repr(model), len(same)) not in self.evidences:
                try:
                    found = refit(fit, same, model=model, run=Run(self.seed, workers=1))
                except ValueError:
                    return -math.inf
                self.evidences[repr(model), len(same)] = log_evidence_of(found)
        without, extended = (self.evidences[repr(model), len(same)] for _, model in pair)
        return extended - without

    def with_substeps(self, one: Judged) -> Tried:
        """What was kept of a candidate, with substeps where they are better and time is left."""
        if self.late is not None and self.late():
            return one.tried
        return with_substeps(self._as_kept(one, one.kind), one.tried)

    def on_one_scale(self, better: Sequence[Judged]) -> list[Judged]:
        """The same candidates scored alike, since gains on different densities do not compare."""
        if len({one.kind for one in better}) == 1:
            return list(better)
        spread = self.on_spread_blocks(better)
        if self.early:
            return list(better)
        return [
            one if one.kind == SPREAD
            else self.judged(one.found, SPREAD, spread[repr(one.tried.model)])
            for one in better
        ]  # fmt: skip

    def on_spread_blocks(self, several: Sequence[Judged]) -> dict[str, Tried]:
        """What is scored otherwise, on blocks spread over the record instead, by its model.

        Against the model without it, which is scored there, too.
        """
        trials = {
            (repr(one.tried.model), SPREAD): self._as_kept(one, SPREAD)
            for one in several
            if one.kind != SPREAD
        }
        if trials:
            base = {("", SPREAD): self.trial((self.model,), SPREAD, None)}
            self._run_new(trials | base, "refits once more")
        return {key[0]: self.results[key] for key in trials if key in self.results}

    def _as_kept(self, one: Judged, kind: Kind) -> Trial:
        """Of the variant that was kept of a candidate, with the numbers that it has."""
        return self.trial((one.tried.model,), kind, None, base=self.current)

    def _run_new(self, tasks: dict[tuple[str, Kind], Trial], label: str) -> None:
        """Keep the results of trials that there are none of yet."""
        new = {key: trial for key, trial in tasks.items() if key not in self.results}
        self.results.update(self.run(new, label))

    def settled(self, judged: Sequence[Judged], level: float) -> list[Judged]:
        """What may be worth most on the last block, scored on blocks of the whole record as well.

        Where the residual speaks for an effect without a doubt (its false discovery rate is no more
        than `unsure`), and its gain is more than that of all that help, if short of its error, most
        of the record is held out instead, a part at a time.

        So it is, where nothing helps, of what loses there, but not for certain, if it goes with
        inputs and has no functions: its gain may be too uncertain before the block to forecast it.
        What has functions, or goes with time, fails where it is taken beyond what it was learnt
        from, and the last block is where that shows.
        """
        level = min(level, self.settings.unsure)
        most = max((one.attempt.gain for one in judged if one.helps), default=-math.inf)
        unsettled = [
            one for one in judged
            if not (one.helps or one.harms) and one.kind != SPREAD
            and one.attempt.gain > (most if self._may_lose(one) else max(most, 0.0))
            and one.found.q_value <= level
        ]  # fmt: skip
        spread = self.on_spread_blocks(unsettled)
        if self.early:
            return list(judged)

        def again(one: Judged) -> Judged:
            two = self.judged(one.found, SPREAD, spread[repr(one.tried.model)])
            reason = f"{one.attempt.reason}; on blocks of the whole record {two.attempt.reason}"
            # Evidence of training data is no match for forecasts that are certainly worse.
            kept = two if two.helps else replace(one, harms=two.harms)
            return replace(kept, attempt=replace(kept.attempt, reason=reason))

        return [again(one) if one in unsettled else one for one in judged]

    def _may_be_weighed(self, one: Judged, level: float) -> bool:
        """Whether a candidate nearly helps, or gains where no more can be expected.

        The latter where tests are certain: of effects that are `settled_by_evidence`, and of
        parametric functions in feedback, of whose few numbers short blocks tell too little.
        """
        if one.harms or one.tried.fit is None or one.found.q_value > level:
            return False
        exempt = self._adds_forms(one) or one.found.effect.settled_by_evidence
        gains = exempt and not self.weighed and one.attempt.gain > 0.0
        return one.attempt.decision == "nearly" or gains

    def _adds_forms(self, one: Judged) -> bool:
        """Whether it adds parametric functions in feedback."""
        return is_parametric(one.tried.model) and not is_parametric(self.model)

    def _may_lose(self, one: Judged) -> bool:
        """Whether a loss on the last block is neither certain nor one of a wrong shape."""
        attempt, effect = one.attempt, one.found.effect
        stiff = not one.tried.model.has_function and effect.acts_on == "inputs"
        return stiff and attempt.gain > -self.settings.standard_errors * attempt.gain_error
