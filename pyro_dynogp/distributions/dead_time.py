"""A prior for dead times, and coordinates in which their posteriors are nearly normal."""

from __future__ import annotations

import math
from typing import Any

import torch
from pyro.distributions import TorchDistribution
from torch import Size, Tensor
from torch.distributions import biject_to, constraints
from torch.distributions.transforms import Transform
from torch.distributions.utils import broadcast_all
from torch.nn.functional import logsigmoid, softplus

# Where the coordinate turns towards minus infinity [steps]: closer to zero a dead time is none.
NONE = 0.05


class _NotNegative(constraints.Constraint):
    """Times from zero on, with the step of the clock (*b) as their unit."""

    def __init__(self, step: Tensor) -> None:
        self.step = step
        super().__init__()

    def check(self, value: Tensor) -> Tensor:
        """Where it holds."""
        return value >= 0


class LateCoordinate(Transform):
    """Dead time d = step (exp(q) - 1), q = NONE log(1 + exp(z / NONE)), of any real z.

    With many steps z is the logarithm of d, with few of them d itself: half a step more or less is
    as far near zero as anywhere. What is as good as no dead time lies below zero.

    Args:
        step: (*b) of the clock [time unit].
    """

    domain = constraints.real
    bijective = True
    sign = 1

    def __init__(self, step: Tensor) -> None:
        super().__init__()
        self.step = step

    @property
    def codomain(self) -> constraints.Constraint:  # type: ignore[override]
        """Times from zero on."""
        return _NotNegative(self.step)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, LateCoordinate) and torch.equal(self.step, other.step)

    def __hash__(self) -> int:
        return hash(type(self))

    def _call(self, x: Tensor) -> Tensor:
        return self.step * torch.expm1(NONE * softplus(x / NONE, threshold=700.0))

    def _inverse(self, y: Tensor) -> Tensor:
        q = torch.log1p(y / self.step)
        return q + NONE * (-torch.expm1(-q / NONE)).log()

    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        """Log dd/dz."""
        q = NONE * softplus(x / NONE, threshold=700.0)
        return self.step.log() + q + logsigmoid(x / NONE)


@biject_to.register(_NotNegative)
def _biject(constraint: _NotNegative) -> LateCoordinate:
    return LateCoordinate(constraint.step)


class DeadTime(TorchDistribution):
    """Half-Cauchy dead times, p(d) = 2 / (pi m (1 + (d/m)^2)) for d >= 0.

    Args:
        median: m (*b) [time unit]. step: (*b) of the clock, the unit of `LateCoordinate`.
    """

    arg_constraints = {  # noqa: RUF012
        "median": constraints.positive,
        "step": constraints.positive,
    }
    has_rsample = True

    def __init__(self, median: Any, step: Any, *, validate_args: bool | None = None) -> None:
        self.median, self.step = broadcast_all(median, step)
        super().__init__(self.median.shape, validate_args=validate_args)

    @property
    def support(self) -> constraints.Constraint:
        """From zero on."""
        return _NotNegative(self.step)

    def expand(self, batch_shape: Any, _instance: Any = None) -> DeadTime:
        """Broadcast to a larger batch shape."""
        new = self._get_checked_instance(DeadTime, _instance)
        shape = Size(batch_shape)
        new.median, new.step = self.median.expand(shape), self.step.expand(shape)
        super(DeadTime, new).__init__(shape, validate_args=False)
        return new

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (*s, *b)."""
        if self._validate_args:
            self._validate_sample(value)
        ratio = value / self.median
        return (2.0 / (math.pi * self.median)).log() - torch.log1p(ratio.square())

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Draws (*s, *b), by inversion."""
        shape = self._extended_shape(Size(sample_shape))
        share = torch.rand(shape, dtype=self.median.dtype, device=self.median.device)
        return self.median * torch.tan(0.5 * math.pi * share)
