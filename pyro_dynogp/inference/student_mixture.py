"""Mixtures of multivariate Student-t distributions: what draws of a posterior are proposed from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

# Degrees of freedom: tails wider than a normal's.
FREEDOM = 20.0


@dataclass(frozen=True, eq=False)
class StudentMixture:
    """Multivariate Student-t distributions around optima, with the scales of normals there.

    Attributes:
        weights: (K,) that add up to one. loc: (K, d). scale_tril: (K, d, d), lower.
    """

    weights: Tensor
    loc: Tensor
    scale_tril: Tensor

    @cached_property
    def _inverse(self) -> Tensor:
        """Inverses (K, d, d) of the roots, lower."""
        eye = torch.eye(self.loc.shape[-1], dtype=self.loc.dtype)
        return torch.linalg.solve_triangular(self.scale_tril, eye, upper=False)

    def components(self, z: Tensor) -> Tensor:
        """Log-densities (S, K) of the components, with their weights."""
        return self._components(z)[0]

    def _components(self, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`components`; z off each centre in units of its root (K, S, d); its square (K, S)."""
        d = z.shape[-1]
        off = (z - self.loc.unsqueeze(1)) @ self._inverse.mT
        square = off.square().sum(-1)
        log_det = self._inverse.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        constant = math.lgamma(0.5 * (FREEDOM + d)) - math.lgamma(0.5 * FREEDOM)
        constant -= 0.5 * d * math.log(FREEDOM * math.pi)
        each = -0.5 * (FREEDOM + d) * torch.log1p(square / FREEDOM)
        return (each.mT + constant + log_det + self.weights.log()), off, square

    def log_prob(self, z: Tensor) -> Tensor:
        """Value (S,) alone."""
        return torch.logsumexp(self.components(z), -1)

    def __call__(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Value (S,) and gradient (S, d)."""
        each, off, square = self._components(z)
        share = torch.softmax(each, -1).mT * (-(FREEDOM + z.shape[-1]) / (FREEDOM + square))
        gradient = ((share.unsqueeze(-1) * off) @ self._inverse).sum(0)
        return torch.logsumexp(each, -1), gradient

    def draw(self, count: int, seed: int) -> Tensor:
        """First particles (S, d), of each component in proportion to its weight."""
        generator = torch.Generator().manual_seed(seed)
        d = self.loc.shape[-1]
        x = torch.randn(count, d, generator=generator, dtype=torch.float64)
        # A chi-squared number by the sum of squares: torch's gamma takes no generator.
        squares = torch.randn(count, int(FREEDOM), generator=generator, dtype=torch.float64)
        spread = (FREEDOM / squares.square().sum(-1, keepdim=True)).sqrt()
        k = resample(self.weights.log(), count, generator)
        return self.loc[k] + spread * torch.einsum("sij,sj->si", self.scale_tril[k], x)


def resample(log_weight: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Systematic resampling: indices (count,)."""
    edges = torch.cumsum(torch.softmax(log_weight, 0), 0)
    shift = torch.rand((), generator=generator, dtype=torch.float64)
    at = (torch.arange(count, dtype=torch.float64) + shift) / count * edges[-1]
    return torch.searchsorted(edges, at).clamp_max(len(log_weight) - 1)
