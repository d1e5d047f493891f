"""Posterior mode of the exact marginal model: several starts, the best one kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from pyro_dynogp.inference.potential import Potential
from pyro_dynogp.parallel import parallel_map, seeded
from pyro_dynogp.record import Record

Optimizer = Literal["lbfgs", "adam"]


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
    model: Any
    records: Record | Sequence[Record]
    values: dict[str, Tensor]
    optimizer: Optimizer
    steps: int
    seed: int


def _lbfgs(potential: Potential, z: np.ndarray, steps: int) -> tuple[np.ndarray, list, str]:
    history: list[float] = []
    result = minimize(
        potential.value_and_gradient,
        z,
        jac=True,
        method="L-BFGS-B",
        callback=lambda intermediate_result: history.append(float(intermediate_result.fun)),
        options={"maxiter": steps, "maxfun": 2 * steps, "maxcor": 20, "ftol": 1e-7},
    )
    return result.x, history, str(result.message)


def _adam(potential: Potential, z: np.ndarray, steps: int) -> tuple[np.ndarray, list, str]:
    x = torch.tensor(z, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([x], lr=0.03)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=1e-4)
    history: list[float] = []
    best, best_z = np.inf, z
    patience = max(50, steps // 10)
    since = 0
    for _ in range(steps):
        here = x.detach().numpy().copy()
        value, gradient = potential.value_and_gradient(here)
        history.append(value)
        since += 1
        if value < best - 1e-3:
            since = 0
        if value < best:
            best, best_z = value, here
        if since > patience:
            return best_z, history, "no improvement of 0.001 nats within the patience"
        x.grad = torch.tensor(gradient)
        optimizer.step()
        schedule.step()
    return best_z, history, "all steps used"


def _optimise(task: _Task) -> Optimum:
    with seeded(task.seed):
        potential = Potential(task.model, (task.records,), task.values)
        z = potential.pack(task.values).numpy()
        method = _lbfgs if task.optimizer == "lbfgs" else _adam
        z, history, message = method(potential, z, task.steps)
        energy = potential.value_and_gradient(z)[0]
        values = {k: v.detach() for k, v in potential.unpack(torch.tensor(z)).items()}
    return Optimum(energy, values, np.asarray(history), message)


def maximise(
    model: Any,
    records: Record | Sequence[Record],
    starts: Sequence[dict[str, Tensor]],
    *,
    optimizer: Optimizer = "lbfgs",
    steps: int = 500,
    seed: int = 0,
    workers: int | None = None,
    progress: bool = False,
) -> list[Optimum]:
    """Climb from every start; the optima sorted by energy, best first.

    All starts get a fifth of the steps, then the best third of them the rest (successive halving:
    a start that is far behind by then hardly ever wins). The mode is that of the density of the
    constrained values (no Jacobian), as AutoDelta has it.
    """

    def climb(values: Sequence[dict[str, Tensor]], count: int, label: str) -> list[Optimum]:
        tasks = [_Task(model, records, value, optimizer, count, seed) for value in values]
        return parallel_map(_optimise, tasks, workers=workers, progress=progress, description=label)

    def best_first(optima: list[Optimum]) -> list[Optimum]:
        return sorted(optima, key=lambda optimum: optimum.energy)

    if len(starts) == 1:
        return climb(starts, steps, "optimum")
    short = max(1, steps // 5)
    first = best_first(climb(starts, short, "starts"))
    if steps <= short:
        return first
    cut = -(-len(first) // 3)
    leading = first[:cut]
    further = climb([optimum.values for optimum in leading], steps - short, "optima")
    joined = [
        replace(after, history=np.concatenate([before.history, after.history]))
        for before, after in zip(leading, further, strict=True)
    ]
    return best_first([*joined, *first[cut:]])
