"""A Gaussian trajectory with mean, semiseparable covariance and white noise: shapes and algebra."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from pyro.distributions import TorchDistribution, constraints
from torch import Tensor

from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.semiseparable import SemiseparableCovariance
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import Numbers, as_tensor


class _RealOrMissing(constraints.Constraint):
    """Real numbers, or NaN for a missing sample."""

    def check(self, value: Tensor) -> Tensor:
        return ~torch.isinf(value)


real_or_missing = _RealOrMissing()


class Trajectory(TorchDistribution):
    """Base of the distributions over whole trajectories, N(mean, S + diag(v)), everything O(n).

    Event shape (n,), or (n, n_y) where the modes have an output dimension; a row of the algebra is
    one output at one time, N = n n_y of them. The factorisation is kept with its gradient graph:
    make a new distribution for each backward pass.
    """

    arg_constraints: dict[str, constraints.Constraint] = {}  # noqa: RUF012 (torch's own attribute)
    has_rsample = True
    # Whether values are standard normal innovations pushed through `root`.
    has_innovations = True

    modes: Modes

    def _shape(self, batch: torch.Size, n: int, validate_args: bool | None) -> None:
        event = (n, self.modes.outputs) if self.modes.several_outputs else (n,)
        self._size = n * self.modes.outputs
        self._root: SemiseparableCovariance | None = None
        super().__init__(batch, torch.Size(event), validate_args=validate_args)

    @property
    def support(self) -> constraints.Constraint:
        """Real trajectories."""
        return constraints.independent(constraints.real, len(self.event_shape))

    @property
    def mean(self) -> Tensor:
        """(*batch, *event)."""
        raise NotImplementedError

    # White-noise variance (*b, n_y) where it is the same at all times, else of each row (*b, N);
    # infinite where a sample is missing.
    noise: Tensor

    @property
    def noise_rows(self) -> Tensor:
        """White-noise variance of each row (*b, N)."""
        v = self.noise
        repeats = self._size // v.shape[-1]
        return v.unsqueeze(-2).expand((*v.shape[:-1], repeats, v.shape[-1])).flatten(-2)

    def covariance(
        self, noise_variance: Tensor, missing: Tensor | None = None
    ) -> SemiseparableCovariance:
        """Covariance of the noise-free trajectory plus noise of variance (*b, n_y) or (*b, N).

        missing (*b, N) is True in rows without a sample.
        """
        raise NotImplementedError

    def expand(self, batch_shape: Any, _instance: Any = None) -> Any:
        """Broadcast to a larger batch shape; nothing is copied."""
        shape = torch.Size(batch_shape)
        own = self.batch_shape
        fits = len(own) <= len(shape) and all(
            a in (1, b) for a, b in zip(own[::-1], shape[::-1], strict=False)
        )
        if not fits:
            raise invalid(
                "batch_shape",
                expected=f"a shape that {tuple(self.batch_shape)} broadcasts to",
                got=str(tuple(shape)),
            )
        new = copy.copy(self)
        new._batch_shape = shape
        return new

    @property
    def root(self) -> SemiseparableCovariance:
        """The covariance S + diag(v), factored once."""
        if self._root is None:
            self._root = self.covariance(self.noise)
        return self._root

    def rsample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Draw whole trajectories in O(n)."""
        shape = torch.Size(sample_shape) + self.batch_shape + self.event_shape
        noise = torch.randn(shape, dtype=torch.float64, device=self.modes.poles.device)
        return self.from_innovations(noise)

    def from_innovations(self, noise: Tensor) -> Tensor:
        """Trajectory m + L D^{1/2} e of standard normal innovations e (..., *event)."""
        return self.mean + self.from_rows(apply(self.root.root_matmul, self.root, self.rows(noise)))

    def to_innovations(self, value: Tensor) -> Tensor:
        """Standardised innovations D^{-1/2} L^{-1} (y - m) of a trajectory y (..., *event)."""
        residual = self.rows(value - self.mean)
        return self.from_rows(apply(self.root.root_solve, self.root, residual))

    def log_prob(self, value: Numbers) -> Tensor:
        """Joint log-density (*s, *batch) of trajectories (*s, *batch, *event)."""
        value = as_tensor(value, device=self.modes.poles.device)
        if self._validate_args:
            self._validate_sample(value)
        residual, missing = split_missing(self.rows(value - self.mean))
        K = self.root if missing is None else self.covariance(self.noise, missing)
        batch = batch_dims(K)
        lead = residual.shape[: residual.dim() - 1 - batch]
        log_prob = K.log_prob(columns(residual, batch))  # *b, R
        return log_prob.movedim(-1, 0).reshape(lead + log_prob.shape[:-1])

    def rows(self, x: Tensor) -> Tensor:
        """(..., *event) to (..., N)."""
        return x.flatten(-2) if self.modes.several_outputs else x

    def from_rows(self, x: Tensor) -> Tensor:
        """(..., N) to (..., *event)."""
        return x.reshape(x.shape[:-1] + self.event_shape)


def batch_dims(K: SemiseparableCovariance) -> int:
    """Number of batch dimensions of a factored covariance."""
    return len(K.batch_shape)


def columns(x: Tensor, batch: int) -> Tensor:
    """(*s, *b, N) with len(b) = batch to right-hand sides (*b, N, R), R the product of s."""
    lead = x.shape[: x.dim() - 1 - batch]
    return x.reshape((math.prod(lead), *x.shape[len(lead) :])).movedim(0, -1)


def apply(method: Callable[[Tensor], Tensor], K: SemiseparableCovariance, x: Tensor) -> Tensor:
    """Apply a method of K that takes right-hand sides to rows (*s, *b, N)."""
    batch = batch_dims(K)
    lead = x.shape[: x.dim() - 1 - batch]
    out = method(columns(x, batch)).movedim(-1, 0)
    return out.reshape(lead + out.shape[1:])


def split_missing(residual: Tensor) -> tuple[Tensor, Tensor | None]:
    """Zeros for NaN in residuals (..., N), and where they were: (N,) if one pattern serves all."""
    missing = torch.isnan(residual)
    if not bool(missing.any()):
        return residual, None
    residual = residual.masked_fill(missing, 0.0)
    flat = missing.reshape(-1, missing.shape[-1])
    return residual, flat[0] if bool((flat == flat[0]).all()) else missing


def noise_of_samples(sd: Tensor, event: torch.Size, varying: bool) -> tuple[Tensor, torch.Size]:
    """Variance of the noise, and its batch shape b: (*b, n_y), or (*b, N) where it varies.

    Args:
        sd: standard deviation [output] (*b), or (*b, n_y) of several outputs; with `varying`
            (*b, *event).

    Raises:
        ValueError: where its shape is another one.
    """
    if varying:
        tail = tuple(event)
    else:
        tail = tuple(event[1:])
        if tail and sd.dim() == 0:
            sd = sd.expand(tail)
    if sd.shape[sd.dim() - len(tail) :] != torch.Size(tail):
        raise invalid("noise_sd", expected=f"shape (..., {tail})", got=f"shape {tuple(sd.shape)}")
    batch = sd.shape[: sd.dim() - len(tail)]
    v = sd.square()
    return v.reshape((*batch, -1)), batch
