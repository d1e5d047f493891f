"""Sample sites as data: what a layer is made of, before anything is sampled."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

# "free": inducing values, first states, rests of functions, which a posterior around an optimum
# treats as unknown; "hyperparameter": all other sites.
Role = Literal["hyperparameter", "free"]
Values = Mapping[str, Tensor]
# A model or a guide, the library's or a user's, and what it is called with.
Program = Callable[..., object]
Arguments = tuple[object, ...]


@dataclass(frozen=True, eq=False)
class Site:
    """One latent sample site of a model.

    Attributes:
        name: of the site. prior: its distribution; the event shape is the site's shape.
        dims: names of the dimensions of one value.
        role: "free" or "hyperparameter".
        growth: where a model is extended and the site gets new rows or columns, what their starting
            values are multiplied by so that they do nothing yet; 1 leaves them as they are.
    """

    name: str
    prior: dist.Distribution
    dims: tuple[str, ...]
    role: Role = "hyperparameter"
    growth: float = 1.0

    @property
    def shape(self) -> torch.Size:
        """Of one value."""
        return self.prior.event_shape

    def typical(self) -> Tensor:
        """A value in the middle of the prior: mean of a normal, median of a log-normal.

        Of other distributions a draw.
        """
        prior = self.prior
        base = prior.base_dist if isinstance(prior, torch.distributions.Independent) else prior
        if isinstance(base, torch.distributions.LogNormal):
            return base.loc.exp().expand(self.shape).clone()
        if isinstance(base, torch.distributions.Normal):
            return base.mean.expand(self.shape).clone()
        with pyro.poutine.block():
            value: Tensor = self.prior.sample()
        return value


def sample(sites: Iterable[Site]) -> dict[str, Tensor]:
    """Pyro samples of sites, in their order, by name."""
    return {site.name: pyro.sample(site.name, site.prior) for site in sites}


def normal(name: str, loc: Tensor, dims: tuple[str, ...], role: Role = "hyperparameter") -> Site:
    """A site of the shape of `loc` that is normal around it with standard deviation one."""
    return Site(name, dist.Normal(loc, 1.0).to_event(loc.dim()), dims, role)
