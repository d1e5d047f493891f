r"""Poles, gains and noise of a fitted model in the units of its record.

Each pair of poles is a second-order section with a steady-state gain g0 and a gain g1 of its
derivative path, G(s) = |lambda| (g1 s + g0 |lambda|) / ((s - lambda)(s - conj lambda)); the sum of
all g0 and the feedthrough D is the steady-state gain of the system.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.criticism.labelled import Variable, ratio_units, units_of
from pyro_dynogp.criticism.site_dimensions import Place, places_of
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.models.linear import LinearDynamicGP
from pyro_dynogp.models.model import Cascade
from pyro_dynogp.models.priors import numerators
from pyro_dynogp.models.system import CascadeSystem, DynamicSystem
from pyro_dynogp.support.tensors import as_tensor


def physical_quantities(
    model: LinearDynamicGP | Cascade, scaling: Scaling, system: Any, draws: int
) -> dict[str, Variable]:
    """Deterministic quantities (S, *shape) by name, in the units of the record.

    Of each dynamic layer g ``g_decay_rate``, ``g_frequency``, ``g_time_constant`` (P,); of a
    linear model with inputs ``g_pair_steady_state_gain``, ``g_pair_derivative_gain`` (P, n_y, n_u)
    and ``g_steady_state_gain`` (n_y, n_u), of all pairs and the feedthrough;
    ``measurement_noise_sd`` (n_y,) where it is constant; ``output_offset`` (n_y,) but for a static
    last layer. Layers of a cascade have gains of no unit, which are left out.

    Args:
        model: the model. scaling: of the training record.
        system: `LinearSystem` or `CascadeSystem`, batch (S,). draws: S.
    """
    out: dict[str, Variable] = {}
    for place in places_of(model, scaling):
        layer = system if isinstance(model, LinearDynamicGP) else system.layer(place.name)
        if isinstance(model, LinearDynamicGP) or isinstance(layer, DynamicSystem):
            out |= _poles(place, layer.modes.expand((draws,)), scaling.time_unit)
    if isinstance(model, LinearDynamicGP):
        if model.inputs:
            out |= _gains(system.modes.expand((draws,)), scaling)
        noise_sd, offset = system.noise_sd, system.offset
        if not model.several_outputs:
            noise_sd, offset = noise_sd.unsqueeze(-1), offset.unsqueeze(-1)
    else:
        noise_sd, offset = _outputs_of(system, scaling)
    for name, value in (("measurement_noise_sd", noise_sd), ("output_offset", offset)):
        if value is not None:
            values = value.expand(draws, value.shape[-1]).numpy()
            out[name] = Variable(values, ("output",), units_of(scaling.output_units))
    return out


def _outputs_of(system: CascadeSystem, scaling: Scaling) -> tuple[Tensor | None, Tensor | None]:
    """Scale of the noise and level of the outputs of a cascade."""
    scale, shift = as_tensor(scaling.output_scale), as_tensor(scaling.output_offset)
    sd, offset = system.noise.constant_sd, system.offset
    return (
        None if sd is None else scale * sd,
        None if offset is None else shift + scale * offset,
    )


def _poles(place: Place, modes: Modes, unit: str) -> dict[str, Variable]:
    decay, frequency = -modes.poles.real, modes.poles.imag
    dims = (place.own("pair"),)
    return {
        f"{place.name}_decay_rate": Variable(decay.numpy(), dims, {"units": f"1/{unit}"}),
        f"{place.name}_frequency": Variable(frequency.numpy(), dims, {"units": f"rad/{unit}"}),
        f"{place.name}_time_constant": Variable((1.0 / decay).numpy(), dims, {"units": unit}),
    }


def _gains(modes: Modes, scaling: Scaling) -> dict[str, Variable]:
    S, P, n_y, n_u = modes.batch_shape[0], modes.pairs, modes.outputs, modes.inputs
    residue = modes.C.mT.unsqueeze(-1) * modes.B.unsqueeze(-2)
    b = numerators(modes.poles, residue.reshape(S, P, n_y * n_u)).reshape(S, P, n_y, n_u, 2)
    size = modes.poles.abs()[..., None, None]
    derivative, steady = b[..., 0] / size, b[..., 1] / size.square()
    total: Tensor = steady.sum(-3) + modes.D
    units = ratio_units(scaling.output_units, scaling.input_units)
    each: dict[str, tuple[Tensor, tuple[str, ...]]] = {
        "g_pair_derivative_gain": (derivative, ("pair", "output", "input")),
        "g_pair_steady_state_gain": (steady, ("pair", "output", "input")),
        "g_steady_state_gain": (total, ("output", "input")),
    }
    return {k: Variable(_real(values), dims, units) for k, (values, dims) in each.items()}


def _real(values: Tensor) -> np.ndarray:
    return torch.as_tensor(values, dtype=torch.float64).numpy()
