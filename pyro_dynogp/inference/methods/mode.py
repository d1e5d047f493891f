"""Posterior modes: climbs from several starts, of cascades from linear fits first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.density import WALL
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.optimise.maximum import EFFORT, Optimizer, Optimum, maximise
from pyro_dynogp.inference.posteriors import Mixture
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.plans import (
    Values,
    leading_layers,
    linear_twin,
    one_output,
    plans,
    starting_point,
)
from pyro_dynogp.inference.starts.poles import grown, starting_values
from pyro_dynogp.layers.noise import TYPICAL
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.variants import without_noise_below_functions
from pyro_dynogp.models.wiring import Dynamic
from pyro_dynogp.support.checkpoints import NOTHING_KEPT, Checkpoints
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import seeded

# Starts and iterations of the linear fits that come first.
LINEAR_STARTS = 6
LINEAR_STEPS = 150
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
            training = one_output(records) if twin.outputs < model.outputs else tuple(records)
            twin = twin.scaled_to(training)
            found = maximise(
                twin,
                training if len(training) > 1 else training[0],
                starting_values(twin, training, count=LINEAR_STARTS, seed=seed),
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


def louder(values: Values) -> Values:
    """A start whose measurement noise can stand for what dynamics and functions lack as yet.

    Linear fits leave that to process noise. Without any, noise of their size makes the density so
    steep that the climb ends on its slopes.
    """
    least = {"noise_sd": UNEXPLAINED, "log_noise_constant": math.log(UNEXPLAINED / TYPICAL)}
    return {
        name: value.clamp_min(least[name]) if name in least else value
        for name, value in values.items()
    }


@dataclass(frozen=True)
class Mode:
    """The posterior mode: the best optimum of several starts.

    Attributes:
        optimizer: "lbfgs", "preconditioned" (L-BFGS in coordinates that Hessians make round, which
            gets to the top of long ridges) or "adam"; None for "adam" where the model has static
            layers, else "lbfgs". The highest mode may be one that fits the noise.

    Raises:
        ValueError: on an unknown optimizer.
    """

    optimizer: Optimizer | None = None

    def __post_init__(self) -> None:
        check_optimizer(self.optimizer)

    def check(self, model: Model, *, warm: bool) -> None:
        """Every model has a mode."""

    @property
    def identity(self) -> object:
        """All options."""
        return self

    def __call__(self, problem: Problem, run: Run) -> Fitted:
        """The mode and how it was found; steps of the run are those of each start."""
        optima = best_optima(problem, run, self.optimizer, run.steps)
        return at_optimum(problem.model, optima, run.seed, problem.records)


def check_optimizer(optimizer: Optimizer | None) -> None:
    """Refuse an optimizer that there is not.

    Raises:
        ValueError: on an unknown name.
    """
    if optimizer is not None and optimizer not in get_args(Optimizer):
        expected = "'lbfgs', 'preconditioned' or 'adam'"
        raise invalid("optimizer", expected=expected, got=repr(optimizer))


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
    optimizer = optimizer or ("adam" if model.has_function else "lbfgs")
    restarts = run.restarts or (8 if model.has_function else 6)
    options: dict[str, Any] = {
        "optimizer": optimizer, "seed": run.seed, "workers": run.workers,
        "progress": run.progress, "checkpoints": run.checkpoints,
    }  # fmt: skip
    if model.is_linear:
        starts = starting_values(model, records, count=restarts, seed=run.seed)
        if learnt is not None:
            starts = [grown(learnt, starts[0]), *starts]
        steps = steps or (1500 if optimizer == "adam" else 500)
        optima = maximise(problem.target, problem.argument, starts, steps=steps, **options)
    else:
        steps = steps or 600
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
        loud = [louder(start) for start in starts]
        found = maximise(quiet, records, loud, steps=steps, key=key, **options)
        better = found[: (len(starts) + 1) // 2]
        starts = [grown(one.values, starts[0]) for one in better]
    return maximise(model, records, [*learnt, *starts], steps=steps, key="cascade", **options)
