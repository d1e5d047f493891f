r"""Static Gaussian-process layers whose inducing values are honest Pyro sample sites.

A function with prior mean mu, kernel s^2 k and inducing values at M locations Z is written in
whitened inducing values v ~ N(0, I):

    K_zz = L L',      u = mu(Z) + s L v,      alpha = s L^-T v,
    E[f(x) | v] = mu(x) + k(x, Z) alpha,
    Cov[f(x), f(x') | v] = s^2 R(x, x'),      R(x, x') = k(x, x') - k(x, Z) K_zz^-1 k(Z, x').

Everything that depends on v is computed from the value of its site (unlike the inducing sites of
`pyro.contrib.gp` and GPyTorch's Pyro models), so that SVI, NUTS, Predictive and importance ratios
see one model. The outputs of a layer share kernel and locations and are independent given them.

Inputs are taken to be of unit scale: the priors of lengthscales and locations say so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import gpytorch
import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp._errors import invalid
from pyro_dynogp._tensors import as_tensor, broadcast
from pyro_dynogp.layers.kernels import SampledKernel, sample_kernel
from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError

MeanName = Literal["constant", "linear"]

# Added to the diagonal of a matrix that is factored, as a share of the kernel's mean variance; the
# second where the first does not suffice. Coincident locations need it: K_zz is then singular.
JITTER = 1e-8
LARGER_JITTER = 1e-6
# Half the width of the starting grid of one channel of unit standard deviation.
REACH = 3.0
# Share of the range of x that support points reach beyond it on either side.
MARGIN = 0.02


class Table(NamedTuple):
    """A function of one channel on an even grid: mean and variance given the inducing values.

    Attributes:
        grid: (*b, count). mean: (*b, e, count). variance: (*b, e, count).
    """

    grid: Tensor
    mean: Tensor
    variance: Tensor


@dataclass(frozen=True, eq=False)
class StaticFunction:
    """A Gaussian process given its whitened inducing values and all its parameters.

    The batch shapes *b of the attributes and of points x need only broadcast. K_zz is factored
    once, with 1e-8 of the kernel's mean variance added to its diagonal; an element of the batch
    where that fails gets 1e-6.

    Attributes:
        kernel: k.
        locations: Z (*b, M, d).
        whitened: v (*b, e, M).
        output_scale: s (*b, e), standard deviations that multiply the kernel's.
        constant: (*b, e), constant part of the prior mean.
        slope: (*b, e, d), slopes of the prior mean; None for a constant mean.
        name: what error messages call it.

    Raises:
        ValueError: if shapes do not fit together, or points have another number of channels.
        NotPositiveDefiniteError: on use, if K_zz cannot be factored even with the larger jitter.
    """

    kernel: SampledKernel
    locations: Tensor
    whitened: Tensor
    output_scale: Tensor
    constant: Tensor
    slope: Tensor | None = None
    name: str = "static function"

    def __post_init__(self) -> None:
        e, (M, d) = self.outputs, self.locations.shape[-2:]
        _check_shape("locations", self.locations, M, self.kernel.channels)
        _check_shape("whitened", self.whitened, e, M)
        _check_shape("output_scale", self.output_scale, e)
        _check_shape("constant", self.constant, e)
        if self.slope is not None:
            _check_shape("slope", self.slope, e, d)

    @property
    def channels(self) -> int:
        """Number of channels d."""
        return self.locations.shape[-1]

    @property
    def outputs(self) -> int:
        """Number of outputs e."""
        return self.whitened.shape[-2]

    @property
    def batch_shape(self) -> torch.Size:
        """Batch shape *b that all attributes broadcast to."""
        pairs = [(self.locations, 2), (self.whitened, 2), (self.output_scale, 1)]
        pairs += [(self.constant, 1)] + ([] if self.slope is None else [(self.slope, 2)])
        return broadcast(self.kernel.batch_shape, *(x.shape[: x.dim() - k] for x, k in pairs))

    @cached_property
    def root(self) -> Tensor:
        """Cholesky factor L (*b, M, M)."""
        K = self.kernel(self.locations, self.locations)
        level = K.diagonal(dim1=-2, dim2=-1).mean(-1)
        return _cholesky(K, level, f"{self.name}: the covariance of the inducing values")

    @property
    def inducing_values(self) -> Tensor:
        """Inducing values u (*b, e, M)."""
        return self.prior_mean(self.locations).mT + self.output_scale.unsqueeze(-1) * (
            self.whitened @ self.root.mT
        )

    @cached_property
    def weights(self) -> Tensor:
        """Weights alpha (*b, e, M), scale included: mean(x) = prior_mean(x) + k(x, Z) alpha'."""
        return self.output_scale.unsqueeze(-1) * _solve(self.root.mT, self.whitened.mT, True).mT

    def prior_mean(self, x: Tensor) -> Tensor:
        """Prior mean mu (*b, n, e) at points x (*b, n, d)."""
        self._check_points("x", x)
        constant = self.constant.unsqueeze(-2)
        if self.slope is not None:
            return constant + x @ self.slope.mT
        return constant + x.new_zeros((x.shape[-2], 1))

    def mean(self, x: Tensor) -> Tensor:
        """Conditional mean E[f(x) | v] (*b, n, e) at points x (*b, n, d)."""
        return self.prior_mean(x) + self.kernel(x, self.locations) @ self.weights.mT

    def variance(self, x: Tensor) -> Tensor:
        """Conditional variance Var[f(x) | v] (*b, n, e) at points x (*b, n, d), at least zero."""
        return self.moments(x)[1]

    def moments(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """`mean` and `variance` at points x (*b, n, d), for the cost of one kernel evaluation."""
        prior_mean = self.prior_mean(x)
        K = self.kernel(x, self.locations)
        explained = _solve(self.root, K.mT).square().sum(-2)
        share = (self.kernel.diagonal(x) - explained).clamp_min(0.0)
        variance = share.unsqueeze(-1) * self.output_scale.square().unsqueeze(-2)
        mean = prior_mean + K @ self.weights.mT
        return mean, variance.expand(broadcast(mean.shape, variance.shape))

    def table(self, low: Any, high: Any, count: int) -> Table:
        """Mean and variance on an even grid from low to high, for functions of one channel.

        Args:
            low, high: (*b) ends of the grid, taken without gradient.
            count: number of points, at least two.

        Raises:
            ValueError: if there are several channels, count < 2, or not low < high.
        """
        if self.channels != 1:
            raise invalid("table", expected="a function of one channel", got=f"{self.channels}")
        device = self.locations.device
        low, high = (as_tensor(end, device=device).detach() for end in (low, high))
        if count < 2:
            raise invalid("count", expected="at least two points", got=str(count))
        if not bool((low < high).all()):
            raise invalid("high", expected=f"above low ({low})", got=str(high))
        grid = _even_grid(low, high, count)
        grid = grid.expand((*broadcast(self.batch_shape, grid.shape[:-1]), count))
        mean, variance = self.moments(grid.unsqueeze(-1))
        return Table(grid, mean.mT, variance.mT)

    def path(self, x: Tensor, residual: Tensor, support: Tensor) -> Tensor:
        """Values (*b, n, e) at x (*b, n, d) of one function drawn from f | v (Matheron's rule).

        The part of f that v leaves open, f - E[f | v], is drawn jointly at the support points and
        interpolated to x by its own conditional mean; what it could still vary between them is
        dropped, so that the support has to be dense compared with the lengthscale. Equal x get
        equal values; where x is among the support points the joint distribution is exact (up to
        1e-8 of the kernel's variance).

        Args:
            x: points.
            residual: (*b, e, K) standard normal innovations.
            support: (*b, K, d) support points.
        """
        self._check_points("x", x)
        self._check_points("support", support)
        _check_shape("residual", residual, self.outputs, support.shape[-2])
        A = _solve(self.root, self.kernel(self.locations, support))
        K = self.kernel(support, support)
        level = K.diagonal(dim1=-2, dim2=-1).mean(-1)
        root = _cholesky(K - A.mT @ A, level, f"{self.name}: the covariance of the residual")
        # Coefficients of k(x, support), and of k(x, Z) for what the support shares with Z.
        own = _solve(root.mT, residual.mT, True)
        shared = _solve(self.root.mT, A @ own, True)
        scale = self.output_scale.unsqueeze(-2)
        drawn = self.kernel(x, support) @ (scale * own)
        given = self.kernel(x, self.locations) @ (self.weights.mT - scale * shared)
        return self.prior_mean(x) + given + drawn

    def _check_points(self, argument: str, x: Tensor) -> None:
        if x.dim() < 2 or x.shape[-1] != self.channels:
            raise invalid(
                argument,
                expected=f"shape (..., n, {self.channels})",
                got=f"shape {tuple(x.shape)}",
            )


def _check_shape(argument: str, x: Tensor, *shape: int) -> None:
    if tuple(x.shape[x.dim() - len(shape) :]) != shape or x.dim() < len(shape):
        sizes = ", ".join(str(size) for size in shape)
        raise invalid(argument, expected=f"shape (..., {sizes})", got=f"shape {tuple(x.shape)}")


def _solve(triangle: Tensor, right: Tensor, upper: bool = False) -> Tensor:
    return torch.linalg.solve_triangular(triangle, right, upper=upper)


def _cholesky(K: Tensor, level: Tensor, what: str) -> Tensor:
    """Lower Cholesky factor of K (*b, n, n) plus jitter, a share of the variance level (*b)."""
    diagonal = level[..., None, None] * torch.eye(K.shape[-1], dtype=K.dtype, device=K.device)
    root, failed = torch.linalg.cholesky_ex(K + JITTER * diagonal)
    if bool(failed.any()):
        # Only where it failed: an element's result must not depend on the rest of its batch.
        jitter = torch.where(failed > 0, K.new_tensor(LARGER_JITTER), K.new_tensor(JITTER))
        root, failed = torch.linalg.cholesky_ex(K + jitter[..., None, None] * diagonal)
    if bool(failed.any()) or not bool(root.isfinite().all()):
        finite = "finite" if bool(K.isfinite().all()) else "not finite"
        raise NotPositiveDefiniteError(
            f"{what} is not positive definite, even with {LARGER_JITTER} of the kernel's variance "
            f"added to its diagonal (its entries are {finite}). Lengthscales far from the scale of "
            "the inputs or points far apart are the usual causes."
        )
    return root


def _even_grid(low: Tensor, high: Tensor, count: int) -> Tensor:
    """(*b, count) from low to high (*b)."""
    share = torch.linspace(0.0, 1.0, count, dtype=torch.float64, device=low.device)
    return low.unsqueeze(-1) + (high - low).unsqueeze(-1) * share


def starting_locations(inducing: int, channels: int) -> Tensor:
    """Inducing locations (M, d) that cover inputs of unit standard deviation.

    One channel: an even grid from -3 to 3. Several: a Sobol sequence mapped to normal quantiles.
    """
    if channels == 1:
        return torch.linspace(-REACH, REACH, inducing, dtype=torch.float64).unsqueeze(-1)
    sobol = torch.quasirandom.SobolEngine(channels, scramble=False)
    sobol.fast_forward(1)  # the first point is the origin, whose quantiles are infinite
    return torch.special.ndtri(sobol.draw(inducing, dtype=torch.float64))


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

    Sites (all start with ``<name>_``), * marking what depends on the options:

    - the kernel's, see `sample_kernel`; by default ``lengthscale`` (d,), LogNormal(0, 1).
    - ``output_scale`` (e,): LogNormal(0, 1).
    - ``constant`` (e,): normal(0, 1).
    - ``slope`` (e, d)*: normal(identity where e = d, else zero; 1).
    - one channel: ``center`` (1,)*, normal(0, 1), and ``half_width`` (1,)*, LogNormal(log 3, 0.5),
      of the even grid of locations; several channels, or `locations` given: ``locations`` (M, d)*,
      normal(starting locations, 1).
    - ``values`` (e, M): standard normal, the whitened inducing values.

    Args:
        name: prefix of the sites.
        channels: d, number of inputs. outputs: e.
        inducing: M, number of inducing locations, where `locations` does not say.
        kernel: a GPyTorch kernel (of unit variance: `output_scale` multiplies it); None for a
            Matern-3/2 with a lengthscale for each channel.
        mean: "constant", or "linear" for a slope as well.
        learn_locations: whether the locations are learnt; else they stay at the start.
        locations: starting locations (M, d), or (M,) for one channel; by default
            `starting_locations`.

    Returns:
        The function with the batch shape of the sites (particles).

    Raises:
        ValueError: if an option or shape is wrong.
    """
    _check_counts(channels=channels, outputs=outputs, inducing=inducing)
    if mean not in ("constant", "linear"):
        raise invalid("mean", expected="'constant' or 'linear'", got=repr(mean))
    if locations is None:
        Z = starting_locations(inducing, channels)
    else:
        Z = _points("locations", locations, channels)

    def normal(site: str, loc: Tensor) -> Tensor:
        return pyro.sample(f"{name}_{site}", dist.Normal(loc, 1.0).to_event(loc.dim()))

    sampled = sample_kernel(name, kernel, channels)
    zero = torch.zeros(outputs, dtype=torch.float64)
    scale = pyro.sample(f"{name}_output_scale", dist.LogNormal(zero, 1.0).to_event(1))
    constant = normal("constant", zero)
    slope = None
    if mean == "linear":
        start = torch.zeros(outputs, channels, dtype=torch.float64)
        if outputs == channels:
            start.fill_diagonal_(1.0)
        slope = normal("slope", start)
    if learn_locations and channels == 1 and locations is None:
        # Two numbers move the grid: free locations of one channel only trade places.
        one = torch.ones(1, dtype=torch.float64)
        spread = dist.LogNormal(math.log(REACH) * one, 0.5 * one).to_event(1)
        center, half_width = normal("center", 0.0 * one), pyro.sample(f"{name}_half_width", spread)
        Z = center.unsqueeze(-2) + half_width.unsqueeze(-2) * (Z / REACH)
    elif learn_locations:
        Z = normal("locations", Z)
    values = normal("values", torch.zeros(outputs, Z.shape[-2], dtype=torch.float64))
    return StaticFunction(sampled, Z, values, scale, constant, slope, name)


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
    """
    d, e = 1 if channels is None else channels, 1 if outputs is None else outputs
    _check_counts(channels=d, outputs=e)
    points = as_tensor(x)
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


def _check_counts(**counts: Any) -> None:
    for argument, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise invalid(argument, expected="a whole number of at least one", got=repr(count))


def _points(argument: str, value: Any, channels: int) -> Tensor:
    """Points (K, d) as a user may write them."""
    points = as_tensor(value)
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
    _check_counts(support=support)
    x = x.detach()
    if x.shape[-1] > 1:
        index = torch.linspace(0, x.shape[-2] - 1, min(support, x.shape[-2]), dtype=torch.float64)
        return x[..., index.round().long(), :]
    low, high = x.squeeze(-1).amin(-1), x.squeeze(-1).amax(-1)
    margin = MARGIN * (high - low)
    return _even_grid(low - margin, high + margin, support).unsqueeze(-1)
