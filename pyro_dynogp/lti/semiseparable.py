r"""O(n) algebra with the covariance of a stochastic LTI system and white measurement noise.

    K = S(T, T) + diag(v),        K = L D L',  L unit lower triangular, D diagonal.

S is semiseparable of rank 2P, so that the factorisation costs O(n P^2) and everything after it
O(n P). Rows are ordered by time, the outputs of one time together: row k n_y + a is output a at
time k. An infinite entry of v marks a missing sample, which is left out exactly.
"""

from __future__ import annotations

import math
from functools import cached_property

import torch
from torch import Tensor

from pyro_dynogp.lti import primitives
from pyro_dynogp.lti.covariance import (
    observability,
    state_covariance,
    state_output_covariance,
)
from pyro_dynogp.lti.fused import output_covariance, output_rows, propagators
from pyro_dynogp.lti.grid import TimeGrid, time_grid
from pyro_dynogp.lti.innovations import innovations
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import Numbers, as_tensor, broadcast


class NotPositiveDefiniteError(ValueError):
    """A covariance that has to be inverted is singular in floating-point arithmetic."""


class SemiseparableCovariance:
    """The covariance of observed outputs, factored in O(n P^2).

    Args:
        modes: the system, batch shape *b.
        time: (n,) times [s] or a `TimeGrid`.
        noise_variance: v [output^2], scalar, (*b, n_y) where it is the same at all times, or
            (*b, N) with N = n n_y; infinite where missing.
        initial_covariance: (*b, 2P, 2P) covariance of [Re x; Im x] at time[0]; None for the
            stationary one.
        missing: (*b, N), True where there is no sample; None for nowhere but where v is infinite.

    Right-hand sides are (*b, N, R). Every result is differentiable with respect to poles, gains,
    noise variance, initial covariance and right-hand sides.
    """

    def __init__(
        self,
        modes: Modes,
        time: Numbers | TimeGrid,
        noise_variance: Tensor | float = 0.0,
        initial_covariance: Tensor | None = None,
        missing: Tensor | None = None,
    ) -> None:
        self.modes = modes
        self.grid = time_grid(time).to(modes.poles.device)
        n, n_y = len(self.grid), modes.outputs
        self.size = n * n_y
        v = as_tensor(noise_variance, device=modes.poles.device)
        if v.dim() == 0:
            v = v.expand(n_y)
        if v.shape[-1] not in (self.size, n_y):
            raise invalid(
                "noise_variance",
                expected=f"a scalar or shape (..., {n_y}) or (..., {self.size})",
                got=f"shape {tuple(v.shape)}",
            )
        if not bool((v >= 0).all()):
            raise invalid("noise_variance", expected="numbers >= 0", got=f"{float(v.min())}")
        J = 2 * modes.pairs
        if initial_covariance is not None and initial_covariance.shape[-2:] != (J, J):
            raise invalid(
                "initial_covariance",
                expected=f"shape (..., {J}, {J}), of [Re x; Im x]",
                got=f"shape {tuple(initial_covariance.shape)}",
            )
        self._noise = v.unflatten(-1, (-1, n_y))  # *b, 1 or n, n_y
        self._absent = missing
        self.initial_covariance = initial_covariance
        self._variances: Tensor | None = None

    @property
    def batch_shape(self) -> torch.Size:
        """Shape b of the batch: of modes, noise, what is missing, and initial covariance."""
        shapes = [self.modes.batch_shape, self._noise.shape[:-2]]
        if self._absent is not None:
            shapes.append(self._absent.shape[:-1])
        if self.initial_covariance is not None:
            shapes.append(self.initial_covariance.shape[:-2])
        return broadcast(*shapes)

    @property
    def noise_variance(self) -> Tensor:
        """Noise variance of each row (*b, N), infinite where missing."""
        n, n_y = len(self.grid), self.modes.outputs
        v = self._noise.expand(*self._noise.shape[:-2], n, n_y).flatten(-2)
        return v if self._absent is None else v.masked_fill(self._absent, math.inf)

    @cached_property
    def _explained(self) -> Tensor | None:
        """Stationary less initial covariance of the state."""
        if self.initial_covariance is None:
            return None
        return state_covariance(self.modes) - self.initial_covariance

    @cached_property
    def _rows(self) -> primitives.Generators:
        modes, grid = self.modes, self.grid
        phi, _ = propagators(modes, grid.steps)
        h, g, k0 = output_rows(modes)
        step, out = grid.rows(modes.outputs)
        S0 = self._explained
        if S0 is None:
            S0 = torch.zeros((2 * modes.pairs,) * 2, dtype=torch.float64, device=phi.device)
        return primitives.Generators(
            re=phi.real,
            im=phi.imag,
            h=h,
            g=g,
            k0=k0,
            S0=S0,
            step=step,
            out=out,
        )

    @cached_property
    def _factor(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        e, p, S_end = primitives.factor(self._rows, self.noise_variance)
        d = self._checked(p + self.noise_variance)
        return e, p, d, e / d.unsqueeze(-1), S_end

    @cached_property
    def _output_covariances(self) -> Tensor:
        return output_covariance(self.modes)

    @cached_property
    def _rounding(self) -> Tensor:
        """What innovation variances (*b, 1, n_y) cannot be told from zero: 4 units of rounding."""
        k0 = 2.0 * (self.modes.C.detach() * self._output_covariances.detach()).sum(-1).real
        return 4.0 * torch.finfo(torch.float64).eps * k0.abs().unsqueeze(-2)

    def _checked(self, d: Tensor) -> Tensor:
        above = (d.unflatten(-1, (-1, self.modes.outputs)) > self._rounding).flatten(-2)
        if not bool(above.all()):
            bad = int((~above).nonzero()[0][-1])
            raise NotPositiveDefiniteError(
                f"The covariance of the outputs is not positive definite at row {bad} "
                f"(innovation variance {float(d.detach().reshape(-1, self.size)[0, bad])}). "
                "Add measurement noise or jitter, or remove repeated times."
            )
        return d

    def _run(self, residual: Tensor) -> tuple[Tensor, Tensor]:
        """Innovations and variances of residuals (..., N), of the batch of both."""
        z, d = innovations(
            self.modes, self.grid, self._noise, residual, missing=self._absent,
            explained=self._explained, output_covariances=self._output_covariances,
        )  # fmt: skip
        if d.shape[:-1] == self.batch_shape:
            self._variances = d
        return z, self._checked(d)

    @property
    def missing(self) -> Tensor:
        """Whether a row is missing (*b, N)."""
        return torch.isinf(self.noise_variance)

    @property
    def innovation_variance(self) -> Tensor:
        """D: variance of each sample given all before it (*b, N); infinite where missing."""
        if "_factor" in self.__dict__:
            return self._factor[2]
        if self._variances is None:
            self._run(torch.zeros(self.size, dtype=torch.float64, device=self._noise.device))
        assert self._variances is not None
        return self._checked(self._variances)

    @property
    def signal_variance_given_past(self) -> Tensor:
        """Variance of the noise-free output given the samples before (*b, N)."""
        return self._factor[1]

    @property
    def final_covariance(self) -> Tensor:
        """Covariance (*b, 2P, 2P) of the state at the last time, given all samples."""
        return state_covariance(self.modes) - self._factor[4]

    def log_determinant(self) -> Tensor:
        """Log-determinant (*b,) of K without the missing rows."""
        d = self.innovation_variance
        return torch.where(torch.isinf(d), torch.ones_like(d), d).log().sum(-1)

    def innovations(self, Y: Tensor) -> Tensor:
        """L^{-1} Y (*b, N, R): each sample less its prediction from the samples before."""
        if Y.shape[-1] == 1:
            return self._run(Y.squeeze(-1))[0].unsqueeze(-1)
        return primitives.triangular(self._rows, self._factor[3], Y, solve=True)

    def root_matmul(self, X: Tensor, *, transpose: bool = False) -> Tensor:
        """L D^{1/2} X, or its transpose (*b, N, R). No row may be missing."""
        self._refuse_missing("root_matmul")
        root = self.innovation_variance.sqrt().unsqueeze(-1)
        w = self._factor[3]
        if transpose:
            return root * (X + primitives.triangular(self._rows, w, X, transpose=True))
        X = root * X
        return X + primitives.triangular(self._rows, w, X)

    def root_solve(self, Y: Tensor, *, transpose: bool = False) -> Tensor:
        """D^{-1/2} L^{-1} Y, or its transpose (*b, N, R)."""
        root = self.innovation_variance.rsqrt().unsqueeze(-1)
        w = self._factor[3]
        if transpose:
            return primitives.triangular(self._rows, w, root * Y, solve=True, transpose=True)
        return root * primitives.triangular(self._rows, w, Y, solve=True)

    def solve(self, Y: Tensor) -> Tensor:
        """K^{-1} Y (*b, N, R); zero in missing rows, whose entries of Y are not used."""
        w = self._factor[3]
        z = primitives.triangular(self._rows, w, Y, solve=True)
        z = z / self.innovation_variance.unsqueeze(-1)
        return primitives.triangular(self._rows, w, z, solve=True, transpose=True)

    def signal_matmul(self, X: Tensor) -> Tensor:
        """S X (*b, N, R), the covariance without measurement noise."""
        rows = self._rows
        g = rows.g[..., torch.as_tensor(rows.out, device=rows.g.device), :]
        k0 = rows.k0[..., torch.as_tensor(rows.out, device=rows.g.device)]
        Z = (
            primitives.triangular(rows, g, X)
            + primitives.triangular(rows, g, X, transpose=True)
            + k0.unsqueeze(-1) * X
        )
        if self.initial_covariance is not None:
            # What an initial covariance adds is of rank 2P: O (P0 - P_stationary) O'.
            O = observability(self.modes, self.grid.time)
            Z = Z - O @ (rows.S0 @ (O.mT @ X))
        return Z

    def matmul(self, X: Tensor) -> Tensor:
        """K X (*b, N, R). No row may be missing."""
        self._refuse_missing("matmul")
        return self.signal_matmul(X) + self.noise_variance.unsqueeze(-1) * X

    def inverse_diagonal(self) -> Tensor:
        """Diagonal of K^{-1} (*b, N); zero in missing rows."""
        e, _, d, _, _ = self._factor
        kappa = primitives.later_information(self._rows, e, d)
        missing = torch.isinf(d)
        # One in place of infinity: what is not used must not be 0/0 in the gradient either.
        finite = torch.where(missing, torch.ones_like(d), d)
        return torch.where(missing, torch.zeros_like(d), 1.0 / finite + kappa / finite.square())

    def signal_variance(self) -> Tensor:
        """Variance of the noise-free output at every row, missing ones too, given all (*b, N)."""
        e, p, d, _, _ = self._factor
        kappa = primitives.later_information(self._rows, e, d)
        missing = torch.isinf(d)
        one = torch.ones_like(d)
        v = torch.where(missing, one, self.noise_variance)
        share = v / torch.where(missing, one, d)
        return (share * p - share.square() * kappa).clamp_min(0.0)

    def log_prob(self, residual: Tensor) -> Tensor:
        """Log-density (*b, R) of residuals (*b, N, R) under N(0, K), missing rows left out."""
        if residual.shape[-1] == 1:
            z, d = (x.unsqueeze(-1) for x in self._run(residual.squeeze(-1)))
        else:
            z, d = self.innovations(residual), self.innovation_variance.unsqueeze(-1)
        missing = torch.isinf(d)
        terms = z.square() / d + torch.where(missing, 1.0, 2.0 * math.pi * d).log()
        return -0.5 * terms.sum(-2)

    def final_state(self, residual: Tensor) -> Tensor:
        """Mean (*b, P), complex, of the state at the last time given residuals (*b, N).

        This is the departure from the mean response; add `mean_response(...).state`.
        """
        alpha = self.solve(residual.unsqueeze(-1)).squeeze(-1)
        modes = self.modes
        since = self.grid.time[-1] - self.grid.time  # age of each sample
        decay = torch.exp(modes.poles.unsqueeze(-2) * since.unsqueeze(-1))  # *b, n, P
        q = state_output_covariance(modes)
        weights = alpha.reshape((*alpha.shape[:-1], len(self.grid), modes.outputs))
        state = (decay * (weights.to(q.dtype) @ q)).sum(-2)
        if self.initial_covariance is not None:
            O = observability(modes, self.grid.time)
            extra = -(self._rows.S0 @ (O.mT @ alpha.unsqueeze(-1))).squeeze(-1)
            P = modes.pairs
            carried = torch.complex(extra[..., :P], extra[..., P:])
            age = self.grid.time[-1] - self.grid.time[0]
            state = state + torch.exp(modes.poles * age) * carried
        return state

    def _refuse_missing(self, method: str) -> None:
        if bool(self.missing.any()):
            raise invalid(
                "noise_variance",
                expected=f"finite numbers for {method}",
                got="infinite ones (missing samples)",
                advice="Leave the missing times out of the time axis.",
            )
