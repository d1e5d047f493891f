"""A prior of arrays whose entries share an unknown size."""

from __future__ import annotations

import math
from typing import Any

import torch
from pyro.distributions import TorchDistribution
from torch import Size, Tensor
from torch.distributions import constraints
from torch.distributions.utils import broadcast_all


class SharedScaleNormal(TorchDistribution):
    r"""Arrays x whose slices are normal, each with one unknown scale, integrated out.

    Each slice is an isotropic multivariate Student-t: tau^2 ~ scaled-inverse-chi^2(df, scale^2) and
    x | tau ~ normal(0, tau^2) in each of the d entries of a slice, so that

        log p(x) = -(df + d)/2 log(1 + |x|^2 / (df scale^2)) + constant

    (Kotz & Nadarajah 2004, section 1.1). Its slope is that of a normal whose variance
    (df scale^2 + |x|^2) / (df + d) is learnt from all entries: a ridge that shrinks entries which
    are not needed, and does not hold large ones down.

    Args:
        df: (*b) degrees of freedom > 0. scale: (*b) positive, in units of x.
        shape: of one array, its event shape. apart: dimension of it along which slices lie.
    """

    arg_constraints = {  # noqa: RUF012
        "df": constraints.positive,
        "scale": constraints.positive,
    }
    has_rsample = True

    def __init__(
        self, df: Any, scale: Any, shape: Any, apart: int, *, validate_args: bool | None = None
    ) -> None:
        self.df, self.scale = broadcast_all(
            torch.as_tensor(df, dtype=torch.float64), torch.as_tensor(scale, dtype=torch.float64)
        )
        self.apart = apart % len(shape)
        super().__init__(self.df.shape, Size(shape), validate_args=validate_args)

    @property
    def support(self) -> constraints.Constraint:
        """All real arrays."""
        return constraints.independent(constraints.real, len(self.event_shape))

    def expand(self, batch_shape: Any, _instance: Any = None) -> SharedScaleNormal:
        """Broadcast to a larger batch shape."""
        new = self._get_checked_instance(SharedScaleNormal, _instance)
        shape = Size(batch_shape)
        new.apart = self.apart
        new.df, new.scale = self.df.expand(shape), self.scale.expand(shape)
        super(SharedScaleNormal, new).__init__(shape, self.event_shape, validate_args=False)
        return new

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (*s, *b) of arrays (*s, *b, *shape)."""
        if self._validate_args:
            self._validate_sample(value)
        dims, slices = len(self.event_shape), self.event_shape[self.apart]
        df, scale = self.df.unsqueeze(-1), self.scale.unsqueeze(-1)
        d = self.event_shape.numel() // max(slices, 1)
        squares = value.square().movedim(self.apart - dims, -dims)
        squares = squares.flatten(1 - dims).sum(-1) if dims > 1 else squares
        constant = (
            torch.lgamma(0.5 * (df + d))
            - torch.lgamma(0.5 * df)
            - 0.5 * d * (df * math.pi * scale.square()).log()
        )
        each = constant - 0.5 * (df + d) * torch.log1p(squares / (df * scale.square()))
        return each.expand(*each.shape[:-1], slices).sum(-1)

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Draws (*s, *b, *shape)."""
        shape = Size(sample_shape) + self.batch_shape
        dims, slices = len(self.event_shape), self.event_shape[self.apart]
        normal = torch.randn(shape + self.event_shape, dtype=self.df.dtype, device=self.df.device)
        # Chi-square over its degrees of freedom; torch's gamma draws have a gradient.
        half = 0.5 * self.df.expand(shape).unsqueeze(-1).expand(*shape, slices)
        tau = self.scale.unsqueeze(-1) / torch.distributions.Gamma(half, half).rsample().sqrt()
        lone = [slices if k == self.apart else 1 for k in range(dims)]
        return normal * tau.reshape(*shape, *lone)
