"""Hamiltonian moves of many particles together, in coordinates whitened by their covariance.

All particles go through the model together, so that one evaluation costs little more than the
compiled recursions do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

# Leapfrog steps of a move, at random between these; acceptance that the step size aims at.
LEAPS, ACCEPTANCE = (3, 8), 0.8
# x of erfc(x) = ACCEPTANCE; step sizes, and largest changes of them.
AT_ACCEPTANCE, SIZES, CHANGE = 0.179143, (1e-3, 1.5), (0.1, 4.0)
# Logarithm of how far steps lie apart in the first move, and in the end.
SPREAD = (1.2, 0.3)


class Density(Protocol):
    """Log-density (S,) of unconstrained vectors z (S, d), up to a constant, and its gradient."""

    def __call__(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Value (S,), -inf where there is none, and gradient (S, d)."""


@dataclass(frozen=True, eq=False)
class Particles:
    """Vectors with both densities and their gradients, and the first particle that each is from."""

    z: Tensor
    start: Tensor
    target: Tensor
    start_gradient: Tensor
    target_gradient: Tensor
    ancestor: Tensor

    @classmethod
    def joined(cls, several: Sequence[Particles]) -> Particles:
        """All of several sets, one after the other."""
        return cls(*(torch.cat(x) for x in zip(*(one._all() for one in several), strict=True)))

    def of(self, index: Tensor) -> Particles:
        """Those at indices (S',)."""
        return Particles(*(x[index] for x in self._all()))

    def where(self, condition: Tensor, other: Particles) -> Particles:
        """These where a condition (S,) holds, others elsewhere."""
        pairs = zip(self._all(), other._all(), strict=True)
        return Particles(
            *(
                torch.where(condition if a.dim() == 1 else condition[:, None], a, b)
                for a, b in pairs
            )
        )

    def _all(self) -> tuple[Tensor, ...]:
        densities = self.start, self.target, self.start_gradient, self.target_gradient
        return self.z, *densities, self.ancestor

    def at(self, b: float) -> tuple[Tensor, Tensor]:
        """Log-density (S,) and gradient (S, d) at temperature b."""
        value = b * self.target + (1.0 - b) * self.start if b < 1.0 else self.target
        return value, b * self.target_gradient + (1.0 - b) * self.start_gradient


def evaluate(z: Tensor, start: Density, target: Density, b: float, ancestor: Tensor) -> Particles:
    """Particles at z (S, d) with both densities, the start's only where its temperature counts."""
    last, last_gradient = target(z)
    # At the end the start counts no more, and may cost as much as the target.
    first, first_gradient = start(z) if b < 1.0 else (last, last_gradient)
    return Particles(z, first, last, first_gradient, last_gradient, ancestor)


def root_of(z: Tensor, weight: Tensor, base: Tensor | None = None) -> Tensor:
    """Cholesky factor (d, d) of the covariance of weighted particles, shrunk to its diagonal.

    What few particles say of a covariance counts little: the share of the diagonal is d over d and
    their effective number. With `base`, a root (d, d), it is the diagonal in coordinates that this
    root whitens.
    """
    if base is not None:
        own = root_of(torch.linalg.solve_triangular(base, z.mT, upper=False).mT, weight)
        return base @ own  # lower, as both are
    d = z.shape[1]
    off = z - weight @ z
    covariance = (off.mT * weight) @ off
    share = d / (d + 1.0 / float(weight.square().sum()))
    diagonal = covariance.diagonal().clamp_min(1e-12)
    return torch.linalg.cholesky((1.0 - share) * covariance + share * torch.diag(diagonal))


