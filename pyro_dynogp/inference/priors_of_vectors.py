r"""Constrained values of unconstrained vectors and their prior density, entry by entry in numpy.

What `torch.distributions.biject_to` and the distributions of `models.priors`, `models.horseshoe`
and `layers.noise` say, for the kinds of sites that linear models have, with derivatives by hand.
All entries of one kind are done together, whatever sites they are of.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from pyro.distributions import HalfCauchy, HalfNormal, LogNormal, Normal, Uniform
from torch import Tensor

from pyro_dynogp.distributions.dead_time import NONE, DeadTime
from pyro_dynogp.distributions.decay import LogDecayRate
from pyro_dynogp.distributions.shared_scale import SharedScaleNormal
from pyro_dynogp.layers.sites import Site

# Bounds of a sigmoid, as torch has them.
LEAST, MOST = np.finfo(float).tiny, 1.0 - np.finfo(float).eps


class Values(NamedTuple):
    """Constrained values x (k, d) of unconstrained u (k, d).

    slope: dx/du (k, d). log_jacobian: (k,). log_jacobian_slope: (k, d), its derivatives by u.
    """

    x: np.ndarray
    slope: np.ndarray
    log_jacobian: np.ndarray
    log_jacobian_slope: np.ndarray


class _Slices(NamedTuple):
    """Entries (slices, d) of a `SharedScaleNormal` whose slices have one scale each."""

    entries: np.ndarray
    freedom: float
    square: float


class Constrained(torch.autograd.Function):
    """Values x (k, d) of vectors u (k, d) and their log prior density (k,), as nodes of a graph.

    With `jacobian` the density is that of the vectors.
    """

    @staticmethod
    def forward(ctx: Any, z: Tensor, priors: VectorPriors, jacobian: bool) -> Any:
        """Values and densities; derivatives are made at once."""
        with np.errstate(all="ignore"):  # what is out of range ends as NaN, which is told apart
            values = priors.values(z.detach().numpy())
            total, by_u = priors.density(values, jacobian=jacobian)
        ctx.slopes = torch.from_numpy(values.slope), torch.from_numpy(by_u)
        return torch.from_numpy(values.x), torch.from_numpy(total)

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> Any:
        """Gradients by the vectors."""
        slope, by_u = ctx.slopes
        return bars[0] * slope + bars[1][:, None] * by_u, None, None


class VectorPriors:
    """Priors of all sites of a model.

    Attributes:
        places: of each site its part of a vector.

    Raises:
        LookupError: where a site has a prior of another kind.
    """

    def __init__(self, sites: Sequence[Site]) -> None:
        self.places: dict[str, slice] = {}
        self.constant = 0.0
        self._slices: list[_Slices] = []
        kinds: dict[str, list[np.ndarray]] = {}
        start = 0
        for site in sites:
            stop = start + site.shape.numel()
            self.places[site.name] = slice(start, stop)
            self._add(site, np.arange(start, stop), kinds)
            start = stop
        self.size = start
        self.shapes = [site.shape for site in sites]
        # Columns of each kind: entries, then two parameters where it has any.
        self._kinds = {name: np.concatenate(found, 1) for name, found in kinds.items()}

    def _add(self, site: Site, entries: np.ndarray, kinds: dict[str, list[np.ndarray]]) -> None:
        prior: Any = site.prior
        base = getattr(prior, "base_dist", prior)
        alone = isinstance(prior, LogNormal | SharedScaleNormal)
        kind = type(prior if alone else base)

        def put(name: str, first: Any = 0.0, second: Any = 0.0) -> None:
            columns = [torch.as_tensor(x, dtype=torch.float64).expand(site.shape).reshape(-1)
                       for x in (first, second)]  # fmt: skip
            kinds.setdefault(name, []).append(np.stack([entries, *columns]))

        if kind is SharedScaleNormal:
            zero = torch.zeros(site.shape, dtype=torch.float64)
            self.constant += float(prior.log_prob(zero))
            each = np.moveaxis(entries.reshape(site.shape), prior.apart, 0)
            spread = float(prior.df * prior.scale.square())
            self._slices.append(_Slices(each.reshape(len(each), -1), float(prior.df), spread))
        elif kind is Normal:
            put("normal", base.loc, base.scale)
        elif kind is HalfNormal:
            put("exponential")
            put("normal", 0.0, base.scale)
            self.constant += len(entries) * math.log(2.0)
        elif kind is HalfCauchy:
            put("exponential")
            put("half cauchy", base.scale)
        elif kind is DeadTime:
            put("late", base.step)
            put("half cauchy", base.median)
        elif kind is LogNormal:
            put("exponential")
            put("log normal", base.loc, base.scale)
        elif kind is LogDecayRate:
            put("below", base.upper)
            put("decay", base.rate)
            at = base.upper - 1.0
            rest = base.log_prob(at) + 0.5 * at + base.rate * (-at).exp()
            self.constant += float(rest.sum())
        elif kind is Uniform:
            put("between", base.low, base.high - base.low)
            self.constant -= float((base.high - base.low).log().sum())
        else:
            raise LookupError(f"no vectors of a site {site.name!r} with prior {prior!r}")

    def _of(self, kind: str) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        if kind not in self._kinds:
            return None
        entries, first, second = self._kinds[kind]
        return entries.astype(int), first, second

    def by_site(self, x: Tensor) -> dict[str, Tensor]:
        """Each site's part (*s, *shape) of values x (*s, d)."""
        parts = x.split([shape.numel() for shape in self.shapes], -1)
        named = zip(self.places, parts, self.shapes, strict=True)
        return {name: part.reshape(x.shape[:-1] + shape) for name, part, shape in named}

    def values(self, u: np.ndarray) -> Values:
        """Of unconstrained vectors u (k, d)."""
        x, slope = u.copy(), np.ones_like(u)
        log_jacobian, by_u = np.zeros(len(u)), np.zeros_like(u)
        if found := self._of("exponential"):
            at = found[0]
            here = np.take(u, at, 1)
            slope[:, at] = x[:, at] = np.exp(here)
            by_u[:, at] = 1.0
            log_jacobian += here.sum(1)
        if found := self._of("late"):
            at, step, _ = found
            here = np.take(u, at, 1) / NONE
            apart = np.log1p(np.exp(-np.abs(here)))
            q = NONE * (np.maximum(here, 0.0) + apart)
            share = np.exp(np.minimum(here, 0.0) - apart)  # dq/du
            x[:, at], slope[:, at] = step * np.expm1(q), step * np.exp(q) * share
            by_u[:, at] = share + (1.0 - share) / NONE
            log_jacobian += (np.log(step) + q + np.minimum(here, 0.0) - apart).sum(1)
        if found := self._of("below"):
            at, upper, _ = found
            here = np.take(u, at, 1)
            size = np.exp(here)
            x[:, at], slope[:, at], by_u[:, at] = upper - size, -size, 1.0
            log_jacobian += here.sum(1)
        if found := self._of("between"):
            at, low, width = found
            here = np.take(u, at, 1)
            share = 1.0 / (1.0 + np.exp(-here))
            inside = np.clip(share, LEAST, MOST)
            x[:, at] = low + width * inside
            slope[:, at] = np.where(share == inside, width * share * (1.0 - share), 0.0)
            by_u[:, at] = 1.0 - 2.0 * share
            rest = -np.abs(here) - 2.0 * np.log1p(np.exp(-np.abs(here))) + np.log(width)
            log_jacobian += rest.sum(1)
        return Values(x, slope, log_jacobian, by_u)

    def log_prob(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Log-density (k,) of values x (k, d), and its derivatives (k, d)."""
        total, by_x = np.full(len(x), self.constant), np.zeros_like(x)
        if found := self._of("normal"):
            at, loc, scale = found
            off = (np.take(x, at, 1) - loc) / scale
            by_x[:, at] -= off / scale
            total -= (0.5 * off * off + np.log(scale) + 0.5 * math.log(2.0 * math.pi)).sum(1)
        if found := self._of("log normal"):
            at, loc, scale = found
            here = np.take(x, at, 1)
            off = (np.log(here) - loc) / scale
            by_x[:, at] -= (1.0 + off / scale) / here
            rest = 0.5 * off * off + np.log(scale * here) + 0.5 * math.log(2.0 * math.pi)
            total -= rest.sum(1)
        if found := self._of("half cauchy"):
            at, scale, _ = found
            ratio = np.take(x, at, 1) / scale
            by_x[:, at] -= 2.0 * ratio / (scale * (1.0 + ratio * ratio))
            total += (np.log(2.0 / (math.pi * scale)) - np.log1p(ratio * ratio)).sum(1)
        if found := self._of("decay"):
            at, rate, _ = found
            here = np.take(x, at, 1)
            settled = rate * np.exp(-here)
            by_x[:, at] += settled - 0.5
            total -= (0.5 * here + settled).sum(1)
        for entries, freedom, square in self._slices:
            for one in entries:
                here = np.take(x, one, 1)
                size = square + (here * here).sum(1)
                power = freedom + len(one)
                total -= 0.5 * power * np.log(size / square)
                by_x[:, one] -= (power / size)[:, None] * here
        return total, by_x

    def density(self, values: Values, *, jacobian: bool) -> tuple[np.ndarray, np.ndarray]:
        """Log prior (k,), with `jacobian` that of the vector, and its derivatives by it (k, d)."""
        total, by_x = self.log_prob(values.x)
        slope = by_x * values.slope
        if jacobian:
            total, slope = total + values.log_jacobian, slope + values.log_jacobian_slope
        return total, slope

    @np.errstate(all="ignore")
    def energies(self, u: np.ndarray, *, jacobian: bool) -> tuple[np.ndarray, np.ndarray]:
        """-log prior (k,) at u (k, d), with `jacobian` of the vector; its gradients (k, d)."""
        total, slope = self.density(self.values(u), jacobian=jacobian)
        return -total, -slope


def vector_priors(sites: Sequence[Site]) -> VectorPriors | None:
    """Priors of all sites; None where there is none, or one of another kind."""
    try:
        return VectorPriors(sites) if sites else None
    except LookupError:
        return None
