"""Any GPyTorch kernel as a function of tensors, its hyperparameters being Pyro sample sites.

The functions of the distance that matter most are evaluated by `pyro_dynogp.layers.radial`, as are
scales, sums and products of them; everything else is the kernel's own `forward`. GPyTorch's Matern
kernels have a hand-written derivative that takes the first derivative for a constant: a Hessian
through it would be silently wrong.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

import pyro.distributions as dist
import torch
from gpytorch import constraints, kernels
from linear_operator import to_dense
from torch import Tensor

from pyro_dynogp.layers.hyperpriors import hyperprior, meaning, plain_name
from pyro_dynogp.layers.radial import check_lengthscale, function_of_distance
from pyro_dynogp.layers.sites import Site, sample
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import broadcast

# Smoothness by default, and of functions in feedback: a rough one is uncertain between its inducing
# values, and free runs draw from that again and again.
ROUGH, SMOOTH = 1.5, 2.5
# Least lengthscale of functions in feedback, in distances between inducing locations. Filters read
# between these, free runs draw what they leave open: of shorter lengthscales nearly everything.
RESOLVED = 2.0
MATERN = {0.5: "matern12", 1.5: "matern32", 2.5: "matern52"}
# Kernels whose GPyTorch code takes parameters with more leading dimensions than they were made
# with; of all others one batch element is evaluated at a time.
BATCHED = (
    kernels.RBFKernel,
    kernels.MaternKernel,
    kernels.ScaleKernel,
    kernels.AdditiveKernel,
    kernels.ProductKernel,
    kernels.PeriodicKernel,
    kernels.LinearKernel,
    kernels.RQKernel,
    kernels.CosineKernel,
)


@dataclass(frozen=True, eq=False)
class SampledKernel:
    """A kernel with given hyperparameters.

    Attributes:
        kernel: the form; its own parameter values are not used, its constraints do nothing.
        values: hyperparameters (*b, *shape) by the full name that they have in the kernel, each as
            what it means (a positive lengthscale, not its softplus inverse).
        channels: d, number of channels of the points.
    """

    kernel: kernels.Kernel
    values: Mapping[str, Tensor]
    channels: int

    def __call__(self, x1: Tensor, x2: Tensor) -> Tensor:
        """Dense covariance (*b, n, m) of points x1 (*b, n, d) and x2 (*b, m, d).

        Raises:
            ValueError: if the points or the kernel have another number of channels.
        """
        K = self._evaluate(x1, x2)
        if K.shape[-2:] != (x1.shape[-2], x2.shape[-2]):
            raise invalid(
                "kernel",
                expected=f"a covariance of {x1.shape[-2]} and {x2.shape[-2]} points",
                got=f"shape {tuple(K.shape)}",
                advice="Kernels of several outputs or of derivatives are not supported.",
            )
        return K

    def diagonal(self, x: Tensor) -> Tensor:
        """Variance (*b, n) at points x (*b, n, d)."""
        return self._evaluate(x, None)

    @property
    def batch_shape(self) -> torch.Size:
        """Batch shape *b that the hyperparameters broadcast to."""
        return broadcast(*(value.shape[: value.dim() - k] for value, k in self._sizes()))

    @property
    def radial(self) -> tuple[str, Tensor] | None:
        """Name of the function of the distance and its lengthscales (*b, d), or None.

        The name is "rbf", "matern12", "matern32" or "matern52"; a scale above it is
        `radial_variance`. None also where the kernel sees only some of the channels.
        """
        found = self._radial()
        return None if found is None else found[:2]

    @property
    def radial_variance(self) -> Tensor | None:
        """Variance (*b) that multiplies the function of the distance; None without a scale."""
        found = self._radial()
        return None if found is None else found[2]

    def _radial(self) -> tuple[str, Tensor, Tensor | None] | None:
        base, prefix, variance = self.kernel, "", None
        if type(base) is kernels.ScaleKernel:
            if base.active_dims is not None:
                return None
            variance = self.values["raw_outputscale"]
            base, prefix = base.base_kernel, "base_kernel."
        form = _form(base)
        if form is None or base.active_dims is not None:
            return None
        lengthscale = self.values[prefix + "raw_lengthscale"].squeeze(-2)
        check_lengthscale(lengthscale, self.channels)
        return form, lengthscale.expand(*lengthscale.shape[:-1], self.channels), variance

    def _sizes(self) -> list[tuple[Tensor, int]]:
        """Each value and the number of its own dimensions, those that are not batch."""
        return [(v, self.kernel.get_parameter(name).dim()) for name, v in self.values.items()]

    def _evaluate(self, x1: Tensor, x2: Tensor | None) -> Tensor:
        for argument, x in (("x1", x1), ("x2", x2)):
            if x is not None and (x.dim() < 2 or x.shape[-1] != self.channels):
                raise invalid(
                    argument,
                    expected=f"shape (..., n, {self.channels})",
                    got=f"shape {tuple(x.shape)}",
                )
        found = self._radial()
        if found is not None:
            return _scaled(function_of_distance(*found[:2], x1, x2), found[2], x2 is None)
        whole = _Evaluation(self.kernel)
        modules = (m for m in self.kernel.modules() if isinstance(m, kernels.Kernel))
        if all(type(module) in BATCHED for module in modules):
            return whole.at(self.values, x1, x2)
        points = [x1] if x2 is None else [x1, x2]
        batch = broadcast(self.batch_shape, *(x.shape[:-2] for x in points))
        if not batch:
            return whole.at(self.values, x1, x2)
        flat = [x.expand(batch + x.shape[-2:]).reshape(-1, *x.shape[-2:]) for x in points]
        values = {
            name: v.expand(batch + v.shape[v.dim() - k :]).reshape(-1, *v.shape[v.dim() - k :])
            for name, (v, k) in zip(self.values, self._sizes(), strict=True)
        }
        each = [
            whole.at({name: v[i] for name, v in values.items()}, *(x[i] for x in flat))
            for i in range(batch.numel())
        ]
        return torch.stack(each).reshape(batch + each[0].shape)


class _Evaluation(torch.nn.Module):
    """Dense evaluation of a kernel, whose parameters a functional call replaces."""

    def __init__(self, kernel: kernels.Kernel) -> None:
        super().__init__()
        self.kernel = kernel

    def at(self, values: Mapping[str, Tensor], x1: Tensor, x2: Tensor | None = None) -> Tensor:
        named = {f"kernel.{name}": value for name, value in values.items()}
        return torch.func.functional_call(self, named, (x1, x2))

    def forward(self, x1: Tensor, x2: Tensor | None) -> Tensor:
        return _dense(self.kernel, x1, x2)


def _dense(kernel: kernels.Kernel, x1: Tensor, x2: Tensor | None, select: bool = True) -> Tensor:
    """Covariance (*b, n, m) of a tree of kernels, or the variance (*b, n) where x2 is None."""
    if select and kernel.active_dims is not None:
        x1 = x1.index_select(-1, kernel.active_dims)
        x2 = None if x2 is None else x2.index_select(-1, kernel.active_dims)
    if type(kernel) is kernels.ScaleKernel:
        # A scale takes over the active channels of what it scales.
        base = _dense(kernel.base_kernel, x1, x2, select=False)
        return _scaled(base, kernel.outputscale, x2 is None)
    if type(kernel) in (kernels.AdditiveKernel, kernels.ProductKernel):
        total = _dense(kernel.kernels[0], x1, x2)
        for part in kernel.kernels[1:]:
            K = _dense(part, x1, x2)
            total = total + K if type(kernel) is kernels.AdditiveKernel else total * K
        return total
    form = _form(kernel)
    if form is not None:
        return function_of_distance(form, kernel.lengthscale.squeeze(-2), x1, x2)
    if x2 is not None:
        return to_dense(kernel.forward(x1, x2))
    diagonal = to_dense(kernel.forward(x1, x1, diag=True))
    # Some kernels do not know of `diag`.
    whole = diagonal.dim() > 1 and diagonal.shape[-2:] == (x1.shape[-2],) * 2
    return diagonal.diagonal(dim1=-2, dim2=-1) if whole else diagonal


def _form(kernel: kernels.Kernel) -> str | None:
    if type(kernel) is kernels.MaternKernel:
        return MATERN[kernel.nu]
    return "rbf" if type(kernel) is kernels.RBFKernel else None


def _scaled(K: Tensor, variance: Tensor | None, diagonal: bool) -> Tensor:
    if variance is None:
        return K
    return K * (variance[..., None] if diagonal else variance[..., None, None])


@lru_cache
def _default_form(channels: int, smoothness: float = ROUGH) -> kernels.Kernel:
    # Shared, and safe to share: a function of the distance is evaluated without touching it.
    return kernels.MaternKernel(smoothness, ard_num_dims=channels).double().requires_grad_(False)


@dataclass(frozen=True, eq=False)
class KernelPrior:
    """Prior of the hyperparameters of a kernel: its sites, and the kernel at their values.

    Sites: for None, which stands for a Matern kernel of unit variance, ``<name>_lengthscale``
    (d,), LogNormal(0, 1). For a GPyTorch kernel ``<name>_<parameter>`` with the shape of the
    parameter, of each that requires a gradient: "base_kernel.raw_lengthscale" is
    ``<name>_base_kernel_lengthscale``. Its value is what the parameter means (within its
    constraint), its distribution the prior registered with the kernel, or else one around the
    present value, see `hyperprior`.

    Attributes:
        name: prefix of the sites.
        kernel: a GPyTorch kernel without batch shape, copied, never changed; or None.
        channels: d, number of channels of the points.
        smoothness: nu of the kernel that None stands for: 0.5, 1.5 or 2.5.

    Raises:
        ValueError: if `kernel` is something else or has a prior that cannot be a site's.
    """

    name: str
    kernel: kernels.Kernel | None
    channels: int
    smoothness: float = ROUGH

    def __post_init__(self) -> None:
        if not isinstance(self.smoothness, float) or self.smoothness not in MATERN:
            raise invalid("smoothness", expected="0.5, 1.5 or 2.5", got=repr(self.smoothness))
        if self.kernel is not None and self.smoothness != ROUGH:
            raise invalid("smoothness", expected="none with a kernel", got=str(self.smoothness))
        if self.kernel is None:
            return
        if not isinstance(self.kernel, kernels.Kernel):
            got = type(self.kernel).__name__
            raise invalid("kernel", expected="a gpytorch kernel or None", got=got)
        if self.kernel.batch_shape:
            raise invalid(
                "kernel",
                expected="a kernel without batch shape",
                got=f"batch shape {tuple(self.kernel.batch_shape)}",
                advice="Batch dimensions come from the plates around the layer.",
            )
        names = {plain_name(parameter) + "_prior" for parameter, _ in self._form.named_parameters()}
        stray = {prior for prior, *_ in self._form.named_priors()} - names
        if stray:
            raise invalid(
                "kernel",
                expected="each prior named after its parameter ('lengthscale_prior')",
                got=", ".join(sorted(stray)),
            )

    @cached_property
    def _form(self) -> kernels.Kernel:
        assert self.kernel is not None
        return copy.deepcopy(self.kernel).double()

    @cached_property
    def _free(self) -> kernels.Kernel:
        """A copy whose parameters are what they mean, so that nothing has to be inverted."""
        form = copy.deepcopy(self._form)
        form.requires_grad_(False)
        _drop_constraints(form)
        return form

    def _site(self, parameter: str) -> str:
        return f"{self.name}_{plain_name(parameter).replace('.', '_')}"

    def sites(self, inputs: str = "input") -> tuple[Site, ...]:
        """The sites; `inputs` is the name of the dimension of the default kernel's lengthscales.

        Parameters of a GPyTorch kernel number their dimensions, as ArviZ does.
        """
        if self.kernel is None:
            zero = torch.zeros(self.channels, dtype=torch.float64)
            prior = dist.LogNormal(zero, 1.0).to_event(1)
            return (Site(f"{self.name}_lengthscale", prior, (inputs,)),)
        sites = []
        for parameter, raw in self._form.named_parameters():
            if raw.requires_grad:
                prior, name = hyperprior(self._form, parameter), self._site(parameter)
                dims = tuple(f"{name}_dim_{axis}" for axis in range(len(prior.event_shape)))
                sites.append(Site(name, prior, dims))
        return tuple(sites)

    def sampled(self, values: Mapping[str, Tensor]) -> SampledKernel:
        """The kernel at values (*b, *shape) of the sites; batch shape *b."""
        if self.kernel is None:
            lengthscale = values[f"{self.name}_lengthscale"].unsqueeze(-2)
            form = _default_form(self.channels, self.smoothness)
            return SampledKernel(form, {"raw_lengthscale": lengthscale}, self.channels)
        given = {
            parameter: values[self._site(parameter)]
            if raw.requires_grad
            else meaning(self._form, parameter)
            for parameter, raw in self._form.named_parameters()
        }
        return SampledKernel(self._free, given, self.channels)


def sample_kernel(name: str, kernel: kernels.Kernel | None, channels: int) -> SampledKernel:
    """Sample the hyperparameters of a kernel; args and sites as those of `KernelPrior`."""
    prior = KernelPrior(name, kernel, channels)
    return prior.sampled(sample(prior.sites()))


def _drop_constraints(kernel: kernels.Kernel) -> None:
    """Let each parameter of our own copy be what it means, so that nothing has to be inverted."""
    for name in [name for name, _ in kernel.named_parameters()]:
        if kernel.constraint_for_parameter_name(name) is not None:
            owner, _, last = name.rpartition(".")
            free = constraints.GreaterThan(-math.inf, transform=None)
            kernel.get_submodule(owner).register_constraint(last, free)
