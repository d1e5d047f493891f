"""What the layers of a fitted model do along a record: their signals and functions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from pyro_dynogp.data.record import Record
from pyro_dynogp.models.arrival import arriving
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.system import DynamicSystem, see
from pyro_dynogp.prediction.first_state import beginning
from pyro_dynogp.prediction.records import prepared
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.shown import shown
from pyro_dynogp.support.tensors import as_tensor

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted


@shown
@dataclass(repr=False, frozen=True)
class LayerTrajectory:
    """Posterior of a layer's output along a record.

    Attributes:
        name: of the layer. time: (n,).
        mean, sd: (n, w), over state and parameters, in the layer's own scale (inputs and outputs of
            the cascade have unit standard deviation there).
        draw_mean, draw_sd: (S, n, w), the same for each posterior draw of the parameters.
    """

    name: str
    time: np.ndarray
    mean: np.ndarray
    sd: np.ndarray
    draw_mean: np.ndarray
    draw_sd: np.ndarray


def layers(fit: Fitted, record: Record) -> dict[str, LayerTrajectory]:
    """See `Fit.layers`."""
    return trajectories(fit, prepared(fit, record))


def trajectories(fit: Fitted, along: PreparedRecord) -> dict[str, LayerTrajectory]:
    """Smoothed trajectories of all layers given a record's inputs and outputs."""
    with torch.no_grad():
        outputs = output_process(beginning(fit, along), along)
        smoothed = outputs.smooth(along.observations if along.has_outputs else None)
    found = {}
    for name, layer in smoothed.items():
        sd = np.sqrt((layer.sd**2).mean(0) + layer.mean.var(0))
        found[name] = LayerTrajectory(
            name, along.record.time, layer.mean.mean(0), sd, layer.mean, layer.sd
        )
    return found


@shown
@dataclass(repr=False, frozen=True)
class StaticBand:
    """A static layer's function over the range of its input.

    Attributes:
        name: of the layer. channel: which input varies; others are at their mean.
        x: (m,). mean, sd: (m, e) over parameters and the function itself.
        inputs: (n,) posterior means of the layer's input along the record: where there are data.
    """

    name: str
    channel: int
    x: np.ndarray
    mean: np.ndarray
    sd: np.ndarray
    inputs: np.ndarray


def static_function(
    fit: Fitted, name: str, record: Record, channel: int, points: int
) -> StaticBand:
    """See `Fit.static_function`."""
    wires = {wire.name: wire for wire in fit.model.wires}
    layer = fit.system.layer(name)
    if isinstance(layer, DynamicSystem):
        raise invalid("name", expected="a static layer", got=f"{name!r}, a dynamic one")
    wire = wires[name]
    if not 0 <= channel < wire.channels:
        raise invalid("channel", expected=f"0 to {wire.channels - 1}", got=repr(channel))
    along = prepared(fit, record)
    found = {k: v.mean for k, v in trajectories(fit, along).items()}
    driving = fit.system.driving(arriving(along, fit.system.delays)[1])
    found["inputs"] = driving.reshape(-1, *driving.shape[-2:]).mean(0).numpy()
    signals = {signal: as_tensor(path) for signal, path in found.items()}
    seen = see(signals, wire).numpy()
    low, high = seen[:, channel].min(), seen[:, channel].max()
    margin = 0.1 * (high - low)
    x = np.linspace(low - margin, high + margin, points)
    at = np.tile(seen.mean(0), (points, 1))
    at[:, channel] = x
    with torch.no_grad():
        mean, variance = layer.function.moments(as_tensor(at))
    mean_, variance_ = mean.numpy(), variance.numpy()
    mean_ = mean_.reshape(-1, *mean_.shape[-2:])
    variance_ = variance_.reshape(-1, *variance_.shape[-2:])
    sd = np.sqrt(variance_.mean(0) + mean_.var(0))
    return StaticBand(name, channel, x, mean_.mean(0), sd, seen[:, channel])
