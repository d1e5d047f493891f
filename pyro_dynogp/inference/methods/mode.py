"""Posterior modes: climbs from several starts, of cascades from linear fits first."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from types import MappingProxyType
from typing import get_args

import numpy as np

from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.inference.density import WALL
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.free_runs import free_run_error, noise_pays, silenced
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.optimise.gauss_newton import has_innovations
from pyro_dynogp.inference.optimise.maximum import EFFORT, Effort, Optimizer, Optimum, maximise
from pyro_dynogp.inference.posteriors import Mixture
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.plans import (
    Values,
    leading_layers,
    linear_twin,
    plans,
    starting_point,
)
from pyro_dynogp.inference.starts.poles import grown, starting_values
from pyro_dynogp.inference.starts.subspace import subspace_starts
from pyro_dynogp.layers.noise import TYPICAL
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord, Records, as_measured
from pyro_dynogp.models.variants import without_noise_below_functions
from pyro_dynogp.models.wiring import Dynamic
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import seeded

# Most iterations of linear fits by each optimizer.
STEPS: Mapping[str, int] = MappingProxyType(
    {"gauss-newton": 100, "lbfgs": 500, "preconditioned": 500, "adam": 1500}
)
# Most starts of linear fits of each kind; iterations of those that come before cascades.
RANDOM = 6
LINEAR_STEPS = 40
# Most iterations of models with functions.
FUNCTION_STEPS: Mapping[str, int] = MappingProxyType(
    {"gauss-newton": 40, "lbfgs": 600, "preconditioned": 600, "adam": 600}
)
# Process noise at which climbs from optima without any begin, as a share of that of a linear fit,
# which has it explain what the functions should.
FAINT = 0.03
# Restarts of models with feedback. Sets of them, until one beats the linear model in free runs;
# what is said where none does.
LOOPED = 4
ATTEMPTS = 2
NO_BETTER = (
    "fit: free runs through the training record are no better than those of the linear model that "
    "the climb began from. Try more pairs, other restarts (seed), or a longer record."
)
# Measurement noise, in sds of the outputs, from which starts without process noise climb at least.
UNEXPLAINED = 0.5


def starting_points(
    model: Model,
    records: Sequence[PreparedRecord],
    run: Run,
    *,
    count: int,
    steps: int,
) -> list[Values]:
    """Values of every site for each restart, from the optima of linear fits."""
    scaling = records[0].scaling
    optima: dict[str, Sequence[Values]] = {}
    known: dict[Model, Sequence[Values]] = {}
    for one in leading_layers(model):
        assert isinstance(one.layer, Dynamic)
        linear = linear_twin(model, one.layer, scaling)
        if linear not in known:
            training = tuple(records) if linear.outputs == model.outputs else _one_output(records)
            twin = replace(linear, scaling=training[0].scaling)
            found = maximise(
                twin,
                training,
                linear_starts(twin, training, None, run.seed),
                run,
                optimizer=optimizer_for(twin),
                steps=min(LINEAR_STEPS, steps),
                key=f"linear-{one.name}",
            )
            known[linear] = [optimum.values for optimum in found]
        optima[one.name] = known[linear]
    with seeded(run.seed):  # what has no typical value is drawn
        return [
            starting_point(model, records, plan) for plan in plans(model, optima, count, run.seed)
        ]


def _louder(values: Values) -> Values:
    """A start whose measurement noise can stand for what dynamics and functions lack as yet.

    Linear fits leave that to process noise. Without any, noise of their size makes the density so
    steep that the climb ends on its slopes.
    """
    least = {"noise_sd": UNEXPLAINED, "log_noise_constant": math.log(UNEXPLAINED / TYPICAL)}
    return {
        name: value.clamp_min(least[name]) if name in least else value
        for name, value in values.items()
    }


def _faint(values: Values) -> Values:
    """A start whose process noise is `FAINT`."""
    return {
        name: FAINT * value if name.endswith("_noise_gain_local_scale") else value
        for name, value in values.items()
    }


def _one_output(records: Sequence[PreparedRecord]) -> tuple[PreparedRecord, ...]:
    names = [records[0].record.output_names[0]]
    selected = [each.record.select(outputs=names) for each in records]
    scaling = Scaling.from_records(selected)
    return tuple(PreparedRecord.of(record, scaling) for record in selected)


@dataclass(frozen=True)
class Mode:
    """The posterior mode: the best optimum of several starts.

    Attributes:
        optimizer: "gauss-newton" (under Gaussian noise), "lbfgs",
            "preconditioned" (L-BFGS in coordinates that Hessians make round, which gets to the top
            of long ridges) or "adam"; None for what suits the model, see `optimizer_for`. The
            highest mode may be one that fits the noise.

    Raises:
        ValueError: on an unknown optimizer.
    """

    optimizer: Optimizer | None = None

    def __post_init__(self) -> None:
        check_optimizer(self.optimizer)

    def check(self, model: Model, *, warm: bool) -> None:
        """Every model has a mode; not every optimizer takes every model."""
        check_optimizer(self.optimizer, model)

    @property
    def identity(self) -> object:
        """All options."""
        return self

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


def optimizer_for(model: Model) -> Optimizer:
    """Gauss-Newton under Gaussian noise, else Adam for functions that do not feed back."""
    if has_innovations(model):
        return "gauss-newton"
    return "adam" if model.has_function and not model.has_feedback else "lbfgs"


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
    model, records, learnt = problem.model, problem.records, problem.learnt
    optimizer = optimizer or optimizer_for(model)
    if model.is_linear:
        starts = linear_starts(model, records, run.restarts, run.seed)
        if learnt is not None:
            starts = [grown(learnt, starts[0]), *starts]
        steps = steps or STEPS[optimizer]
        optima = maximise(problem.target, records, starts, run, steps=steps, optimizer=optimizer)
    else:
        steps = steps or FUNCTION_STEPS[optimizer]
        optima = cascade_optima(problem, run, optimizer, steps)
    if optima[0].energy >= WALL:
        raise ValueError(
            "fit: no start reached a point where the likelihood can be evaluated. Check the "
            "record for jumps of many orders of magnitude, or try fewer pairs."
        )
    return optima


def cascade_optima(problem: Problem, run: Run, optimizer: Optimizer, steps: int) -> list[Optimum]:
    """Optima of a model with static layers, best first.

    A model with feedback whose free runs are no better than those of the linear model gets another
    set of starts, and then a warning.
    """
    model, records, learnt = problem.model, problem.records, problem.learnt
    usual = LOOPED if model.has_feedback else 8 if model.has_function else RANDOM
    optima: list[Optimum] = []
    least = math.inf
    for attempt in range(ATTEMPTS if model.has_feedback else 1):
        again = replace(run, seed=run.seed + attempt)
        starts = starting_points(
            problem.target, records, again, count=run.restarts or usual, steps=steps
        )
        warm = [] if learnt is None else [grown(learnt, starts[0])]
        optima += climb(
            problem.target, records, starts, warm, again, steps=steps, optimizer=optimizer,
            prefix=f"again-{attempt}-" if attempt else "",
        )  # fmt: skip
        if not model.has_feedback:
            return optima
        optima.sort(key=lambda one: one.energy)
        # Nothing comes back in a start: it is the linear model.
        least = min(least, *(free_run_error(problem.target, one, records) for one in starts))
        if free_run_error(problem.target, optima[0].values, records) < least:
            return optima
    warnings.warn(NO_BETTER, stacklevel=2)
    return optima


def linear_starts(
    model: Model, records: Sequence[PreparedRecord], count: int | None, seed: int
) -> list[Values]:
    """Starts of a linear model: of subspace identification and with random poles, in turn.

    Args:
        model: the model. records: to which it is fitted. seed: of random poles.
        count: how many; None for `RANDOM` of each kind, as far as there are orders.
    """
    subspace = subspace_starts(model, records, seed)[:RANDOM]
    random = starting_values(model, records, count=count or RANDOM, seed=seed)
    both = [one for pair in zip_longest(subspace, random) for one in pair if one is not None]
    return both[:count]


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
    effort: Effort = EFFORT,
    prefix: str = "",
) -> list[Optimum]:
    """Optima of the collapsed model from fresh starts and from what is learnt, best first.

    Where static layers see process noise fresh starts take half of the steps without any, which
    needs no filter, and the better half of them takes the other half with it. Such noise can
    explain all that dynamics and functions should: from a poor start to a high density and poor
    forecasts. With feedback the noise stays only where free runs are better with it.

    Args:
        model: collapsed. records: of it. starts, learnt: values of all sites. run: how.
        steps: most of each start. optimizer, effort: of climbs. prefix: of keys of checkpoints.
    """
    effort = replace(effort, kept=0.5)

    def optima_of(target: Model, points: Sequence[Values], key: str) -> list[Optimum]:
        return maximise(
            target, records, points, run, optimizer=optimizer, steps=steps, key=key, effort=effort
        )

    quiet = without_noise_below_functions(model)
    better: list[Optimum] = []
    if quiet != model and starts:
        fast = optimizer == "gauss-newton"
        steps = steps if fast else max(1, steps // 2)
        key = f"{prefix}without-process-noise"
        found = optima_of(quiet, [_louder(start) for start in starts], key)
        better = found[: max(1, math.ceil(len(starts) * (0.25 if fast else 0.5)))]
        starts = [grown(one.values, _faint(starts[0])) for one in better]
    elif model.has_feedback:
        starts = [_louder(start) for start in starts]
    optima = optima_of(model, [*learnt, *starts], f"{prefix}cascade")
    if not model.has_feedback or not better:
        return optima
    prepared = model.prepare(records)
    silent = [silenced(model, prepared, one, starts[0]) for one in better]
    return optima if noise_pays(model, prepared, optima[0], silent[0]) else silent


def grow(
    model: Model, records: Records, learnt: Values, start: Values, run: Run, *, steps: int
) -> list[Optimum]:
    """Optima of the collapsed model near what a smaller model, or the same one, has learnt.

    Process noise that has explained what the smaller model lacks keeps the larger one from
    explaining it: one climb goes without any first, and takes that of `start` then.
    """

    def climbed(target: Model, point: Values, key: str) -> Optimum:
        return maximise(
            target, records, [point], run, optimizer="preconditioned", steps=steps, key=key
        )[0]

    starts = [learnt]
    quiet = without_noise_below_functions(model)
    if quiet != model:
        starts.append(grown(climbed(quiet, _louder(learnt), "grown-quiet").values, start))
    return sorted((climbed(model, point, "grown") for point in starts), key=lambda o: o.energy)
