"""Fits made again: the same model on other data, or one that extends it, from what is learnt."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.records import as_records
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.mode import at_optimum, climb, louder, starting_points
from pyro_dynogp.inference.methods.nuts import sample_posterior
from pyro_dynogp.inference.methods.optima import POLISH, Hyperparameters, free_sites, posterior_of
from pyro_dynogp.inference.optimise.descent import descend
from pyro_dynogp.inference.optimise.lockstep import Functions
from pyro_dynogp.inference.optimise.maximum import Effort, Optimum, maximise
from pyro_dynogp.inference.optimise.side_by_side import each_in_lockstep
from pyro_dynogp.inference.posteriors import Mixture, Sampled, draws_of_guide
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.dynamic import Values
from pyro_dynogp.inference.starts.extended import extended_starts
from pyro_dynogp.inference.starts.poles import grown, starting_values
from pyro_dynogp.models.delays import longest_delay, where_inputs_are_known
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.variants import without_noise_below_functions
from pyro_dynogp.support.checkpoints import NOTHING_KEPT
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import seeded

# Iterations from the old optima, and of Adam and SVI where they are of a model with functions.
SAME_STEPS, ADAM_STEPS, SVI_STEPS = 300, 200, 400
# Iterations of extended models: linear, others of the same layers, with a layer more; fresh starts
# of the first and the last.
LINEAR_STEPS, LAYERED_STEPS, ADDED_STEPS, FRESH = 120, 150, 300, 2
# Of the same model every start goes on, near its optimum; of a linear one that is extended half of
# them do, side by side, as processors are kept busy by other trials.
AGAIN = Effort(kept=1.0, rate=0.004, near=True)
EXTENDED = Effort(kept=1 / 2, together=8)
# Iterations of all variants of an effect, and more of the leading ones: this share, three at least.
FIRST_STEPS, MORE_STEPS = 8, 32
LEADING, FEWEST = 1 / 5, 3
# Of NUTS, whose chains start at the mode.
WARMUP = 300
FittedKind = TypeVar("FittedKind", bound=Fitted)
# A linear model in the units of its records, and where it may start.
_Beginning = tuple[Problem, Sequence[Values]]


def refit(
    fit: FittedKind,
    records: Record | Sequence[Record],
    *,
    model: Model | None = None,
    run: Run | None = None,
) -> FittedKind:
    """Fit again by the same method, beginning at what a fit has learnt.

    The same model keeps its scaling, and with it every prior: what changes is the data alone. A
    model that extends it gets the units of the new records, and starts where nothing that is new
    does anything yet. `fit.at_mode()` gives a mode again, whatever the method was.

    Args:
        fit: the old fit.
        records: one or several; of the same model as many as it has, with the same channels.
        model: that extends the one of the fit, or that one again in other units; None for the same.
        run: steps are those of each start, restarts the fresh starts of a linear model and of one
            with a layer more; by default with the seed of the fit, in this process.

    Raises:
        ValueError: on a fit with trajectories as sites, whose guide belongs to its record, on
            another number of records, or where records do not fit the model.
    """
    run = run or Run(fit.seed, workers=1)
    several = as_records(records)
    fit.check_collapsed()
    if model is None:
        if len(several) != len(fit.records):
            expected = f"{len(fit.records)}, as before"
            raise invalid("records", expected=expected, got=str(len(several)))
        problem = Problem(fit.model, several)
        optima = _again(fit, problem, run)
    else:
        problem = _problem(model, several)
        optima = _extended(fit, problem, run)
    return _posterior(fit, problem, optima, run)


def race(
    fit: FittedKind, models: Sequence[Model], record: Record, run: Run
) -> tuple[list[FittedKind], list[str]]:
    """Variants that extend a mode, the most probable first, and why others could not be fitted.

    All take a few steps from what the fit has learnt, the leading ones more: a variant that is
    far behind after the first (they differ by tens to hundreds of nats) hardly ever wins.

    Args:
        fit: a mode. models: that extend its model. record: training record. run: its seed counts.
    """
    found: list[FittedKind] = []
    problems: list[str] = []
    beginnings: list[_Beginning] = []
    few, more = (replace(run, steps=steps, workers=1) for steps in (FIRST_STEPS, MORE_STEPS))
    for model in models:
        try:
            if model.is_linear:
                problem = _problem(model, (record,))
                starts, _ = extended_starts(fit, problem.model, problem.records, run.seed)
                beginnings.append((problem, starts))
            else:
                found.append(refit(fit, record, model=model, run=few))
        except ValueError as error:  # for instance a channel that is constant there
            problems.append(str(error))
    found = sorted([*found, *_side_by_side(fit, beginnings, few)], key=energy)
    cut = max(FEWEST, round(LEADING * len(found)))
    leading, rest = found[:cut], found[cut:]
    linear = [one for one in leading if one.model.is_linear]
    begun = [(Problem(one.model, one.records), [dict(one.mode)]) for one in linear]
    further = [refit(one, one.records, run=more) for one in leading if not one.model.is_linear]
    return sorted([*further, *_side_by_side(fit, begun, more), *rest], key=energy), problems


def energy(fit: Fitted) -> float:
    """-log p(y, values) at the mode [nats]."""
    return float(fit.start_energies[0])


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


def _problem(model: Model, records: Sequence[Record]) -> Problem:
    """A model in the units of records, with their channels.

    Outputs count where the model knows its inputs.
    """
    late = longest_delay(model)
    checked = model.check([where_inputs_are_known(record, late) for record in records])
    return Problem(replace(model, scaling=None).scaled_to(checked), checked)


def _again(fit: Fitted, problem: Problem, run: Run) -> list[Optimum]:
    """Optima of the same model: of functions by Adam, as before, but where the mode is wanted.

    Better optimisers leave an optimum of a model with functions along its ridges.
    """
    adam = fit.model.has_function and fit.method != "map"
    steps = run.steps or (ADAM_STEPS if adam else SAME_STEPS)
    return maximise(
        problem.target, problem.argument, optima_of(fit), steps=steps, seed=run.seed,
        optimizer="adam" if adam else "preconditioned", workers=run.workers, effort=AGAIN,
    )  # fmt: skip


def _extended(fit: Fitted, problem: Problem, run: Run) -> list[Optimum]:
    """Optima of a model that extends that of a fit.

    With a layer more Adam climbs, as in a first fit, also from fresh starts: better optimisers find
    modes that fit the noise (a function that is flat where outputs repeat), and what is learnt
    without an input function may be too far from what is right with it.

    Process noise that has explained what the smaller model lacks keeps the larger one from
    explaining it: one climb goes without any first, and takes that of a fresh start then.
    """
    model, target = problem.model, problem.target
    starts, new = extended_starts(fit, model, problem.records, run.seed)
    options: dict[str, Any] = {
        "optimizer": "preconditioned", "seed": run.seed, "workers": run.workers,
        "steps": run.steps or (LINEAR_STEPS if model.is_linear else LAYERED_STEPS),
    }  # fmt: skip
    if model.is_linear:
        count = run.restarts or FRESH
        fresh = starting_values(model, problem.records, count=count, seed=run.seed)
        starts, options["effort"] = [*fresh, *starts], EXTENDED
    if len(model.layers) > len(fit.model.layers):
        options |= {"optimizer": "adam", "steps": run.steps or ADDED_STEPS}
        fresh = starting_points(
            target, problem.records, run.restarts or FRESH, LINEAR_STEPS, run.seed, run.workers,
            False, NOTHING_KEPT,
        )  # fmt: skip
        return climb(target, problem.argument, [*starts, *fresh], [], **options)
    quiet = without_noise_below_functions(target)
    if quiet != target:
        (found, *_) = maximise(quiet, problem.argument, [louder(x) for x in starts], **options)
        starts = [*starts, grown(found.values, new)]
    return maximise(target, problem.argument, starts, **options)


def _side_by_side(fit: FittedKind, beginnings: Sequence[_Beginning], run: Run) -> list[FittedKind]:
    """Fits of linear models, each from the most probable of its starts, some steps on.

    Variants that differ in their inputs only (a delay, a limit, which channel) go through the model
    together at each step.
    """
    potentials = [
        Potential(problem.target, (problem.argument,), starts[0]) for problem, starts in beginnings
    ]

    def climb_from(potential: Potential, starts: Sequence[Values]) -> Callable[..., Optimum]:
        z = np.stack([potential.pack(one).numpy() for one in starts])

        def climb(functions: Functions) -> Optimum:
            best = z[functions(z)[0].argmin()]
            end, history, message = descend(
                functions, best, run.steps or LINEAR_STEPS, every=potential.hessian_cost, first=0
            )
            values = {k: v.detach() for k, v in potential.unpack(torch.tensor(end)).items()}
            return Optimum(float(functions(end[None])[0][0]), values, np.asarray(history), message)

        return climb

    climbs = [climb_from(one, x) for one, (_, x) in zip(potentials, beginnings, strict=True)]
    optima = each_in_lockstep(potentials, climbs, jacobian=False)
    return [
        type(fit).of(at_optimum(problem.model, [optimum], run.seed, problem.records))
        for optimum, (problem, _) in zip(optima, beginnings, strict=True)
    ]


def _posterior(
    fit: FittedKind, problem: Problem, optima: Sequence[Optimum], run: Run
) -> FittedKind:
    """The posterior around new optima, of the kind that a fit has."""
    mode = type(fit).of(at_optimum(problem.model, optima, run.seed, problem.records))
    if fit.method == "map":
        return mode
    count = len(next(iter(fit.draws.values())))
    if fit.method == "nuts":
        chains = int(fit.diagnostics["chains"])
        found = sample_posterior(
            problem.target, problem.argument, optima[0].values, chains=chains,
            draws=count // chains, warmup=WARMUP, seed=run.seed, workers=run.workers,
            progress=False,
        )  # fmt: skip
        draws = FrozenMapping({name: x.flatten(0, 1) for name, x in found.draws.items()})
        return replace(mode, posterior=Sampled(draws), draws=draws, diagnostics=fit.diagnostics)
    family = family_of(fit)
    fitted = posterior_of(
        problem.target, problem.argument, list(optima), family, free=free_sites(problem),
        steps=POLISH if family == "map" else SVI_STEPS, run=run,
    )  # fmt: skip
    with seeded(run.seed):
        drawn = draws_of_guide(fitted.guide, count)
    return replace(
        mode, posterior=fitted.guide, mode=FrozenMapping(fitted.mode), history=fitted.elbo,
        draws=FrozenMapping({name: drawn[name] for name in mode.mode}),
        diagnostics=fit.diagnostics,
    )  # fmt: skip
