"""Static Gaussian-process layers whose inducing values are honest Pyro sample sites.

Everything that depends on the whitened inducing values is computed from the value of their site
(unlike the inducing sites of `pyro.contrib.gp` and GPyTorch's Pyro models), so that SVI, NUTS,
Predictive and importance ratios see one model. Inputs are taken to be of unit scale: the priors of
lengthscales and locations say so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal

import gpytorch
import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.layers.functions import JITTER, StaticFunction, even_grid, in_place
from pyro_dynogp.layers.kernels import ROUGH, KernelPrior
from pyro_dynogp.layers.sites import Site, Values, normal, sample
from pyro_dynogp.support.errors import COUNT, checked, invalid, verify, verify_fields
from pyro_dynogp.support.tensors import as_tensor

MeanName = Literal["constant", "linear"]
NO_NAMES: Mapping[str, str] = MappingProxyType({})

# Half the width of the starting grid of one channel of unit standard deviation.
REACH = 3.0
# Share of the range of x that support points reach beyond it on either side.
MARGIN = 0.02


def starting_locations(inducing: int, channels: int) -> Tensor:
    """Inducing locations (M, d) that cover inputs of unit standard deviation.

    One channel: an even grid from -3 to 3. Several: a Sobol sequence mapped to normal quantiles.
    """
    if channels == 1:
        return torch.linspace(-REACH, REACH, inducing, dtype=torch.float64).unsqueeze(-1)
    sobol = torch.quasirandom.SobolEngine(channels, scramble=False)
    sobol.fast_forward(1)  # the first point is the origin, whose quantiles are infinite
    return torch.special.ndtri(sobol.draw(inducing, dtype=torch.float64))


@dataclass(frozen=True, eq=False)
class StaticPrior:
    """Prior of a static function of inputs of unit scale.

    It lists the sites and maps their values to a `StaticFunction`. Sites (all start with
    ``<name>_``), * marking what depends on the options:

    - the kernel's, see `kernel_sites`; by default ``lengthscale`` (d,), LogNormal(0, 1).
    - ``output_scale`` (e,): LogNormal(0, 1).
    - ``constant`` (e,): normal(0, 1).
    - ``slope`` (e, d)*: normal(identity where e = d, else zero; 1).
    - one channel: ``center`` (1,)*, normal(0, 1), and ``half_width`` (1,)*, LogNormal(log 3, 0.5),
      of the even grid of locations; several channels, or `locations` given: ``locations`` (M, d)*,
      normal(starting locations, 1).
    - ``values`` (e, M): standard normal, the whitened inducing values.

    Attributes:
        name: prefix of the sites.
        channels: d, number of inputs. outputs: e.
        inducing: M, number of inducing locations, where `locations` does not say.
        kernel: a GPyTorch kernel (of unit variance: `output_scale` multiplies it); None for a
            Matern with a lengthscale for each channel, of this `smoothness`.
        mean: "constant", or "linear" for a slope as well.
        learn_locations: whether the locations are learnt; else they stay at the start.
        locations: starting locations (M, d), or (M,) for one channel; by default
            `starting_locations`.
        order: places of the channels as the sequence of starting locations takes them; None as
            they are given.
        least_lengthscale: l0, of the default kernel on an even grid, in distances of locations.

    Raises:
        ValueError: if an option or shape is wrong.
    """

    name: str
    channels: int
    outputs: int
    inducing: int = 32
    kernel: gpytorch.kernels.Kernel | None = None
    mean: MeanName = "constant"
    learn_locations: bool = True
    locations: Any = None
    smoothness: float = ROUGH
    order: tuple[int, ...] | None = None
    least_lengthscale: float = 0.0

    def __post_init__(self) -> None:
        verify_fields(self)

    @cached_property
    def start(self) -> Tensor:
        """Starting locations (M, d)."""
        if self.locations is None:
            return in_place(starting_locations(self.inducing, self.channels), self.order)
        return _points("locations", self.locations, self.channels)

    @property
    def _even(self) -> bool:
        """Whether two numbers move an even grid: free locations of one channel trade places."""
        return self.learn_locations and self.channels == 1 and self.locations is None

    @cached_property
    def kernel_prior(self) -> KernelPrior:
        """Of the kernel's parameters."""
        return KernelPrior(self.name, self.kernel, self.channels, self.smoothness)

    @property
    def kernel_sites(self) -> tuple[str, ...]:
        """Names of the sites of the kernel and its scale."""
        return (*(site.name for site in self.kernel_prior.sites()), f"{self.name}_output_scale")

    def sites(self, dims: Mapping[str, str] = NO_NAMES) -> tuple[Site, ...]:
        """The sites, in the order in which they are sampled.

        Args:
            dims: names of dimensions ("input", "output", "inducing") where they are others.
        """
        inputs, outputs = dims.get("input", "input"), dims.get("output", "output")
        inducing = dims.get("inducing", "inducing")
        zero = torch.zeros(self.outputs, dtype=torch.float64)
        name, Z = self.name, self.start
        sites = [
            *self.kernel_prior.sites(inputs),
            Site(f"{name}_output_scale", dist.LogNormal(zero, 1.0).to_event(1), (outputs,)),
            normal(f"{name}_constant", zero, (outputs,)),
        ]
        if self.mean == "linear":
            start = torch.zeros(self.outputs, self.channels, dtype=torch.float64)
            if self.outputs == self.channels:
                start.fill_diagonal_(1.0)
            sites.append(normal(f"{name}_slope", start, (outputs, inputs)))
        if self._even:
            one = torch.ones(1, dtype=torch.float64)
            spread = dist.LogNormal(math.log(REACH) * one, 0.5 * one).to_event(1)
            sites.append(normal(f"{name}_center", 0.0 * one, (inputs,)))
            sites.append(Site(f"{name}_half_width", spread, (inputs,)))
        elif self.learn_locations:
            sites.append(normal(f"{name}_locations", Z, (inducing, inputs)))
        values = torch.zeros(self.outputs, Z.shape[-2], dtype=torch.float64)
        sites.append(normal(f"{name}_values", values, (outputs, inducing), role="free"))
        return tuple(sites)

    def lengthscale(self, values: Values) -> Tensor | None:
        """sqrt(l^2 + (l0 h)^2) (*b, d), l of the site and h between locations; None of a kernel."""
        own = values.get(f"{self.name}_lengthscale") if self.kernel is None else None
        if own is None or not self._even or not self.least_lengthscale:
            return own
        h = 2.0 * values[f"{self.name}_half_width"] / max(self.inducing - 1, 1)
        return torch.hypot(own, self.least_lengthscale * h)

    def function(self, values: Values) -> StaticFunction:
        """The function at values (*b, *shape) of the sites; batch shape *b."""
        name, Z = self.name, self.start
        if self._even:
            center, half_width = values[f"{name}_center"], values[f"{name}_half_width"]
            Z = center.unsqueeze(-2) + half_width.unsqueeze(-2) * (Z / REACH)
        elif self.learn_locations:
            Z = values[f"{name}_locations"]
        lengthscale = self.lengthscale(values)
        own = values if lengthscale is None else {f"{name}_lengthscale": lengthscale}
        return StaticFunction(
            self.kernel_prior.sampled(own),
            Z,
            values[f"{name}_values"],
            values[f"{name}_output_scale"],
            values[f"{name}_constant"],
            values.get(f"{name}_slope"),
            name,
            order=self.order,
        )


