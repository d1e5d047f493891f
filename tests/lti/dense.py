"""The dense twin of the semiseparable algebra: same interface, O(n^3), plain torch."""

from __future__ import annotations

import math
from functools import cached_property

import torch
from torch import Tensor

from pyro_dynogp.lti.covariance import autocovariance, observability, state_covariance
from pyro_dynogp.lti.grid import TimeGrid, time_grid
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.support.tensors import Numbers


def signal_covariance(
    modes: Modes,
    time: Numbers | TimeGrid,
    other: Numbers | TimeGrid,
    initial_covariance: Tensor | None = None,
) -> Tensor:
    """S(time, other) (*b, n n_y, m n_y), rows ordered by time, the outputs of a time together."""
    t, s = time_grid(time).time, time_grid(other).time
    S = autocovariance(modes, t[:, None] - s[None, :])
    if not modes.several_outputs:
        S = S[..., None, None]
    n_y = modes.outputs
    S = S.transpose(-3, -2).reshape(*S.shape[:-4], len(t) * n_y, len(s) * n_y)
    if initial_covariance is not None:
        extra = initial_covariance - state_covariance(modes)
        origin = torch.minimum(t[0], s[0])
        S = S + _from(modes, t, origin) @ extra @ _from(modes, s, origin).mT
    return S


def _from(modes: Modes, time: Tensor, origin: Tensor) -> Tensor:
    padded = torch.cat([origin.reshape(1), time])
    return observability(modes, padded)[..., modes.outputs :, :]


class DenseCovariance:
    """Same arguments and methods as `SemiseparableCovariance`; missing rows are cut out."""

    def __init__(
        self,
        modes: Modes,
        time: Numbers | TimeGrid,
        noise_variance: Tensor | float = 0.0,
        initial_covariance: Tensor | None = None,
    ) -> None:
        self.modes = modes
        self.grid = time_grid(time)
        self.size = len(self.grid) * modes.outputs
        v = torch.as_tensor(noise_variance, dtype=torch.float64, device=modes.poles.device)
        self.noise_variance = v.expand(self.size) if v.dim() == 0 else v
        self.initial_covariance = initial_covariance

    @cached_property
    def signal(self) -> Tensor:
        """S(T, T) (*b, N, N)."""
        t = self.grid.time
        return signal_covariance(self.modes, t, t, self.initial_covariance)

    @cached_property
    def _keep(self) -> Tensor:
        keep = ~torch.isinf(self.noise_variance)
        return keep.reshape(-1, self.size)[0]

    @cached_property
    def matrix(self) -> Tensor:
        """K without its missing rows and columns."""
        keep = self._keep
        S = self.signal[..., keep, :][..., keep]
        return S + torch.diag_embed(self.noise_variance[..., keep])

    @cached_property
    def root(self) -> Tensor:
        """Lower Cholesky factor of `matrix`."""
        return torch.linalg.cholesky(self.matrix)

    def _pad(self, X: Tensor) -> Tensor:
        full = torch.zeros(*X.shape[:-2], self.size, X.shape[-1], dtype=X.dtype, device=X.device)
        return full.index_copy(-2, self._keep.nonzero().squeeze(-1), X)

    @property
    def innovation_variance(self) -> Tensor:
        """Squared diagonal of the Cholesky factor (*b, N); infinite where missing."""
        d = self._pad(self.root.diagonal(dim1=-2, dim2=-1).square().unsqueeze(-1)).squeeze(-1)
        return torch.where(self._keep, d, torch.full_like(d, math.inf))

    def log_determinant(self) -> Tensor:
        """Log-determinant (*b,) of K without the missing rows."""
        return 2.0 * self.root.diagonal(dim1=-2, dim2=-1).log().sum(-1)

    def root_matmul(self, X: Tensor, *, transpose: bool = False) -> Tensor:
        """Cholesky factor times X, or its transpose."""
        return (self.root.mT if transpose else self.root) @ X

    def root_solve(self, Y: Tensor, *, transpose: bool = False) -> Tensor:
        """Inverse Cholesky factor times Y, or its transpose; zero in missing rows."""
        root = self.root.mT if transpose else self.root
        cut = Y[..., self._keep, :]
        return self._pad(torch.linalg.solve_triangular(root, cut, upper=transpose))

    def solve(self, Y: Tensor) -> Tensor:
        """K^{-1} Y; zero in missing rows."""
        return self._pad(torch.cholesky_solve(Y[..., self._keep, :], self.root))

    def signal_matmul(self, X: Tensor) -> Tensor:
        """S X."""
        return self.signal @ X

    def matmul(self, X: Tensor) -> Tensor:
        """K X."""
        return self.matrix @ X

    def inverse_diagonal(self) -> Tensor:
        """Diagonal of K^{-1}; zero in missing rows."""
        inverse = torch.cholesky_inverse(self.root)
        return self._pad(inverse.diagonal(dim1=-2, dim2=-1).unsqueeze(-1)).squeeze(-1)

    def signal_variance(self) -> Tensor:
        """Variance of the noise-free output at every row given all samples."""
        cross = self.signal[..., :, self._keep]
        V = torch.linalg.solve_triangular(self.root, cross.mT, upper=False)
        return self.signal.diagonal(dim1=-2, dim2=-1) - V.square().sum(-2)

    def log_prob(self, residual: Tensor) -> Tensor:
        """Log-density (*b, R) of residuals (*b, N, R) under N(0, K)."""
        z = self.root_solve(residual)
        count = int(self._keep.sum())
        return -0.5 * (
            z.square().sum(-2)
            + self.log_determinant().unsqueeze(-1)
            + count * math.log(2.0 * math.pi)
        )
