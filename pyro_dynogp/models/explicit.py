"""Observing a record by a cascade whose trajectories are sample sites."""

from __future__ import annotations

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.models.known import KnownFunction
from pyro_dynogp.models.output_process import OutputProcess
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.system import DynamicSystem, StaticSystem, see
from pyro_dynogp.models.wiring import INPUTS, Wire

# Least variance of the conditional of a static layer's value (scaled units): its density is finite
# where a sample lies on an inducing location.
TINY = 1e-10


def observe_explicit(
    outputs: OutputProcess, record: PreparedRecord, suffix: str, *, last_integrated: bool
) -> None:
    """Sample every trajectory, then the outputs.

    With `last_integrated` the trajectory of a dynamic last layer is integrated out.
    """
    system, inputs = outputs.system, outputs.scaled_inputs
    y, missing = outputs_of(record)
    signals = {INPUTS: system.driving(inputs)}
    for wire, layer in zip(system.wires, system.layers, strict=True):
        x = see(signals, wire)
        if isinstance(layer, DynamicSystem):
            driven = x if layer.modes.inputs else None
            process = LTIProcess(layer.modes, record.grid, driven, layer.prior_state())
            if wire.last and last_integrated:
                observe_linear(process, outputs, record, suffix)
                return
            value = pyro.sample(wire.name + suffix, process)
            signals[wire.name] = value if layer.modes.several_outputs else value.unsqueeze(-1)
        else:
            signals[wire.name] = _sample_function(wire, layer, x, suffix)
    mean = signals[system.wires[-1].name]
    level = system.level(inputs)
    if level is not None:
        mean = mean + level
    mean, sd = outputs.shift + outputs.scale * mean, outputs.scale * outputs.noise_sd
    if not outputs.several:
        mean, sd = mean.squeeze(-1), sd.squeeze(-1)
    noise = system.noise.distribution(mean, sd, missing)
    pyro.sample(f"y{suffix}", noise.to_event(1 + outputs.several), obs=y)


def _sample_function(wire: Wire, layer: StaticSystem, x: Tensor, suffix: str) -> Tensor:
    several = wire.layer.outputs > 1
    if wire.pathwise or isinstance(layer.function, KnownFunction):
        value = layer(x)
        value = value if several else value.squeeze(-1)
        value = pyro.deterministic(wire.name + suffix, value, event_dim=1 + several)
    else:
        mean, variance = layer.function.mean(x), layer.function.variance(x)
        if not several:
            mean, variance = mean.squeeze(-1), variance.squeeze(-1)
        sd = (variance + TINY).sqrt()
        value = pyro.sample(wire.name + suffix, dist.Normal(mean, sd).to_event(1 + several))
    return value if several else value.unsqueeze(-1)


def outputs_of(record: PreparedRecord) -> tuple[Tensor | None, Tensor | None]:
    """Outputs (n,) or (n, n_y) with zeros where missing, and where that is; None for none."""
    if not record.has_outputs:
        return None, None
    y = record.observations
    missing = torch.isnan(y)
    return (y.masked_fill(missing, 0.0), missing) if bool(missing.any()) else (y, None)


def observe_linear(
    process: LTIProcess, outputs: OutputProcess, record: PreparedRecord, suffix: str
) -> None:
    """Observe a dynamic last layer, its trajectory integrated out."""
    system, scale, shift = outputs.system, outputs.scale, outputs.shift
    assert system.offset is not None
    assert system.noise.constant_sd is not None
    level, sd = shift + scale * system.offset, scale * system.noise.constant_sd
    modes = process.modes.rescale(outputs=scale if outputs.several else scale[0])
    if not outputs.several:
        level, sd = level.squeeze(-1), sd.squeeze(-1)
    driven = process.inputs if modes.inputs else None
    physical = LTIProcess(modes, process.grid, driven, process.initial_state, offset=level)
    y = record.observations if record.has_outputs else None
    pyro.sample(f"y{suffix}", physical.observed(sd), obs=y)
