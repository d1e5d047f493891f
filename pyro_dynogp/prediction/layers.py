"""What the layers of a fitted cascade do along a record: their signals and functions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from pyro_dynogp.data.record import Record
from pyro_dynogp.lti.grid import time_grid
from pyro_dynogp.models.assembly import Assembly, assemble
from pyro_dynogp.models.system import DynamicSystem, scaled_inputs, scaled_outputs
from pyro_dynogp.moments import filtering, smoothing
from pyro_dynogp.moments.problem import FilterProblem, each
from pyro_dynogp.prediction.first_state import beginning, cascade_of
from pyro_dynogp.prediction.records import one_record
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import as_tensor

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fit


@dataclass(frozen=True)
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


def layers(fit: Fit, record: Record) -> dict[str, LayerTrajectory]:
    """Smoothed trajectories of all layers given a record's inputs and outputs."""
    record = one_record(fit, record)
    with torch.no_grad():
        inputs = scaled_inputs(fit.scaling, record)
        assembly = assemble(beginning(fit, record), time_grid(record.time), inputs)
        y = scaled_outputs(fit.scaling, record) if record.n_outputs else None
        problem = assembly.problem if y is None else assembly.with_outputs(y)
        return smoothed_layers(assembly, problem, record.time)


def smoothed_layers(
    assembly: Assembly, problem: FilterProblem, time: np.ndarray
) -> dict[str, LayerTrajectory]:
    """Mean and sd of every signal of a cascade given the outputs of the problem."""
    elements, batch = problem.elements()
    A = problem.G.shape[-1]
    names, widths, rows = [], [], []
    for name, signal in assembly.signals.items():
        if signal.rows is None:
            continue
        names.append(name)
        widths.append(signal.rows.shape[-2])
        rows.append(signal.rows.expand(*batch, widths[-1], A).reshape(-1, widths[-1], A))
    nothing = torch.zeros(len(elements), 0, A, dtype=torch.float64)
    joined = (torch.cat(rows, -2) if rows else nothing).contiguous().numpy()

    def one(b: int) -> tuple[np.ndarray, np.ndarray]:
        _, means, covariances, _, _ = filtering.run(problem.layout, elements[b])
        mean, variance = smoothing.smooth(
            problem.layout, elements[b], joined[b], means, covariances
        )
        return mean @ joined[b].T, variance

    found = each(one, len(elements))
    mean = np.stack([m for m, _ in found])
    sd = np.sqrt(np.stack([v for _, v in found]))
    out, start = {}, 0
    for name, signal in assembly.signals.items():
        n, w = signal.known.shape[-2:]
        known = signal.known.expand(*batch, n, w).reshape(-1, n, w).numpy()
        if signal.rows is None:
            draw_mean, draw_sd = known, np.zeros_like(known)
        else:
            own = slice(start, start + w)
            draw_mean, draw_sd = known + mean[..., own], sd[..., own]
            start += w
        if name == "inputs":
            continue
        total = np.sqrt((draw_sd**2).mean(0) + draw_mean.var(0))
        out[name] = LayerTrajectory(name, time, draw_mean.mean(0), total, draw_mean, draw_sd)
    return out


@dataclass(frozen=True)
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


def static_function(fit: Fit, name: str, record: Record, channel: int, points: int) -> StaticBand:
    """See `Fit.static_function`."""
    wires = {one.name: one for one in cascade_of(fit).wires}
    layer = fit.system.layer(name)
    if isinstance(layer, DynamicSystem):
        raise invalid("name", expected="a static layer", got=f"{name!r}, a dynamic one")
    one = wires[name]
    if not 0 <= channel < one.channels:
        raise invalid("channel", expected=f"0 to {one.channels - 1}", got=repr(channel))
    record = one_record(fit, record)
    found = {k: v.mean for k, v in layers(fit, record).items()}
    found["inputs"] = fit.system.driving(scaled_inputs(fit.scaling, record)).numpy()
    seen = np.concatenate([found[source] for source in one.sources], -1)
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
