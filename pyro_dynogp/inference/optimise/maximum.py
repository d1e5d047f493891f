"""Posterior mode of the exact marginal model: several starts, the best one kept."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.optimise import gauss_newton
from pyro_dynogp.inference.optimise.descent import descend, lbfgs
from pyro_dynogp.inference.optimise.gauss_newton import has_innovations
from pyro_dynogp.inference.optimise.lockstep import Functions, in_lockstep
from pyro_dynogp.inference.run import Run
from pyro_dynogp.layers.sites import Program
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import Records, as_measured
from pyro_dynogp.support.checkpoints import Piece, tensor_text, text_tensor
from pyro_dynogp.support.parallel import parallel_map, seeded

# End, energies on the way, why it ended.
Climb = tuple[np.ndarray, list[float], str]
Optimizer = Literal["gauss-newton", "lbfgs", "preconditioned", "adam"]
# Adam's first step, and how often it goes back to the best point with a shorter one.
RATE, RETURNS = 0.02, 2
# Starts that climb together, as long as they have no more samples than this in all: longer records
# keep a processor busy one by one.
TOGETHER, BATCH_SAMPLES = 4, 8000


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
class Optimum:
    """What one start came to.

    Attributes:
        energy: -log p(y, values), the lower the better.
        values: value of every latent site.
        history: energy after each iteration.
        message: why the optimiser stopped.
    """

    energy: float
    values: dict[str, Tensor]
    history: np.ndarray
    message: str


@dataclass(frozen=True)
class _Task:
    """Starts that climb together; `goes_on` says that they have climbed already.

    Sites in `held` keep their values.
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
    held: tuple[str, ...] = ()


def _lbfgs(functions: Functions, z: np.ndarray, task: _Task, every: int) -> Climb:
    del every  # of Hessians, of which it has none
    history: list[float] = []
    result = lbfgs(functions, z, task.steps, history, maxfun=2 * task.steps, ftol=1e-7)
    return result.x, history, str(result.message)


def _preconditioned(functions: Functions, z: np.ndarray, task: _Task, every: int) -> Climb:
    return descend(functions, z, task.steps, every=every, first=0 if task.goes_on else None)


