"""Posterior mode of the exact marginal model: several starts, the best one kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from pyro_dynogp.inference.checkpoints import (
    NOTHING_KEPT,
    Checkpoints,
    Piece,
    tensor_text,
    text_tensor,
)
from pyro_dynogp.inference.potential import Potential
from pyro_dynogp.parallel import parallel_map, seeded
from pyro_dynogp.record import Record

Optimizer = Literal["lbfgs", "adam"]
# Adam's first step, and how often it goes back to the best point with a shorter one.
RATE, RETURNS = 0.02, 2


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
    checkpoints: Checkpoints
    key: str
    rate: float


def _lbfgs(
    potential: Potential, z: np.ndarray, steps: int, rate: float
) -> tuple[np.ndarray, list, str]:
    del rate  # its line search finds the step
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


def _adam(
    potential: Potential, z: np.ndarray, steps: int, rate: float
) -> tuple[np.ndarray, list, str]:
    """Adam with a falling step; back to the best point with a shorter one where it got lost.

    Its first steps have full length in every direction, however good the start is.
    """
    x, optimizer, schedule = _from(z, rate, steps)
    history: list[float] = []
    best, best_z = np.inf, z
    patience = max(50, steps // 10)
    since, returns = 0, 0
    for done in range(steps):
        here = x.detach().numpy().copy()
        value, gradient = potential.value_and_gradient(here)
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
        x.grad = torch.tensor(gradient)
        optimizer.step()
        schedule.step()
    return best_z, history, "all steps used"


def _from(z: np.ndarray, rate: float, steps: int) -> tuple[Tensor, Any, Any]:
    """Adam at a point, with a step that falls over the steps that are left."""
    x = torch.tensor(z, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([x], lr=rate)
    low = min(1e-4, 0.1 * rate)
    return x, optimizer, torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=low)


_METHODS = {"lbfgs": _lbfgs, "adam": _adam}


def _optimise(task: _Task) -> Optimum:
    piece = task.checkpoints.piece(task.key, lambda: _pack(_climb(task)))
    return _unpack(piece)


def _climb(task: _Task) -> Optimum:
    with seeded(task.seed):
        potential = Potential(task.model, (task.records,), task.values)
        z = potential.pack(task.values).numpy()
        z, history, message = _METHODS[task.optimizer](potential, z, task.steps, task.rate)
        energy = potential.value_and_gradient(z)[0]
        values = {k: v.detach() for k, v in potential.unpack(torch.tensor(z)).items()}
    return Optimum(energy, values, np.asarray(history), message)


def _pack(optimum: Optimum) -> Piece:
    return {
        "energy": torch.tensor(optimum.energy, dtype=torch.float64),
        "history": torch.tensor(optimum.history, dtype=torch.float64),
        "message": text_tensor(optimum.message),
        **{f"value/{name}": value for name, value in optimum.values.items()},
    }


def _unpack(piece: Piece) -> Optimum:
    values = {k[len("value/") :]: v for k, v in piece.items() if k.startswith("value/")}
    message = tensor_text(piece["message"])
    history = piece["history"].numpy()
    return Optimum(float(piece["energy"]), values, history, message)


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
    checkpoints: Checkpoints = NOTHING_KEPT,
    key: str = "optimum",
    kept: float = 1 / 3,
    rate: float = RATE,
) -> list[Optimum]:
    """Climb from every start; the optima sorted by energy, best first.

    All starts get a fifth of the steps, then the best of them, the share `kept`, the rest
    (successive halving: a start that is far behind by then hardly ever wins). The mode is that of
    the density of the constrained values (no Jacobian), as AutoDelta has it. `rate` is Adam's
    first step, in unconstrained units.
    """

    def climb(values: Sequence[dict[str, Tensor]], count: int, label: str) -> list[Optimum]:
        tasks = [
            _Task(
                model,
                records,
                value,
                optimizer,
                count,
                seed,
                checkpoints,
                f"{key}-{label}-{i}",
                rate,
            )
            for i, value in enumerate(values)
        ]
        return parallel_map(
            _optimise,
            tasks,
            workers=workers,
            progress=progress,
            description=label,
            news=lambda found: f"log p {-min(o.energy for o in found):.2f}",
        )

    def best_first(optima: list[Optimum]) -> list[Optimum]:
        return sorted(optima, key=lambda optimum: optimum.energy)

    if len(starts) == 1:
        return climb(starts, steps, "optimum")
    short = max(1, steps // 5)
    first = best_first(climb(starts, short, "starts"))
    if steps <= short:
        return first
    cut = max(1, round(kept * len(first)))
    leading = first[:cut]
    further = climb([optimum.values for optimum in leading], steps - short, "optima")
    joined = [
        replace(after, history=np.concatenate([before.history, after.history]))
        for before, after in zip(leading, further, strict=True)
    ]
    return best_first([*joined, *first[cut:]])
