"""Exact densities of cascades in which only the last layer's trajectory is unknown.

Where dynamic layers have no process noise and a known first state, the recorded inputs determine
their trajectories: nothing is there to be filtered. What remains is white noise around a known
signal, or one linear stochastic system with known inputs, whose density is exact in O(n) and much
cheaper than the moment-matching filter's.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.lti.grid import TimeGrid
from pyro_dynogp.models.system import CascadeSystem, DynamicSystem, StaticSystem, see
from pyro_dynogp.models.wiring import INPUTS


def is_known(layer: DynamicSystem) -> bool:
    """Whether known inputs determine a dynamic layer's trajectory."""
    return layer.first_state is not None and not layer.modes.has_process_noise


def has_exact_density(system: CascadeSystem) -> bool:
    """Whether noise is Gaussian and no dynamic layer's trajectory is unknown but the last layer's.

    The last layer may have process noise and an unknown first state where it is dynamic.
    """
    known = all(is_known(one) for one in system.layers[:-1] if isinstance(one, DynamicSystem))
    return known and system.noise.likelihood.gaussian


def log_density(system: CascadeSystem, grid: TimeGrid, inputs: Tensor, y: Tensor) -> Tensor:
    """Log-density (*b) of scaled outputs.

    Args:
        system: for which `has_exact_density` holds. grid: time axis. inputs: (n, n_u) scaled.
        y: (*s, n, n_y) scaled outputs, NaN where missing.
    """
    signals = {INPUTS: system.driving(inputs)}
    sd = system.noise_sd(inputs, grid)
    level = system.level(inputs)
    if level is not None:
        y = y - level
    for one, layer in zip(system.wires, system.layers, strict=True):
        seen = see(signals, one)
        if isinstance(layer, DynamicSystem) and one.last and not is_known(layer):
            driven = seen if layer.modes.inputs else None
            process = LTIProcess(layer.modes, grid, driven, layer.prior_state())
            if not layer.modes.several_outputs:
                y, sd = y.squeeze(-1), sd.squeeze(-1)
            return process.observed(sd, varying=True).log_prob(y)
        if isinstance(layer, StaticSystem) and one.last and not one.pathwise:
            signals[one.name], variance = layer.function.moments(seen)
            sd = (sd.square() + variance).sqrt()
        else:
            signals[one.name] = layer.mean(seen, grid)
    missing = torch.isnan(y)
    error = (torch.where(missing, 0.0, y) - signals[system.wires[-1].name]) / sd
    each = -0.5 * error.square() - sd.log() - 0.5 * math.log(2.0 * math.pi)
    return torch.where(missing, 0.0, each).sum((-2, -1))