def _adam(functions: Functions, z: np.ndarray, task: _Task, every: int) -> Climb:
    """Adam with a falling step; back to the best point with a shorter one where it got lost.

    Its first steps have full length in every direction, however good the start is.
    """
    del every  # of Hessians, of which it has none
    steps, rate = task.steps, task.rate
    x, optimizer, schedule = _from(z, rate, steps)
    history: list[float] = []
    best, best_z = np.inf, z
    patience = max(50, steps // 10)
    since, returns = 0, 0
    for done in range(steps):
        here = x.detach().numpy().copy()
        values, gradients = functions(here[None])
        value = float(values[0])
        history.append(value)
        since += 1
        if value < best - 1e-3:
            since = 0
        if value < best:
            best, best_z = value, here
        if since > patience:
            if returns == RETURNS:
                return best_z, history, "no improvement of 0.001 nats within the patience"
            returns, since, rate = returns + 1, 0, rate / 4.0
            x, optimizer, schedule = _from(best_z, rate, steps - done)
            continue
        x.grad = torch.tensor(gradients[0])
        optimizer.step()
        schedule.step()
    return best_z, history, "all steps used"


def _from(z: np.ndarray, rate: float, steps: int) -> tuple[Tensor, Any, Any]:
    """Adam at a point, with a step that falls over the steps that are left."""
    x = torch.tensor(z, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([x], lr=rate)
    low = min(1e-4, 0.1 * rate)
    return x, optimizer, torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=low)


_METHODS = {"lbfgs": _lbfgs, "preconditioned": _preconditioned, "adam": _adam}


def _optimise(task: _Task) -> list[Optimum]:
    return _unpack(task.run.checkpoints.piece(task.key, lambda: _pack(_climb(task))))


def _climb(task: _Task) -> list[Optimum]:
    with seeded(task.run.seed):
        potential = Potential(task.model, (task.records,), task.starts[0])
        found, energies = _climbs(potential, task)
        return [
            Optimum(float(energy), _values(potential, z), np.asarray(history), message)
            for energy, (z, history, message) in zip(energies, found, strict=True)
        ]


def _climbs(potential: Potential, task: _Task) -> tuple[list[Climb], np.ndarray]:
    """Climbs from every start, and the energies (k,) at their ends."""
    starts = [potential.pack(start).numpy() for start in task.starts]
    held = potential.places(task.held)
    if task.optimizer == "gauss-newton":
        free = np.setdiff1d(np.arange(potential.size), held)
        innovations = gauss_newton.Innovations(potential, free)
        found = [gauss_newton.climb(innovations, z, task.steps) for z in starts]
        return found, innovations.energies(np.stack([z for z, _, _ in found]))
    method = _METHODS[task.optimizer]
    every = potential.hessian_cost  # of a climb, Hessians are at most half the work

    def run(z: np.ndarray) -> Callable[[Functions], Climb]:
        return lambda functions: method(functions, z, task, every)

    def functions(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values, gradients = potential.values_and_gradients(z)
        gradients[:, held] = 0.0  # no optimizer moves along them
        return values, gradients

    found = in_lockstep(functions, [run(z) for z in starts])
    return found, potential.values_and_gradients(np.stack([z for z, _, _ in found]))[0]


def _values(potential: Potential, z: np.ndarray) -> dict[str, Tensor]:
    return {k: v.detach() for k, v in potential.unpack(torch.tensor(z)).items()}


def _pack(optima: Sequence[Optimum]) -> Piece:
    piece: Piece = {}
    for i, one in enumerate(optima):
        piece[f"{i}/energy"] = torch.tensor(one.energy, dtype=torch.float64)
        piece[f"{i}/history"] = torch.tensor(one.history, dtype=torch.float64)
        piece[f"{i}/message"] = text_tensor(one.message)
        piece |= {f"{i}/value/{name}": value for name, value in one.values.items()}
    return piece


def _unpack(piece: Piece) -> list[Optimum]:
    optima: list[Optimum] = []
    while f"{len(optima)}/energy" in piece:
        own = f"{len(optima)}/"
        mark = f"{own}value/"
        values = {k.removeprefix(mark): v for k, v in piece.items() if k.startswith(mark)}
        energy, history = float(piece[f"{own}energy"]), piece[f"{own}history"].numpy()
        optima.append(Optimum(energy, values, history, tensor_text(piece[f"{own}message"])))
    return optima


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
) -> list[Optimum]:
    """Climb from every start; the optima sorted by energy, best first.

    All starts get a fifth of the steps, then the best of them the rest (successive halving: a start
    that is far behind by then hardly ever wins); by Gauss-Newton in the stages of `RANKED`. The
    mode is that of the density of the constrained values (no Jacobian), as AutoDelta has it. The
    result does not depend on the number of processors. Sites in `held` keep their values.
    """
    # Gauss-Newton evaluates several points by itself.
    together = 1 if optimizer == "gauss-newton" else effort.together

    def climb(values: Sequence[dict[str, Tensor]], count: int, label: str) -> list[Optimum]:
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

    def best_first(optima: list[Optimum]) -> list[Optimum]:
        return sorted(optima, key=lambda optimum: optimum.energy)

    if len(starts) == 1:
        return climb(starts, steps, "optimum")
    behind: list[Optimum] = []
    ranked: Sequence[tuple[int, float]] = ((max(1, steps // 5), effort.kept),)
    if optimizer == "gauss-newton":
        ranked = RANKED_FUNCTIONS if getattr(model, "has_function", False) else RANKED
    (first, _), *further = _stages(ranked, steps, effort.kept)
    leading = best_first(climb(starts, first, "starts"))
    for stage, (count, kept) in enumerate(further):
        cut = max(1, math.ceil(kept * len(leading) - 0.5))
        leading, behind = leading[:cut], behind + leading[cut:]
        label = "optima" if stage == 0 else f"optima-{stage}"
        goes_on = climb([optimum.values for optimum in leading], count, label)
        leading = best_first([
            replace(after, history=np.concatenate([before.history, after.history]))
            for before, after in zip(leading, goes_on, strict=True)
        ])  # fmt: skip
    return best_first([*leading, *behind])


def _stages(
    ranked: Sequence[tuple[int, float]], steps: int, kept: float
) -> list[tuple[int, float]]:
    """Steps of each stage, and the share of the starts that takes them, all of them at first."""
    ends = [min(end, steps) for end, _ in ranked] + [steps]
    shares = [1.0, *(max(kept, share) for _, share in ranked)]
    counts = np.diff([0, *ends]).tolist()
    return [(count, share) for count, share in zip(counts, shares, strict=True) if count]


def optimizer_for(model: Model) -> Optimizer:
    """Gauss-Newton under Gaussian noise for linear models and with feedback, Adam for functions.

    Else L-BFGS. Of other models with functions Gauss-Newton finds higher modes, but with output
    scales and short lengthscales that make the functions less certain than they are. With feedback
    kernels are found by the evidence afterwards, and L-BFGS stops far below the top.
    """
    if has_innovations(model) and (model.is_linear or model.has_feedback):
        return "gauss-newton"
    return "adam" if model.has_function and not model.has_feedback else "lbfgs"


def optimizer_near(model: Model) -> Optimizer:
    """The optimizer that goes on from near an optimum."""
    return "gauss-newton" if model.is_linear and has_innovations(model) else "preconditioned"
