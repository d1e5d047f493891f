"""Fits made again: the same model on other data, or one that extends it, from what is learnt."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TypeVar

import torch

from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.bayes_factor import energy
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.function_evidence import kernel_sites, kernels_by_evidence
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.importance import with_draws_around
from pyro_dynogp.inference.methods.mode import at_optimum, climb
from pyro_dynogp.inference.methods.nuts import sample_posterior
from pyro_dynogp.inference.methods.optima import POLISH, Hyperparameters, posterior_of
from pyro_dynogp.inference.methods.svi import Schedule
from pyro_dynogp.inference.optimise.maximum import (
    Effort,
    Optimizer,
    maximise,
    optimizer_for,
    optimizer_near,
)
from pyro_dynogp.inference.optimise.optimum import Optimum
from pyro_dynogp.inference.posteriors import Mixture, Sampled, draws_of_guide
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.dynamic import Values
from pyro_dynogp.inference.starts.extended import extended_starts
from pyro_dynogp.inference.starts.linear import fresh_starts
from pyro_dynogp.inference.starts.noise import louder, most_probable, with_likely_noise
from pyro_dynogp.inference.starts.plans import starting_points
from pyro_dynogp.inference.starts.poles import grown
from pyro_dynogp.models.forms import have_no_place
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.variants import have_same_parameters, without_noise_below_functions
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import seeded

# Iterations from the old optima, and of Adam and SVI where they are of a model with functions.
SAME_STEPS, ADAM_STEPS, SVI_STEPS = 300, 200, 400
# Iterations of extended models: linear, others of the same layers, with a layer more.
LINEAR_STEPS, LAYERED_STEPS = 100, 100
ADDED_STEPS: Mapping[str, int] = MappingProxyType({"gauss-newton": 60, "lbfgs": 300, "adam": 300})
# Starts from linear fits of its own that a model with a layer more has beside what is learnt; those
# of one with more hidden signals than outputs, or other dynamics than the learnt; of one with
# functions in feedback beside learnt ones, of which three more came to nothing; and iterations.
FRESH, REPLACED, FRESH_BACK, FRESH_STEPS = 4, 12, 1, 40
# Of the same model every start goes on, near its optimum; of a linear one that is extended half of
# them do, side by side, as processors are kept busy by other trials. With feedback all go on: after
# few iterations their order says little (of nine plants two chose a start 180 nats below another).
AGAIN = Effort(kept=1.0, rate=0.004, near=True)
EXTENDED, LOOPED = Effort(kept=1 / 2, together=8), Effort(kept=1.0, together=8)
# Samples from which what is new in feedback is looked for along an excerpt first, and its length:
# an iteration goes through the filter once for each of some hundred numbers.
LONG, EXCERPT = 1_600, 1_000
# Iterations of all variants of an effect, by Gauss-Newton and of others, and more of the leading
# ones: this share, three at least.
FIRST_STEPS, MORE_STEPS = (14, 8), (20, 32)
LEADING, FEWEST = 1 / 5, 3
# Of NUTS, whose chains start at the mode.
WARMUP = 300
FittedKind = TypeVar("FittedKind", bound=Fitted)


def refit(
    fit: FittedKind,
    records: Record | Sequence[Record],
    *,
    model: Model | None = None,
    run: Run | None = None,
) -> FittedKind:
    """Fit again by the same method, beginning at what a fit has learnt.

    The same model keeps its scaling, and with it every prior: what changes is the data alone. A
    model that extends it gets the units of the new records, or with feedback keeps those of the
    fit, and starts where nothing that is new does anything yet. `fit.at_mode()` gives a mode again,
    whatever the method was.

    Args:
        fit: the old fit.
        records: one or several; of the same model as many as it has, with the same channels.
        model: that extends the one of the fit, or that one again in other units; None for the same.
        run: steps are those of each start, of which a linear model has one where they are given;
            by default with the seed of the fit, in this process.

    Raises:
        ValueError: on a fit with trajectories as sites, whose guide belongs to its record, on
            another number of records, or where records do not fit the model.
    """
    run = run or Run(fit.seed, workers=1)
    several = (records,) if isinstance(records, Record) else tuple(records)
    fit.check_collapsed()
    if model is not None:
        # With feedback what is learnt is another system in other units: 10 % more of an output's
        # scale make a cubic spring a fifth softer, and a climb began 850 000 nats below the fit.
        units = fit.scaling if model.has_feedback else None
        problem = Problem.of(model, several, units=units)
        return _posterior(fit, problem, _extended(fit, problem, run), run)
    if len(several) != len(fit.records):
        raise invalid("records", expected=f"{len(fit.records)}, as before", got=str(len(several)))
    problem = Problem(fit.model, fit.model.prepare(several))
    return _posterior(fit, problem, _again(fit, problem, run), run)


def race(
    fit: FittedKind, models: Sequence[Model], record: Record, run: Run
) -> tuple[list[FittedKind], list[ValueError]]:
    """Variants that extend a mode, the most probable first, and why others could not be fitted.

    All take a few steps from what the fit has learnt, the leading ones more: a variant that is
    far behind after the first (they differ by tens to hundreds of nats) hardly ever wins.

    Args:
        fit: a mode. models: that extend its model. record: training record. run: its seed counts.
    """

    def after(steps: tuple[int, int], optimizer: str) -> Run:
        newton, other = steps
        return replace(run, steps=newton if optimizer == "gauss-newton" else other, workers=1)

    def first(model: Model) -> str:
        layered = len(model.layers) > len(fit.model.layers)
        return _optimizer_of_layer(model) if layered else optimizer_near(model)

    found, problems = refits(fit, models, record, lambda model: after(FIRST_STEPS, first(model)))
    found.sort(key=energy)
    cut = max(FEWEST, round(LEADING * len(found)))
    further = [
        refit(f, f.records, run=after(MORE_STEPS, optimizer_near(f.model))) for f in found[:cut]
    ]
    return sorted([*further, *found[cut:]], key=energy), problems


def refits(
    fit: FittedKind, models: Sequence[Model], record: Record, run_of: Callable[[Model], Run]
) -> tuple[list[FittedKind], list[ValueError]]:
    """Refits of models that can be fitted, and why others cannot: a channel is constant there."""
    found, problems = list[FittedKind](), list[ValueError]()
    for model in models:
        try:
            found.append(refit(fit, record, model=model, run=run_of(model)))
        except ValueError as error:
            problems.append(error)
    return found, problems


def optima_of(fit: Fitted) -> list[Values]:
    """Values of all sites at each optimum that a fit consists of, the leading one first."""
    posterior = fit.posterior
    if isinstance(posterior, Mixture) and posterior.points and posterior.sites:
        return posterior.centres
    return [dict(fit.mode)]


def family_of(fit: Fitted) -> Hyperparameters:
    """What `fit` was told about hyperparameters."""
    assert isinstance(fit.posterior, Mixture)
    if fit.posterior.points:
        return "map"
    root = fit.posterior.scale_tril[0]
    independent = torch.equal(root, torch.diag(root.diagonal()))
    return "normal" if independent else "multivariate normal"


def _again(fit: Fitted, problem: Problem, run: Run) -> list[Optimum]:
    """Optima of the same model: by Adam where a first fit is, but where the mode is wanted.

    Better optimisers leave such an optimum along its ridges.
    """
    model = problem.target
    adam = fit.method != "map" and optimizer_for(model) == "adam"
    steps = run.steps or (ADAM_STEPS if adam else SAME_STEPS)
    optimizer = "adam" if adam else optimizer_near(model)
    optima = maximise(
        model, problem.records, optima_of(fit), run, optimizer=optimizer, steps=steps,
        effort=AGAIN, held=_held(model, optimizer),
    )  # fmt: skip
    return _settled(problem, optima, run)


def _optimizer_of_layer(model: Model) -> Optimizer:
    """The optimizer of a layer that is added, see `_climbed`."""
    forward = model.has_function and not model.has_feedback
    return "adam" if forward else optimizer_for(model)


def _held(model: Model, optimizer: Optimizer) -> tuple[str, ...]:
    """Sites that keep what is learnt: kernels that are those of the evidence, see `_settled`.

    And others while Gauss-Newton climbs, which would make the functions less certain.
    """
    held = optimizer == "gauss-newton" or optimizer_for(model) != "adam"
    return kernel_sites(model) if held else ()


def _settled(
    problem: Problem, optima: list[Optimum], run: Run, *, other: bool = False
) -> list[Optimum]:
    """The best optimum with kernels by the evidence; without feedback, and of variants, all optima.

    Variants are compared at the mode. Without feedback others keep the kernels that they have, but
    functions that were learnt next to other inputs or dynamics: what these lacked was in them.

    Args:
        other: whether the functions were.
    """
    target = problem.target
    learnt = target.has_feedback or (other and optimizer_for(target) != "adam")
    if run.steps or not learnt:
        return optima
    return kernels_by_evidence(target, problem.records, optima[:1], run)


def _extended(fit: Fitted, problem: Problem, run: Run) -> list[Optimum]:
    """Optima of a model that extends that of a fit, on long records with feedback from an excerpt.

    What is new is found along the excerpt, and climbs on along the whole.
    """
    target = problem.target
    new = not have_same_parameters(target, fit.model)
    looped = new and target.has_feedback and not run.steps
    excerpt = problem.beginning(LONG, EXCERPT) if looped else None
    if excerpt is None:
        other = new and len(target.layers) == len(fit.model.layers)
        return _settled(problem, _climbed(fit, problem, run), run, other=other)
    (best, *_) = _climbed(fit, excerpt, run)
    optimizer = optimizer_near(target)
    optima = maximise(
        target, problem.records, [best.values], run, optimizer=optimizer, steps=LAYERED_STEPS,
        effort=AGAIN, held=_held(target, optimizer),
    )  # fmt: skip
    return _settled(problem, optima, run)


def _climbed(fit: Fitted, problem: Problem, run: Run) -> list[Optimum]:
    """Optima of a model that extends that of a fit.

    With a layer more Adam climbs: better optimisers find functions that fit the noise and of which
    special cases have none, so that gains would be those of climbs. With feedback Gauss-Newton
    climbs, and kernels are then those of the highest evidence. Where the function is far from a
    line (a sensor that reports a size) the linear fit is any of several poor optima: such a model
    starts from linear fits of its own, too; a function in feedback from what is learnt, where
    nothing comes back as yet, and one of hidden signals that has no place from both. Real poles
    take over nothing from pairs. Some linear models have `fresh_starts`, too.

    Process noise that has explained what the smaller model lacks keeps the larger one from it: one
    climb goes without any first, and takes that of a fresh start then. Not where variants are
    compared: their order is the same without.
    """
    target, records = problem.target, problem.records
    if target.has_real_poles and not fit.model.has_real_poles:
        fresh = starting_points(target, records, run, count=REPLACED, steps=FRESH_STEPS)
        optimizer = optimizer_for(target)
        return climb(target, records, fresh, [], run, optimizer=optimizer,
                     steps=run.steps or ADDED_STEPS[optimizer])  # fmt: skip
    starts, new = extended_starts(fit, problem.model, records, run.seed)
    effort = LOOPED if target.has_feedback else EXTENDED

    def climbed(model: Model, points: Sequence[Values], usual: int) -> list[Optimum]:
        optimizer = optimizer_near(model)
        return maximise(
            model, records, points, run, optimizer=optimizer, steps=run.steps or usual,
            effort=effort, held=_held(model, optimizer),
        )  # fmt: skip

    if len(target.layers) > len(fit.model.layers):
        line = target.has_feedback and fit.model.is_linear
        if not run.steps and (not line or have_no_place(target.layers)):
            many = any(layer.mostly_hidden for _, layer in target.dynamic)
            learnt = target.has_feedback and not have_no_place(target.layers)
            count = REPLACED if many else FRESH_BACK if learnt else FRESH
            starts += starting_points(target, records, run, count=count, steps=FRESH_STEPS)
        optimizer = _optimizer_of_layer(target)
        return climb(target, records, starts, [], run, optimizer=optimizer, effort=effort,
                     steps=run.steps or ADDED_STEPS[optimizer])  # fmt: skip
    if target.is_linear:
        compared = bool(run.steps)
        fresh = fresh_starts(fit.model, target, records, run.seed, compared=compared)
        starts = [*fresh, *starts]
    if run.steps:  # a few, to compare variants
        return climbed(target, [most_probable(target, records, starts)], run.steps)
    if target.is_linear:
        return climbed(target, starts, LINEAR_STEPS)
    if have_same_parameters(target, fit.model):  # nothing is new but data, or substeps
        (start, *_) = starts
        if target.has_feedback:
            start = with_likely_noise(target, records, start)
        return climbed(target, [start], LAYERED_STEPS)
    quiet = without_noise_below_functions(target)
    if quiet != target:
        best = climbed(quiet, [louder(start) for start in starts], LAYERED_STEPS)[0]
        starts = [*starts, grown(best.values, new)]
    return climbed(target, starts, LAYERED_STEPS)


def _posterior(
    fit: FittedKind, problem: Problem, optima: Sequence[Optimum], run: Run
) -> FittedKind:
    """The posterior around new optima, of the kind that a fit has."""
    mode = type(fit).of(at_optimum(problem.model, optima, run.seed, problem.records))
    if fit.method == "map":
        return mode
    count = fit.n_draws
    if fit.method == "importance":
        return type(fit).of(with_draws_around(problem, list(optima), run, count))
    if fit.method == "nuts":
        chains = int(fit.diagnostics["chains"])
        found = sample_posterior(
            problem.target, problem.records, optima[0].values, run, chains=chains,
            draws=count // chains, warmup=WARMUP,
        )  # fmt: skip
        draws = FrozenMapping({name: x.flatten(0, 1) for name, x in found.draws.items()})
        return replace(mode, posterior=Sampled(draws), draws=draws, diagnostics=fit.diagnostics)
    family = family_of(fit)
    schedule = Schedule(POLISH if family == "map" else SVI_STEPS)
    fitted = posterior_of(problem, optima, family, run, schedule)
    with seeded(run.seed):
        drawn = draws_of_guide(fitted.guide, count)
    return replace(
        mode, posterior=fitted.guide, mode=FrozenMapping(fitted.mode), history=fitted.elbo,
        draws=FrozenMapping({name: drawn[name] for name in mode.mode}),
        diagnostics=fit.diagnostics,
    )  # fmt: skip
