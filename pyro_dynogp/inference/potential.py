"""The log joint density of a Pyro model as a function of one unconstrained vector."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyro
import torch
from torch import Tensor
from torch.distributions import biject_to
from torch.distributions.transforms import Transform

from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError


@dataclass(frozen=True)
class Site:
    """One latent sample site: its shape, and the map from unconstrained to constrained values."""

    name: str
    shape: torch.Size
    unconstrained: torch.Size
    transform: Transform


class Potential:
    """Sites of a model given its arguments, and its log joint density.

    Args:
        model: a Pyro function. args: what it is called with.
        values: a value for every latent site, at which the model is traced once.
    """

    def __init__(
        self, model: Callable[..., Any], args: tuple[Any, ...], values: Mapping[str, Tensor]
    ) -> None:
        self.model, self.args = model, args
        trace = pyro.poutine.trace(pyro.poutine.condition(model, data=dict(values))).get_trace(
            *args
        )
        self.sites: list[Site] = []
        for name, node in trace.nodes.items():
            if node["type"] == "sample" and name in values:
                value = node["value"].detach()
                transform = biject_to(node["fn"].support)
                self.sites.append(Site(name, value.shape, transform.inv(value).shape, transform))

    @property
    def size(self) -> int:
        """Length of the unconstrained vector."""
        return sum(site.unconstrained.numel() for site in self.sites)

    def pack(self, values: Mapping[str, Tensor]) -> Tensor:
        """Constrained values of every site to the unconstrained vector (d,)."""
        parts = [site.transform.inv(values[site.name]).reshape(-1) for site in self.sites]
        return torch.cat(parts).detach()

    def unpack(self, z: Tensor) -> dict[str, Tensor]:
        """Unconstrained vectors (*s, d) to constrained values (*s, *shape) of every site."""
        values, start = {}, 0
        for site in self.sites:
            stop = start + site.unconstrained.numel()
            part = z[..., start:stop].reshape(z.shape[:-1] + site.unconstrained)
            values[site.name] = site.transform(part)
            start = stop
        return values

    def log_joint(self, values: Mapping[str, Tensor]) -> Tensor:
        """Log p(y, values), of constrained values."""
        conditioned = pyro.poutine.condition(self.model, data=dict(values))
        return pyro.poutine.trace(conditioned).get_trace(*self.args).log_prob_sum()

    def log_jacobian(self, z: Tensor) -> Tensor:
        """Log-determinant of the map from the unconstrained vector z (d,) to the values."""
        total, start = z.new_zeros(()), 0
        for site in self.sites:
            stop = start + site.unconstrained.numel()
            part = z[start:stop].reshape(site.unconstrained)
            total = total + site.transform.log_abs_det_jacobian(part, site.transform(part)).sum()
            start = stop
        return total

    def energy(self, z: Tensor, *, jacobian: bool) -> Tensor:
        """-log density at z (d,): of the values, or with `jacobian` of the unconstrained vector."""
        energy = -self.log_joint(self.unpack(z))
        return energy - self.log_jacobian(z) if jacobian else energy

    def value_and_gradient(
        self, z: np.ndarray, *, jacobian: bool = False
    ) -> tuple[float, np.ndarray]:
        """Energy and its gradient at z (d,).

        Where the density cannot be evaluated (a covariance singular to rounding, a number out of
        range) the energy is so high that a line search steps back.
        """
        x = torch.tensor(z, dtype=torch.float64, requires_grad=True)
        try:
            with pyro.validation_enabled(False):
                energy = self.energy(x, jacobian=jacobian)
                (gradient,) = torch.autograd.grad(energy, x)
        except (NotPositiveDefiniteError, ValueError):
            return _WALL, np.zeros_like(z)
        value, slope = float(energy.detach()), gradient.numpy()
        if not (np.isfinite(value) and np.isfinite(slope).all()):
            return _WALL, np.zeros_like(z)
        return value, slope

    def hessian(self, z: np.ndarray, *, step: float = 1e-4) -> np.ndarray:
        """Hessian (d, d) of the energy with Jacobian, by central differences of the gradient."""
        d = z.shape[0]
        H = np.empty((d, d))
        for i in range(d):
            shift = np.zeros(d)
            shift[i] = step
            up = self.value_and_gradient(z + shift, jacobian=True)[1]
            down = self.value_and_gradient(z - shift, jacobian=True)[1]
            H[i] = (up - down) / (2.0 * step)
        return 0.5 * (H + H.T)


_WALL = 1e15


def laplace_root(hessian: np.ndarray, *, widest: float = 10.0) -> np.ndarray:
    """Lower Cholesky factor of the inverse Hessian.

    Directions in which the density is flat or curves upwards get the standard deviation `widest`
    (unconstrained units), so that the result is always a usable scale.
    """
    eigenvalues, vectors = np.linalg.eigh(hessian)
    bounded = np.maximum(eigenvalues, widest**-2)
    covariance = (vectors / bounded) @ vectors.T
    return np.linalg.cholesky(0.5 * (covariance + covariance.T))
