r"""Kernels that are functions of the distance alone, with their derivatives.

    r^2 = sum_c ((x_c - x'_c) / l_c)^2,
    rbf       exp(-r^2 / 2)
    matern12  exp(-r)
    matern32  (1 + sqrt(3) r) exp(-sqrt(3) r)
    matern52  (1 + sqrt(5) r + 5/3 r^2) exp(-sqrt(5) r)

The formulas are GPyTorch's. First derivatives are written by hand, one channel at a time in memory
that is used again; where a derivative is to be differentiated itself, the graph of the plain
formulas is made instead.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import broadcast

# What keeps the derivative of r finite at r = 0.
TINY = 1e-30


def check_lengthscale(lengthscale: Tensor, channels: int) -> None:
    """Whether there is one lengthscale (*b, 1), or (*b, channels) one for each channel.

    Raises:
        ValueError: where there is another number.
    """
    if lengthscale.shape[-1] not in (1, channels):
        raise invalid(
            "kernel",
            expected=f"one lengthscale, or one for each of {channels} channels",
            got=f"{lengthscale.shape[-1]} lengthscales",
            advice="Set ard_num_dims to the number of channels that the kernel sees.",
        )


def function_of_distance(form: str, lengthscale: Tensor, x1: Tensor, x2: Tensor | None) -> Tensor:
    """Kernel of unit variance (*b, n, m), or its diagonal (*b, n) where x2 is None.

    Args:
        form: "rbf", "matern12", "matern32" or "matern52".
        lengthscale: (*b, d) or (*b, 1). x1: (*b, n, d). x2: (*b, m, d).

    Raises:
        ValueError: where the number of lengthscales does not fit.
    """
    check_lengthscale(lengthscale, x1.shape[-1])
    if x2 is None:
        shape = broadcast(lengthscale.shape[:-1], x1.shape[:-2]) + x1.shape[-2:-1]
        return x1.new_ones(shape)
    inverse = lengthscale.reciprocal().unsqueeze(-2)
    value: Tensor = _Radial.apply(form, x1 * inverse, x2 * inverse)
    return value


def _difference(x1: Tensor, x2: Tensor, channel: int) -> Tensor:
    """Difference x - x' (*b, n, m) in one channel.

    Differences, not |x|^2 - 2 x'y + |y|^2: near points would lose their distance to rounding.
    """
    return x1[..., channel].unsqueeze(-1) - x2[..., channel].unsqueeze(-2)


def _plain(form: str, x1: Tensor, x2: Tensor) -> Tensor:
    """The function at points in lengthscales, for as many derivatives as are wanted."""
    square = torch.zeros((), dtype=x1.dtype, device=x1.device)
    for channel in range(x1.shape[-1]):
        square = square + _difference(x1, x2, channel).square()
    if form == "rbf":
        return torch.exp(-0.5 * square)
    r = torch.sqrt(square + TINY)
    if form == "matern12":
        return torch.exp(-r)
    a = math.sqrt(3.0 if form == "matern32" else 5.0) * r
    return (1.0 + a if form == "matern32" else 1.0 + a + a.square() / 3.0) * torch.exp(-a)


def _with_slope(form: str, x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
    """The function (*b, n, m), and its derivative by half the squared distance."""
    square = _difference(x1, x2, 0).square_()
    for channel in range(1, x1.shape[-1]):
        difference = _difference(x1, x2, channel)
        square.addcmul_(difference, difference)
    if form == "rbf":
        value = square.mul_(-0.5).exp_()
        return value, -value
    r = square.add_(TINY).sqrt_()
    if form == "matern12":
        value = torch.neg(r).exp_()
        return value, (value / r).neg_()
    a = r.mul_(math.sqrt(3.0 if form == "matern32" else 5.0))
    decay = torch.neg(a).exp_()
    if form == "matern32":
        return a.add_(1.0).mul_(decay), decay.mul_(-3.0)
    slope = (a + 1.0).mul_(decay).mul_(-5.0 / 3.0)
    return a.addcmul_(a, a, value=1.0 / 3.0).add_(1.0).mul_(decay), slope


class _Radial(torch.autograd.Function):
    """The function at points in lengthscales x1 (*b, n, d) and x2 (*b, m, d)."""

    @staticmethod
    def forward(ctx: Any, form: str, x1: Tensor, x2: Tensor) -> Tensor:
        value, slope = _with_slope(form, x1, x2)
        ctx.form = form
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(x1, x2, slope)
        return value

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> Any:
        x1, x2, slope = ctx.saved_tensors
        wanted = ctx.needs_input_grad[1:]
        if torch.is_grad_enabled():  # the derivative is to be differentiated
            points = [x for x, needed in zip((x1, x2), wanted, strict=True) if needed]
            found = iter(
                torch.autograd.grad(_plain(ctx.form, x1, x2), points, bar, create_graph=True)
            )
            return None, *(next(found) if needed else None for needed in wanted)
        weight = bar * slope
        bars: list[list[Tensor]] = [[], []]
        for channel in range(x1.shape[-1]):
            each = _difference(x1, x2, channel).mul_(weight)
            for side, sign in ((0, 1.0), (1, -1.0)):
                if wanted[side]:
                    bars[side].append(sign * each.sum(-1 - side))
        both = zip(bars, (x1, x2), strict=True)
        return None, *(
            torch.stack(bar_, -1).sum_to_size(x.shape) if bar_ else None for bar_, x in both
        )
