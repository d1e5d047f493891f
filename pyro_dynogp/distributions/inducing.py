r"""A variational distribution over trajectories with inducing times (the paper's), joint in time.

With p = N(m, S + J) the prior with its jitter J, and R R' = (S + J)_zz its root on the inducing
times z (a subset of the samples),

    Upsilon = h_z = m_z + R e,     e ~ N(loc, scale_tril scale_tril'),     h | Upsilon ~ p,

    KL(q || p) = KL(N(loc, .) || N(0, I)),
    log q(h) = log p(h) + log q(e(h)) - log N(e(h); 0, I),

the latter two since q and p share the conditional of everything else given Upsilon, and the
Jacobian of the whitening cancels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal, register_kl

from pyro_dynogp.distributions.divergence import require_same
from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.distributions.trajectory import Trajectory, apply
from pyro_dynogp.lti.grid import TimeGrid, time_grid
from pyro_dynogp.lti.semiseparable import SemiseparableCovariance
from pyro_dynogp.lti.state import ModalState, propagate
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import as_tensor, broadcast


class InducingLTIProcess(Trajectory):
    """Trajectory h whose values at inducing times are Gaussian, the rest drawn given them.

    Samples (Matheron's rule) and log-density are exact and O(n), and so is the divergence from the
    prior, which is registered with torch. All of them, and mean and variance, are those of the
    trajectory with the jitter of `LTIProcess`.

    Args:
        prior: the process.
        index: (M,) which samples are inducing times, increasing; see `inducing_times`.
        loc: (*b, M n_y) mean of the whitened values e, the outputs of one time together.
        scale_tril: (*b, M n_y, M n_y) lower Cholesky factor of their covariance.

    Raises:
        ValueError: where index does not increase or reaches beyond the samples, or shapes disagree.
    """

    has_innovations = False

    def __init__(
        self,
        prior: LTIProcess,
        index: Any,
        loc: Any,
        scale_tril: Any,
        *,
        validate_args: bool | None = None,
    ) -> None:
        self.modes, self.prior = prior.modes, prior
        device = prior.modes.poles.device
        self.index = check_index(index, len(prior.grid)).to(device)
        size = self.index.shape[0] * prior.modes.outputs
        self.loc = as_tensor(loc, device=device)
        self.scale_tril = as_tensor(scale_tril, device=device)
        if self.loc.shape[-1:] != (size,):
            raise invalid("loc", expected=f"shape (..., {size})", got=f"{tuple(self.loc.shape)}")
        if self.scale_tril.shape[-2:] != (size, size):
            raise invalid(
                "scale_tril",
                expected=f"shape (..., {size}, {size})",
                got=f"{tuple(self.scale_tril.shape)}",
            )
        n_y = prior.modes.outputs
        self._rows = (self.index.unsqueeze(-1) * n_y + torch.arange(n_y, device=device)).flatten()
        self._inner: SemiseparableCovariance | None = None
        batch = broadcast(prior.batch_shape, self.loc.shape[:-1], self.scale_tril.shape[:-2])
        self._shape(batch, len(prior.grid), validate_args)

    @property
    def K_zz(self) -> SemiseparableCovariance:
        """Covariance of the trajectory, jitter included, at the inducing times."""
        if self._inner is None:
            prior, grid = self.prior, self.prior.grid
            P0 = prior.initial_covariance
            if P0 is not None and int(self.index[0]) > 0:
                # The state is given at the first sample: carry it to the first inducing time.
                zero = torch.zeros_like(prior.modes.poles)
                gap = float(grid.time[self.index[0]] - grid.time[0])
                P0 = propagate(prior.modes, ModalState(zero, P0), gap).covariance
            self._inner = SemiseparableCovariance(
                prior.modes, grid.time[self.index], self._inducing(prior.noise_rows), P0
            )
        return self._inner

    def _inducing(self, x: Tensor) -> Tensor:
        """Rows (..., N) at the inducing times (..., M n_y)."""
        return x[..., self._rows]

    def _spread(self, alpha: Tensor) -> Tensor:
        """(S + J)_{.z} alpha (..., N) of alpha (..., M n_y)."""
        prior = self.prior
        shape = (*alpha.shape[:-1], self._size)
        padded = alpha.new_zeros(shape).index_copy(-1, self._rows, alpha)
        K = prior.root
        return apply(K.signal_matmul, K, padded) + prior.noise_rows * padded

    def whiten(self, value: Tensor) -> Tensor:
        """Whitened values e (..., M n_y) at the inducing times of trajectories (..., *event)."""
        residual = self._inducing(self.rows(value - self.prior.mean))
        return apply(self.K_zz.root_solve, self.K_zz, residual)

    @property
    def mean(self) -> Tensor:
        """(*batch, *event)."""
        shape = self.batch_shape + self.event_shape
        e = self.loc.expand(self.batch_shape + self.loc.shape[-1:])
        return self.prior.mean.expand(shape) + self.from_rows(self._spread(self._unwhiten(e)))

    def _unwhiten(self, e: Tensor) -> Tensor:
        """R^{-T} e."""
        K = self.K_zz
        return apply(lambda x: K.root_solve(x, transpose=True), K, e)

    @property
    def variance(self) -> Tensor:
        """Var[h_k] (*batch, *event); O(n M^2) time and O(n M) memory."""
        size = self.loc.shape[-1]
        batch = self.batch_shape
        one = torch.eye(size, dtype=torch.float64, device=self.loc.device)
        # Row j holds the column j of W = (S + J)_{.z} R^{-T}.
        W = self._spread(
            self._unwhiten(
                one.reshape((size, *[1] * len(batch), size)).expand((size, *batch, size))
            )
        )
        W = W.movedim(0, -1)  # *batch, N, M n_y
        shape = batch + self.event_shape
        prior = self.rows(self.prior.variance.expand(shape)) + self.prior.noise_rows
        change = (W @ self.scale_tril).square().sum(-1) - W.square().sum(-1)
        return self.from_rows(prior + change).expand(shape)

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Joint draws: a draw of the prior, moved to the drawn values at the inducing times."""
        lead = torch.Size(sample_shape) + self.batch_shape
        shape = lead + self.event_shape
        noise = torch.randn(shape, dtype=torch.float64, device=self.loc.device)
        h = self.prior.from_innovations(noise)
        unit = torch.randn(lead + self.loc.shape[-1:], dtype=torch.float64, device=self.loc.device)
        e = self.loc + (self.scale_tril @ unit.unsqueeze(-1)).squeeze(-1)
        move = self._spread(self._unwhiten(e - self.whiten(h)))
        return h + self.from_rows(move)

    def log_prob(self, value: Any) -> Tensor:
        """Joint log-density (*s, *batch) of trajectories (*s, *batch, *event)."""
        value = as_tensor(value, device=self.loc.device)
        if self._validate_args:
            self._validate_sample(value)
        value = value.expand(broadcast(value.shape, self.batch_shape + self.event_shape))
        e = self.whiten(value)
        q = MultivariateNormal(self.loc, scale_tril=self.scale_tril, validate_args=False)
        constant = 0.5 * e.shape[-1] * np.log(2.0 * np.pi)
        standard = -0.5 * e.square().sum(-1) - constant
        return self.prior.log_prob(value) + q.log_prob(e) - standard


@register_kl(InducingLTIProcess, LTIProcess)
def inducing_divergence(q: InducingLTIProcess, p: LTIProcess) -> Tensor:
    """KL(q || p) [nats], of the batch shape of q: that of the whitened values from N(0, I).

    Raises:
        NotImplementedError: where the prior of q is not p, so that Pyro takes a Monte Carlo
            estimate instead.
    """
    require_same(q.prior, p)
    trace = q.loc.square().sum(-1) + q.scale_tril.square().sum((-2, -1)) - q.loc.shape[-1]
    log_det = q.scale_tril.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return (0.5 * trace - log_det).expand(broadcast(q.batch_shape, p.batch_shape))


def inducing_times(time: Any, count: int, seed: int = 0) -> Tensor:
    """Draw inducing times from the samples, without replacement.

    The probability of sample i is proportional to log(1 + t_i / t_n), as in the paper (appendix
    "Implementation"). Time t counts from one mean step before the first sample, so that no sample
    has probability zero.

    Args:
        time: (n,) times [s], or a `TimeGrid`.
        count: M, from 1 to n.
        seed: of the draw.

    Returns:
        Indices (M,) of the samples, increasing.

    Raises:
        ValueError: where count is not a whole number from 1 to n.
    """
    grid: TimeGrid = time_grid(time)
    n = len(grid)
    if not isinstance(count, int) or not 1 <= count <= n:
        raise invalid(
            "count", expected=f"a whole number from 1 to {n}, that of samples", got=repr(count)
        )
    t = grid.time.detach().cpu().numpy()
    duration = t[-1] - t[0]
    step = duration / (n - 1) if duration > 0 else 1.0
    weight = np.log1p((t - t[0] + step) / (duration + step))
    rng = np.random.default_rng(seed)
    drawn = rng.choice(n, size=count, replace=False, p=weight / weight.sum())
    return torch.as_tensor(np.sort(drawn))


def check_index(index: Any, n: int) -> Tensor:
    """Indices (M,) of samples as a tensor.

    Raises:
        ValueError: where they do not increase or reach beyond the n samples.
    """
    i = torch.as_tensor(index)
    whole = not (i.is_floating_point() or i.is_complex() or i.dtype == torch.bool)
    if i.dim() != 1 or i.shape[0] == 0 or not whole:
        raise invalid(
            "index",
            expected="a vector (M,) of whole numbers with M >= 1",
            got=f"shape {tuple(i.shape)}, {i.dtype}",
        )
    if int(i[0]) < 0 or int(i[-1]) >= n or not bool((i.diff() > 0).all()):
        raise invalid(
            "index", expected=f"numbers from 0 to {n - 1} that increase", got=str(i.tolist())
        )
    return i.to(torch.int64)
