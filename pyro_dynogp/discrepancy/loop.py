"""Close the loop: find the residual, name the effect, add it, report the error before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pyro_dynogp._errors import invalid
from pyro_dynogp.discrepancy.blocks import blocks_of
from pyro_dynogp.discrepancy.confirm import Confirmed
from pyro_dynogp.discrepancy.data_faults import data_spikes
from pyro_dynogp.discrepancy.effects import CATALOGUE, Effect, ProcessNoise
from pyro_dynogp.discrepancy.evidence import Residuals
from pyro_dynogp.discrepancy.extend import (
    Model,
    has_function,
    has_process_noise,
    used_channels,
)
from pyro_dynogp.discrepancy.refits import poles_of, quick_fit
from pyro_dynogp.discrepancy.report import Attempt, Report
from pyro_dynogp.discrepancy.reporting import report_of
from pyro_dynogp.discrepancy.rounds import Looked, Rounds, Stopwatch
from pyro_dynogp.discrepancy.search import Found, candidates_of
from pyro_dynogp.discrepancy.trials import without
from pyro_dynogp.discrepancy.words import OUTSIDE
from pyro_dynogp.inference.fit import fit as fit_model
from pyro_dynogp.inference.result import Method
from pyro_dynogp.models.cascade import Cascade
from pyro_dynogp.parallel import one_thread, parallel_map
from pyro_dynogp.record import Record

if TYPE_CHECKING:
    from pyro_dynogp.inference.result import Fit

# Fresh starts of the last fits, of linear models and of cascades.
LAST_LINEAR_STARTS, LAST_CASCADE_STARTS = 2, 1


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

    Block A is what the model is fitted to, B is held out for the search, C is opened once, at the
    end. Where process noise certainly costs forecasts of B it hides what is missing: the search
    begins without it, and it comes back as soon as it costs nothing. A round first asks whether
    there is any structure in the residuals at all (an omnibus test, or a false discovery rate of
    one effect, at half of `level` each); if so, effects whose test rejects at `level`, and their
    nearest relatives, are added to the model one at a time and fitted to A; the one that raises
    the log-density of held-out data most is kept if it does so by more than two block standard
    errors and 4 nats (or, as outliers make both large, with no sample counted for more than 10
    nats), effects between inputs and output before those of the noise, which their lack imitates.
    Of effects that explain as much the one that leaves least open is kept, and the others are
    reported as ties, and so is a cause that the catalogue lacks, where products of inputs or
    responses that change with time explain far more. Rounds end where nothing is left, or nothing
    helps. An effect that no block mends (feedback) is among the report's effects, after those that
    were added.

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
    watch = Stopwatch()
    other = candidates if isinstance(candidates, Record) else None
    data = blocks_of(fit, record, other)
    names = _names(fit, data.known, candidates)
    training = without(data.known, data.held_out)
    # As far up as its extensions will get: what a better climb gains is no effect.
    first = quick_fit(
        fit.model, training, seed, None if data.refit else fit.at_mode(), poles=poles_of(fit)
    )
    rounds = Rounds(data, names, seed, level, tries, effects, workers, progress)
    current, plain = first, rounds.plain(first)
    hidden = rounds.hiding(first, plain)
    waiting: set[str] = set()  # process noise that is taken away until it hides nothing
    if hidden and has_process_noise(fit.model):
        current, waiting = plain, {ProcessNoise.name}
    watch.stop("fit of block A")
    model: Model = replace(current.model, scaling=None)
    attempts: list[Attempt] = []
    accepted: list[tuple[Found, Confirmed]] = []
    seen: list[Sequence[Residuals]] = []  # before each of them was added
    reported: list[Found] = []
    channels = ("", *data.known.output_names, *names)
    warnings = [fault.sentence for fault in data.faults if fault.channel in channels]
    left: tuple[str, ...] = ()
    for number in range(1, max_rounds + 1):
        known = waiting | {one.effect.name for one, _ in accepted}
        looked = rounds.look(current, known, plain if number == 1 else None)
        if number == 1:
            warnings += [*_spikes(looked.residuals, data.known), *looked.notes]
        reported = _reported(looked.found, rounds.gate)
        left = rounds.left(looked)
        watch.stop("residual tests")
        chosen = candidates_of(looked.found, model, data.known, level, tries) if left else []
        attempts += _untried(looked.found, chosen, level, number)
        if not chosen:
            break
        confirmed = rounds.confirm(chosen, current, number)
        watch.stop("refits")
        attempts += confirmed.attempts
        winner, larger = confirmed.winner, confirmed.model
        if winner is None or larger is None:
            break
        if rounds.doubtful(winner, looked.whole, rounds.beyond(looked.residuals)):
            confirmed = replace(confirmed, ties=(*confirmed.ties, OUTSIDE))
        accepted.append((winner, confirmed))
        seen.append(looked.whole)
        watch.stop("residual tests")
        model = larger
        again = rounds.hold_out_less(winner)
        if confirmed.fit is not None and not again:
            current = confirmed.fit
        else:
            current = quick_fit(model, without(data.known, rounds.held_out), seed, current)
        if waiting and (noisy := rounds.with_process_noise(current)) is not None:
            current, model, waiting = noisy, replace(noisy.model, scaling=None), set()
        watch.stop("refits")
    else:  # rounds are spent; whether something is left is still to be said
        looked = rounds.look(current, waiting | {one.effect.name for one, _ in accepted})
        left = rounds.left(looked)
        reported = _reported(looked.found, rounds.gate)
        watch.stop("residual tests")
    if accepted and left:
        accepted = _doubted(accepted, seen, rounds, looked)
        watch.stop("residual tests")
    if hidden:
        warnings.append(_hiding(hidden, fit, current, bool(accepted)))
    fits = [first, current] if accepted else [first]
    fitted = _final(fits, data.known, workers, progress)
    base, extended = fitted[0], fitted[-1]
    watch.stop("last fits")
    return report_of(base, extended, rounds, accepted, reported, attempts, warnings, left, watch)


def _doubted(
    accepted: Sequence[tuple[Found, Confirmed]], seen: Sequence[Sequence[Residuals]],
    rounds: Rounds, last: Looked,
) -> list[tuple[Found, Confirmed]]:  # fmt: skip
    """With a cause outside the catalogue as a tie, where what is left at the end explains more.

    Args:
        accepted: effects. seen: residuals before each of them was added. last: what is left.
    """
    beyond = rounds.beyond(last.whole)
    return [
        (winner, replace(one, ties=(*one.ties, OUTSIDE)))
        if OUTSIDE not in one.ties and rounds.doubtful(winner, before, beyond)
        else (winner, one)
        for (winner, one), before in zip(accepted, seen, strict=True)
    ]


def _hiding(hidden: str, given: Fit, current: Fit, added: bool) -> str:
    """That process noise hides what is missing, and what was done about it."""
    done = "Fit it with process_noise=False, and close the loop on that."
    if has_process_noise(given.model) and not added:
        done = f"The search without it found nothing to add. {done}"
    elif has_process_noise(given.model):
        back = has_process_noise(current.model)
        done = "The search began without it, and the extended model " + (
            "has it again: there it costs nothing." if back else "does without it."
        )
    return f"The model as given {hidden}: such noise can hide what is missing. {done}"


def _spikes(residuals: Sequence[Residuals], record: Record) -> list[str]:
    """Spikes of the outputs, in words, also in samples that tests leave out."""
    whole = [replace(one, output=record.outputs[:, a]) for a, one in enumerate(residuals)]
    return [fault.sentence for one in whole if (fault := data_spikes(one)) is not None]


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
