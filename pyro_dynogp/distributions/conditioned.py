"""The trajectory of a stochastic LTI system given noisy samples of it: again a distribution."""

from __future__ import annotations

from typing import Any

import torch
from pyro.distributions import constraints
from torch import Tensor
from torch.distributions import Normal

from pyro_dynogp.distributions.process import ObservedLTIProcess
from pyro_dynogp.distributions.trajectory import (
    Trajectory,
    apply,
    batch_dims,
    columns,
    split_missing,
)
from pyro_dynogp.lti.semiseparable import SemiseparableCovariance
from pyro_dynogp.lti.state import ModalState
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import as_tensor


class ConditionedLTIProcess(Trajectory):
    """Posterior of a trajectory h given y = h + e, on the time axis of the process.

    Missing samples (NaN in y) are where the process interpolates and forecasts: give it a time
    axis that goes on beyond the last sample. Mean, variance and final state are exact and O(n), and
    know no jitter; joint samples (Matheron's rule) and the joint log-density are exact and O(n)
    for the prior with the jitter of `LTIProcess`.

    Args:
        observed: the prior with its measurement noise, every noise_sd > 0.
        y: samples (*batch, *event) [output], NaN where missing.

    Attributes:
        residual: y - m (*batch, N), zero where missing.
    """

    has_innovations = False

    def __init__(
        self, observed: ObservedLTIProcess, y: Any, *, validate_args: bool | None = None
    ) -> None:
        self.modes = observed.modes
        self.prior = observed.process
        self.observed = observed
        value = as_tensor(y, device=self.modes.poles.device)
        if value.shape[value.dim() - len(observed.event_shape) :] != observed.event_shape:
            raise invalid(
                "y",
                expected=f"shape (..., {tuple(observed.event_shape)})",
                got=f"shape {tuple(value.shape)}",
            )
        if not bool((observed.noise_variance > 0).all()):
            raise invalid(
                "noise_sd",
                expected="numbers > 0",
                got="zero",
                advice="Condition with a small measurement noise instead.",
            )
        self.y = value
        residual, missing = split_missing(self.observed.rows(value - observed.mean))
        self.residual = residual
        v = observed.noise_rows
        self.noise_with_missing = v if missing is None else v.masked_fill(missing, torch.inf)
        self.K = self.prior.covariance(self.noise_with_missing)
        self._with_jitter: SemiseparableCovariance | None = None
        self._shape(residual.shape[:-1], len(self.prior.grid), validate_args)

    @property
    def support(self) -> constraints.Constraint:
        """Real trajectories."""
        return constraints.independent(constraints.real, len(self.event_shape))

    def covariance(self, noise_variance: Tensor) -> SemiseparableCovariance:
        """Prior covariance plus independent noise."""
        return self.prior.covariance(noise_variance)

    @property
    def noise_rows(self) -> Tensor:
        """Noise of the samples, infinite where missing (*b, N)."""
        return self.noise_with_missing

    @property
    def _jittered(self) -> SemiseparableCovariance:
        """Covariance of the samples under the prior with jitter, which can be drawn from."""
        if self._with_jitter is None:
            v = self.noise_with_missing + self.prior.noise_rows
            self._with_jitter = self.prior.covariance(v)
        return self._with_jitter

    @property
    def mean(self) -> Tensor:
        """Smoothed trajectory E[h | y] (*batch, *event)."""
        alpha = apply(self.K.solve, self.K, self.residual)
        update = apply(self.K.signal_matmul, self.K, alpha)
        shape = self.batch_shape + self.event_shape
        return self.prior.mean.expand(shape) + self.from_rows(update).expand(shape)

    @property
    def variance(self) -> Tensor:
        """Var[h_k | y] (*batch, *event)."""
        return self.from_rows(self.K.signal_variance()).expand(self.batch_shape + self.event_shape)

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Joint draws of the trajectory given y, by Matheron's rule."""
        shape = torch.Size(sample_shape) + self.batch_shape + self.event_shape
        noise = torch.randn(shape, dtype=torch.float64, device=self.modes.poles.device)
        h = self.prior.from_innovations(noise)
        e = torch.randn(shape, dtype=torch.float64, device=h.device)
        v = self.observed.noise_variance
        departure = self.rows(self.y - h - v.sqrt() * e)
        departure = departure.masked_fill(self.K.missing, 0.0)
        K = self._jittered
        alpha = apply(K.solve, K, departure)
        update = apply(K.signal_matmul, K, alpha) + self.prior.noise_rows * alpha
        return h + self.from_rows(update)

    def log_prob(self, value: Any) -> Tensor:
        """Joint log-density of trajectories: log p(h) + log p(y | h) - log p(y)."""
        value = as_tensor(value, device=self.modes.poles.device)
        if self._validate_args:
            self._validate_sample(value)
        sd = self.observed.noise_variance.sqrt()
        there = ~torch.isnan(self.y)
        filled = self.y.masked_fill(~there, 0.0)
        terms = Normal(value, sd).log_prob(filled) * there
        likelihood = self.rows(terms).sum(-1)
        return self.prior.log_prob(value) + likelihood - self._evidence(self._jittered)

    @property
    def log_evidence(self) -> Tensor:
        """Log p(y) (*batch), the marginal likelihood of the samples."""
        return self._evidence(self.K)

    def _evidence(self, K: SemiseparableCovariance) -> Tensor:
        batch = batch_dims(K)
        lead = self.residual.shape[: self.residual.dim() - 1 - batch]
        out = K.log_prob(columns(self.residual, batch)).movedim(-1, 0)
        return out.reshape(lead + out.shape[1:])

    @property
    def final_state(self) -> ModalState:
        """The modal state at the last time given y: what a forecast starts from."""
        carried = self.K.final_state(self.residual)
        return ModalState(self.prior.response.state + carried, self.K.final_covariance)
