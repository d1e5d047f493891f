"""Gains of the modes of a linear system, as its sites state them: numerators and directions."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pyro_dynogp.lti.views import residues


def input_gains(poles: Tensor, gain: Tensor, rate: float) -> Tensor:
    """B (*b, P, n_u) of sections with numerators gain (*b, P, n_u, 2): g1 and g0 of each.

    With one number g, gain (*b, P, n_u, 1), of real poles: G = g rate / (s - lambda), half of which
    is the mode's and half that of its conjugate.
    """
    if gain.shape[-1] == 1:
        return (0.5 * rate * gain[..., 0]).to(poles)
    return residues(poles, _section(poles, gain) * poles.abs()[..., None, None])


def noise_gains(poles: Tensor, share: Tensor, rate: float) -> Tensor:
    """L (*b, P, n_l) of sections with numerators (*b, P, n_l, 2) or (*b, P, n_l, 1).

    A mode of unit gain that decays at `rate` [1/time unit] has an output of standard deviation one.
    """
    if share.shape[-1] == 1:
        return (0.5 * math.sqrt(2.0 * rate) * share[..., 0]).to(poles)
    return residues(poles, _section(poles, share) * math.sqrt(4.0 * rate))


def _section(poles: Tensor, gain: Tensor) -> Tensor:
    """(g1, g0) to the numerator (g1, g0 |lambda|)."""
    size = poles.abs().unsqueeze(-1)
    return torch.stack(torch.broadcast_tensors(gain[..., 0], gain[..., 1] * size), -1)


def unit_direction(raw: Tensor, reference: int = 0) -> Tensor:
    """Columns of raw (*b, n_y, P) of unit length, their entry `reference` real, positive."""
    first = raw[..., reference : reference + 1, :]
    turned = raw * (first.conj() / first.abs())
    return turned / raw.abs().square().sum(-2, keepdim=True).sqrt()
