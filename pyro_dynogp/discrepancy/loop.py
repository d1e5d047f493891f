"""Close the loop: find the residual, name the effect, add it, report the error before and after."""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pyro_dynogp._errors import invalid
from pyro_dynogp.criticism.comparison import block_standard_error
from pyro_dynogp.discrepancy import words
from pyro_dynogp.discrepancy.blocks import Blocks, blocks_of, shared
from pyro_dynogp.discrepancy.confirm import Confirmed, confirm
from pyro_dynogp.discrepancy.effects import CATALOGUE, Effect
from pyro_dynogp.discrepancy.evidence import Residuals
from pyro_dynogp.discrepancy.extend import (
    Model,
    has_function,
    used_channels,
    without_process_noise,
)
from pyro_dynogp.discrepancy.gate import structure_left
from pyro_dynogp.discrepancy.noise_effects import data_faults
from pyro_dynogp.discrepancy.parameters import limits_of, parameters_of
from pyro_dynogp.discrepancy.refits import poles_of, quick_fit
from pyro_dynogp.discrepancy.report import Attempt, FoundEffect, Report
from pyro_dynogp.discrepancy.residuals import residuals_of
from pyro_dynogp.discrepancy.search import Found, candidates_of, look, merged
from pyro_dynogp.discrepancy.trials import one_step_density, without
from pyro_dynogp.inference.fit import fit as fit_model
from pyro_dynogp.inference.result import Method
from pyro_dynogp.models.cascade import Cascade
from pyro_dynogp.parallel import one_thread, parallel_map
from pyro_dynogp.prediction.clock import joined
from pyro_dynogp.prediction.scores import scores
from pyro_dynogp.record import Record

if TYPE_CHECKING:
    from pyro_dynogp.inference.result import Fit

# Families of effects that go with inputs.
OF_INPUTS = ("paths", "shapes")
# Fresh starts of the last fits, of linear models and of cascades.
LAST_LINEAR_STARTS, LAST_CASCADE_STARTS = 2, 1
SCORES = ("rmse", "mae", "nrmse", "crps", "coverage_50", "coverage_95")


