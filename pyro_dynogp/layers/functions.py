r"""A static function: a Gaussian process given its whitened inducing values.

A function with prior mean mu, kernel s^2 k and inducing values at M locations Z is written in
whitened inducing values v ~ N(0, I):

    K_zz = L L',      u = mu(Z) + s L v,      alpha = s L^-T v,
    E[f(x) | v] = mu(x) + k(x, Z) alpha,
    Cov[f(x), f(x') | v] = s^2 R(x, x'),      R(x, x') = k(x, x') - k(x, Z) K_zz^-1 k(Z, x').

The outputs of a layer share kernel and locations and are independent given them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pyro_dynogp.layers.kernels import SampledKernel
from pyro_dynogp.layers.one_channel import FORMS, moments_along
from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import broadcast

# Added to the diagonal of a matrix that is factored, as a share of the kernel's mean variance; the
# second where the first does not suffice. Coincident locations need it: K_zz is then singular.
JITTER = 1e-8
LARGER_JITTER = 1e-6
UNLIMITED = (-math.inf, math.inf)


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
        limits: where the prior mean stops, below and above; infinite where it does not.
        order: places of its channels as whatever goes channel by channel takes them (quadrature,
            support points); None as they are given.

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
    limits: tuple[float, float] = UNLIMITED
    order: tuple[int, ...] | None = None

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
        mean = self.constant.unsqueeze(-2) + x.new_zeros((x.shape[-2], 1))
        if self.slope is not None:
            mean = mean + x @ self.slope.mT
        return mean if self.limits == UNLIMITED else mean.clamp(*self.limits)

    def mean(self, x: Tensor) -> Tensor:
        """Conditional mean E[f(x) | v] (*b, n, e) at points x (*b, n, d)."""
        prior_mean = self.prior_mean(x)
        found = self._along(x, explained=False)
        if found is not None:
            return prior_mean + found[0]
        return prior_mean + self.kernel(x, self.locations) @ self.weights.mT

    def variance(self, x: Tensor) -> Tensor:
        """Conditional variance Var[f(x) | v] (*b, n, e) at points x (*b, n, d), at least zero."""
        return self.moments(x)[1]

    def moments(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """`mean` and `variance` at points x (*b, n, d), for the cost of one kernel evaluation."""
        prior_mean = self.prior_mean(x)
        found = self._along(x, explained=True)
        if found is not None:
            mean, explained = prior_mean + found[0], found[1]
        else:
            K = self.kernel(x, self.locations)
            explained = _solve(self.root, K.mT).square().sum(-2)
            mean = prior_mean + K @ self.weights.mT
        share = (self.kernel.diagonal(x) - explained).clamp_min(0.0)
        variance = share.unsqueeze(-1) * self.output_scale.square().unsqueeze(-2)
        return mean, variance.expand(broadcast(mean.shape, variance.shape))

    def _along(self, x: Tensor, *, explained: bool) -> tuple[Tensor, Tensor] | None:
        """What weights add to the prior mean, and variance they explain; None in many channels."""
        radial = self.kernel.radial if self.channels == 1 else None
        if radial is None or radial[0] not in FORMS:
            return None
        scale = self.kernel.radial_variance
        scale = torch.ones((), dtype=torch.float64) if scale is None else scale
        mean, share = moments_along(
            radial[0],
            radial[1].squeeze(-1),
            x.squeeze(-1),
            self.locations.squeeze(-1),
            self.weights * scale[..., None, None],
            self.root if explained else None,
        )
        return mean, share * scale.square().unsqueeze(-1)

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
        return self.drawn(residual, support).mean(x)

    def drawn(self, residual: Tensor, support: Tensor) -> DrawnFunction:
        """The function that `path` follows, as weights of the kernel at Z and at the support."""
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
        return DrawnFunction(
            self.kernel,
            _stacked([self.locations, support]),
            _stacked([self.weights.mT - scale * shared, scale * own]).mT,
            self.output_scale,
            self.constant,
            self.slope,
            self.name,
            self.limits,
            self.order,
        )

    def _check_points(self, argument: str, x: Tensor) -> None:
        if x.dim() < 2 or x.shape[-1] != self.channels:
            raise invalid(
                argument,
                expected=f"shape (..., n, {self.channels})",
                got=f"shape {tuple(x.shape)}",
            )


class DrawnFunction(StaticFunction):
    """One function that is known everywhere: `whitened` holds the weights of the kernel."""

    @property
    def weights(self) -> Tensor:
        """Weights (*b, e, M), scale included."""
        return self.whitened

    def moments(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Its values at points x (*b, n, d), and no variance."""
        mean = self.mean(x)
        return mean, torch.zeros_like(mean)


def _stacked(parts: Sequence[Tensor]) -> Tensor:
    """Parts (*b, K, m) one below the other."""
    batch = broadcast(*(part.shape[:-2] for part in parts))
    return torch.cat([part.expand(batch + part.shape[-2:]) for part in parts], -2)


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


def even_grid(low: Tensor, high: Tensor, count: int) -> Tensor:
    """Even grid (*b, count) from low (*b) to high (*b)."""
    share = torch.linspace(0.0, 1.0, count, dtype=torch.float64, device=low.device)
    return low.unsqueeze(-1) + (high - low).unsqueeze(-1) * share


def in_place(columns: Tensor, order: Sequence[int] | None) -> Tensor:
    """Columns (..., d) that are in this order of the channels, each in its channel's place."""
    return columns if order is None else columns[..., torch.as_tensor(order).argsort()]


def support_points(function: StaticFunction, count: int) -> Tensor:
    """Points (*b, K, d) at which the rest of a function is drawn: over where inducing points lie.

    One channel: an even grid. Several: the inducing locations spread by a Sobol sequence over
    their box. No gradient passes.
    """
    z = function.locations.detach()
    low, high = z.amin(-2, keepdim=True), z.amax(-2, keepdim=True)
    margin = 0.1 * (high - low) + 1e-3
    if z.shape[-1] == 1:
        unit = torch.linspace(0.0, 1.0, count, dtype=torch.float64).unsqueeze(-1)
    else:
        engine = torch.quasirandom.SobolEngine(z.shape[-1])
        unit = in_place(engine.draw(count, dtype=torch.float64), function.order)
    return low - margin + (high - low + 2.0 * margin) * unit
