"""A prior for decay rates that a record can tell from no decay at all."""

from __future__ import annotations

import math
from typing import Any

import torch
from pyro.distributions import TorchDistribution
from torch import Size, Tensor
from torch.distributions import constraints
from torch.distributions.utils import broadcast_all


class LogDecayRate(TorchDistribution):
    r"""Logarithm z of a decay rate c = exp(z) whose time constant is short beside a record.

    The square root of the time constant 1/c is half-normal with standard deviation
    1/sqrt(2 rate), so that

        log p(z) = -z/2 - rate exp(-z) + constant,    z < upper:

    rates far above `rate` are nearly alike, rates far below it all but excluded. A uniform prior
    has its mode anywhere, also where a pole hardly decays within the record: a resonance that
    imitates a stretch of the data by its initial state alone, and forecasts badly.

    Args:
        rate: (*b) positive, in units of exp(z). upper: (*b) upper end of z.
    """

    arg_constraints = {  # noqa: RUF012
        "rate": constraints.positive,
        "upper": constraints.real,
    }
    has_rsample = True

    def __init__(self, rate: Any, upper: Any, *, validate_args: bool | None = None) -> None:
        self.rate, self.upper = broadcast_all(rate, upper)
        super().__init__(self.rate.shape, validate_args=validate_args)

    @property
    def support(self) -> constraints.Constraint:
        """Everything below `upper`."""
        return constraints.less_than(self.upper)

    @property
    def _least(self) -> Tensor:
        # z = log(2 rate / n^2) of a standard normal n; z < upper is |n| > this.
        return (2.0 * self.rate * (-self.upper).exp()).sqrt()

    def expand(self, batch_shape: Any, _instance: Any = None) -> LogDecayRate:
        """Broadcast to a larger batch shape."""
        new = self._get_checked_instance(LogDecayRate, _instance)
        shape = Size(batch_shape)
        new.rate, new.upper = self.rate.expand(shape), self.upper.expand(shape)
        super(LogDecayRate, new).__init__(shape, validate_args=False)
        return new

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (*s, *b) of z."""
        if self._validate_args:
            self._validate_sample(value)
        inside = torch.erfc(self._least / math.sqrt(2.0)).log()
        constant = 0.5 * (self.rate / math.pi).log() - inside
        return constant - 0.5 * value - self.rate * (-value).exp()

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Draws (*s, *b), by inversion."""
        shape = self._extended_shape(Size(sample_shape))
        share = torch.rand(shape, dtype=self.rate.dtype, device=self.rate.device)
        # Of |n|, uniform in the tail beyond `_least`; erfc(x) = 1 - erf(x).
        tail = torch.erfc(self._least / math.sqrt(2.0)) * (1.0 - share)
        n = math.sqrt(2.0) * torch.erfinv(1.0 - tail)
        tiny = torch.finfo(n.dtype).tiny
        return torch.minimum((2.0 * self.rate / n.square().clamp_min(tiny)).log(), self.upper)