@one_thread()
def close_loop(
    fit: Fit,
    record: Record,
    *,
    candidates: Sequence[str] | Record | None = None,
    seed: int = 0,
    max_rounds: int = 4,
    level: float = 0.05,
    tries: int = 8,
    effects: Sequence[Effect] = CATALOGUE,
    workers: int | None = None,
    progress: bool = True,
) -> Report:
    """Say what a fitted model lacks, add it, and report the error before and after.

    Block A is what the model is fitted to, B is searched, C is opened once, at the end. A round
    first asks whether there is any structure in the residuals at all (an omnibus test, or a false
    discovery rate below `level` for one effect); if so, effects whose test rejects at `level`, and
    their nearest relatives, are added to the model one at a time and fitted to A; the one that
    raises the log-density of held-out data most is kept if it does so by more than two block
    standard errors and 4 nats (or, as outliers make both large, with no sample counted for more
    than 10 nats), effects between inputs and output before those of the noise, which their lack
    imitates. Of effects that explain as much the one that leaves least open is kept, and
    the others are reported as ties. Rounds end where nothing is left, or nothing helps. An effect
    that no block mends (feedback) is among the report's effects, after those that were added.

    Args:
        fit: a fit to one record.
        record: the training record, its continuation, or both; see `discrepancy.blocks`.
        candidates: extra channels that may act: names in ``record.extra`` (None: all of them), or
            a record on the same times whose channels they are.
        seed: the same seed gives the same report. max_rounds: most effects that are added.
        level: of the tests. tries: most effects that are refitted in a round.
        effects: what is looked for, `CATALOGUE` and your own.
        workers: processes; None for all processors, or the cluster of
            ``joblib.parallel_config``. progress: whether to show progress bars.

    Raises:
        ValueError: on blocks that are too short, unknown candidates, numbers that make no sense.
    """
    if not isinstance(max_rounds, int) or max_rounds < 1:
        raise invalid("max_rounds", expected="a whole number >= 1", got=repr(max_rounds))
    if not 0.0 < level < 1.0:
        raise invalid("level", expected="a number between 0 and 1", got=repr(level))
    clock = _Clock()
    other = candidates if isinstance(candidates, Record) else None
    data = blocks_of(fit, record, other)
    names = _names(fit, data.known, candidates)
    training = without(data.known, data.held_out)
    # As far up as its extensions will get: what a better climb gains is no effect.
    first = quick_fit(
        fit.model, training, seed, None if data.refit else fit.at_mode(), poles=poles_of(fit)
    )
    current = first
    clock.next("fit of block A")
    state = _State(data, names, seed, level, tries, effects, workers, progress)
    model: Model = replace(fit.model, scaling=None)
    attempts: list[Attempt] = []
    accepted: list[tuple[Found, Confirmed]] = []
    reported: list[Found] = []
    warnings: list[str] = []
    left = False
    for number in range(1, max_rounds + 1):
        known = {one.effect.name for one, _ in accepted}
        residuals, found, skipped = state.look(current, known)
        clock.next("residual tests")
        if number == 1:
            warnings += [*_faults(residuals, data.known), *skipped]
        reported = _reported(found, level)
        left = state.structure(residuals, found)
        chosen = candidates_of(found, model, data.known, level, tries) if left else []
        attempts += _untried(found, chosen, level, number)
        if not chosen:
            break
        confirmed = state.confirm(chosen, current, number)
        clock.next("refits")
        attempts += confirmed.attempts
        if confirmed.winner is None or confirmed.model is None:
            break
        accepted.append((confirmed.winner, confirmed))
        model = confirmed.model
        again = state.hold_out_less(confirmed.winner)
        if confirmed.fit is not None and not again:
            current = confirmed.fit
        else:
            training = without(data.known, state.held_out)
            current = quick_fit(model, training, seed, current)
        clock.next("refits")
    else:  # rounds are spent; whether something is left is still to be said
        residuals, found, _ = state.look(current, {one.effect.name for one, _ in accepted})
        left = state.structure(residuals, found)
        reported = _reported(found, level)
        clock.next("residual tests")
    fits = [first, current] if accepted else [first]
    fitted = _final(fits, data.known, workers, progress)
    base, extended = fitted[0], fitted[-1]
    clock.next("last fits")
    return _report(base, extended, state, accepted, reported, attempts, warnings, left, clock)


