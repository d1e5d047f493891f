r"""Energies of a model's posterior and their local shape, from one-step predictions alone.

Outputs have the densities of their innovations e_i, the errors of one-step predictions, with
variances d_i. Under Gaussian noise these are normal, unless the last layer is a function; else a
rest r_i is added to each normal log-density. The energy, its gradient and the Fisher matrix
(without the rest) are

    E = E_prior + sum_i (e_i^2 / d_i + log 2 pi d_i) / 2 - r_i,
    g = g_prior + sum_i e_i e_i' / d_i + (1 - e_i^2 / d_i) l_i' / 2 - r_i',     l_i = log d_i,
    F = sum_i a e_i' e_i'^T / d_i + b l_i' l_i'^T / 2,

primes being derivatives by the unconstrained vector (Fahrmeir & Tutz 2001, section 8.2). Under
Student-t noise of nu degrees of freedom, d_i being squares of its scale, a = (nu + 1) / (nu + 3)
and b = nu / (nu + 3) (Lange, Little & Taylor, JASA 84:881, 1989), else both are 1. Derivatives are
differences over d + 1 points that go through the filter together, forward only; the prior has its
own curvature.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pyro
import torch
from torch import Tensor

from pyro_dynogp.inference.log_joint import Direct
from pyro_dynogp.inference.optimise.lengths import Lengths
from pyro_dynogp.layers.noise import Likelihood
from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.wiring import Static

if TYPE_CHECKING:
    from pyro_dynogp.inference.density import Potential

# Change of the unconstrained vector over which a change is a derivative.
STEP = 1e-6
# Numbers that a filter may keep of all points that go through it together.
KEPT = 100_000_000
# Share of a step over which its bend is found.
ALONG = 0.02


def has_innovations(model: object) -> bool:
    """Whether a model, once collapsed, is a product of predictions that are nearly normal."""
    if not isinstance(model, Model):
        return False
    last = model.layers[-1]
    return not (isinstance(last, Static) and last.limits is not None)


def information(likelihood: Likelihood) -> tuple[float, float]:
    """Shares a and b of the information that Gaussian noise of the same scale would leave.

    Of an output's mean, and of the logarithm of its variance; those of the noise alone.
    """
    nu = likelihood.degrees_of_freedom
    return (1.0, 1.0) if nu is None else ((nu + 1.0) / (nu + 3.0), nu / (nu + 3.0))


@dataclass(frozen=True, eq=False)
class Local:
    """The energy near a point.

    Attributes:
        energy: -log p(y, values). gradient: (d,). fisher: (d, d), of the outputs.
        prior: (d, d), curvature of the prior.
        level: (2, N) sqrt(a) errors over their sd, and sqrt(b / 2) log variances. sd: (N,).
        slopes: (2, d, N) their derivatives. rest: (d,) gradient of what is added to the densities.
    """

    energy: float
    gradient: np.ndarray
    fisher: np.ndarray
    prior: np.ndarray
    level: np.ndarray
    sd: np.ndarray
    slopes: np.ndarray
    rest: np.ndarray

    @cached_property
    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Curvature (d,) of outputs and prior along axes, the columns of (d, d)."""
        curvature, axes = np.linalg.eigh(self.fisher + self.prior)
        return curvature, axes


class Innovated(NamedTuple):
    """Of the measured samples at k points, each (k, N), as `OutputProcess.innovations` has them."""

    error: np.ndarray
    variance: np.ndarray
    rest: np.ndarray


class Evaluated(NamedTuple):
    """`Innovated` at k points, and the prior's energies (k,) and their gradients (k, d)."""

    error: np.ndarray
    variance: np.ndarray
    rest: np.ndarray
    prior: np.ndarray
    gradient: np.ndarray


