"""The horseshoe prior on the noise gains: most of them nothing, a few of any size."""

from __future__ import annotations

import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.layers.sites import Site, Values

# Scale of the horseshoe on the noise gains (paper, appendix "Implementation").
HORSESHOE_SCALE = 0.1


def horseshoe_sites(
    name: str, *shape: int, dims: tuple[str, ...], positive: bool = False, growth: float = 1.0
) -> tuple[Site, Site]:
    """Sites of a horseshoe over rows, hierarchical and non-centred.

    ``<name>_local_scale`` (shape[0],) half-Cauchy(1) and ``<name>_unit`` standard normal, or
    half-normal if `positive`. Their density is proper, unlike the horseshoe density itself, whose
    mode at zero is infinite.

    Source: Carvalho, Polson & Scott, Proc. AISTATS 5:73 (2009).
    """
    local = dist.HalfCauchy(torch.ones(shape[:1], dtype=torch.float64)).to_event(1)
    ones = torch.ones(shape, dtype=torch.float64)
    unit = dist.HalfNormal(ones) if positive else dist.Normal(0.0 * ones, ones)
    return (
        Site(f"{name}_local_scale", local, dims[:1]),
        Site(f"{name}_unit", unit.to_event(len(shape)), dims, growth=growth),
    )


def horseshoe(name: str, values: Values, rank: int, scale: float = HORSESHOE_SCALE) -> Tensor:
    """Scale * local * unit (*b, *shape), of the sites of `horseshoe_sites`; rank: of the shape."""
    local, unit = values[f"{name}_local_scale"], values[f"{name}_unit"]
    return scale * local.reshape(local.shape + (1,) * (rank - 1)) * unit