def sample_static(
    name: str,
    *,
    channels: int,
    outputs: int,
    inducing: int = 32,
    kernel: gpytorch.kernels.Kernel | None = None,
    mean: MeanName = "constant",
    learn_locations: bool = True,
    locations: Any = None,
) -> StaticFunction:
    """Sample a static function of inputs of unit scale.

    Arguments are the attributes of `StaticPrior`, which lists the sites.

    Returns:
        The function with the batch shape of the sites (particles).

    Raises:
        ValueError: if an option or shape is wrong.

    Examples:
        >>> f = dgp.sample_static("f", channels=1, outputs=1, inducing=8)  # inside a Pyro model
        >>> f.mean(torch.zeros(5, 1, dtype=torch.float64)).shape
        torch.Size([5, 1])
    """
    prior = StaticPrior(name, channels, outputs, inducing, kernel, mean, learn_locations, locations)
    return prior.function(sample(prior.sites()))


@checked
def static_gp(
    name: str,
    x: Any,
    *,
    outputs: int | None = None,
    channels: int | None = None,
    inducing: int = 32,
    kernel: gpytorch.kernels.Kernel | None = None,
    mean: MeanName = "constant",
    pathwise: bool = False,
    support: Any = 256,
    learn_locations: bool = True,
    locations: Any = None,
) -> Tensor:
    """A static layer in a Pyro model: values f(x) along a trajectory.

    Sites: those of `sample_static`, and

    - ``<name>`` (n,) or (n, e): f at each point, by the conditional given the inducing values,
      independent between points. For a last layer, whose likelihood sees one point at a time: a
      guide gives this site the same conditional, by calling the same layer.
    - with `pathwise` instead ``<name>_residual`` (e, K), standard normal innovations, and the
      deterministic site ``<name>``: one function along the path, see `StaticFunction.path`. For a
      layer that feeds another dynamic layer, which would average independent noise away.

    The variance of the site gets 1e-8 of the kernel's variance added, so that its density exists
    where the inducing values leave nothing open.

    Args:
        name: name of the site and prefix of the others.
        x: (*b, n), or (*b, n, d) where `channels` is given; of unit scale.
        outputs: e; None for a single output without a dimension of its own.
        channels: d; None for a single channel without a dimension of its own.
        inducing, kernel, mean, learn_locations, locations: see `sample_static`.
        pathwise: whether to draw one function instead of a value at each point.
        support: K, or support points (K, d), or (K,) for one channel. A number stands for an even
            grid over the range of x (one channel) or K samples of x, evenly spread in time; both
            move with x, without gradient. Give points where the same function has to be met again
            along another x.

    Returns:
        f, (*b, n), or (*b, n, e) where `outputs` is given.

    Raises:
        ValueError: if an option or shape is wrong, or x is not finite.

    Examples:
        >>> x = torch.linspace(-1.0, 1.0, 5, dtype=torch.float64)
        >>> dgp.static_gp("f", x, inducing=8).shape  # inside a Pyro model
        torch.Size([5])
    """
    d, e = 1 if channels is None else channels, 1 if outputs is None else outputs
    verify(channels=d, outputs=e)
    points = as_tensor(x, argument="x")
    if channels is None:
        points = points.unsqueeze(-1)
    if points.dim() < 2 or points.shape[-1] != d:
        shape = "(..., n)" if channels is None else f"(..., n, {channels})"
        got = f"shape {tuple(as_tensor(x).shape)}"
        raise invalid("x", expected=f"shape {shape}", got=got)
    if not bool(points.isfinite().all()):
        raise invalid("x", expected="finite numbers", got="NaN or infinity")
    function = sample_static(
        name,
        channels=d,
        outputs=e,
        inducing=inducing,
        kernel=kernel,
        mean=mean,
        learn_locations=learn_locations,
        locations=locations,
    )
    event = 1 if outputs is None else 2
    if pathwise:
        at = _support(support, points)
        zero = torch.zeros(e, at.shape[-2], dtype=torch.float64)
        residual = pyro.sample(f"{name}_residual", dist.Normal(zero, 1.0).to_event(2))
        values = function.path(points, residual, at)
        values = values.squeeze(-1) if outputs is None else values
        return pyro.deterministic(name, values, event_dim=event)
    loc, variance = function.moments(points)
    floor = function.kernel.diagonal(points).unsqueeze(-1)
    floor = JITTER * floor * function.output_scale.square().unsqueeze(-2)
    scale = (variance + floor).sqrt()
    if outputs is None:
        loc, scale = loc.squeeze(-1), scale.squeeze(-1)
    return pyro.sample(name, dist.Normal(loc, scale).to_event(event))


def _points(argument: str, value: Any, channels: int) -> Tensor:
    """Points (K, d) as a user may write them."""
    points = as_tensor(value, argument=argument)
    if points.dim() == 1 and channels == 1:
        points = points.unsqueeze(-1)
    if points.dim() != 2 or points.shape[-1] != channels or not len(points):
        expected = f"shape (count, {channels})"
        raise invalid(argument, expected=expected, got=f"shape {tuple(points.shape)}")
    if not bool(points.isfinite().all()):
        raise invalid(argument, expected="finite numbers", got="NaN or infinity")
    return points


def _support(support: Any, x: Tensor) -> Tensor:
    """Support points (*b, K, d) for points x (*b, n, d)."""
    if not isinstance(support, int):
        return _points("support", support, x.shape[-1])
    COUNT.check("support", support)
    x = x.detach()
    if x.shape[-1] > 1:
        index = torch.linspace(0, x.shape[-2] - 1, min(support, x.shape[-2]), dtype=torch.float64)
        return x[..., index.round().long(), :]
    low, high = x.squeeze(-1).amin(-1), x.squeeze(-1).amax(-1)
    margin = MARGIN * (high - low)
    return even_grid(low - margin, high + margin, support).unsqueeze(-1)
