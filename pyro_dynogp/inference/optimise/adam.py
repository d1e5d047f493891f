"""Adam, for densities whose slopes vary by orders of magnitude on the way."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.inference.optimise.lockstep import Functions

# The first step, and how often a climb goes back to the best point with a shorter one.
RATE, RETURNS = 0.02, 2
# Share of the largest slope below which one is rounding.
ROUNDING = 1e-11


def adam(
    functions: Functions, z: np.ndarray, steps: int, rate: float
) -> tuple[np.ndarray, list[float], str]:
    """Adam with a falling step; back to the best point with a shorter one where it got lost.

    Its first steps have full length in every direction, however good the start is.

    Args:
        functions: values and gradients. z: (d,), where it begins.
        steps: most iterations. rate: the first step, in unconstrained units.

    Returns:
        The best point, the value at each iteration, and why it ended.
    """
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
        # Of rounding, as along directions without any slope, Adam would make steps of full length.
        slope = gradients[0]
        seen = np.abs(slope) > ROUNDING * np.abs(slope).max(initial=0.0)
        x.grad = torch.tensor(np.where(seen, slope, 0.0))
        optimizer.step()
        schedule.step()
    return best_z, history, "all steps used"


def _from(z: np.ndarray, rate: float, steps: int) -> tuple[Tensor, Any, Any]:
    """Adam at a point, with a step that falls over the steps that are left."""
    x = torch.tensor(z, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([x], lr=rate)
    low = min(1e-4, 0.1 * rate)
    return x, optimizer, torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=low)
