"""Posterior modes: climbs from several starts, of cascades from linear fits first."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import get_args

import numpy as np

from pyro_dynogp.inference.density import WALL
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.free_runs import free_run_error, noise_pays, silenced
from pyro_dynogp.inference.function_evidence import kernels_by_evidence
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.optimise.innovation_energy import has_innovations
from pyro_dynogp.inference.optimise.maximum import (
    Effort,
    Optimizer,
    maximise,
    optimizer_for,
    optimizer_near,
)
from pyro_dynogp.inference.optimise.optimum import Optimum
from pyro_dynogp.inference.posteriors import Mixture
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.delays import moved
from pyro_dynogp.inference.starts.linear import RANDOM, linear_starts, linear_twins
from pyro_dynogp.inference.starts.noise import faint, louder, with_likely_noise
from pyro_dynogp.inference.starts.plans import Plan, Values, starting_point, starts_of
from pyro_dynogp.inference.starts.poles import grown
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import Records, as_measured
from pyro_dynogp.models.variants import without_noise_below_functions
from pyro_dynogp.support.errors import invalid, warn
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import seeded

# Most iterations of linear fits by each optimizer.
STEPS: Mapping[str, int] = MappingProxyType(
    {"gauss-newton": 100, "lbfgs": 500, "preconditioned": 500, "adam": 1500}
)
# Most iterations of models with functions.
FUNCTION_STEPS: Mapping[str, int] = MappingProxyType(
    {"gauss-newton": 40, "lbfgs": 600, "preconditioned": 600, "adam": 600}
)
# Optima along an excerpt of a long record from which climbs go on along the whole.
CARRIED = 3
# Restarts of models with functions, and of those with feedback of measured signals alone. Hidden
# ones have more poor optima (tanks that overflow: errors of 22.7 and 2.1 times the noise with four
# restarts, and of 4.6 and 1.1 times with eight, for a fifth more time).
# Of more hidden signals than outputs fewer still lead to the best optimum: a sixth to a half.
CURVED, LOOPED, HIDDEN = 8, 4, 16
# Sets of restarts, until a model with functions beats the linear one in free runs, and what is said
# where none does.
ATTEMPTS = 2
NO_BETTER = (
    "fit: free runs through the training record are no better than those of the linear model that "
    "the climb began from. Try more pairs, other restarts (seed), or a longer record."
)
# Half of the starts of models with functions climb to the end.
HALF = Effort(kept=0.5)


@dataclass(frozen=True)
class Mode:
    """The posterior mode: the best optimum of several starts.

    Kernels and output scales of functions are those of the highest evidence, and all else is at its
    mode given them, see `function_evidence`; not where Adam climbs, as it does in forward cascades
    whose static layers see process noise, see `optimizer_for`.

    Attributes:
        optimizer: "gauss-newton" (of models whose last layer has no limits), "lbfgs",
            "preconditioned" (L-BFGS in coordinates that Hessians make round, which gets to the top
            of long ridges) or "adam"; None for what suits the model, see `optimizer_for`.

    Raises:
        ValueError: on an unknown optimizer.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> model, method = dgp.LinearDynamicGP(1, pairs=1), dgp.Mode(optimizer="lbfgs")
        >>> fit = dgp.fit(model, record, method=method, restarts=1, workers=1, progress=False)
        >>> fit.method
        'map'
    """

    optimizer: Optimizer | None = None

    def __post_init__(self) -> None:
        check_optimizer(self.optimizer)

    def check(self, model: Model, *, warm: bool) -> None:
        """Every model has a mode; not every optimizer takes every model."""
        check_optimizer(self.optimizer, model)

    def __call__(self, problem: Problem, run: Run) -> Fitted:
        """The mode and how it was found; steps of the run are those of each start."""
        optima = best_optima(problem, run, self.optimizer, run.steps)
        return at_optimum(problem.model, optima, run.seed, problem.records)


def check_optimizer(optimizer: Optimizer | None, model: Model | None = None) -> None:
    """Refuse an optimizer that there is not, or that cannot climb a given model's posterior.

    Raises:
        ValueError: on such a name.
    """
    names = list(get_args(Optimizer))
    if model is not None and not has_innovations(model):
        names.remove("gauss-newton")
    if optimizer is not None and optimizer not in names:
        *most, last = (repr(name) for name in names)
        raise invalid("optimizer", expected=f"{', '.join(most)} or {last}", got=repr(optimizer))


def best_optima(
    problem: Problem, run: Run, optimizer: Optimizer | None, steps: int | None
) -> list[Optimum]:
    """Optima of the collapsed model from all starts, and from what is learnt, best first.

    Args:
        problem: what is fitted. run: how.
        optimizer: None for what suits the model. steps: most of each start, None for the same.

    Raises:
        ValueError: where no start leads to a point with a density.
    """
    model, learnt = problem.model, problem.learnt
    if learnt is not None and run.restarts == 0:
        usual = optimizer_for if model.has_function else optimizer_near
        optimizer = optimizer or usual(model)
        with seeded(run.seed):  # what has no typical value is drawn
            start = starting_point(model, problem.records, Plan(None, None, False, run.seed))
        starts: list[Values] = [grown(learnt, start)]
        optima = _near(problem, starts, run, optimizer, steps, "optimum")
    else:
        optimizer = optimizer or optimizer_for(model)
        excerpt = problem.excerpt
        optima = _from_all_starts(excerpt or problem, run, optimizer, steps)
        if excerpt is not None:
            few = [optimum.values for optimum in optima[:CARRIED]]
            optima = _near(problem, few, run, optimizer, steps, "whole")
    if optima[0].energy >= WALL:
        raise ValueError(
            "fit: no start reached a point where the likelihood can be evaluated. Check the "
            "record for jumps of many orders of magnitude, or try fewer pairs."
        )
    if optimizer == "adam" and not model.has_feedback:
        return optima  # which ends before kernels fit the noise
    return kernels_by_evidence(problem.target, problem.records, optima, run)


def _near(
    problem: Problem,
    starts: list[Values],
    run: Run,
    optimizer: Optimizer,
    steps: int | None,
    key: str,
) -> list[Optimum]:
    """Optima that starts near them lead to, best first."""
    usual = FUNCTION_STEPS if problem.model.has_function else STEPS
    return maximise(
        problem.target, problem.records, starts, run, optimizer=optimizer,
        steps=steps or usual[optimizer], key=key, effort=Effort(near=True),
    )  # fmt: skip


def _from_all_starts(
    problem: Problem, run: Run, optimizer: Optimizer, steps: int | None
) -> list[Optimum]:
    """Optima from fresh starts, and from what is learnt, best first."""
    model, records, learnt = problem.model, problem.records, problem.learnt
    if not model.is_linear:
        return cascade_optima(problem, run, optimizer, steps or FUNCTION_STEPS[optimizer])
    starts = linear_starts(model, records, run.restarts, run.seed)
    if learnt is not None:
        starts = [grown(learnt, starts[0]), *starts]
    steps = steps or STEPS[optimizer]
    optima = maximise(problem.target, records, starts, run, steps=steps, optimizer=optimizer)
    return _with_others_around(problem, optima, run, optimizer, steps) if model.late else optima


def _with_others_around(
    problem: Problem, optima: list[Optimum], run: Run, optimizer: Optimizer, steps: int
) -> list[Optimum]:
    """The optima, and those climbed to from the best one with other dead times, best first."""
    starts = moved(optima[0].values, float(problem.scaling.time_step))
    found = maximise(
        problem.target, problem.records, starts, run, steps=steps, optimizer=optimizer,
        key="delay", effort=Effort(near=True),
    )  # fmt: skip
    return sorted([*optima, *found], key=lambda one: one.energy)


def cascade_optima(problem: Problem, run: Run, optimizer: Optimizer, steps: int) -> list[Optimum]:
    """Optima of a model with static layers, best first.

    Those whose free runs through the training record are worse than those of the linear model are
    left out. Where none remains there is another set of starts, and then a warning.
    """
    model, records, learnt = problem.target, problem.records, problem.learnt
    unseen = model.has_real_poles or any(layer.hidden for _, layer in model.dynamic)
    many = any(layer.mostly_hidden for _, layer in model.dynamic)
    several = LOOPED if model.has_feedback and not unseen else HIDDEN if many else CURVED
    usual = several if model.has_function else RANDOM
    optima: list[Optimum] = []
    least = math.inf
    for attempt in range(ATTEMPTS):
        again = replace(run, seed=run.seed + attempt)
        twins = linear_twins(model, records, again, steps)
        lines = [t for t in twins.values() if model.has_function and t[0].outputs == model.outputs]
        least = min([least, *(free_run_error(one, at[0], own) for one, own, at in lines)])
        starts = starts_of(model, records, twins, run.restarts or usual, again.seed)
        warm = [] if learnt is None else [grown(learnt, starts[0])]
        if model.has_feedback:
            warm = [with_likely_noise(model, records, one) for one in warm]
        optima += climb(
            model, records, starts, warm, again, steps=steps, optimizer=optimizer,
            prefix=f"again-{attempt}-" if attempt else "", line=least,
        )  # fmt: skip
        if not lines:
            return optima
        optima.sort(key=lambda one: one.energy)
        holding = [one for one in optima if free_run_error(model, one.values, records) <= least]
        if holding:
            return holding
    warn(NO_BETTER)
    return optima


def at_optimum(model: Model, optima: Sequence[Optimum], seed: int, records: Records) -> Fitted:
    """The fit that the best of several optima is: a posterior mode."""
    best = optima[0]
    return Fitted(
        model=model,
        posterior=Mixture.at(best.values),
        draws=FrozenMapping({k: v.unsqueeze(0) for k, v in best.values.items()}),
        mode=FrozenMapping(best.values),
        history=best.history,
        start_energies=np.array([optimum.energy for optimum in optima]),
        diagnostics=FrozenMapping({"iterations": float(len(best.history))}),
        seed=seed,
        records=as_measured(records),
    )


def climb(
    model: Model,
    records: Records,
    starts: Sequence[Values],
    learnt: Sequence[Values],
    run: Run,
    *,
    steps: int,
    optimizer: Optimizer,
    effort: Effort = HALF,
    prefix: str = "",
    line: float = math.inf,
) -> list[Optimum]:
    """Optima of the collapsed model from fresh starts and from what is learnt, best first.

    Where static layers see process noise starts take half of the steps without any, which needs no
    filter, and the better half of them takes the other half with it; what is learnt takes all with
    it, too. Such noise can explain all that dynamics and functions should: from a poor start to a
    high density and poor forecasts. With feedback, or beside a linear model, it stays only where it
    pays (`noise_pays`).

    Args:
        model: collapsed. records: of it. starts, learnt: values of all sites. run: how.
        steps: most of each start. optimizer, effort: of climbs. prefix: of keys of checkpoints.
        line: error of free runs of the linear model, infinite where noise is not judged.
    """

    def optima_of(
        target: Model, points: Sequence[Values], key: str, effort: Effort
    ) -> list[Optimum]:
        return maximise(target, records, points, run, optimizer=optimizer, steps=steps, key=key,
                        effort=effort, learnt=len(learnt))  # fmt: skip

    quiet = without_noise_below_functions(model)
    better: list[Optimum] = []
    if quiet != model and starts:
        steps = max(1, steps // 2)
        key = f"{prefix}without-process-noise"
        found = optima_of(quiet, [*learnt, *(louder(start) for start in starts)], key, effort)
        better = found[: (len(starts) + 1) // 2]
        starts = [grown(one.values, faint(starts[0])) for one in better]
        # They have climbed: their order says more than that of what has not.
        effort = replace(effort, kept=min(effort.kept, HALF.kept))
    elif model.has_feedback:
        starts = [louder(start) for start in starts]
    optima = optima_of(model, [*learnt, *starts], f"{prefix}cascade", effort)
    if not better or not (model.has_feedback or math.isfinite(line)):
        return optima
    prepared = model.prepare(records)
    silent = [silenced(model, prepared, one, starts[0]) for one in better]
    return optima if noise_pays(model, prepared, optima[0], silent[0], line) else silent
