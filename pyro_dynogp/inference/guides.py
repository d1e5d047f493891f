"""Fitted posteriors as Pyro guides that hold their own numbers: no parameter store, no state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.inference.potential import Potential, parts


@dataclass(frozen=True)
class PointGuide:
    """Delta at the posterior mode: what AutoDelta would hold.

    Attributes:
        values: value of every latent site.
    """

    values: Mapping[str, Tensor]

    def __call__(self, *args: Any) -> dict[str, Tensor]:
        """Sample (repeat) every site."""
        return {
            name: pyro.sample(name, dist.Delta(value, event_dim=value.dim()))
            for name, value in self.values.items()
        }


@dataclass(frozen=True)
class DrawsGuide:
    """Posterior draws, one of them at random: what Predictive or a replay needs after NUTS.

    Attributes:
        draws: (S, *shape) of every latent site, jointly drawn.
    """

    draws: Mapping[str, Tensor]

    def __call__(self, *args: Any) -> dict[str, Tensor]:
        """Sample an index, then every site at it."""
        count = next(iter(self.draws.values())).shape[0]
        index = pyro.sample(
            "_draw",
            dist.Categorical(torch.full((count,), 1.0 / count, dtype=torch.float64)),
            infer={"is_auxiliary": True},
        )
        return {
            name: pyro.sample(name, dist.Delta(x[index], event_dim=x.dim() - 1))
            for name, x in self.draws.items()
        }


@dataclass(frozen=True)
class GaussianGuide:
    """Multivariate normal over the unconstrained vector of all sites: AutoMultivariateNormal.

    Attributes:
        loc: (d,). scale_tril: (d, d), lower triangular.
        sites: what `Potential.sites` says of the sites, in order.
    """

    loc: Tensor
    scale_tril: Tensor
    sites: Any

    def __call__(self, *args: Any) -> dict[str, Tensor]:
        """Sample the vector (auxiliary site ``_latent``), then every site from it."""
        z = pyro.sample(
            "_latent",
            dist.MultivariateNormal(self.loc, scale_tril=self.scale_tril),
            infer={"is_auxiliary": True},
        )
        values = {}
        for site, part in parts(self.sites, z):
            value = site.transform(part)
            jacobian = site.transform.log_abs_det_jacobian(part, value)
            extra = jacobian.dim() - (z.dim() - 1)
            jacobian = jacobian.flatten(-extra).sum(-1) if extra else jacobian
            values[site.name] = pyro.sample(
                site.name,
                dist.Delta(value, log_density=-jacobian, event_dim=len(site.shape)),
            )
        return values


@dataclass(frozen=True)
class JointGuide:
    """Some sites at a point, the others normal.

    Attributes:
        point: of the former. gaussian: of the latter.
    """

    point: PointGuide
    gaussian: GaussianGuide

    def __call__(self, *args: Any) -> dict[str, Tensor]:
        """Sample every site."""
        return {**self.point(*args), **self.gaussian(*args)}


def gaussian_guide(potential: Potential, loc: Tensor, scale_tril: Tensor) -> GaussianGuide:
    """Guide over the sites of a potential."""
    return GaussianGuide(loc.detach(), scale_tril.detach(), tuple(potential.sites))


Guide = Callable[..., dict[str, Tensor]]
