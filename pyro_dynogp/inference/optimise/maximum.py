"""Posterior mode of the exact marginal model: several starts, the best one kept."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.inference.density import Potential, parts
from pyro_dynogp.inference.log_joint import Direct
from pyro_dynogp.inference.optimise import gauss_newton
from pyro_dynogp.inference.optimise.adam import RATE, adam
from pyro_dynogp.inference.optimise.descent import descend, lbfgs, polished
from pyro_dynogp.inference.optimise.gauss_newton import Climbed
from pyro_dynogp.inference.optimise.innovation_energy import Innovations, has_innovations
from pyro_dynogp.inference.optimise.lengths import Lengths
from pyro_dynogp.inference.optimise.lockstep import Functions, in_lockstep
from pyro_dynogp.inference.optimise.optimum import Optimum, from_piece, to_piece
from pyro_dynogp.inference.run import Run
from pyro_dynogp.layers.sites import Program
from pyro_dynogp.models.gauge import in_gauge
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import Records, as_measured
from pyro_dynogp.models.variants import without_noise_below_functions
from pyro_dynogp.support.parallel import parallel_map, seeded

Optimizer = Literal["gauss-newton", "lbfgs", "preconditioned", "adam"]
# Decimals of energies [nats] to which two starts are at one optimum: the first of them is kept,
# whatever rounding says.
TIED = 6
# Nats that the last iterations of a climb gained where the top is near.
NEAR = 0.1
# Most iterations along a ridge from there.
RIDGE = 200
# Starts that climb together, as long as they have no more samples than this in all: longer records
# keep a processor busy one by one.
TOGETHER, BATCH_SAMPLES = 4, 8000
# So many points of a batch cost no less than one by itself.
BATCHED = 8
# Iterations of Gauss-Newton after which starts are ranked, and the share of them that goes on:
# those from subspace identification rise first, others may end higher.
RANKED = ((5, 0.75), (15, 0.5), (30, 0.5))
# The same of models with static functions, whose starts are fewer and part earlier.
RANKED_FUNCTIONS = ((4, 0.5), (10, 0.5))


@dataclass(frozen=True)
class Effort:
    """How starts share the work.

    Attributes:
        kept: share of the starts that climbs to the end.
        rate: Adam's first step, in unconstrained units.
        together: most starts that climb side by side where evaluating them at once pays.
        near: whether starts are near their optima: optimisers that make use of the curvature do so
            at once.
    """

    kept: float = 1 / 3
    rate: float = RATE
    together: int = TOGETHER
    near: bool = False


EFFORT = Effort()


@dataclass(frozen=True)
class _Task:
    """Starts that climb together.

    `goes_on` says that they have climbed already, `last` that they will not climb again. Sites in
    `held` keep their values.
    """

    model: Program
    records: Records
    starts: tuple[dict[str, Tensor], ...]
    optimizer: Optimizer
    steps: int
    run: Run
    key: str
    rate: float
    goes_on: bool
    last: bool
    held: tuple[str, ...] = ()


def _lbfgs(functions: Functions, z: np.ndarray, task: _Task, every: int) -> Climbed:
    del every  # of Hessians, of which it has none
    history: list[float] = []
    result = lbfgs(functions, z, task.steps, history, maxfun=2 * task.steps, ftol=1e-7)
    return result.x, history, str(result.message)


def _preconditioned(functions: Functions, z: np.ndarray, task: _Task, every: int) -> Climbed:
    # A Hessian before the first iteration, unless it costs more than all of them.
    pays = task.steps >= len(z) / BATCHED
    return descend(
        functions, z, task.steps, every=every, first=0 if task.goes_on and pays else None
    )


def _adam(functions: Functions, z: np.ndarray, task: _Task, every: int) -> Climbed:
    del every  # of Hessians, of which it has none
    return adam(functions, z, task.steps, task.rate)


_METHODS = {"lbfgs": _lbfgs, "preconditioned": _preconditioned, "adam": _adam}


def _optimise(task: _Task) -> list[Optimum]:
    return from_piece(task.run.checkpoints.piece(task.key, lambda: to_piece(_climb(task))))


def _climb(task: _Task) -> list[Optimum]:
    with seeded(task.run.seed):
        potential = Potential(task.model, (task.records,), task.starts[0])
        found, energies = _climbs(potential, task)
        return [
            Optimum(float(energy), _values(potential, z), np.asarray(history), message)
            for energy, (z, history, message) in zip(energies, found, strict=True)
        ]


def _climbs(potential: Potential, task: _Task) -> tuple[list[Climbed], np.ndarray]:
    """Climbs from every start, and the energies (k,) at their ends."""
    starts = [_placed(potential, potential.pack(start).numpy()) for start in task.starts]
    held = potential.places(task.held)
    every = potential.hessian_cost  # of a climb, Hessians are at most half the work
    whole = Lengths(potential.sites).added(potential.values_and_gradients)

    def functions(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values, gradients = whole(z)
        gradients[:, held] = 0.0  # no optimizer moves along them
        return values, gradients

    if task.optimizer == "gauss-newton":
        free = np.setdiff1d(np.arange(potential.size), held)
        innovations = Innovations(potential, free)
        found = gauss_newton.climb_together(innovations, starts, task.steps)
    else:
        method = _METHODS[task.optimizer]

        def run(z: np.ndarray) -> Callable[[Functions], Climbed]:
            return lambda functions: method(functions, z, task, every)

        found = in_lockstep(functions, [run(z) for z in starts])
    # Gauss-Newton gets near the top again from near it; what else ends early does not.
    finishes = task.last or task.optimizer != "gauss-newton"
    if finishes and getattr(task.model, "is_linear", False):
        found = [_to_the_top(functions, one, every) for one in found]
    found = [(_placed(potential, z), history, message) for z, history, message in found]
    return found, potential.values_and_gradients(np.stack([z for z, _, _ in found]))[0]


def _to_the_top(functions: Functions, climb: Climbed, every: int) -> Climbed:
    """A climb that is all but at an end, with Newton's method from there on.

    Where it stops for want of 0.01 nats depends on rounding, and so on units and order of channels.
    """
    z, history, message = climb
    lately = history[-gauss_newton.PATIENCE - 1 :]
    slow = len(lately) > gauss_newton.PATIENCE and lately[0] - lately[-1] < NEAR
    if message != gauss_newton.DONE and not slow:
        return climb
    if message != gauss_newton.DONE:
        z, further, _ = descend(functions, z, RIDGE, every=every, first=0)
        history = [*history, *further]
    z, energy, _ = polished(functions, z)
    return z, [*history, energy], message


def _placed(potential: Potential, z: np.ndarray) -> np.ndarray:
    """The point (d,) that all points share which are the same model, see `in_gauge`."""
    density = potential.log_density
    if not isinstance(density, Direct):
        return z
    point = torch.tensor(z)
    shared = in_gauge(density.model, potential.unpack(point), density.records[0].scaling)
    of_sites = [shared.get(site.name, part) for site, part in parts(potential.sites, point)]
    placed: np.ndarray = torch.cat([part.reshape(-1) for part in of_sites]).detach().numpy()
    return placed


def _values(potential: Potential, z: np.ndarray) -> dict[str, Tensor]:
    return {k: v.detach() for k, v in potential.unpack(torch.tensor(z)).items()}


def _batches(
    starts: Sequence[dict[str, Tensor]],
    model: Program,
    records: Records,
    together: int,
) -> list[tuple[dict[str, Tensor], ...]]:
    """Starts in batches of nearly one size."""
    outputs = sum(len(one) * max(one.n_outputs, 1) for one in as_measured(records))
    pays = BATCH_SAMPLES // outputs if getattr(model, "takes_batches", False) else 1
    count = -(-len(starts) // max(1, min(together, pays)))
    edges = np.linspace(0, len(starts), count + 1).round().astype(int)
    return [tuple(starts[a:b]) for a, b in itertools.pairwise(edges)]


def maximise(
    model: Program,
    records: Records,
    starts: Sequence[dict[str, Tensor]],
    run: Run,
    *,
    optimizer: Optimizer = "lbfgs",
    steps: int = 500,
    key: str = "optimum",
    effort: Effort = EFFORT,
    held: Sequence[str] = (),
    learnt: int = 0,
) -> list[Optimum]:
    """Climb from every start; the optima sorted by energy, best first.

    All starts get a fifth of the steps, then the best of them the rest (successive halving: a start
    that is far behind by then hardly ever wins); by Gauss-Newton in the stages of `RANKED`. The
    mode is that of the density of the constrained values (no Jacobian), as AutoDelta has it. The
    result does not depend on the number of processors. Sites in `held` keep their values. The
    first `learnt` starts climb to the end whatever others come to: next to other data or finer
    steps what is learnt begins low, and may end highest.
    """
    # Of a linear model Gauss-Newton has compiled functions alone.
    alone = optimizer == "gauss-newton" and getattr(model, "is_linear", False)
    together = 1 if alone else effort.together

    def climb(
        values: Sequence[dict[str, Tensor]], count: int, label: str, *, last: bool = False
    ) -> list[Optimum]:
        tasks = [
            _Task(
                model,
                records,
                batch,
                optimizer,
                count,
                run,
                f"{key}-{label}-{i}",
                effort.rate,
                effort.near or label.startswith("optima"),
                last,
                tuple(held),
            )
            for i, batch in enumerate(_batches(values, model, records, together))
        ]
        found = parallel_map(
            _optimise,
            tasks,
            workers=run.workers,
            progress=run.progress,
            description=f"{len(values)} {label}",
            news=lambda done: f"log p {-min(o.energy for batch in done for o in batch):.2f}",
        )
        return [optimum for batch in found for optimum in batch]

    if len(starts) == 1:
        return climb(starts, steps, "optimum", last=True)
    behind: list[int] = []
    ranked: Sequence[tuple[int, float]] = ((max(1, steps // 5), effort.kept),)
    if optimizer == "gauss-newton":
        ranked = RANKED_FUNCTIONS if getattr(model, "has_function", False) else RANKED
    (first, _), *further = _stages(ranked, steps, effort.kept)
    found = climb(starts, first, "starts", last=not further)

    def best_first(places: Sequence[int]) -> list[int]:
        least = min(found[k].energy for k in places)
        return sorted(places, key=lambda k: round(found[k].energy - least, TIED))

    order = best_first(range(len(found)))
    for stage, (count, kept) in enumerate(further):
        cut = max(1, math.ceil(kept * len(order) - 0.5))
        leading = [k for place, k in enumerate(order) if place < cut or k < learnt]
        behind += [k for k in order if k not in leading]
        label = "optima" if stage == 0 else f"optima-{stage}"
        last = stage == len(further) - 1
        goes_on = climb([found[k].values for k in leading], count, label, last=last)
        for k, after in zip(leading, goes_on, strict=True):
            history = np.concatenate([found[k].history, after.history])
            found[k] = replace(after, history=history)
        order = best_first(leading)
    return [found[k] for k in best_first([*order, *behind])]


def _stages(
    ranked: Sequence[tuple[int, float]], steps: int, kept: float
) -> list[tuple[int, float]]:
    """Steps of each stage, and the share of the starts that takes them, all of them at first."""
    ends = [min(end, steps) for end, _ in ranked] + [steps]
    shares = [1.0, *(max(kept, share) for _, share in ranked)]
    counts = np.diff([0, *ends]).tolist()
    return [(count, share) for count, share in zip(counts, shares, strict=True) if count]


def optimizer_for(model: Model) -> Optimizer:
    """The optimizer of a first fit: Gauss-Newton where the model has innovations, or Adam.

    Where static layers see process noise the highest modes explain with it what dynamics and
    functions should, and free runs are poor: on the measured circuit (8192 samples) the mode by
    Gauss-Newton is 14 000 nats above that of 300 steps of Adam, and its error on the multisine is
    100 mV, not 36 mV. Adam stops before. With feedback free runs tell whether noise stays.
    """
    noisy = without_noise_below_functions(model) != model
    if noisy and model.has_function and not model.has_feedback:
        return "adam"
    return "gauss-newton" if has_innovations(model) else "lbfgs"


def optimizer_near(model: Model) -> Optimizer:
    """The optimizer that goes on from near an optimum: Gauss-Newton where it can."""
    return "gauss-newton" if has_innovations(model) else "preconditioned"
