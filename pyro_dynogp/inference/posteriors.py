"""Fitted posteriors as Pyro guides that hold their own numbers: no parameter store, no state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.inference.density import Potential, parts
from pyro_dynogp.support.errors import invalid


@dataclass(frozen=True)
class PointGuide:
    """Delta at the posterior mode: what AutoDelta would hold.

    Attributes:
        values: (*b, *shape) of every latent site. batch: the number of dimensions *b.
    """

    values: Mapping[str, Tensor]
    batch: int = 0

    def __call__(self, *args: Any) -> dict[str, Tensor]:
        """Sample (repeat) every site."""
        return {
            name: pyro.sample(name, dist.Delta(value, event_dim=value.dim() - self.batch))
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

    def values_at(self, z: Tensor) -> dict[str, Tensor]:
        """Constrained values (*s, *shape) of every site at unconstrained vectors z (*s, d)."""
        return {site.name: site.transform(part) for site, part in parts(self.sites, z)}

    def log_prob(self, values: Mapping[str, Tensor]) -> Tensor:
        """Log-density (*s) of constrained values (*s, *shape) of all sites."""
        z, log_jacobian = [], torch.zeros((), dtype=torch.float64)
        for site in self.sites:
            value = values[site.name]
            lead = value.shape[: value.dim() - len(site.shape)]
            part = site.transform.inv(value)
            jacobian = site.transform.log_abs_det_jacobian(part, value)
            log_jacobian = log_jacobian + jacobian.reshape((*lead, -1)).sum(-1)
            z.append(part.reshape((*lead, -1)))
        normal = dist.MultivariateNormal(self.loc, scale_tril=self.scale_tril)
        return normal.log_prob(torch.cat(z, -1)) - log_jacobian


@dataclass(frozen=True)
class MixtureGuide:
    """Several optima, each with its own weight: some sites at a point there, the others normal.

    Attributes:
        weights: (K,) of the optima, the best first. points: (K, *shape) of the former sites.
        loc: (K, d), scale_tril: (K, d, d) of the unconstrained vector of the latter.
        sites: as of `GaussianGuide`.
    """

    weights: Tensor
    points: Mapping[str, Tensor]
    loc: Tensor
    scale_tril: Tensor
    sites: Any

    @classmethod
    def of(
        cls,
        weights: Tensor,
        points: Sequence[Mapping[str, Tensor]],
        normals: Sequence[GaussianGuide],
    ) -> MixtureGuide:
        """From the posterior at each optimum."""
        return cls(
            weights,
            {name: torch.stack([p[name] for p in points]) for name in points[0]},
            torch.stack([one.loc for one in normals]),
            torch.stack([one.scale_tril for one in normals]),
            normals[0].sites,
        )

    def __call__(self, *args: Any) -> dict[str, Tensor]:
        """Sample an optimum (auxiliary site ``_optimum``), then every site there."""
        k = pyro.sample("_optimum", dist.Categorical(self.weights), infer={"is_auxiliary": True})
        point = PointGuide({name: x[k] for name, x in self.points.items()}, k.dim())
        normal = GaussianGuide(self.loc[k], self.scale_tril[k], self.sites)
        return {**point(*args), **normal(*args)}

    def optimum(self, values: Mapping[str, Tensor]) -> Tensor:
        """Which optimum (S,) each of S draws belongs to.

        Raises:
            ValueError: where a draw is at none of them.
        """
        count = next(iter(values.values())).shape[0]
        equal = torch.ones(count, len(self.weights), dtype=torch.bool)
        for name, at in self.points.items():
            same = values[name].unsqueeze(1) == at
            equal &= same.reshape(count, len(self.weights), -1).all(-1)
        if not bool(equal.any(-1).all()):
            raise invalid(
                "values", expected="draws of this guide", got="values at none of its optima"
            )
        return equal.to(torch.int64).argmax(-1)

    def log_prob(self, values: Mapping[str, Tensor]) -> Tensor:
        """Log-density (S,) of S draws: of the free sites at their optimum, and of the optimum."""
        k = self.optimum(values)
        normal = GaussianGuide(self.loc[k], self.scale_tril[k], self.sites)
        return normal.log_prob(values) + self.weights.log()[k]


def gaussian_guide(potential: Potential, loc: Tensor, scale_tril: Tensor) -> GaussianGuide:
    """Guide over the sites of a potential."""
    return GaussianGuide(loc.detach(), scale_tril.detach(), tuple(potential.sites))


Guide = Callable[..., dict[str, Tensor]]
