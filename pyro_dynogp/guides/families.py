"""Variational families: the posterior of one latent site, made from the prior that the site has.

A family says what `LayerGuide` puts in the place of a site's distribution. Its parameters are
`pyro.param`, named after the site, in whatever parameter store is in scope. They have the shape
of the site itself; particles share them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from torch import Tensor
from torch.distributions.transforms import ReshapeTransform

from pyro_dynogp.distributions.inducing import InducingLTIProcess, inducing_times
from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.guides.coordinates import (
    is_real,
    joint_normal,
    middle,
    parameter,
    to_support,
    unconstrained,
)
from pyro_dynogp.guides.normal import FlatNormal
from pyro_dynogp.support.errors import invalid, verify_fields
from pyro_dynogp.support.tensors import as_tensor


class Family:
    """Base of the families. One of your own has to define `posterior`; no more is needed."""

    @property
    def start(self) -> Tensor | None:
        """Value of the site at which it starts, if one was given."""
        return None

    def started(self, name: str, prior: dist.TorchDistribution, value: Tensor) -> Family:
        """The same family, made to start at a value of the site.

        `LayerGuide` calls this once, before there are particles.

        Args:
            name: of the site. prior: its distribution when all sites are at their starting values.
            value: starting value (*plates, *event).
        """
        return self

    def posterior(self, name: str, prior: dist.TorchDistribution) -> dist.TorchDistribution:
        """Distribution of the site in the guide.

        Args:
            name: of the site. prior: its distribution in the model, given all sites before it, as
                the guide has drawn them; with particles it has their batch dimensions.

        Returns:
            A distribution with the event shape of the prior and a batch shape that broadcasts with
            its batch shape.
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class SameAsPrior(Family):
    """The site's distribution in the model itself, given what comes before it; no parameters."""

    def posterior(self, name: str, prior: dist.TorchDistribution) -> dist.TorchDistribution:
        """The prior."""
        return prior


@dataclass(frozen=True, eq=False)
class _Started(Family):
    # The start in the coordinates of the parameters; LayerGuide fills it in.
    at: Tensor | None = field(default=None, kw_only=True, repr=False)

    def __post_init__(self) -> None:
        verify_fields(self)

    @property
    def start(self) -> Tensor | None:
        """Value of the site at which it starts, if one was given."""
        init = self._init()
        return init if isinstance(init, Tensor | None) else as_tensor(init)

    def _init(self) -> Any:
        return getattr(self, "init", None)

    def started(self, name: str, prior: dist.TorchDistribution, value: Tensor) -> Family:
        """The same family, made to start at a value of the site."""
        return replace(self, at=self._coordinates(name, prior, value))

    def _coordinates(self, name: str, prior: dist.TorchDistribution, value: Tensor) -> Tensor:
        return unconstrained(name, prior, value)

    def _at(self, name: str, prior: dist.TorchDistribution) -> Tensor:
        """Where the parameters start; outside a LayerGuide, the family's own value or the prior's.

        Such a start has the batch shape of the prior.
        """
        if self.at is not None:
            return self.at
        value = middle(prior) if self.start is None else self.start
        return self._coordinates(name, prior, value)


@dataclass(frozen=True, eq=False)
class Point(_Started):
    """A point estimate, the mode of the posterior density of the site (maximum a posteriori).

    Parameter: ``<name>.point``, the value in unconstrained coordinates (`biject_to`).

    Args:
        init: starting value of the site.
    """

    init: Any = None

    def posterior(self, name: str, prior: dist.TorchDistribution) -> dist.TorchDistribution:
        """Delta at the value."""
        transform = to_support(name, prior)
        point = parameter(
            f"{name}.point", lambda: self._at(name, prior), transform.domain.event_dim
        )
        return dist.Delta(transform(point), event_dim=prior.event_dim)


@dataclass(frozen=True, eq=False)
class MeanField(_Started):
    """Independent normals in the unconstrained coordinates of the site, pushed to its support.

    Parameters: ``<name>.loc`` and ``<name>.scale``, of the unconstrained shape of the site.

    Args:
        init_scale: first standard deviation. init: starting value of the site.
    """

    init_scale: float = 0.05
    init: Any = None

    def posterior(self, name: str, prior: dist.TorchDistribution) -> dist.TorchDistribution:
        """A normal, transformed where the support is not all real numbers."""
        transform = to_support(name, prior)
        event_dim = transform.domain.event_dim
        loc = parameter(f"{name}.loc", lambda: self._at(name, prior), event_dim)
        scale = parameter(
            f"{name}.scale",
            lambda: torch.full_like(self._at(name, prior), self.init_scale),
            event_dim,
            constraints.positive,
        )
        normal = dist.Normal(loc, scale).to_event(event_dim)
        if is_real(prior):  # left as a normal it has closed-form divergences
            return normal
        return dist.TransformedDistribution(normal, [transform.with_cache()])


