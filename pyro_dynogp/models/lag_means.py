r"""What a first-order lag in feedback sends to the next layer: its mean over the step.

Held at its value at the beginning of a step, a signal comes half a step late. Of a lag
x' = lambda x + b w, with w held for a step d,

    mean of x = p_1 x(0) + d p_2 b w,  p_1 = (exp(z) - 1)/z,  p_2 = (p_1 - 1)/z,  z = lambda d,

is linear in what the filter has at the beginning of the step: x(0) and what comes back to the lag.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pyro_dynogp.lti.fused import propagators
from pyro_dynogp.lti.grid import TimeGrid
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.models.wiring import Dynamic, Wire

# Where the formula of p_2 loses digits, and how many terms its series has there.
_SMALL, _TERMS = 0.1, 12


@dataclass(frozen=True, eq=False)
class LagMean:
    """Means over steps of the output of a first-order lag.

    Attributes:
        share: (*b, m) of the output at the beginning of each distinct step.
        gains: (*b, m, E) of the static outputs that are held meanwhile.
        known: (*b, n) what known inputs add to `share` times what they cause at the beginning.
    """

    share: Tensor
    gains: Tensor
    known: Tensor


def has_mean(above: Wire, place: Wire) -> bool:
    """Whether a layer sees the mean over each step of the one above it.

    That is a first-order lag, and nothing passes through either layer at once.
    """
    layers = above.layer, place.layer
    if not all(isinstance(layer, Dynamic) and not layer.feedthrough for layer in layers):
        return False
    first = above.layer
    return isinstance(first, Dynamic) and first.real and first.pairs == 1


def mean_of_lag(modes: Modes, grid: TimeGrid, known: Tensor, held: Tensor) -> LagMean:
    """Means over the steps of a grid.

    Args:
        modes: of the lag. known: (*b, n) its output, as far as known inputs cause it.
        held: (*b, m, n_u, E) share of each static output in each of its inputs.
    """
    decay, held_gain = (x[..., 0].real for x in propagators(modes, grid.steps))  # (*b, m)
    first, second = held_gain / grid.steps, _second(modes.poles.real * grid.steps)
    gain = 2.0 * (modes.C.real[..., 0, :, None] * modes.B.real)[..., 0, :]  # (*b, n_u)
    gains = (grid.steps * second)[..., None] * (gain[..., None, None, :] @ held)[..., 0, :]
    step = torch.from_numpy(grid.step_index[1:].clip(0))
    # What drives the known part follows from its two ends; a step of no length adds nothing.
    grown = known[..., 1:] - decay[..., step] * known[..., :-1]
    added = (second / first)[..., step] * grown
    added = torch.where(torch.from_numpy(grid.step_index[1:] >= 0), added, 0.0)
    nothing = added.new_zeros((*added.shape[:-1], 1))
    return LagMean(first, gains, torch.cat([added, nothing], -1))


def _second(z: Tensor) -> Tensor:
    """(exp(z) - 1 - z)/z^2 for z <= 0."""
    away = torch.where(z.abs() < _SMALL, -1.0, z)
    series = torch.ones_like(z)
    for k in range(_TERMS, 0, -1):
        series = 1.0 + series * z / (k + 2)
    return torch.where(z.abs() < _SMALL, 0.5 * series, (torch.expm1(away) - away) / away.square())
