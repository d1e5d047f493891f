"""The changes that `coordinates` puts together: bijections with their Jacobians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pyro_dynogp.layers.functions import StaticFunction

# Unconstrained values of sites (*s, *unconstrained) by name.
Parts = dict[str, Tensor]
# What values v of a site act through, h = mu + W v: mu (*s, m) and W (*s, m, m), given such values.
Affine = Callable[[Parts], tuple[Tensor, Tensor]]


class Step(Protocol):
    """One change of coordinates, in place."""

    def forward(self, x: Parts) -> Tensor:
        """Coordinates to unconstrained values; log |det| (*s) of the Jacobian."""

    def backward(self, z: Parts) -> None:
        """Unconstrained values to coordinates."""


@dataclass(frozen=True)
class RelativeToGain:
    """All that is measured in units of a signal, relative to its largest gain.

    Attributes:
        gains: sites of the gains, the one of shape (*s, P, n_u, 2) first. place: of G_r among all.
        sign: of G_r. logs: sites whose unconstrained value is the logarithm of a length along g.
        lengths: sites that are such lengths themselves. local: site of the noise's scales (*s, P),
            None without noise. unit: site of its directions (*s, P, n_l, 2).
        positive: whether those are positive, and their unconstrained values logarithms.
    """

    gains: tuple[str, ...]
    place: int
    sign: float
    logs: tuple[str, ...]
    lengths: tuple[str, ...]
    local: str | None
    unit: str
    positive: bool

    def forward(self, x: Parts) -> Tensor:
        """As `Step` has it."""
        ratio, shapes = self._gains(x)
        s = ratio[..., self.place]
        one = torch.nn.functional.one_hot(torch.tensor(self.place), ratio.shape[-1]).bool()
        gain = self.sign * s.exp().unsqueeze(-1) * torch.where(one, 1.0, ratio)
        self._put(x, gain, shapes)
        return ratio.shape[-1] * s + self._rescale(x, s, 1.0)

    def backward(self, z: Parts) -> None:
        """As `Step` has it."""
        gain, shapes = self._gains(z)
        s = self.size(z).log()
        one = torch.nn.functional.one_hot(torch.tensor(self.place), gain.shape[-1]).bool()
        ratio = gain * self.sign * (-s).exp().unsqueeze(-1)
        self._put(z, torch.where(one, s.unsqueeze(-1), ratio), shapes)
        self._rescale(z, s, -1.0)

    def _rescale(self, values: Parts, s: Tensor, sign: float) -> Tensor:
        """Multiply by exp(sign s) what is measured in units of the signal; log |det| (*s)."""
        log_det = torch.zeros_like(s)
        shift = sign * s.unsqueeze(-1)
        for name in self.logs:
            values[name] = values[name] + shift
        for name in self.lengths:
            values[name] = values[name] * shift.exp()
            log_det = log_det + values[name].shape[-1] * shift.squeeze(-1)
        if self.local is not None:
            unit = values[self.unit]
            factor = sign * (s.unsqueeze(-1) - values[self.local])[..., None, None]
            values[self.unit] = unit + factor if self.positive else unit * factor.exp()
            if not self.positive:
                log_det = log_det + factor.expand_as(unit).flatten(-3).sum(-1)
        return log_det

    def size(self, z: Parts) -> Tensor:
        """|G_r| (*s) of unconstrained values."""
        return self.sign * self._gains(z)[0][..., self.place]

    def _gains(self, z: Parts) -> tuple[Tensor, list[torch.Size]]:
        """All gains side by side (*s, n), and the shapes of their sites."""
        gains = [z[name] for name in self.gains]
        batch = gains[0].shape[: gains[0].dim() - 3]
        flat = torch.cat([gain.reshape(*batch, -1) for gain in gains], -1)
        return flat, [gain.shape for gain in gains]

    def _put(self, into: Parts, values: Tensor, shapes: Sequence[torch.Size]) -> None:
        start = 0
        for name, shape in zip(self.gains, shapes, strict=True):
            count = shape[len(values.shape) - 1 :].numel()
            into[name] = values[..., start : start + count].reshape(shape)
            start += count


@dataclass(frozen=True, eq=False)
class GivenOthers:
    """Values of a standard normal prior relative to what the data and all other parameters say.

    About the start the log-likelihood is quadratic in what the values v act through,
    h = mu + W v (a function's mean at fixed points; gains, v in units of their scale):
    b'h - h'Lambda h / 2. With the prior of v given the other parameters that is a normal
    distribution of v, whose standardised values are the coordinates.

    Attributes:
        name: site of v (*s, *shape), m values. affine: mu and W given the unconstrained values of
            all sites. precision: Lambda (m, m). linear: b (m,). rank: dimensions of the shape.
    """

    name: str
    affine: Affine
    precision: Tensor
    linear: Tensor
    rank: int = 2

    def _normal(self, z: Parts) -> tuple[Tensor, Tensor]:
        """Mean (*s, m) of v, and the Cholesky factor R (*s, m, m) of its precision."""
        mean, W = self.affine(z)
        one = torch.eye(W.shape[-1], dtype=W.dtype)
        R = torch.linalg.cholesky(one + W.mT @ self.precision @ W)
        push = W.mT @ (self.linear - mean @ self.precision).unsqueeze(-1)
        return torch.cholesky_solve(push, R).squeeze(-1), R

    def forward(self, x: Parts) -> Tensor:
        """As `Step` has it."""
        centre, R = self._normal(x)
        value = x[self.name]
        flat = value.flatten(-self.rank).unsqueeze(-1)
        apart = torch.linalg.solve_triangular(R.mT, flat, upper=True)
        x[self.name] = (centre + apart.squeeze(-1)).reshape(value.shape)
        log_det: Tensor = -R.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return log_det

    def backward(self, z: Parts) -> None:
        """As `Step` has it."""
        centre, R = self._normal(z)
        value = z[self.name]
        apart = (value.flatten(-self.rank) - centre).unsqueeze(-1)
        z[self.name] = (R.mT @ apart).squeeze(-1).reshape(value.shape)


def affine(f: StaticFunction, points: Tensor) -> tuple[Tensor, Tensor]:
    """Mean values mu + W v at M points (*s, M, d), outputs side by side: (*s, eM), (*s, eM, eM)."""
    mean = f.prior_mean(points).mT
    K = f.kernel(f.locations, points)
    one = torch.linalg.solve_triangular(f.root, K, upper=False).mT
    scaled = f.output_scale[..., None, None] * one.unsqueeze(-3)  # (*s, e, M, M)
    e, M = scaled.shape[-3:-1]
    eye = torch.eye(e, dtype=scaled.dtype)
    W = torch.einsum("...aij,ab->...aibj", scaled, eye).reshape(*scaled.shape[:-3], e * M, e * M)
    return mean.expand(*mean.shape[:-2], e, M).flatten(-2), W
