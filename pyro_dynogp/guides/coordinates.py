"""Unconstrained coordinates of sites, where they start, and the parameters of normals over them."""

from __future__ import annotations

from collections.abc import Callable

import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import constraints
from torch import Tensor
from torch.distributions import biject_to
from torch.distributions.transforms import Transform

from pyro_dynogp.support.errors import invalid


def parameter(
    name: str,
    init: Callable[[], Tensor],
    event_dim: int,
    constraint: constraints.Constraint = constraints.real,
) -> Tensor:
    """`pyro.param` that starts at a copy; dimensions left of event_dim belong to plates."""
    value: Tensor = pyro.param(
        name, lambda: init().detach().clone(), constraint=constraint, event_dim=event_dim
    )
    return value


def joint_normal(name: str, loc: Tensor, scale: float) -> dist.MultivariateNormal:
    """Multivariate normal with parameters ``<name>.loc``, ``.scale`` and ``.scale_tril``.

    The Cholesky factor is scale times scale_tril, whose diagonal is one: apart from their scale,
    its entries are of one size, which suits a learning rate for all of them.

    Args:
        name: prefix. loc: (*b, d) first mean. scale: first standard deviation.
    """
    if not scale > 0:
        raise invalid("init_scale", expected="a number > 0", got=repr(scale))
    d = loc.shape[-1]

    def eye() -> Tensor:
        return torch.eye(d, dtype=loc.dtype, device=loc.device).expand((*loc.shape, d))

    mean = parameter(f"{name}.loc", lambda: loc, 1)
    sd = parameter(f"{name}.scale", lambda: torch.full_like(loc, scale), 1, constraints.positive)
    unit = parameter(f"{name}.scale_tril", eye, 2, constraints.unit_lower_cholesky)
    return dist.MultivariateNormal(mean, scale_tril=sd.unsqueeze(-1) * unit)


def to_support(name: str, prior: dist.TorchDistribution) -> Transform:
    """The map from unconstrained coordinates to the support of a site.

    Raises:
        ValueError: where there is none, as for discrete sites.
    """
    try:
        return biject_to(prior.support)
    except NotImplementedError as error:
        raise invalid(
            f"site '{name}'",
            expected="a continuous distribution",
            got=f"{type(prior).__name__} on {prior.support}",
            advice="Give it the family SameAsPrior(), or integrate it out.",
        ) from error


def unconstrained(name: str, prior: dist.TorchDistribution, value: Tensor) -> Tensor:
    """Unconstrained coordinates of a value.

    Raises:
        ValueError: where the value is not inside the support.
    """
    z: Tensor = to_support(name, prior).inv(value)
    if not bool(torch.isfinite(z).all()):
        raise invalid(
            f"starting value of site '{name}'",
            expected=f"values inside {prior.support}",
            got="some on its boundary or beyond",
        )
    return z


def each(support: constraints.Constraint) -> constraints.Constraint:
    """The constraint on what `independent` repeats."""
    while hasattr(support, "base_constraint"):
        support = support.base_constraint
    return support


def is_real(prior: dist.TorchDistribution) -> bool:
    """Whether the support is all real numbers, so that `to_support` is the identity."""
    return isinstance(each(prior.support), type(constraints.real))


def middle(prior: dist.TorchDistribution) -> Tensor:
    """Mean of a distribution, or a median of draws where the mean is not finite or unknown."""
    support = prior.support
    try:
        mean: Tensor = prior.mean
        if bool(torch.isfinite(mean).all()) and bool(support.check(mean).all()):
            return mean.detach().clone()
    except (NotImplementedError, AttributeError, ValueError):
        pass  # transformed distributions, for instance
    draws: Tensor = prior.sample((31,)).detach()
    # Medians of single numbers are some draw's, so inside the support; where the support ties
    # numbers together (a simplex) only whole draws are.
    return draws.median(0).values if each(support).event_dim == 0 else draws[0]
