"""Posterior modes: climbs from several starts, of cascades from linear fits first."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from types import MappingProxyType
from typing import Any, get_args

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.density import WALL
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.optimise.gauss_newton import has_innovations
from pyro_dynogp.inference.optimise.maximum import EFFORT, Optimizer, Optimum, maximise
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
from pyro_dynogp.models.variants import without_noise_below_functions
from pyro_dynogp.models.wiring import Dynamic
from pyro_dynogp.support.checkpoints import NOTHING_KEPT, Checkpoints
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import seeded

# Most iterations of linear fits by each optimizer.
STEPS: Mapping[str, int] = MappingProxyType(
    {"gauss-newton": 100, "lbfgs": 500, "preconditioned": 500, "adam": 1500}
)
# Starts of linear fits with random poles; iterations of those that come before cascades.
RANDOM = 6
LINEAR_STEPS = 40
# Measurement noise, in sds of the outputs, from which starts without process noise climb at least.
UNEXPLAINED = 0.5


def starting_points(
    model: Model,
    records: Sequence[Record],
    count: int,
    steps: int,
    seed: int,
    workers: int | None,
    progress: bool,
    checkpoints: Checkpoints,
) -> list[Values]:
    """Values of every site for each restart, from the optima of linear fits."""
    assert model.scaling is not None
    optima: dict[str, Sequence[Values]] = {}
    known: dict[Any, Sequence[Values]] = {}
    for one in leading_layers(model):
        assert isinstance(one.layer, Dynamic)
        twin = linear_twin(model, one.layer, model.scaling)
        if twin not in known:
            training = _one_output(records) if twin.outputs < model.outputs else tuple(records)
            twin = twin.scaled_to(training)
            found = maximise(
                twin,
                training if len(training) > 1 else training[0],
                linear_starts(twin, training, None, seed),
                optimizer=optimizer_for(twin),
                steps=min(LINEAR_STEPS, steps),
                seed=seed,
                workers=workers,
                progress=progress,
                checkpoints=checkpoints,
                key=f"linear-{one.name}",
            )
            known[twin] = [optimum.values for optimum in found]
        optima[one.name] = known[twin]
    with seeded(seed):  # what has no typical value is drawn
        return [
            starting_point(model, records, model.scaling, plan)
            for plan in plans(model, optima, count, seed)
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


def _one_output(records: Sequence[Record]) -> tuple[Record, ...]:
    return tuple(record.select(outputs=[record.output_names[0]]) for record in records)


@dataclass(frozen=True)
class Mode:
    """The posterior mode: the best optimum of several starts.

    Attributes:
        optimizer: "gauss-newton" (for linear models under Gaussian noise), "lbfgs",
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
    """Gauss-Newton where outputs have Gaussian innovations, Adam where there are functions."""
    if has_innovations(model):
        return "gauss-newton"
    return "adam" if model.has_function else "lbfgs"


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
    options: dict[str, Any] = {
        "optimizer": optimizer, "seed": run.seed, "workers": run.workers,
        "progress": run.progress, "checkpoints": run.checkpoints,
    }  # fmt: skip
    if model.is_linear:
        starts = linear_starts(model, records, run.restarts, run.seed)
        if learnt is not None:
            starts = [grown(learnt, starts[0]), *starts]
        steps = steps or STEPS[optimizer]
        optima = maximise(problem.target, problem.argument, starts, steps=steps, **options)
    else:
        steps = steps or 600
        restarts = run.restarts or (8 if model.has_function else RANDOM)
        starts = starting_points(
            problem.target, records, restarts, steps, run.seed, run.workers, run.progress,
            run.checkpoints,
        )  # fmt: skip
        warm = [] if learnt is None else [grown(learnt, starts[0])]
        optima = climb(problem.target, problem.argument, starts, warm, steps=steps, **options)
    if optima[0].energy >= WALL:
        raise ValueError(
            "fit: no start reached a point where the likelihood can be evaluated. Check the "
            "record for jumps of many orders of magnitude, or try fewer pairs."
        )
    return optima


def linear_starts(
    model: Model, records: Sequence[Record], count: int | None, seed: int
) -> list[Values]:
    """Starts of a linear model: of subspace identification and with random poles, in turn.

    Args:
        model: with its scaling. records: prepared with its channels. seed: of random poles.
        count: how many; None for all orders of subspace identification and `RANDOM` others.
    """
    subspace = subspace_starts(model, records, seed)
    random = starting_values(model, records, count=count or RANDOM, seed=seed)
    both = [one for pair in zip_longest(subspace, random) for one in pair if one is not None]
    return both[:count]


def at_optimum(
    model: Model, optima: Sequence[Optimum], seed: int, records: Sequence[Record]
) -> Fitted:
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
        records=tuple(records),
    )


def climb(
    model: Model,
    records: Record | Sequence[Record],
    starts: Sequence[Values],
    learnt: Sequence[Values],
    *,
    steps: int,
    checkpoints: Checkpoints = NOTHING_KEPT,
    **options: Any,
) -> list[Optimum]:
    """Optima of the collapsed model from fresh starts and from what is learnt, best first.

    Where static layers see process noise fresh starts take half of the steps without any, which
    needs no filter, and the better half of them takes the other half with it. Such noise can
    explain all that dynamics and functions should: from a poor start to a high density and poor
    forecasts.
    """
    options["checkpoints"] = checkpoints
    options["effort"] = replace(options.get("effort", EFFORT), kept=0.5)
    quiet = without_noise_below_functions(model)
    if quiet != model and starts:
        steps = max(1, steps // 2)
        key = "without-process-noise"
        louder = [_louder(start) for start in starts]
        found = maximise(quiet, records, louder, steps=steps, key=key, **options)
        better = found[: (len(starts) + 1) // 2]
        starts = [grown(one.values, starts[0]) for one in better]
    return maximise(model, records, [*learnt, *starts], steps=steps, key="cascade", **options)


def grow(
    model: Model, record: Record, learnt: Values, start: Values, *, steps: int, seed: int
) -> list[Optimum]:
    """Optima of the collapsed model near what a smaller model, or the same one, has learnt.

    Process noise that has explained what the smaller model lacks keeps the larger one from
    explaining it: one climb goes without any first, and takes that of `start` then.
    """
    options: dict[str, Any] = {
        "steps": steps, "seed": seed, "workers": 1, "optimizer": "preconditioned",
    }  # fmt: skip
    starts = [learnt]
    quiet = without_noise_below_functions(model)
    if quiet != model:
        (found, *_) = maximise(quiet, record, [_louder(learnt)], key="grown-quiet", **options)
        starts.append(grown(found.values, start))
    optima = [maximise(model, record, [one], key="grown", **options)[0] for one in starts]
    return sorted(optima, key=lambda one: one.energy)
