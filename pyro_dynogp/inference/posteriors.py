"""Posteriors of the sites of a model: a mixture of normals, or draws; both are Pyro guides."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.inference.density import Potential, Site, parts
from pyro_dynogp.inference.posterior_draws import PosteriorDraws
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import seeded
from pyro_dynogp.support.shown import shown

MethodName = Literal["importance", "map", "svi", "nuts"]
Guide = Callable[..., dict[str, Tensor]]


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws of the sites of a model, and their density under the posterior they come from.

    Attributes:
        values: (S, *shape) of each site.
        log_q: (S,) log-density [nats]; None where it is not known.
        group: (S,) number of the component that each draw belongs to.
        kind: where they come from, in words.
    """

    values: Mapping[str, Tensor]
    log_q: Tensor | None
    group: Tensor
    kind: str


@shown
@dataclass(repr=False, frozen=True, eq=False)
class Mixture:
    """K multivariate normals of the unconstrained free sites, with the other sites at points.

    A posterior mode is a mixture of one component without free sites. As a guide it samples the
    component (auxiliary site ``_optimum``, where there are points besides free sites), the
    unconstrained vector (``_latent``, where there are free sites), then every site.

    Attributes:
        weights: (K,) of the components, the best first.
        points: (K, *shape) of the fixed sites.
        loc: (K, d) mean of the unconstrained vector of the free sites.
        scale_tril: (K, d, d) root of its covariance, lower triangular.
        sites: the free sites in the order of the vector, as of `Potential.sites`.
    """

    weights: Tensor
    points: Mapping[str, Tensor]
    loc: Tensor
    scale_tril: Tensor
    sites: tuple[Site, ...]

    @classmethod
    def at(cls, values: Mapping[str, Tensor]) -> Mixture:
        """The point at values (*shape) of all sites: a posterior mode."""
        points = FrozenMapping({name: value.unsqueeze(0) for name, value in values.items()})
        one = torch.ones(1, dtype=torch.float64)
        return cls(one, points, one.new_zeros(1, 0), one.new_zeros(1, 0, 0), ())

    @classmethod
    def normal(cls, potential: Potential, loc: Tensor, scale_tril: Tensor) -> Mixture:
        """One normal (d,), (d, d) of all sites of a potential."""
        return cls(
            torch.ones(1, dtype=torch.float64), FrozenMapping({}), loc.detach()[None],
            scale_tril.detach()[None], tuple(potential.sites),
        )  # fmt: skip

    @classmethod
    def of(
        cls, weights: Tensor, points: Sequence[Mapping[str, Tensor]], normals: Sequence[Mixture]
    ) -> Mixture:
        """From the normal of the free sites at each of K points of the others."""
        return cls(
            weights,
            FrozenMapping({name: torch.stack([p[name] for p in points]) for name in points[0]}),
            torch.cat([normal.loc for normal in normals]),
            torch.cat([normal.scale_tril for normal in normals]),
            normals[0].sites,
        )

    @property
    def method(self) -> MethodName:
        """The method that gives such a posterior."""
        return "svi" if self.sites else "map"

    @property
    def kind(self) -> str:
        """In words."""
        if not self.sites:
            return "posterior mode"
        if not self.points:
            return "SVI, multivariate normal"
        return f"SVI, {len(self.weights)} optima, hyperparameters at each optimum"

    @property
    def _numbered(self) -> bool:
        return len(self.weights) > 1 or bool(self.points and self.sites)

    def __call__(self, *args: object) -> dict[str, Tensor]:
        """Sample the component, then every site."""
        k = torch.zeros((), dtype=torch.int64)
        if self._numbered:
            which = dist.Categorical(self.weights)
            k = pyro.sample("_optimum", which, infer={"is_auxiliary": True})
        values = {}
        for name, x in self.points.items():
            point = x[k]
            values[name] = pyro.sample(name, dist.Delta(point, event_dim=x.dim() - 1))
        if not self.sites:
            return values
        normal = dist.MultivariateNormal(self.loc[k], scale_tril=self.scale_tril[k])
        z = pyro.sample("_latent", normal, infer={"is_auxiliary": True})
        for site, part in parts(self.sites, z):
            value = site.transform(part)
            jacobian = site.transform.log_abs_det_jacobian(part, value)
            extra = jacobian.dim() - (z.dim() - 1)
            jacobian = jacobian.flatten(-extra).sum(-1) if extra else jacobian
            delta = dist.Delta(value, log_density=-jacobian, event_dim=len(site.shape))
            values[site.name] = pyro.sample(site.name, delta)
        return values

    def draws(self, count: int, seed: int) -> Draws:
        """Fresh draws (S = `count`) of all sites."""
        with seeded(seed), torch.no_grad():
            values = draws_of_guide(self, count)
            return self.rated(FrozenMapping(values))

    def rated(self, values: Mapping[str, Tensor]) -> Draws:
        """Given draws of this posterior with their densities; a point has none."""
        group = self.component(values)
        return Draws(values, self.log_prob(values) if self.sites else None, group, self.kind)

    def at_latent(self, z: Tensor) -> dict[str, Tensor]:
        """Values (*s, *shape) of the free sites at unconstrained vectors z (*s, d)."""
        return {site.name: site.transform(part) for site, part in parts(self.sites, z)}

    @property
    def centres(self) -> list[dict[str, Tensor]]:
        """Values of all sites at the centre of each component."""
        return [
            {**{name: x[k] for name, x in self.points.items()}, **self.at_latent(self.loc[k])}
            for k in range(len(self.weights))
        ]

    def component(self, values: Mapping[str, Tensor]) -> Tensor:
        """Which component (S,) each of S draws belongs to.

        Raises:
            ValueError: where a draw is at none of them.
        """
        count = next(iter(values.values())).shape[0]
        if not self._numbered:
            return torch.zeros(count, dtype=torch.int64)
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
        """Log-density (S,) of S draws: of the free sites in their component, and of the component.

        Of constrained values (S, *shape) [nats].
        """
        k = self.component(values)
        z, log_jacobian = [], torch.zeros((), dtype=torch.float64)
        for site in self.sites:
            value = values[site.name]
            lead = value.shape[: value.dim() - len(site.shape)]
            part = site.transform.inv(value)
            jacobian = site.transform.log_abs_det_jacobian(part, value)
            log_jacobian = log_jacobian + jacobian.reshape((*lead, -1)).sum(-1)
            z.append(part.reshape((*lead, -1)))
        loc, root = (self.loc[k], self.scale_tril[k]) if self._numbered else (
            self.loc[0], self.scale_tril[0])  # fmt: skip
        normal = dist.MultivariateNormal(loc, scale_tril=root)
        return normal.log_prob(torch.cat(z, -1)) - log_jacobian + self.weights.log()[k]

    def with_values(self, values: Mapping[str, Tensor]) -> Sampled:
        """Other draws, for what is computed from draws alone."""
        return Sampled(values, self.method)


