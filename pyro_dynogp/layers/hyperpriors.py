"""Distributions of a GPyTorch kernel's parameters, as Pyro has them."""

from __future__ import annotations

import math

import pyro.distributions as dist
import torch
from gpytorch import kernels, priors
from torch import Tensor
from torch.distributions import AffineTransform
from torch.distributions import constraints as supports

from pyro_dynogp.support.errors import invalid


def hyperprior(kernel: kernels.Kernel, parameter: str) -> dist.Distribution:
    """Distribution of one parameter of a kernel, of what it means.

    The prior registered for it (a Gamma, LogNormal, Normal, HalfCauchy, HalfNormal or Uniform one,
    which then replaces the constraint's bounds); without one and within the constraint's bounds
    LogNormal(log(present value), 1) if positive, the same for the distance to the bound if bounded
    on one side by another number, uniform between two bounds, and Normal(present value, 1) if free.

    Args:
        kernel: a GPyTorch kernel.
        parameter: full name of the parameter, "base_kernel.raw_lengthscale".

    Returns:
        A distribution whose event is the parameter's shape.

    Raises:
        ValueError: if the registered prior is of another kind or wider than the constraint's sign.
    """
    value = meaning(kernel, parameter)
    constraint = kernel.constraint_for_parameter_name(parameter)
    lower, upper = (-math.inf, math.inf)
    if constraint is not None:
        lower, upper = (float(b.detach().double()) for b in constraint)
    registered = _registered_prior(kernel, parameter, positive=lower >= 0.0)
    if registered is not None:
        return registered.expand(value.shape).to_event(value.dim())
    one = torch.ones_like(value)
    prior: dist.Distribution
    if math.isfinite(lower) and math.isfinite(upper):
        prior = dist.Uniform(lower * one, upper * one)
    elif lower == 0.0:
        prior = dist.LogNormal(value.log(), one)
    elif math.isfinite(lower):
        prior = dist.LogNormal((value - lower).log(), one)
        prior = dist.TransformedDistribution(prior, [_From(lower, 1.0)])
    elif math.isfinite(upper):
        prior = dist.LogNormal((upper - value).log(), one)
        prior = dist.TransformedDistribution(prior, [_From(upper, -1.0)])
    else:
        prior = dist.Normal(value, one)
    return prior.to_event(value.dim())


class _From(AffineTransform):
    """Positive numbers to those above (scale 1) or below (scale -1) a bound; knows its range."""

    @supports.dependent_property(is_discrete=False, event_dim=0)
    def codomain(self) -> supports.Constraint:
        above = self.scale > 0
        return supports.greater_than(self.loc) if above else supports.less_than(self.loc)


def _registered_prior(
    kernel: kernels.Kernel, parameter: str, positive: bool
) -> dist.Distribution | None:
    """Pyro's twin of the GPyTorch prior of a parameter, or None without one."""
    found = [
        entry for entry in kernel.named_priors() if entry[0] == plain_name(parameter) + "_prior"
    ]
    if not found:
        return None
    _, module, p, closure, _ = found[0]
    kind = type(p)
    plain = torch.equal(closure(module), meaning(kernel, parameter))
    if plain and getattr(p, "_transform", None) is None:
        if kind is priors.GammaPrior:
            return dist.Gamma(p.concentration.double(), p.rate.double())
        if kind is priors.LogNormalPrior:
            return dist.LogNormal(p.loc.double(), p.scale.double())
        if kind is priors.HalfCauchyPrior:
            return dist.HalfCauchy(p.scale.double())
        if kind is priors.HalfNormalPrior:
            return dist.HalfNormal(p.scale.double())
        if kind is priors.NormalPrior and not positive:
            return dist.Normal(p.loc.double(), p.scale.double())
        if kind is priors.UniformPrior and not (positive and bool((p.low < 0).any())):
            return dist.Uniform(p.low.double(), p.high.double())
    raise invalid(
        "kernel",
        expected="priors of the parameters themselves that are Gamma, LogNormal, HalfCauchy, "
        "HalfNormal or Uniform (for a parameter of any sign also Normal)",
        got=f"{kind.__name__} for {parameter}",
        advice="Register another prior, or none for the default.",
    )


def plain_name(parameter: str) -> str:
    """Name of a parameter, or of each part of it, without "raw_"."""
    return parameter.replace("raw_", "")


def meaning(kernel: kernels.Kernel, parameter: str) -> Tensor:
    """Present value of a parameter within its constraint."""
    raw = kernel.get_parameter(parameter).detach()
    constraint = kernel.constraint_for_parameter_name(parameter)
    return raw if constraint is None else constraint.transform(raw)
