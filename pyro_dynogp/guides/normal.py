"""Distributions of guides whose divergences Pyro does not know, or gets wrong."""

from __future__ import annotations

import pyro.distributions as dist
import torch
from pyro.distributions.distribution import Distribution
from torch import Tensor
from torch.distributions import Independent, Normal, register_kl

from pyro_dynogp.support.tensors import broadcast


class FlatNormal(dist.TransformedDistribution):
    """A multivariate normal over the numbers of an event, reshaped to the event."""


class PlacedDelta(dist.Delta):
    """A value computed from another site, with the density that the map to it has there."""


@register_kl(PlacedDelta, Distribution)
def placed_divergence(q: PlacedDelta, p: Distribution) -> Tensor:
    """E_q[log q - log p]; Pyro's own for Delta leaves out the first, the log-Jacobian."""
    return q.log_density - p.log_prob(q.v)


@register_kl(FlatNormal, Normal)
@register_kl(FlatNormal, Independent)
def flat_divergence(q: FlatNormal, p: Distribution) -> Tensor:
    """KL of a multivariate normal from independent normals.

    Raises:
        NotImplementedError: where p is another distribution.
    """
    shape = broadcast(q.batch_shape, p.batch_shape)
    event = q.event_shape
    while isinstance(p, Independent):
        p = p.base_dist
    if not isinstance(p, Normal):
        raise NotImplementedError("no closed form")
    loc, scale_tril = q.base_dist.loc, q.base_dist.scale_tril
    mean = p.loc.expand(shape + event).reshape((*shape, event.numel()))
    sd = p.scale.expand(shape + event).reshape((*shape, event.numel()))
    trace = ((scale_tril / sd.unsqueeze(-1)).square()).sum((-2, -1))
    distance = ((loc - mean) / sd).square().sum(-1)
    log_det = sd.log().sum(-1) - scale_tril.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    divergence = 0.5 * (trace + distance - event.numel()) + log_det
    return torch.broadcast_to(divergence, shape)