@shown
@dataclass(repr=False, frozen=True, eq=False)
class Sampled:
    """Draws of a posterior: of chains, by importance, or of a guide with trajectories as sites.

    As a guide it samples the number of a draw (auxiliary site ``_draw``), then every site at it.

    Attributes:
        values: (S, *shape) of every site of the parameters, jointly drawn.
        method: that gave them.
        trajectories: (S, ...) of trajectories and other sites that belong to the training record,
            where the guide had them.
        log_q_sites: (S,) log-density of the draws of each site, auxiliary ones of the guide too,
            where the guide had trajectories as sites [nats].
        source: the draws with their densities that `values` were resampled from, where they were.
    """

    values: Mapping[str, Tensor]
    method: MethodName = "nuts"
    trajectories: Mapping[str, Tensor] = field(default_factory=lambda: FrozenMapping({}))
    log_q_sites: Mapping[str, Tensor] = field(default_factory=lambda: FrozenMapping({}))
    source: PosteriorDraws | None = None

    @property
    def kind(self) -> str:
        """In words."""
        if self.source is not None:
            return self.source.kind
        return "SVI with trajectories as sites" if self.log_q_sites else self.method.upper()

    def __call__(self, *args: object) -> dict[str, Tensor]:
        """Sample the number of a draw, then every site at it."""
        count = next(iter(self.values.values())).shape[0]
        equal = torch.full((count,), 1.0 / count, dtype=torch.float64)
        index = pyro.sample("_draw", dist.Categorical(equal), infer={"is_auxiliary": True})
        return {
            name: pyro.sample(name, dist.Delta(x[index], event_dim=x.dim() - 1))
            for name, x in self.values.items()
        }

    def draws(self, count: int, seed: int) -> Draws:
        """The draws that there are, whatever `count` and `seed`."""
        return self.rated(self.values)

    def rated(self, values: Mapping[str, Tensor]) -> Draws:
        """These draws with their density, trajectories left out."""
        log_q = None
        if self.log_q_sites:
            own = [v for name, v in self.log_q_sites.items() if name not in self.trajectories]
            log_q = torch.stack(own).sum(0)
        group = torch.zeros(len(next(iter(values.values()))), dtype=torch.int64)
        return Draws(values, log_q, group, self.kind)

    def with_values(self, values: Mapping[str, Tensor]) -> Sampled:
        """Other draws; that trajectories were sites stays known."""
        return replace(self, values=values, trajectories=FrozenMapping({}), source=None)


Posterior = Mixture | Sampled


def draws_of_guide(guide: Guide, count: int, *args: object) -> dict[str, Tensor]:
    """Draws (count, *shape) of every site that is not auxiliary."""
    with torch.no_grad(), pyro.plate("draws", count, dim=-1):
        trace = pyro.poutine.trace(guide).get_trace(*args)
    return {
        name: node["value"]
        for name, node in trace.nodes.items()
        if node["type"] == "sample" and not node["infer"].get("is_auxiliary")
        and name != "draws"
    }  # fmt: skip