class Innovations:
    """Energies of a model, as of `Potential` and `Lengths`, and their local shape.

    Args:
        potential: of a model for which `has_innovations` holds.
        free: entries of the unconstrained vector that vary; None for all.
        jacobian: whether they are those of the vector's density, not of the values'.
    """

    def __init__(
        self, potential: Potential, free: np.ndarray | None = None, *, jacobian: bool = False
    ) -> None:
        assert isinstance(potential.log_density, Direct)
        self.potential, self.density = potential, potential.log_density
        self.free = np.arange(potential.size) if free is None else free
        self.jacobian = jacobian
        # Lengths are for climbs of the values' density alone.
        self._linear, self._lengths = potential.linear, Lengths([] if jacobian else potential.sites)
        self._priors = potential.priors if potential.linear is None else potential.linear.priors
        self._of_mean, self._of_variance = information(self.density.model.likelihood)
        self._there = [~torch.isnan(y) for y in self.density.observations]
        model = self.density.model
        states = sum(2 * layer.modes for _, layer in model.dynamic)
        self.has_functions = model.has_function
        functions = sum(layer.inducing for layer in model.layers if isinstance(layer, Static))
        samples = sum(y.numel() for y in self.density.observations)
        self.width = max(1, KEPT // (samples * (4 + states + 10 * functions)))
        self._ask: Callable[[np.ndarray], Evaluated] | None = None

    def asking(self, evaluate: Callable[[np.ndarray], Evaluated]) -> Innovations:
        """The same, of which another evaluates what `evaluate` does."""
        other = copy.copy(self)
        other._ask = evaluate
        return other

    def evaluate(self, z: np.ndarray) -> Evaluated:
        """Predictions and prior at z (k, d)."""
        if self._ask is not None:
            return Evaluated(*self._ask(z))
        return Evaluated(*self._innovations(z), *self._prior(z))

    def energies(self, z: np.ndarray) -> np.ndarray:
        """Energies (k,) at z (k, d); infinite where there is none."""
        found = self.evaluate(z)
        with np.errstate(all="ignore"):
            return _finite(found.prior + _energies(found))

    def local(self, z: np.ndarray) -> Local | None:
        """Energy, gradient and curvatures at z (d,), by one-sided differences; None at an edge.

        Of the entries that vary.
        """
        points = np.concatenate([z[None], z + STEP * np.eye(len(z))[self.free]])
        found = self.evaluate(points)
        errors, variances, rest, prior, gradients = found
        with np.errstate(all="ignore"):
            sd = np.sqrt(variances[0])
            level = self._level(errors, variances, sd)
            slopes = (level[:, 1:] - level[:, :1]) / STEP
            first = level[:, 0]
            gradients = gradients[:, self.free]
            of_rest = (rest[1:] - rest[0]).sum(1) / STEP
            gradient = gradients[0] + self._slope(slopes, first[0], first[0] ** 2) - of_rest
            energy = float(prior[0]) + float(_energies(found)[0])
            curvature = (gradients[1:] - gradients[0]) / STEP
            curvature = 0.5 * (curvature + curvature.T)
            fisher = sum(J @ J.T for J in slopes)
        if not all(np.isfinite(part).all() for part in (energy, gradient, fisher, curvature)):
            return None
        return Local(energy, gradient, fisher, curvature, first, sd, slopes, of_rest)

    def beside(self, here: Local, z: np.ndarray) -> tuple[float, np.ndarray]:
        """Energy at z (d,), and its gradient with the predictions' derivatives of another point."""
        found = self.evaluate(z[None])
        (errors,), (variances,), _, (prior,), (gradient,) = found
        with np.errstate(all="ignore"):
            energy = float(prior + _energies(found)[0])
            share = math.sqrt(self._of_mean) * errors * (here.sd / variances)
            own = self._slope(here.slopes, share, self._of_mean * errors**2 / variances)
        return energy, gradient[self.free] + own - here.rest

    def _slope(self, slopes: np.ndarray, share: np.ndarray, squares: np.ndarray) -> np.ndarray:
        """Gradient (d,) of the normal densities.

        Args:
            slopes: of `Local`. share, squares: (N,) a^1/2 e s / d, s being the sds of the slopes,
                and a e^2 / d.
        """
        of_variance = math.sqrt(0.5 / self._of_variance)
        weights = (share / self._of_mean, of_variance * (1.0 - squares / self._of_mean))
        return np.asarray(sum(J @ w for J, w in zip(slopes, weights, strict=True)))

    def bends(self, here: Local, z: np.ndarray, moves: np.ndarray) -> np.ndarray:
        """Second derivatives along moves (k, d) from z (d,), projected on the slopes (k, free)."""
        errors, variances, _ = self._innovations(z + ALONG * moves)
        with np.errstate(all="ignore"):
            level = self._level(errors, variances, here.sd)
            change = (level - here.level[:, None]) / ALONG
        parts = [
            (2.0 / ALONG) * ((c - moves[:, self.free] @ J) @ J.T)
            for c, J in zip(change, here.slopes, strict=True)
        ]
        return np.nan_to_num(sum(parts), posinf=0.0, neginf=0.0)

    def _level(self, errors: np.ndarray, variances: np.ndarray, sd: np.ndarray) -> np.ndarray:
        """As of `Local`, at k points (2, k, N)."""
        mean, variance = math.sqrt(self._of_mean), math.sqrt(0.5 * self._of_variance)
        return np.stack([mean * errors / sd, np.log(variances) * variance])

    def _prior(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Energies (k,) of the prior at z (k, d), and their gradients (k, d)."""
        more, further = self._lengths.energies(z)
        if self._priors is not None:
            energy, gradient = self._priors.energies(z, jacobian=self.jacobian)
            return energy + more - float(self.density.constant), gradient + further
        x = torch.tensor(z, requires_grad=True)
        with torch.enable_grad(), pyro.validation_enabled(False):
            prior = self.density.prior.log_prob(self.potential.unpack(x)) + self.density.constant
            energies = -(prior + self.potential.log_jacobian(x) if self.jacobian else prior)
            (gradients,) = torch.autograd.grad(energies.sum(), x)
        return energies.detach().numpy() + more, gradients.numpy() + further

    def _innovations(self, z: np.ndarray) -> Innovated:
        """Of the measured samples at z (k, d)."""
        if self._ask is not None:
            return Innovated(*self._ask(z)[:3])
        if self._linear is not None:
            errors, variances = self._linear.innovations(z)
            return Innovated(errors, variances, np.zeros((len(z), 1)))
        portions = [self._portion(torch.tensor(part)) for part in
                    np.split(z, range(self.width, len(z), self.width))]  # fmt: skip
        return Innovated(*(np.concatenate(part) for part in zip(*portions, strict=True)))

    def _values(self, z: Tensor) -> dict[str, Tensor]:
        """Constrained values of every site at z (k, d)."""
        if self._priors is None:
            return self.potential.unpack(z)
        with np.errstate(all="ignore"):  # as torch, which says nothing where numbers are too large
            return self._priors.by_site(torch.from_numpy(self._priors.values(z.numpy()).x))

    def _portion(self, z: Tensor) -> Innovated:
        """`_innovations` of few points; where one breaks the evaluation of all, NaN for it."""
        try:
            with torch.no_grad(), pyro.validation_enabled(False):
                found = []
                outputs = self.density.outputs(self._values(z))
                each = zip(outputs, self.density.observations, self._there, strict=True)
                for process, y, there in each:
                    found.append([part[:, there].numpy() for part in process.innovations(y)])
        except (NotPositiveDefiniteError, torch.linalg.LinAlgError, ValueError):
            if len(z) == 1:
                nothing = np.full((1, sum(int(there.sum()) for there in self._there)), np.nan)
                return Innovated(nothing, nothing, nothing)
            halves = [self._portion(half) for half in z.tensor_split(2)]
            return Innovated(*(np.concatenate(part) for part in zip(*halves, strict=True)))
        return Innovated(*(np.concatenate(part, axis=1) for part in zip(*found, strict=True)))


def _energies(of: Evaluated) -> np.ndarray:
    """Of the outputs alone."""
    normal = of.error**2 / of.variance + np.log(2.0 * np.pi * of.variance)
    return np.asarray((0.5 * normal - of.rest).sum(1))


def _finite(energies: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(energies), energies, np.inf)
