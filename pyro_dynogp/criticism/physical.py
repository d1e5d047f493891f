r"""Poles, gains and noise of a fitted model in the units of its record.

Each pair of poles is a second-order section with a steady-state gain g0 and a gain g1 of its
derivative path, G(s) = |lambda| (g1 s + g0 |lambda|) / ((s - lambda)(s - conj lambda)); the sum of
all g0 and the feedthrough D is the steady-state gain of the system.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.criticism.labelled import Variable, ratio_units, units_of
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.views import numerators
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.system import System
from pyro_dynogp.models.wiring import Dynamic, Wire
from pyro_dynogp.support.tensors import as_tensor


def physical_quantities(
    model: Model, scaling: Scaling, system: System, draws: int
) -> dict[str, Variable]:
    """Deterministic quantities (S, *shape) by name, in the units of the record.

    Of each dynamic layer g ``g_decay_rate``, ``g_frequency``, ``g_time_constant`` (P,); of a model
    of one layer of dynamics with inputs ``g_pair_steady_state_gain``, ``g_pair_derivative_gain``
    (P, n_y, n_u) and ``g_steady_state_gain`` (n_y, n_u), of all pairs and the feedthrough, or of
    one with integrators ``g_integrator_rate`` (n_y, n_u), per unit of time;
    ``measurement_noise_sd`` (n_y,) where it is constant; ``output_offset`` (n_y,) but for a static
    last layer. Layers beside others have gains of no unit, which are left out.

    Args:
        model: the model. scaling: of the training record.
        system: batch (S,). draws: S.
    """
    out: dict[str, Variable] = {}
    for wire, layer in system.dynamic:
        assert isinstance(wire.layer, Dynamic)
        poles = layer.modes.expand((draws,)).poles[:, : wire.layer.pairs]
        out |= _poles(wire, poles, scaling.time_unit)
    if system.is_linear and model.inputs:
        ((_, made),) = model.dynamic
        out |= _gains(system.physical(scaling).modes.expand((draws,)), made, scaling)
    scale, shift = as_tensor(scaling.output_scale), as_tensor(scaling.output_offset)
    sd, offset = system.noise.constant_sd, system.offset
    for name, value in (
        ("measurement_noise_sd", None if sd is None else scale * sd),
        ("output_offset", None if offset is None else shift + scale * offset),
    ):
        if value is not None:
            values = value.expand(draws, value.shape[-1]).numpy()
            out[name] = Variable(values, ("output",), units_of(scaling.output_units))
    return out


def _poles(wire: Wire, poles: Tensor, unit: str) -> dict[str, Variable]:
    decay, frequency = -poles.real, poles.imag
    dims = (wire.dims["pair"],)
    return {
        f"{wire.name}_decay_rate": Variable(decay.numpy(), dims, {"units": f"1/{unit}"}),
        f"{wire.name}_frequency": Variable(frequency.numpy(), dims, {"units": f"rad/{unit}"}),
        f"{wire.name}_time_constant": Variable((1.0 / decay).numpy(), dims, {"units": unit}),
    }


def _gains(modes: Modes, layer: Dynamic, scaling: Scaling) -> dict[str, Variable]:
    S, P, n_y, n_u = modes.batch_shape[0], layer.pairs, modes.outputs, modes.inputs
    residue = modes.C.mT.unsqueeze(-1) * modes.B.unsqueeze(-2)
    rate = 2.0 * residue[:, P : P + layer.integrators * n_y].sum(1).real
    poles, residue = modes.poles[:, :P], residue[:, :P].reshape(S, P, n_y * n_u)
    b = numerators(poles, residue).reshape(S, P, n_y, n_u, 2)
    size = poles.abs()[..., None, None]
    derivative, steady = b[..., 0] / size, b[..., 1] / size.square()
    total: Tensor = steady.sum(-3) + modes.D
    units = ratio_units(scaling.output_units, scaling.input_units)
    each: dict[str, tuple[Tensor, tuple[str, ...]]] = {
        "g_pair_derivative_gain": (derivative, ("pair", "output", "input")),
        "g_pair_steady_state_gain": (steady, ("pair", "output", "input")),
    }
    if layer.integrators:
        each["g_integrator_rate"] = (rate, ("output", "input"))
    else:
        each["g_steady_state_gain"] = (total, ("output", "input"))
    return {k: Variable(_real(values), dims, units) for k, (values, dims) in each.items()}


def _real(values: Tensor) -> np.ndarray:
    return torch.as_tensor(values, dtype=torch.float64).numpy()
