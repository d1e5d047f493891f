"""One of many values that are the same model: phases of modes, and axes of their Brownian motions.

With several outputs no prediction changes where all output gains of a pair are multiplied by a
complex number, of which directions are made, nor where the Brownian motions that drive a layer are
rotated into each other. Where a climb ends along such directions is a matter of rounding.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.layers.sites import Values
from pyro_dynogp.models.gains import unit_direction
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.wiring import Dynamic


def in_gauge(model: Model, values: Values, scaling: Scaling) -> dict[str, Tensor]:
    """Values of some sites that make a point the one which all equivalent points share.

    The output gains of a pair are turned until that of the reference output is positive, and get
    the `usual_length`; Brownian motions are rotated until their gains, row by row, are a lower
    triangle.

    Args:
        model: of the sites. values: one of each. scaling: of the record.
    """
    found: dict[str, Tensor] = {}
    for wire, layer in model.dynamic:
        name = f"{wire.name}_output_gain"
        if name in values:
            raw = torch.complex(values[name][..., 0], values[name][..., 1])
            direction = unit_direction(raw, model.reference_of(layer, scaling))
            found[name] = usual_length(len(raw)) * torch.view_as_real(direction)
        if layer.process_noise and (layer.brownian or layer.outputs) > 1:
            found |= _rotated(wire.name, layer, values)
    return found


def usual_length(signals: int) -> float:
    """The most likely length of raw output gains (n_y complex numbers), normal(0, 1) a priori."""
    return math.sqrt(2.0 * signals - 1.0)


def _rotated(name: str, layer: Dynamic, values: Values) -> dict[str, Tensor]:
    """Noise gains of a layer in the axes of their first rows."""
    unit = values[f"{name}_noise_gain_unit"].numpy()
    rows = unit.swapaxes(1, 2)  # P, 2, n_l
    walk = values.get(f"{name}_integrator_noise")
    if layer.noise == "independent":
        turned = np.stack([_triangle(own)[0] for own in rows])
        return {f"{name}_noise_gain_unit": torch.tensor(turned.swapaxes(1, 2))}
    flat, axes = _triangle(rows.reshape(-1, rows.shape[-1]))
    found = {f"{name}_noise_gain_unit": torch.tensor(flat.reshape(rows.shape).swapaxes(1, 2))}
    if walk is not None:
        found[f"{name}_integrator_noise"] = torch.tensor(walk.numpy() @ axes)
    return found


def _triangle(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (m, n) in axes (n, n) in which they are a lower triangle, its diagonal positive."""
    axes, triangle = np.linalg.qr(rows.T, mode="complete")
    sign = np.ones(axes.shape[1])
    diagonal = np.diagonal(triangle)
    sign[: len(diagonal)] = np.where(diagonal < 0.0, -1.0, 1.0)
    axes = axes * sign
    return rows @ axes, axes