class _Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def next(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now


class _State:
    """What rounds have in common."""

    def __init__(
        self,
        data: Blocks,
        names: Sequence[str],
        seed: int,
        level: float,
        tries: int,
        effects: Sequence[Effect],
        workers: int | None,
        progress: bool,
    ) -> None:
        self.data, self.names, self.seed = data, names, seed
        self.held_out = data.held_out
        self.level, self.tries, self.effects = level, tries, effects
        self.workers, self.progress = workers, progress

    def residuals(self, fit: Fit, record: Record, held_out: np.ndarray) -> list[Residuals]:
        taken = used_channels(fit.model)
        free = [name for name in self.names if name not in taken]
        return [
            residuals_of(fit, record, held_out=held_out, candidates=free, output=a, seed=self.seed)
            for a in range(record.n_outputs)
        ]

    def look(
        self, fit: Fit, known: Collection[str]
    ) -> tuple[list[Residuals], list[Found], list[str]]:
        """Residuals, evidence of all effects but those that are known, what was not tested.

        Process noise can take up what inputs do, and a simulation with it explains less than it
        could: what goes with inputs is looked for in the residuals of a fit without it, too.
        """
        residuals = self.residuals(fit, self.data.known, self.held_out)
        effects = [e for e in self.effects if not (e.once and e.name in known)]
        options: dict[str, Any] = {
            "seed": self.seed, "workers": self.workers, "progress": self.progress,
        }  # fmt: skip
        found, skipped = look(residuals, effects, **options)
        plain = without_process_noise(fit.model)
        if plain != fit.model:
            structural = [e for e in effects if e.family in OF_INPUTS and e.score == "forecast"]
            training = without(self.data.known, self.held_out)
            again = quick_fit(plain, training, self.seed, fit)
            others = self.residuals(again, self.data.known, self.held_out)
            found = merged(found, look(others, structural, **options)[0])
        return residuals, found, skipped

    def confirm(self, chosen: Any, current: Fit, number: int) -> Confirmed:
        return confirm(
            chosen, current, self.data.known, self.held_out, number=number,
            seed=self.seed, level=self.level, workers=self.workers, progress=self.progress,
        )  # fmt: skip

    def hold_out_less(self, winner: Found) -> bool:
        """Give parts of B to the fit where an effect begins there; whether that was needed."""
        if not winner.effect.localised or (self.held_out != self.data.held_out).any():
            return False
        begin = self.data.known.time[int(np.argmax(self.held_out))]
        if float(winner.evidence.where.get("time", -np.inf)) < begin:
            return False
        self.held_out = shared(self.held_out)
        return True

    def structure(self, residuals: Sequence[Residuals], found: Sequence[Found]) -> bool:
        """Whether anything is left: by the omnibus test, or by one of the others, all paid for."""
        if min((f.q_value for f in found), default=1.0) < self.level:
            return True
        omnibus = min(structure_left(one, seed=self.seed)[0] for one in residuals)
        return min(1.0, omnibus * len(residuals)) < self.level


def _faults(residuals: Sequence[Residuals], record: Record) -> list[str]:
    """Faults of the data, in words; samples that tests leave out are none."""
    whole = [replace(one, output=record.outputs[:, a]) for a, one in enumerate(residuals)]
    return [text for one in whole for text in data_faults(one)]


def _names(fit: Fit, record: Record, candidates: Sequence[str] | Record | None) -> list[str]:
    """Candidate channels, in the order of their names, so that the record's order is no matter."""
    if isinstance(candidates, str):
        raise invalid("candidates", expected="a list of names", got=repr(candidates))
    if candidates is None:
        names = list(record.extra)
    elif isinstance(candidates, Record):
        names = [*candidates.input_names, *candidates.output_names, *candidates.extra]
    else:
        names = list(candidates)
        unknown = sorted(set(names) - set(record.extra))
        if unknown:
            raise invalid(
                "candidates", expected=f"extra channels {list(record.extra)}", got=f"{unknown}"
            )
    return sorted(set(names) - used_channels(fit.model))


def _reported(found: Sequence[Found], level: float) -> list[Found]:
    """What no block mends. Of the last tests: what a model lacks may look like feedback, too."""
    return [f for f in found if not f.effect.added and f.q_value <= level]


def _untried(
    found: Sequence[Found], chosen: Sequence[tuple[Found, Any]], level: float, number: int
) -> list[Attempt]:
    """Effects that the residual speaks for, but that were not refitted."""
    tried = [one for one, _ in chosen]
    return [
        Attempt(
            number, f.evidence, f.q_value,
            "not tried" if f.effect.added else "reported",
            "others are more probable, or no block of the model stands for it" if f.effect.added
            else "is reported, not added",
        )
        for f in found
        if f.q_value <= level and not any(f is one for one in tried)
    ]  # fmt: skip


def _final(fits: Sequence[Fit], record: Record, workers: int | None, progress: bool) -> list[Fit]:
    """Models of block A fitted to A and B, from what they have learnt and from fresh starts.

    Refits of the search are posterior modes; here the posterior of static functions is wanted.
    """

    def one(given: Fit) -> Fit:
        model = replace(given.model, scaling=None)
        method: Method = "svi" if has_function(model) or given.method != "map" else "map"
        restarts = LAST_CASCADE_STARTS if isinstance(model, Cascade) else LAST_LINEAR_STARTS
        return fit_model(
            model, record, method=method, start=given, restarts=restarts, seed=given.seed,
            workers=1, progress=False,
        )  # fmt: skip

    return parallel_map(one, fits, workers=workers, progress=progress, description="last fits")


def _report(
    base: Fit,
    extended: Fit,
    state: _State,
    accepted: Sequence[tuple[Found, Confirmed]],
    reported: Sequence[Found],
    attempts: Sequence[Attempt],
    warnings: Sequence[str],
    left: bool,
    clock: _Clock,
) -> Report:
    """Open block C, once."""
    data = state.data
    forecasts = [one.forecast(data.known, data.sealed, seed=state.seed) for one in (base, extended)]
    before, after = ({k: _mean(v) for k, v in scores(f, data.sealed).items() if k in SCORES}
                     for f in forecasts)  # fmt: skip
    whole = joined(data.known, data.sealed)
    sealed = np.zeros(len(whole), dtype=bool)
    sealed[len(data.known) :] = True
    densities = [one_step_density(one, whole)[sealed] for one in (base, extended)]
    there = np.isfinite(densities[0])
    gain = densities[1][there] - densities[0][there]
    clock.next("scores of the last block")
    tests = _tested([f for f, _ in accepted], (base, extended), whole, sealed, state)
    clock.next("residual tests of the last block")
    effects = [_effect(f, c, extended, data.known) for f, c in accepted]
    clock.next("numbers of the effects")
    return Report(
        effects=(*effects, *(_only_reported(f) for f in reported)),
        outcome=_outcome(bool(accepted), left),
        before=before,
        after=after,
        elpd_gain=float(gain.sum()),
        elpd_gain_error=block_standard_error(gain)[0],
        fit=extended,
        base=base,
        attempts=tuple(attempts),
        warnings=tuple(warnings),
        data=data.sentence,
        tests=tests,
        sealed=data.sealed,
        known=data.known,
        forecast_before=forecasts[0],
        forecast_after=forecasts[1],
        model_before=words.describe(base.model),
        model_after=words.describe(extended.model),
        seconds=dict(clock.seconds),
    )


def _outcome(added: bool, left: bool) -> str:
    if added:
        return "effects added, structure left" if left else "effects added"
    return "structure left, cause unknown" if left else "nothing missing"


def _tested(
    found: Sequence[Found], fits: Sequence[Fit], whole: Record, sealed: np.ndarray, state: _State
) -> dict[str, tuple[float, float]]:
    """Smallest p-value of each effect's tests on C, of the model before and after."""
    effects = list({f.effect.name: f.effect for f in found}.values())
    if not effects:
        return {}
    residuals = [state.residuals(one, whole, sealed) for one in fits]

    def smallest(task: tuple[Effect, list[Residuals]]) -> float:
        effect, parts = task
        p = [e.p_value for one in parts for e in effect.detect(one, seed=state.seed)]
        return min(p, default=1.0)  # nothing left to test

    tasks = [(effect, parts) for effect in effects for parts in residuals]
    p = parallel_map(
        smallest, tasks, workers=state.workers, progress=state.progress, description="last tests"
    )
    return {effect.name: (p[2 * k], p[2 * k + 1]) for k, effect in enumerate(effects)}


def _effect(found: Found, confirmed: Confirmed, extended: Fit, record: Record) -> FoundEffect:
    attempt = confirmed.attempt
    assert attempt is not None
    assert confirmed.model is not None
    own = [one for one in confirmed.model.channels if one not in confirmed.before.channels]
    lines = [words.in_words(one) for one in own] or words.describe(confirmed.model)
    parameters = parameters_of(extended, own, record)
    parameters |= limits_of(extended, found.evidence, record)
    return FoundEffect(
        name=found.effect.name,
        sentence=found.effect.sentence(found.evidence, confirmed.model),
        p_value=found.evidence.p_value,
        q_value=found.q_value,
        gain=attempt.gain,
        gain_error=attempt.gain_error,
        size=found.evidence.size,
        parameters=parameters,
        block="; ".join(lines),
        curve=found.evidence.curve,
        ties=confirmed.ties,
        experiment=words.experiment(found.effect.name, confirmed.ties),
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
