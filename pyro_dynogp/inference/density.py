"""The log joint density of a Pyro model as a function of one unconstrained vector."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyro
import torch
from torch import Tensor
from torch.distributions import biject_to
from torch.distributions.transforms import Transform

from pyro_dynogp.inference.linear_density import LinearEnergy, linear_density
from pyro_dynogp.inference.log_joint import Direct, LogJoint, density_of
from pyro_dynogp.inference.optimise.descent import hessian
from pyro_dynogp.inference.priors_of_vectors import Constrained, vector_priors
from pyro_dynogp.layers.sites import Arguments, Program
from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError

# Energy where there is no density.
WALL = 1e15
# Samples in all, over the points of a batch, up to which more points cost less than one by one:
# above, the compiled recursions are what an evaluation costs.
AT_ONCE = 12_000
# So many times as many of a linear model, whose points need next to no memory.
LINEAR = 8
# Beyond this logarithms of scales mean nothing. What is larger at an optimum, as a gain may be, may
# be so many times as large.
REACH = 40.0


@dataclass(frozen=True)
class Site:
    """One latent sample site: its shape, and the map from unconstrained to constrained values."""

    name: str
    shape: torch.Size
    unconstrained: torch.Size
    transform: Transform


def parts(sites: Sequence[Site], z: Tensor) -> Iterator[tuple[Site, Tensor]]:
    """Each site with its part (*s, *unconstrained) of the vectors z (*s, d)."""
    start = 0
    for site in sites:
        stop = start + site.unconstrained.numel()
        yield site, z[..., start:stop].reshape(z.shape[:-1] + site.unconstrained)
        start = stop


def joint_energy(
    log_joint: LogJoint,
    sites: Sequence[Site],
    z: Tensor,
    *,
    jacobian: bool,
) -> Tensor:
    """-log p(y, values) at the unconstrained vector z (d,), or (k,) at vectors z (k, d) together.

    With `jacobian` the density is that of the unconstrained vector.
    """
    values: dict[str, Tensor] = {}
    log_jacobian = torch.zeros(z.shape[:-1], dtype=torch.float64)
    for site, part in parts(sites, z):
        value = site.transform(part)
        values[site.name] = value
        if jacobian:
            each = site.transform.log_abs_det_jacobian(part, value)
            log_jacobian = log_jacobian + each.reshape(*z.shape[:-1], -1).sum(-1)
    return -log_joint(values, None if z.dim() == 1 else len(z)) - log_jacobian


def each_with_gradient(energy: Callable[[Tensor], Tensor], z: Tensor) -> tuple[Tensor, Tensor]:
    """Energies (k,) at z (k, d) and their gradients (k, d), infinite and zero where there are none.

    Where one point breaks the evaluation of all, it is found by halving.
    """
    x = z.detach().requires_grad_()
    try:
        with torch.enable_grad(), pyro.validation_enabled(False), denormals_flushed():
            value = energy(x)
            (gradient,) = torch.autograd.grad(value.sum(), x)
    except (NotPositiveDefiniteError, torch.linalg.LinAlgError, ValueError):
        if len(z) == 1:
            return torch.full((1,), torch.inf, dtype=torch.float64), torch.zeros_like(z)
        halves = [each_with_gradient(energy, half) for half in z.tensor_split(2)]
        return torch.cat([v for v, _ in halves]), torch.cat([g for _, g in halves])
    bad = ~(torch.isfinite(value) & torch.isfinite(gradient).all(-1))
    return value.detach().masked_fill(bad, torch.inf), gradient.masked_fill(bad[:, None], 0.0)


def energies_of(energy: Callable[[Tensor], Tensor], z: Tensor) -> Tensor:
    """Energies (k,) at z (k, d) without gradient, infinite where there are none."""
    try:
        with torch.no_grad(), pyro.validation_enabled(False):
            return energy(z).nan_to_num(torch.inf, torch.inf, torch.inf)
    except (NotPositiveDefiniteError, torch.linalg.LinAlgError, ValueError):
        if len(z) == 1:
            return torch.full((1,), torch.inf, dtype=torch.float64)
        return torch.cat([energies_of(energy, half) for half in z.tensor_split(2)])


@contextlib.contextmanager
def denormals_flushed() -> Iterator[None]:
    """Inside, numbers below 1e-308 are zero; outside nothing has changed.

    What an unknown first state leaves decays through that range along a record, and processors are
    many times slower there.
    """
    before = not bool(torch.tensor(1e-310, dtype=torch.float64) * 1.0)
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)


class Potential:
    """Sites of a model given its arguments, and its log joint density.

    A model whose class says ``takes_batches = True`` runs with values (k, *shape) of every site as
    it does with one of each; several points then go through it together.

    `nearly_normal` says whether the density is so close to normal that Laplace's approximation at
    the mode is all the preparation that chains need.

    Args:
        model: a Pyro function. args: what it is called with.
        values: a value for every latent site, at which the model is traced once.
        fixed: values of sites that do not vary; then `model` is called with these.

    Raises:
        ValueError: where a latent site has no value.
    """

    nearly_normal = False

    def __init__(
        self,
        model: Program,
        args: Arguments,
        values: Mapping[str, Tensor],
        fixed: Mapping[str, Tensor] | None = None,
    ) -> None:
        self.model = pyro.poutine.condition(model, data=dict(fixed)) if fixed else model
        self.args, self.at = args, dict(values)
        self.log_density = density_of(model, args, fixed)
        # All of a linear model, of others the priors, without tensors, where there is such a form.
        self.linear = linear_density(self.log_density)
        sites = getattr(self.log_density, "sites", [])
        self.priors = vector_priors(sites) if self.linear is None else None
        self.sites: list[Site] = []
        latent, count = self.log_density.latent(values)
        for name, prior, value in latent:
            transform = biject_to(prior.support)
            unconstrained = transform.inv(value).shape
            self.sites.append(Site(name, value.shape, unconstrained, transform))
        # Points that are evaluated at once.
        batches = getattr(model, "takes_batches", False)
        self.width = max(1, AT_ONCE // max(count, 1)) if batches else 1
        if self.linear is not None:
            self.width *= LINEAR

    @cached_property
    def reach(self) -> Tensor:
        """Sizes (d,) of coordinates beyond which draws count as having no density."""
        return REACH * self.pack(self.at).abs().clamp(min=1.0)

    @property
    def size(self) -> int:
        """Length of the unconstrained vector."""
        return sum(site.unconstrained.numel() for site in self.sites)

    def places(self, names: Sequence[str]) -> np.ndarray:
        """Entries of the unconstrained vector that belong to some sites, in the vector's order."""
        every = parts(self.sites, torch.arange(self.size))
        own = [place.reshape(-1).numpy() for site, place in every if site.name in names]
        return np.concatenate([np.empty(0, dtype=int), *own])

    @property
    def hessian_cost(self) -> int:
        """Evaluations, of `width` points each, that one-sided differences take for a Hessian."""
        return -(-self.size // self.width)

    def pack(self, values: Mapping[str, Tensor]) -> Tensor:
        """Constrained values (*s, *shape) of every site to unconstrained vectors (*s, d), finite.

        A mode may lie on a boundary to the last digit, where the vector would be infinite.
        """
        first = self.sites[0]
        lead = values[first.name].shape[: values[first.name].dim() - len(first.shape)]
        parts = [site.transform.inv(values[site.name]).reshape(*lead, -1) for site in self.sites]
        return within_edges(torch.cat(parts, -1))

    def unpack(self, z: Tensor) -> dict[str, Tensor]:
        """Unconstrained vectors (*s, d) to constrained values (*s, *shape) of every site."""
        return {site.name: site.transform(part) for site, part in parts(self.sites, z)}

    def log_joint(self, values: Mapping[str, Tensor]) -> Tensor:
        """Log p(y, values), of constrained values."""
        return self.log_density(values, None)

    def energy(self, z: Tensor, *, jacobian: bool) -> Tensor:
        """-log density at z (d,) or, of a model that takes batches, (k,) at z (k, d).

        Of the values, or with `jacobian` of the unconstrained vector.
        """
        if self.linear is not None:
            points = z if z.dim() > 1 else z[None]
            energy: Tensor = LinearEnergy.apply(points, self.linear, jacobian)
            return energy if z.dim() > 1 else energy[0]
        if self.priors is not None:
            x, prior = Constrained.apply(z if z.dim() > 1 else z[None], self.priors, jacobian)
            x, prior = (x, prior) if z.dim() > 1 else (x[0], prior[0])
            assert isinstance(self.log_density, Direct)
            return -(prior + self.log_density.likelihood(self.priors.by_site(x)))
        return joint_energy(self.log_density, self.sites, z, jacobian=jacobian)

    def log_jacobian(self, z: Tensor) -> Tensor:
        """Log |d values / dz| (*s) at unconstrained vectors z (*s, d)."""
        total = torch.zeros(z.shape[:-1], dtype=torch.float64)
        for site, part in parts(self.sites, z):
            each = site.transform.log_abs_det_jacobian(part, site.transform(part))
            total = total + each.reshape(*z.shape[:-1], -1).sum(-1)
        return total

    def value_and_gradient(
        self, z: np.ndarray, *, jacobian: bool = False
    ) -> tuple[float, np.ndarray]:
        """Energy and its gradient at z (d,).

        Where the density cannot be evaluated (a covariance singular to rounding, a number out of
        range) the energy is so high that a line search steps back.
        """
        values, gradients = self.values_and_gradients(z[None], jacobian=jacobian)
        return float(values[0]), gradients[0]

    def values_and_gradients(
        self, z: np.ndarray, *, jacobian: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Energies (k,) and their gradients (k, d) at z (k, d), as `value_and_gradient` has them.

        A model that takes batches is evaluated at `width` points at once.
        """

        def energy(x: Tensor) -> Tensor:
            if len(x) == 1:
                return self.energy(x[0], jacobian=jacobian)[None]
            return self.energy(x, jacobian=jacobian)

        points = torch.tensor(z, dtype=torch.float64)
        found = [each_with_gradient(energy, batch) for batch in points.split(self.width)]
        values = torch.cat([value for value, _ in found]).numpy()
        values[np.isinf(values)] = WALL
        return values, torch.cat([gradient for _, gradient in found]).numpy()

    def energies_at(self, points: Sequence[Mapping[str, Tensor]]) -> np.ndarray:
        """Energies (k,) at values of the sites."""
        return self.values_and_gradients(np.stack([self.pack(one).numpy() for one in points]))[0]

    def energies(self, z: Tensor) -> Tensor:
        """Energies (k,) of the unconstrained vector's density at z (k, d), infinite where none."""
        if not getattr(self.model, "takes_batches", False):
            found = [energies_of(lambda x: self.energy(x[0], jacobian=True)[None], one[None]) for
                     one in z]  # fmt: skip
            return torch.cat(found)
        return energies_of(lambda x: self.energy(x, jacobian=True), z)

    def hessian(self, z: np.ndarray, *, step: float = 1e-4) -> np.ndarray:
        """Hessian (d, d) of the energy with Jacobian, by central differences of the gradient."""
        return self.hessian_of(z, range(z.shape[0]), step=step)

    def hessian_of(self, z: np.ndarray, some: Sequence[int], *, step: float = 1e-4) -> np.ndarray:
        """Rows and columns of `hessian` that belong to some entries of z."""
        return hessian(self.with_jacobian, z, some, step=step)

    def with_jacobian(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Energies (k,) and gradients (k, d) of the unconstrained vector's density."""
        return self.values_and_gradients(z, jacobian=True)


# Unconstrained value of what lies on a boundary: within 1e-13 of it.
EDGE = 30.0


def within_edges(z: Tensor) -> Tensor:
    """Unconstrained vectors, finite where values lie on a boundary."""
    return z.detach().nan_to_num(nan=math.nan, posinf=EDGE, neginf=-EDGE)


def spread(values: Mapping[str, Tensor]) -> float:
    """sqrt(d/2), the standard deviation of a d-dimensional normal's log density over its draws."""
    return math.sqrt(0.5 * sum(value.numel() for value in values.values()))


def heaviest(
    evidence: Tensor, values: Mapping[str, Tensor], *, least: float, most: int
) -> tuple[Tensor, Tensor]:
    """Indices of the optima that carry weight, the weightiest first, and their weights.

    Log densities of draws spread by sqrt(d/2) nats, so that an optimum's evidence says hardly more
    than that about the mass around it: weights are exp(evidence / sqrt(d/2)), not exp(evidence),
    which would keep one whatever the rest is.

    Args:
        evidence: (K,) Laplace's approximations of log p(y) around each [nats].
        values: of all sites at one of them. least: weight that counts. most: how many are kept.
    """
    weights, order = torch.softmax(evidence / spread(values), 0).sort(descending=True)
    order = order[weights >= least][:most]
    weights = weights[: len(order)]
    return order, weights / weights.sum()