def move(
    now: Particles,
    start: Density,
    target: Density,
    b: float,
    root: Tensor,
    size: float,
    spread: float,
    generator: torch.Generator,
) -> tuple[Particles, Tensor, Tensor]:
    """One Hamiltonian move of every particle, of `size` times a factor within exp(+-spread).

    Returns:
        The particles; chances (S,) with which they were accepted, and the factors (S,).
    """
    count, d = now.z.shape
    low, high = LEAPS
    leaps = int(torch.randint(low, high + 1, (), generator=generator))
    uniform = torch.rand(count, 1, generator=generator, dtype=torch.float64)
    factor = (spread * (2.0 * uniform - 1.0)).exp()
    h = size * factor * d**-0.25
    momentum = torch.randn(count, d, generator=generator, dtype=torch.float64)
    value, gradient = now.at(b)
    energy = value - 0.5 * momentum.square().sum(-1)
    there = now
    for leap in range(leaps):
        momentum = momentum + (0.5 if leap == 0 else 1.0) * h * (gradient @ root)
        there = evaluate(there.z + (h * momentum) @ root.mT, start, target, b, now.ancestor)
        value, gradient = there.at(b)
    momentum = momentum + 0.5 * h * (gradient @ root)
    change = value - 0.5 * momentum.square().sum(-1) - energy
    change = torch.nan_to_num(change, nan=-torch.inf)
    chance = torch.rand(count, generator=generator, dtype=torch.float64).log()
    accept = chance < change
    return there.where(accept, now), change.clamp_max(0.0).exp(), factor[:, 0]


def next_size(size: float, factor: Tensor, chance: Tensor) -> float:
    """Step size at which `ACCEPTANCE` of the moves would have been accepted.

    Errors of the energy grow with the square of a step h, so that the chance is erfc(c h^2)
    (Beskos, Pillai, Roberts, Sanz-Serna & Stuart, Bernoulli 19:1501, 2013); c is such that chances
    of moves with steps of all lengths have the mean that they have.
    """
    square, mean = factor.square(), chance.mean()
    low, high = -12.0, 12.0  # of log c
    for _ in range(40):
        middle = 0.5 * (low + high)
        over = bool(torch.erfc(math.exp(middle) * square).mean() > mean)
        low, high = (middle, high) if over else (low, middle)
    change = math.sqrt(AT_ACCEPTANCE * math.exp(-0.5 * (low + high)))
    return float(np.clip(size * np.clip(change, *CHANGE), *SIZES))


@dataclass(frozen=True, eq=False)
class Chains:
    """States of several chains that were moved side by side.

    Attributes:
        z: (m, C, d) m states of each of C chains. log_target: (m, C).
    """

    z: Tensor
    log_target: Tensor

    @property
    def r_hat(self) -> float:
        """Of the log-density: spread over all states by that within chains; 1 where they agree.

        Source: Gelman & Rubin, Statistical Science 7(4):457 (1992).
        """
        m = len(self.log_target)
        within = float(self.log_target.var(0).mean())
        between = float(self.log_target.mean(0).var())
        return math.sqrt((m - 1) / m + between / within) if within > 0.0 else math.inf


def chains_from(
    z: Tensor, target: Density, root: Tensor, *, burnt: int, kept: int, seed: int
) -> Chains:
    """Chains of Hamiltonian moves from points z (C, d), all with one step size.

    Args:
        z: where they begin. target: log-density and gradient. root: (d, d) of its covariance.
        burnt: moves that find the step size and are not kept. kept: moves that are.
        seed: of the moves.
    """
    generator = torch.Generator().manual_seed(seed)
    now = evaluate(z, target, target, 1.0, torch.arange(len(z)))
    size, spread = 0.5, SPREAD[0]
    states: list[Particles] = []
    for turn in range(burnt + kept):
        now, chance, factor = move(now, target, target, 1.0, root, size, spread, generator)
        spread = max(0.5 * spread, SPREAD[1])
        if turn < burnt:  # a size that goes on changing with the states would bias them
            size = next_size(size, factor, chance)
        else:
            states.append(now)
    return Chains(torch.stack([x.z for x in states]), torch.stack([x.target for x in states]))