@dataclass(frozen=True, eq=False)
class FullRank(_Started):
    """A multivariate normal over the unconstrained coordinates of the site, pushed to its support.

    Parameters: ``<name>.loc`` (*plates, d), ``<name>.scale`` (*plates, d) and ``<name>.scale_tril``
    (*plates, d, d), d numbers in the unconstrained event; see `joint_normal`. Members of a plate
    are independent.

    Args:
        init_scale: first standard deviation. init: starting value of the site.

    Examples:
        >>> def model():
        ...     pyro.sample("x", dist.Normal(torch.zeros(3).double(), 1.0).to_event(1))
        >>> guide = dgp.LayerGuide(model, {"x": dgp.FullRank(init_scale=0.1)})
        >>> guide()["x"].shape
        torch.Size([3])
    """

    init_scale: float = 0.05
    init: Any = None

    def posterior(self, name: str, prior: dist.TorchDistribution) -> dist.TorchDistribution:
        """A multivariate normal, reshaped, and transformed where the support needs it."""
        transform = to_support(name, prior)
        first = self._at(name, prior)
        plates = first.dim() - transform.domain.event_dim
        event = first.shape[plates:]
        flat = first.reshape((*first.shape[:plates], event.numel()))
        normal = joint_normal(name, flat, self.init_scale)
        reshape = ReshapeTransform(torch.Size([event.numel()]), event)
        if is_real(prior):
            return FlatNormal(normal, [reshape])
        return dist.TransformedDistribution(normal, [reshape, transform.with_cache()])


@dataclass(frozen=True, eq=False)
class GaussMarkov(_Started):
    """A trajectory given pseudo-observations of all its samples, with noise of their own.

    The best Gaussian there is where the likelihood is a product over time given this trajectory
    (Khan & Lin 2017); O(n). Only for sites that are an `LTIProcess`.

    Parameters: ``<name>.pseudo_outputs`` and ``<name>.pseudo_sd`` (*plates, *event) [output].

    Start near: from pseudo-observations that are many standard deviations off the data, stochastic
    gradients first widen their noise, until they say so little that moving them no longer pays.

    Args:
        init_mean: first pseudo-observations, of the shape of the trajectory.
        init_sd: first standard deviation of their noise [output]: a number, or one each.

    Examples:
        >>> modes = dgp.Modes([-1.0 + 2.0j], [[1.0 + 0.0j]], [0.5 + 0.0j], [[0.3 + 0.0j]])
        >>> def model():
        ...     pyro.sample("g", dgp.LTIProcess(modes, [0.0, 0.1], [[1.0], [0.0]]))
        >>> guide = dgp.LayerGuide(model, {"g": dgp.GaussMarkov(init_sd=0.5)})
        >>> guide()["g"].shape
        torch.Size([2])
    """

    init_mean: Any = None
    init_sd: Any = 1.0

    def _init(self) -> Any:
        return self.init_mean

    def posterior(self, name: str, prior: dist.TorchDistribution) -> dist.TorchDistribution:
        """The prior, conditioned."""
        require_process("GaussMarkov", name, prior)

        def sd() -> Tensor:
            value = as_tensor(self.init_sd)
            if not bool((value > 0).all()):
                raise invalid("init_sd", expected="numbers > 0", got=str(self.init_sd))
            return value.expand(self._at(name, prior).shape)

        event_dim = prior.event_dim
        y = parameter(f"{name}.pseudo_outputs", lambda: self._at(name, prior), event_dim)
        noise = parameter(f"{name}.pseudo_sd", sd, event_dim, constraints.positive)
        return prior.condition(y, noise, varying=True)


@dataclass(frozen=True, eq=False)
class InducingTimes(_Started):
    """A trajectory whose values at inducing times are jointly normal, the rest as the prior has it.

    Only for sites that are an `LTIProcess`; see `InducingLTIProcess` and `inducing_times`.

    Parameters: ``<name>.loc``, ``<name>.scale`` and ``<name>.scale_tril`` as those of `FullRank`,
    of the whitened values at the inducing times.

    Args:
        count: number of inducing times, at most that of samples. seed: of their draw.
        init_scale: first standard deviation; 1 is that of the prior, less is learnt faster from
            informative records. init: starting trajectory.

    Examples:
        >>> modes = dgp.Modes([-1.0 + 2.0j], [[1.0 + 0.0j]], [0.5 + 0.0j], [[0.3 + 0.0j]])
        >>> def model():
        ...     pyro.sample("g", dgp.LTIProcess(modes, [0.0, 0.1, 0.2], [[1.0], [0.0], [0.0]]))
        >>> guide = dgp.LayerGuide(model, {"g": dgp.InducingTimes(2)})
        >>> guide()["g"].shape
        torch.Size([3])
    """

    count: int
    seed: int = 0
    init_scale: float = 0.1
    init: Any = None

    def _coordinates(self, name: str, prior: dist.TorchDistribution, value: Tensor) -> Tensor:
        require_process("InducingTimes", name, prior)
        index = inducing_times(prior.grid, self.count, self.seed)
        size = self.count * prior.modes.outputs
        standard = torch.eye(size, dtype=torch.float64)
        return InducingLTIProcess(prior, index, standard[0], standard).whiten(value)

    def posterior(self, name: str, prior: dist.TorchDistribution) -> dist.TorchDistribution:
        """The variational distribution of the trajectory."""
        require_process("InducingTimes", name, prior)
        index = inducing_times(prior.grid, self.count, self.seed)
        normal = joint_normal(name, self._at(name, prior), self.init_scale)
        return InducingLTIProcess(prior, index, normal.loc, normal.scale_tril)


def default_family(name: str, prior: dist.TorchDistribution) -> Family:
    """What a site without a family gets: Gauss-Markov if it is a trajectory, else mean field."""
    return GaussMarkov() if isinstance(prior, LTIProcess) else MeanField()


def require_process(family: str, name: str, prior: dist.TorchDistribution) -> None:
    """Refuse a site that is not a trajectory.

    Raises:
        ValueError: naming family and site.
    """
    if not isinstance(prior, LTIProcess):
        raise invalid(
            f"{family} for site '{name}'",
            expected="an LTIProcess",
            got=type(prior).__name__,
            advice="Give the site another family, such as MeanField() or FullRank().",
        )
