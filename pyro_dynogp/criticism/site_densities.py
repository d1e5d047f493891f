"""Densities of single samples of an observed site of any Pyro model."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.criticism.densities import Kind, pointwise_log_density
from pyro_dynogp.distributions.process import ObservedLTIProcess
from pyro_dynogp.distributions.trajectory import Trajectory
from pyro_dynogp.models.output_process import OutputProcess

AROUND = (torch.distributions.Independent, dist.MaskedDistribution, dist.ExpandedDistribution)


def inside(distribution: Any) -> Any:
    """The distribution inside `to_event`, `mask` and `expand`."""
    while isinstance(distribution, AROUND):
        distribution = distribution.base_dist
    return distribution


def is_trajectory(distribution: Any) -> bool:
    """Whether a site's value is a whole trajectory, measured or not."""
    return isinstance(inside(distribution), Trajectory | OutputProcess)


def is_integrated(distribution: Any) -> bool:
    """Whether a site's value is measured along a trajectory that is integrated out."""
    return isinstance(inside(distribution), ObservedLTIProcess | OutputProcess)


def is_masked(distribution: Any) -> bool:
    """Whether part of a site's value is masked."""
    while isinstance(distribution, AROUND):
        if isinstance(distribution, dist.MaskedDistribution):
            return True
        distribution = distribution.base_dist
    return False


def integrated_density(
    distribution: Any, value: Tensor, kind: Kind, horizon: int = 1
) -> np.ndarray:
    """Log-density (R, n, n_y) [nats] of each output of R records; NaN where it is missing.

    Raises:
        ValueError: where no trajectory is integrated out, see `pointwise_log_density`.
    """
    return pointwise_log_density(inside(distribution), value, kind, horizon=horizon)


def elementwise_density(distribution: Any, value: Tensor) -> Tensor:
    """Log-density [nats] of each element of a value that factorises; NaN where it is masked.

    Of the shape of the value; without the dimensions over which the distribution is joint, such as
    those of a multivariate normal.
    """
    if isinstance(distribution, torch.distributions.Independent):
        return elementwise_density(distribution.base_dist, value)
    if isinstance(distribution, dist.MaskedDistribution):
        density = elementwise_density(distribution.base_dist, value)
        keep = torch.as_tensor(distribution._mask)
        keep = keep.reshape(keep.shape + (1,) * (density.dim() - keep.dim()))
        return density.masked_fill(~keep.expand(density.shape), torch.nan)
    own: Tensor = distribution.log_prob(value)
    return own


def measured(distribution: Any, value: Tensor) -> Tensor:
    """Which elements of a value carry data: neither masked nor NaN.

    Of shape (R, n, n_y), in the order of the densities: R records, n samples of each, n_y outputs.
    Of a site that factorises dimensions before the last two count as records.
    """
    if is_integrated(distribution):
        event = inside(distribution).event_shape
        there = ~torch.isnan(value)
        return there.reshape(-1, event[0], event[1] if len(event) > 1 else 1)
    there = _unmasked(distribution, value)
    if there.dim() < 2:
        return there.reshape(1, -1, 1)
    return there.reshape(-1, *there.shape[-2:])


def _unmasked(distribution: Any, value: Tensor) -> Tensor:
    if isinstance(distribution, torch.distributions.Independent):
        return _unmasked(distribution.base_dist, value)
    if isinstance(distribution, dist.MaskedDistribution):
        there = _unmasked(distribution.base_dist, value)
        keep = torch.as_tensor(distribution._mask)
        return there & keep.reshape(keep.shape + (1,) * (there.dim() - keep.dim()))
    there = ~torch.isnan(value)
    for _ in distribution.event_shape:
        there = there.all(-1)
    return there.expand(torch.broadcast_shapes(there.shape, distribution.batch_shape))
