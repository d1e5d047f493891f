r"""Trajectories of stochastic LTI systems as Pyro distributions.

`LTIProcess` is the noise-free trajectory, a Gaussian process over time. `ObservedLTIProcess` adds
white measurement noise and integrates it out; `ConditionedLTIProcess` is it given noisy samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from pyro.distributions import constraints
from torch import Tensor
from torch.distributions import Normal

from pyro_dynogp.distributions.trajectory import (
    Trajectory,
    apply,
    batch_dims,
    columns,
    noise_of_samples,
    real_or_missing,
    split_missing,
)
from pyro_dynogp.lti.covariance import jitter_variance
from pyro_dynogp.lti.grid import TimeGrid, time_grid
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.response import Response, as_inputs, mean_response
from pyro_dynogp.lti.semiseparable import SemiseparableCovariance
from pyro_dynogp.lti.state import ModalState
from pyro_dynogp.support.errors import POSITIVE_OR_ZERO, instance, invalid
from pyro_dynogp.support.tensors import Numbers, as_tensor, broadcast


class LTIProcess(Trajectory):
    """Trajectory of a stochastic LTI system: a sample site of Pyro, joint in time.

    Args:
        modes: the system; batch dimensions of the modes are batch dimensions of the distribution.
        time: t (n,) [s], increasing, or a `TimeGrid`.
        inputs: u (*b, n, n_u) [input], held constant between samples; None for no input.
        initial_state: at t[0]; a complex tensor x (*b, P) is its mean (None: zero), with the
            stationary covariance; a `ModalState` is a Gaussian, integrated out exactly.
        jitter: variance added to each sample, as a share of the stationary variance, but not in
            `observed`: finely sampled smooth trajectories are singular in float64 without it.
        offset: constant added to the mean [output], of batch shape (*b), or (*b, n_y).

    Batch shape: that of modes, inputs, initial state and offset, broadcast. Event shape: (n,) for
    one output, (n, n_y) for modes with an output dimension. dtype float64.

    Raises:
        ValueError: on shapes that do not fit, times that decrease, NaN in the inputs.

    Examples:
        >>> modes = dgp.Modes([-1.0 + 2.0j], [[1.0 + 0.0j]], [0.5 + 0.0j], [[0.3 + 0.0j]])
        >>> dgp.LTIProcess(modes, [0.0, 0.1, 0.4], [[1.0], [0.0], [0.0]]).mean.shape
        torch.Size([3])
    """

    def __init__(
        self,
        modes: Modes,
        time: Numbers | TimeGrid,
        inputs: Numbers | None = None,
        initial_state: Numbers | ModalState | None = None,
        *,
        jitter: float = 1e-9,
        offset: Numbers | None = None,
        validate_args: bool | None = None,
    ) -> None:
        instance("modes", modes, Modes)
        self.modes = modes
        time = time if isinstance(time, TimeGrid) else as_tensor(time, argument="time")
        inputs = None if inputs is None else as_tensor(inputs, argument="inputs")
        self.grid = time_grid(time).to(modes.poles.device)
        self.inputs = as_inputs(modes, self.grid, inputs)
        if initial_state is not None and not isinstance(initial_state, ModalState):
            x0 = as_tensor(initial_state, torch.complex128, modes.poles.device)
            initial_state = ModalState(x0)
        self.initial_state: ModalState | None = initial_state
        if initial_state is not None:
            initial_state.check(modes.pairs)
        self.jitter: float = POSITIVE_OR_ZERO.check("jitter", jitter)
        shapes = [modes.batch_shape, self.inputs.shape[:-2]]
        if initial_state is not None:
            shapes.append(initial_state.mean.shape[:-1])
            if initial_state.covariance is not None:
                shapes.append(initial_state.covariance.shape[:-2])
        self.offset: Tensor | None = None
        if offset is not None:
            b = as_tensor(offset, device=modes.poles.device)
            if modes.several_outputs and b.shape[-1:] != (modes.outputs,):
                raise invalid(
                    "offset", expected=f"shape (..., {modes.outputs})", got=f"{tuple(b.shape)}"
                )
            self.offset = b.unsqueeze(-2) if modes.several_outputs else b.unsqueeze(-1)
            shapes.append(b.shape[: b.dim() - modes.several_outputs])
        self._response: Response | None = None
        self._shape(broadcast(*shapes), len(self.grid), validate_args)

    @property
    def initial_covariance(self) -> Tensor | None:
        """Covariance of the state at the first time, None for the stationary one."""
        return None if self.initial_state is None else self.initial_state.covariance

    @property
    def response(self) -> Response:
        """Mean response to the inputs, without offset, and the state it ends in."""
        if self._response is None:
            x0 = None if self.initial_state is None else self.initial_state.mean
            self._response = mean_response(self.modes, self.grid, self.inputs, x0)
        return self._response

    @property
    def mean(self) -> Tensor:
        """(*batch, *event)."""
        m = self.response.output
        if self.offset is not None:
            m = m + self.offset
        return m.expand(self.batch_shape + self.event_shape)

    @property
    def variance(self) -> Tensor:
        """(*batch, *event): of each sample by itself, without jitter."""
        unseen = torch.full((self._size,), math.inf, dtype=torch.float64)
        p = self.covariance(unseen.to(self.modes.poles.device)).signal_variance_given_past
        return self.from_rows(p).expand(self.batch_shape + self.event_shape)

    def covariance(
        self, noise_variance: Tensor, missing: Tensor | None = None
    ) -> SemiseparableCovariance:
        """Covariance of the trajectory plus independent noise; see `Trajectory`."""
        P0 = self.initial_covariance
        return SemiseparableCovariance(self.modes, self.grid, noise_variance, P0, missing)

    @property
    def noise(self) -> Tensor:  # type: ignore[override]  # others set it, here it follows from modes
        """The jitter, as a variance (*b, n_y) [output^2]."""
        v = jitter_variance(self.modes, self.initial_covariance, self.jitter)
        return v.expand((*v.shape[:-1], self.modes.outputs))

    def observed(self, noise_sd: Numbers, *, varying: bool = False) -> ObservedLTIProcess:
        """Trajectory plus white measurement noise, the trajectory integrated out.

        Args:
            noise_sd: standard deviation [output] of batch shape (*b), or (*b, n_y) for several
                outputs; with `varying`, of the shape of a whole trajectory (*b, *event).
            varying: whether noise_sd changes from sample to sample.
        """
        return ObservedLTIProcess(self, noise_sd, varying=varying)

    def condition(
        self, y: Numbers, noise_sd: Numbers, *, varying: bool = False
    ) -> ConditionedLTIProcess:
        """Trajectory given noisy samples y (..., *event); NaN where there is none.

        See `ConditionedLTIProcess`; noise_sd and varying as in `observed`.
        """
        return ConditionedLTIProcess(self.observed(noise_sd, varying=varying), y)


class ObservedLTIProcess(Trajectory):
    """Noisy samples y = h + e of a trajectory h, with h integrated out.

    NaN in a value marks a missing sample and integrates out. Log-density, gradient and samples
    are exact and O(n). Make it by `LTIProcess.observed`.

    Raises:
        ValueError: where noise_sd is negative, not finite or of a wrong shape, or zero although
            two samples share a time.
    """

    def __init__(
        self,
        process: LTIProcess,
        noise_sd: Numbers,
        *,
        varying: bool = False,
        validate_args: bool | None = None,
    ) -> None:
        self.modes = process.modes
        self.process = process
        sd = as_tensor(noise_sd, device=self.modes.poles.device)
        if not bool((sd >= 0).all() and torch.isfinite(sd).all()):
            raise invalid("noise_sd", expected="finite numbers >= 0", got=f"{sd.detach().min()}")
        repeated = bool((process.grid.step_index[1:] == -1).any())
        if repeated and bool((sd == 0).any()):
            raise invalid(
                "noise_sd", expected="numbers > 0, since two samples share a time", got="zero",
                advice="Without measurement noise two samples of one time cannot differ: "
                "give noise_sd > 0 or drop the repeated time.",
            )  # fmt: skip
        self.noise, batch = noise_of_samples(sd, process.event_shape, varying)
        self._shape(broadcast(process.batch_shape, batch), len(process.grid), validate_args)

    @property
    def support(self) -> constraints.Constraint:
        """Real trajectories in which NaN marks a missing sample."""
        return constraints.independent(real_or_missing, len(self.event_shape))

    @property
    def mean(self) -> Tensor:
        """(*batch, *event)."""
        return self.process.mean.expand(self.batch_shape + self.event_shape)

    @property
    def variance(self) -> Tensor:
        """(*batch, *event)."""
        signal = self.process.variance.expand(self.batch_shape + self.event_shape)
        return signal + self.noise_variance

    def covariance(
        self, noise_variance: Tensor, missing: Tensor | None = None
    ) -> SemiseparableCovariance:
        """Covariance of the trajectory plus independent noise; see `Trajectory`."""
        return self.process.covariance(noise_variance, missing)

    @property
    def noise_variance(self) -> Tensor:
        """Measurement-noise variance of each sample (*b, *event) [output^2]."""
        return self.from_rows(self.noise_rows)


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
        self, observed: ObservedLTIProcess, y: Numbers, *, validate_args: bool | None = None
    ) -> None:
        self.modes = observed.modes
        self.prior = observed.process
        self.observed = observed
        value = as_tensor(y, device=self.modes.poles.device)
        if value.shape[value.dim() - len(observed.event_shape) :] != observed.event_shape:
            shape = f"shape (..., {tuple(observed.event_shape)})"
            raise invalid("y", expected=shape, got=f"shape {tuple(value.shape)}")
        if not bool((observed.noise_variance > 0).all()):
            raise invalid(
                "noise_sd", expected="numbers > 0", got="zero",
                advice="Condition with a small measurement noise instead.",
            )  # fmt: skip
        self.y = value
        self.residual, missing = split_missing(self.observed.rows(value - observed.mean))
        v = observed.noise_rows
        self.noise = v if missing is None else v.masked_fill(missing, torch.inf)
        self.K = self.prior.covariance(observed.noise, missing)
        self._with_jitter: SemiseparableCovariance | None = None
        self._shape(self.residual.shape[:-1], len(self.prior.grid), validate_args)

    def covariance(
        self, noise_variance: Tensor, missing: Tensor | None = None
    ) -> SemiseparableCovariance:
        """Prior covariance plus independent noise."""
        return self.prior.covariance(noise_variance, missing)

    @property
    def _jittered(self) -> SemiseparableCovariance:
        """Covariance of the samples under the prior with jitter, which can be drawn from."""
        if self._with_jitter is None:
            self._with_jitter = self.prior.covariance(self.noise_rows + self.prior.noise_rows)
        return self._with_jitter

    @property
    def mean(self) -> Tensor:
        """Smoothed trajectory E[h | y] (*batch, *event)."""
        update = apply(self.K.signal_matmul, self.K, apply(self.K.solve, self.K, self.residual))
        shape = self.batch_shape + self.event_shape
        return self.prior.mean.expand(shape) + self.from_rows(update).expand(shape)

    @property
    def variance(self) -> Tensor:
        """Var[h_k | y] (*batch, *event)."""
        return self.from_rows(self.K.signal_variance()).expand(self.batch_shape + self.event_shape)

    def rsample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Joint draws of the trajectory given y, by Matheron's rule."""
        shape = torch.Size(sample_shape) + self.batch_shape + self.event_shape
        noise = torch.randn(shape, dtype=torch.float64, device=self.modes.poles.device)
        h = self.prior.from_innovations(noise)
        e = torch.randn(shape, dtype=torch.float64, device=h.device)
        v = self.observed.noise_variance
        departure = self.rows(self.y - h - v.sqrt() * e).masked_fill(self.K.missing, 0.0)
        K = self._jittered
        alpha = apply(K.solve, K, departure)
        update = apply(K.signal_matmul, K, alpha) + self.prior.noise_rows * alpha
        return h + self.from_rows(update)

    def log_prob(self, value: Numbers) -> Tensor:
        """Joint log-density of trajectories: log p(h) + log p(y | h) - log p(y)."""
        value = as_tensor(value, device=self.modes.poles.device)
        if self._validate_args:
            self._validate_sample(value)
        sd = self.observed.noise_variance.sqrt()
        missing = torch.isnan(self.y)
        terms = Normal(value, sd).log_prob(self.y.masked_fill(missing, 0.0)) * ~missing
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
