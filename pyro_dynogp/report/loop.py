"""Close the loop: find the residual, name the effect, add it, report the error before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.records import one_record
from pyro_dynogp.discrepancy.blocks import Blocks, blocks_of
from pyro_dynogp.discrepancy.context import SearchContext, Stopwatch
from pyro_dynogp.discrepancy.held_out import without
from pyro_dynogp.discrepancy.search_notes import said_of_hiding, said_of_misses, said_of_time
from pyro_dynogp.discrepancy.state import SearchState
from pyro_dynogp.effects import CATALOGUE, Effect
from pyro_dynogp.fitting import fit as fit_model
from pyro_dynogp.fitting import fit_in_units
from pyro_dynogp.inference.fitted import known_fit
from pyro_dynogp.inference.isolation import isolated
from pyro_dynogp.inference.refit import WARMUP, family_of, refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.delays import longest_delay, where_inputs_are_known
from pyro_dynogp.models.feedback_variants import with_usual_substeps
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.variants import used_channels
from pyro_dynogp.report.last_block import report_of
from pyro_dynogp.report.report import Report
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.support.errors import instance, invalid
from pyro_dynogp.support.parallel import one_thread, parallel_map

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit

# Of cascades where the fit of block A begins anew.
FRESH_CASCADE_STARTS = 4


@isolated
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
    settings: LoopSettings | None = None,
    workers: int | None = None,
    progress: bool = True,
    time_limit: float | None = None,
) -> Report:
    """Say what a fitted model lacks, add it, and report the error before and after.

    Block A is what the model is fitted to, B is held out for the search, C is opened once, at the
    end. Where process noise certainly costs forecasts of B it hides what is missing: the search
    begins without it, and it comes back as soon as it costs nothing, or where nothing can be added
    without it (`SearchState`). A round first asks whether there is any structure in the residuals
    at all (an omnibus test, or a false discovery rate of one effect, at half of `level` each); if
    so, effects whose test rejects at `level`, and their nearest relatives, are added to the model
    one at a time and fitted to A; the one that raises the log-density of held-out data most is kept
    if it does so by more than two block standard errors and 4 nats (or, as outliers make both
    large, with no sample counted for more than 10 nats), effects between inputs and output before
    those of the noise, which their lack imitates. Of effects that explain as much the one that
    leaves least open is kept, and the others are reported as ties, and so is a cause that the
    catalogue lacks, where products of inputs or responses that change with time explain far more.
    Rounds end where nothing is left, or nothing helps. An effect that no block mends (feedback) is
    among the report's effects, after those that were added. C is forecast with each effect and
    those before it. Where a model does clearly worse there than one before, its last effect is
    named, and left out of the report's fit.

    Args:
        fit: a fit to one record.
        record: the training record, its continuation, or both; see `discrepancy.blocks`.
        candidates: extra channels that may act: names in ``record.extra`` (None: all of them), or
            a record on the same times whose channels they are.
        seed: the same seed gives the same report. max_rounds: most effects that are added.
        level: of the tests. tries: most effects that are refitted in a round.
        effects: what is looked for, `CATALOGUE` and your own.
        settings: every other threshold; None for the defaults of `LoopSettings`.
        workers: processes; None for all processors, or the cluster of
            ``joblib.parallel_config``. progress: whether to show progress bars.
        time_limit: of the search [s]; None for none. No round, no refit and no variant of one
            begins after it; a round that it cuts short adds nothing. Last fits and scores come
            after it, and the report says what was not tried.

    Raises:
        ValueError: on blocks that are too short, unknown candidates, numbers that make no sense.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").full[:240]
        >>> quick = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
        >>> fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record[:120], **quick)
        >>> drift = (dgp.effects.CATALOGUE[10],)  # one effect, to be quick
        >>> report = dgp.close_loop(
        ...     fit, record, effects=drift, max_rounds=1, workers=1, progress=False
        ... )
        >>> report.fit.method
        'map'
    """
    known_fit(fit)
    one_record(record, "Close the loop on one record.")
    settings = LoopSettings() if settings is None else settings
    instance("settings", settings, LoopSettings)
    for effect in effects if isinstance(effects, Sequence) else (effects,):
        instance("effects", effect, Effect)
    if not isinstance(candidates, Sequence | Record | None.__class__):
        raise invalid("candidates", expected="names, or a Record", got=repr(candidates))
    watch = Stopwatch(time_limit)
    other = candidates if isinstance(candidates, Record) else None
    data = blocks_of(fit, record, other, settings)
    names = _names(fit, data.known, candidates)
    # As far up as its extensions will get: what a better climb gains is no effect.
    late = None if time_limit is None else watch.late
    rounds = SearchContext(
        data, names, seed, level, tries, effects, workers, progress, settings, late
    )
    first = rounds.refit(_given(fit, data, seed), fit.model)
    course = SearchState(rounds, watch, first)
    watch.stop("fit of block A")
    course.go_rounds(max_rounds)
    channels = ("", *data.known.output_names, *names)
    warnings = [fault.sentence for fault in data.faults if fault.channel in channels]
    warnings += [
        *course.notes,
        *course.rest.untested,
        *said_of_hiding(course),
        *said_of_misses(course),
        *said_of_time(course),
    ]
    # The same samples for all, so that they can be compared.
    known = where_inputs_are_known(data.known, longest_delay(course.model))
    fitted = _final([first, *course.fits], fit, known, workers, progress)
    watch.stop("last fits")
    return report_of(fitted, course, warnings)


def _given(fit: Fit, data: Blocks, seed: int) -> Fit:
    """The mode that a fit of block A starts from: a fresh one where the fit is of other data.

    So it is where trajectories were sites, whose parameters are not the mode of the search.
    """
    if fit.collapsed and not data.refit:
        return fit.at_mode()
    known = where_inputs_are_known(without(data.known, data.held_out), longest_delay(fit.model))
    return fit_model(
        replace(fit.model, scaling=None), known, method="map", seed=seed, workers=1,
        restarts=FRESH_CASCADE_STARTS if fit.model.has_function else None, progress=False,
    )  # fmt: skip


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


def _final(
    fits: Sequence[Fit], given: Fit, record: Record, workers: int | None, progress: bool
) -> list[Fit]:
    """Models of block A fitted to A and B, from what they have learnt.

    They have fresh starts, too, models with functions one, linear ones as many as in a first fit:
    an optimum of less data may be a poor one of more, and errors before would be too large. Models
    with functions are refitted first: in units of other data what is learnt is off, its free runs
    may be worse than those of a linear model, and a poor fresh optimum would take its place (245
    nats below, with 1.5 times the error). Those with feedback keep the units of block A, in which
    the refit and the fit begin where the search has ended.
    Refits of the search are posterior modes; here the posterior is of the kind that the given fit
    has, and at least that of static functions is wanted. A step in feedback that the search added
    gets its substeps, which the search does without where they are no better.
    """

    def refitted(found: Fit) -> Fit:
        run = Run(found.seed, workers=1)
        model = replace(found.model, scaling=None)
        usual = model if found is fits[0] else with_usual_substeps(model, fits[0].model)
        options = _method_of(given, usual)
        if model.has_feedback:
            near = refit(found, record, run=run)
            return fit_in_units(near, usual, record, replace(run, restarts=1), **options)
        near = refit(found, record, model=model, run=run) if model.has_function else found
        return fit_model(
            usual, record, start=near, restarts=1 if model.has_function else None,
            seed=found.seed, workers=1, progress=False, **options,
        )  # fmt: skip

    return parallel_map(refitted, fits, workers=workers, progress=progress, description="last fits")


def _method_of(given: Fit, model: Model) -> dict[str, Any]:
    """Options of `fit` with which a model gets a posterior of the kind that a fit has."""
    count = given.n_draws
    if given.method == "nuts":
        chains = int(given.diagnostics["chains"])
        warmup = int(given.diagnostics.get("warmup", WARMUP))  # older files do not say
        return {"method": "nuts", "chains": chains, "draws": count // chains, "warmup": warmup}
    if given.method == "importance" and model.learns_function == given.model.learns_function:
        return {"method": "importance", "draws": count}
    if given.method == "svi":
        options: dict[str, Any] = {"method": "svi", "draws": count}
        if model.learns_function == given.model.learns_function and given.collapsed:
            options["hyperparameters"] = family_of(given)
        return options
    return {"method": "svi" if model.learns_function else given.method}
