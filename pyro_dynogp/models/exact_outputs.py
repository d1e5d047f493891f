"""Exact engine: outputs of a model in which only the last layer's trajectory is unknown.

Where dynamic layers have no process noise and a known first state, the recorded inputs determine
their trajectories. What remains is white noise around a known signal, or one linear stochastic
system with known inputs, whose densities and predictions are exact and O(n). One layer of linear
dynamics is the case without known layers.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.distributions.pointwise import (
    Moments,
    ahead,
    innovations,
    left_out,
    one_step,
    prediction_errors,
)
from pyro_dynogp.distributions.process import ConditionedLTIProcess, LTIProcess, ObservedLTIProcess
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.state import ModalState, propagate
from pyro_dynogp.models.draws import JointState
from pyro_dynogp.models.output_process import Components, LayerMoments, OutputProcess
from pyro_dynogp.models.system import DynamicSystem, StaticSystem, System, see
from pyro_dynogp.models.wiring import INPUTS
from pyro_dynogp.support.parallel import seeded
from pyro_dynogp.support.tensors import as_tensor, broadcast


def has_exact_density(system: System) -> bool:
    """Whether noise is Gaussian and no dynamic layer's trajectory is unknown but the last layer's.

    The last layer may have process noise and an unknown first state where it is dynamic.
    """
    if system.has_feedback:
        return False
    lower = [layer for layer in system.layers[:-1] if isinstance(layer, DynamicSystem)]
    return all(layer.is_known for layer in lower) and system.noise.likelihood.gaussian


class ExactOutputs(OutputProcess):
    """Measured outputs where `has_exact_density` holds; see `OutputProcess`.

    One layer of linear dynamics under noise of constant size is computed in the units of the
    record, other systems in scaled units.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        # Made at once, so that gradients of several records add up in the order of the records.
        if self._physical:
            _ = self.process

    @property
    def has_rsample(self) -> bool:  # type: ignore[override]
        """Whether draws have gradients: those of one linear layer."""
        return self.system.is_linear

    @cached_property
    def _physical(self) -> bool:
        return self.system.is_linear and self.system.noise.constant_sd is not None

    @cached_property
    def _signals(self) -> dict[str, Tensor]:
        """Signals (*b, n, w) of all layers that known inputs determine, scaled."""
        signals = {INPUTS: self.system.driving(self.scaled_inputs)}
        for wire, layer in zip(self.system.wires, self.system.layers, strict=True):
            unknown = isinstance(layer, DynamicSystem) and not self._is_known(layer)
            if not (wire.last and unknown):
                signals[wire.name] = layer.mean(see(signals, wire), self.grid)
        return signals

    def _is_known(self, layer: DynamicSystem) -> bool:
        return layer.is_known and self.start is None

    @cached_property
    def process(self) -> ObservedLTIProcess | None:
        """The last layer with noise, in the units that `_to_process` gives; None if it is known."""
        wire, layer = self.system.wires[-1], self.system.layers[-1]
        if not isinstance(layer, DynamicSystem) or self._is_known(layer):
            return None
        start = None if self.start is None else self.start.modal()
        if self._physical:
            physical = self.system.physical(self.scaling)
            assert physical.noise_sd is not None
            driving = None
            if physical.modes.inputs:
                driving = self.inputs - as_tensor(self.scaling.input_offset)
            # A first state that is known leaves the stationary covariance of process noise.
            state: ModalState | Tensor | None = start or layer.first_state
            if state is None:
                state = replace(layer, modes=physical.modes, past=layer.past_inputs).prior_state()
            process = LTIProcess(physical.modes, self.grid, driving, state, offset=physical.offset)
            return process.observed(physical.noise_sd)
        seen = see(self._signals, wire) if layer.modes.inputs else None
        process = LTIProcess(layer.modes, self.grid, seen, start or layer.prior_state())
        sd = self.noise_sd if layer.modes.several_outputs else self.noise_sd.squeeze(-1)
        return process.observed(sd, varying=True)

    def _to_process(self, y: Tensor) -> Tensor:
        """Outputs (..., *event) in the units and with the level of the process, its event shape."""
        if self._physical:
            return y
        level = self.system.level(self.scaled_inputs)
        z = self.scaled(y)
        z = z if level is None else z - level
        return z if self.several else z.squeeze(-1)

    def _from_process(self, found: Moments) -> Moments:
        """Moments (*b, n, n_y) in the units of the record."""
        mean, variance, density = (
            self.columns(x) for x in (found.mean, found.variance, found.log_density)
        )
        if self._physical:
            return Moments(mean, variance, density)
        level = self.system.level(self.scaled_inputs)
        mean = self.shift + self.scale * (mean if level is None else mean + level)
        return Moments(mean, variance * self.scale.square(), density - self.scale.log())

    @cached_property
    def _white(self) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, variance and noise variance (*b, n, n_y) of scaled outputs, all layers known."""
        wire, layer = self.system.wires[-1], self.system.layers[-1]
        mean = self._signals[wire.name]
        variance = torch.zeros_like(mean)
        if isinstance(layer, StaticSystem) and not wire.pathwise:
            mean, variance = layer.function.moments(see(self._signals, wire))
        level = self.system.level(self.scaled_inputs)
        return mean if level is None else mean + level, variance, self.noise_sd.square()

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (*s, *batch) of outputs (*s, *batch, *event) [nats]."""
        if self.process is not None and self._physical:
            return self.process.log_prob(value)
        z = self.scaled(value)
        missing = torch.isnan(z)
        if self.process is None:
            mean, variance, noise = self._white
            sd = (variance + noise).sqrt()
            error = (torch.where(missing, 0.0, z) - mean) / sd
            density = -0.5 * error.square() - sd.log() - 0.5 * math.log(2.0 * math.pi)
            total = torch.where(missing, 0.0, density).sum((-2, -1))
        else:
            total = self.process.log_prob(self._to_process(value))
        jacobian = ((~missing).to(torch.float64) * self.scale.log()).sum((-2, -1))
        return (total - jacobian).expand(broadcast(z.shape[:-2], self.batch_shape))

    def innovations(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `OutputProcess`."""
        if self.process is not None:
            error, variance = innovations(self.process, self._to_process(y))
            if not self._physical:
                unit = self.scale if self.several else self.scale[0]
                error, variance = unit * error, unit.square() * variance
        else:
            mean, variance, noise = self._white
            error, missing = self.scaled(y) - mean, torch.isnan(self.columns(y))
            error = self.scale * error.masked_fill(missing, 0.0)
            variance = (self.scale.square() * (variance + noise)).expand(error.shape)
            variance = variance.masked_fill(missing, torch.inf)
            if not self.several:
                error, variance = error.squeeze(-1), variance.squeeze(-1)
        return error, variance, torch.zeros_like(error)

    def one_step(self, y: Tensor) -> Moments:
        """See `OutputProcess`."""
        if self.process is None:
            return self._each(y, with_noise=True)
        return self._from_process(one_step(self.process, self._to_process(y)))

    def ahead(self, y: Tensor, horizon: int) -> Moments:
        """See `OutputProcess`."""
        if self.process is None:
            return self._each(y)
        return self._from_process(ahead(self.process, self._to_process(y), horizon))

    def left_out(self, y: Tensor) -> Moments:
        """See `OutputProcess`."""
        if self.process is None:
            return self._each(y, with_noise=True)
        return self._from_process(left_out(self.process, self._to_process(y)))

    def _each(self, y: Tensor, with_noise: bool = False) -> Moments:
        """Outputs around a known signal: none says anything of another."""
        mean, variance, noise = self._white
        total = variance + noise
        z = self.scaled(y)
        density = -0.5 * ((z - mean).square() / total + total.log() + math.log(2.0 * math.pi))
        return Moments(
            self.shift + self.scale * mean,
            self.scale.square() * (total if with_noise else variance),
            density - self.scale.log(),
        )

    def prediction_errors(self, y: Tensor, horizon: int, count: int) -> Tensor | None:
        """Joint draws (count, *b, n, n_y) of the errors of predictions; None where independent."""
        if self.process is None:
            return None
        errors = prediction_errors(self.process, self._to_process(y), horizon, count)
        errors = self.columns(errors)
        return errors if self._physical else self.scale * errors

    def smooth(self, y: Tensor | None) -> dict[str, LayerMoments]:
        """See `OutputProcess`."""
        found = {}
        for wire in self.system.wires:
            if wire.name in self._signals:
                signal = self._signals[wire.name]
                mean = signal.reshape(-1, *signal.shape[-2:]).numpy()
                found[wire.name] = LayerMoments(mean, np.zeros_like(mean))
        if self.process is not None:
            found[self.system.wires[-1].name] = self._smoothed(self.process, y)
        return found

    def _smoothed(self, observed: ObservedLTIProcess, y: Tensor | None) -> LayerMoments:
        """The last layer's trajectory, in its own scale."""
        trajectory = observed.process if y is None else self._given(observed, y)
        mean, sd = self.columns(trajectory.mean), self.columns(trajectory.variance).sqrt()
        if self._physical:
            offset = self.system.physical(self.scaling).offset
            level = offset.unsqueeze(-2) if self.several else offset[..., None, None]
            mean, sd = (mean - level) / self.scale, sd / self.scale
        shape = (-1, *mean.shape[-2:])
        return LayerMoments(mean.reshape(shape).numpy(), sd.reshape(shape).numpy())

    def _given(self, observed: ObservedLTIProcess, y: Tensor) -> ConditionedLTIProcess:
        """Trajectory of the last layer given the outputs."""
        z = self._to_process(y)
        z = z.expand(observed.batch_shape + observed.event_shape)
        return ConditionedLTIProcess(observed, z)

    def state_after(
        self, y: Tensor, gap: float, next_inputs: Tensor, *, process_noise: bool = True
    ) -> JointState:
        """See `OutputProcess`."""
        means, covariances = [], []
        for wire, layer in self.system.dynamic:
            J = 2 * layer.modes.pairs
            held = see({k: v[..., -1:, :] for k, v in self._signals.items()}, wire).squeeze(-2)
            if wire.last and self.process is not None:
                end, modes = self._given(self.process, y).final_state, self.process.modes
                if self._physical:
                    held = self.inputs[..., -1, :] - as_tensor(self.scaling.input_offset)
            else:
                response = layer.response(see(self._signals, wire), self.grid)
                nothing = torch.zeros(J, J, dtype=torch.float64)
                end, modes = ModalState(response.state, nothing), layer.modes
            modes = modes if process_noise else modes.without_process_noise()
            end = propagate(modes, end, gap, held if modes.inputs else None)
            assert end.covariance is not None
            means.append(end.mean.expand((*self.batch_shape, layer.modes.pairs)))
            covariances.append(end.covariance.expand((*self.batch_shape, J, J)))
        return JointState.of_layers(means, covariances)

    def components(self, *, samples: int, seed: int, several_channels: bool = False) -> Components:
        """See `OutputProcess`; exact, one component for each draw, of one layer of dynamics."""
        if self.process is None or not self.system.is_linear:
            return super().components(samples=samples, seed=seed, several_channels=several_channels)
        observed, process = self.process, self.process.process
        level = torch.zeros(())
        moments = Moments(process.mean, process.variance, level.expand(process.mean.shape))
        physical = self._from_process(moments)
        mean, variance = physical.mean.numpy(), physical.variance.numpy()
        sd = self.scale * self.noise_sd
        sd = sd.expand((len(mean), *sd.shape[-2:]))
        if self._physical:
            constant = self.system.physical(self.scaling).noise_sd
            assert constant is not None
            sd = self.columns(constant)
        noise = sd.square().numpy()

        def parts() -> dict[str, np.ndarray]:
            known = nothing_left(process.modes)
            fresh = LTIProcess(process.modes, process.grid, process.inputs, known)
            unit = 1.0 if self._physical else self.scale.square()
            with torch.no_grad():
                driven = np.minimum((unit * self.columns(fresh.variance)).numpy(), variance).mean(0)
            return {
                "parameters": mean.var(0),
                "initial state": variance.mean(0) - driven,
                "process noise": driven,
                "measurement noise": np.broadcast_to(noise.mean(0), mean.shape[1:]),
            }

        def draw() -> np.ndarray:
            with torch.no_grad(), seeded(seed):
                y = observed.sample((-(-samples // len(mean)),))
                drawn = self._from_process(Moments(y, torch.zeros(()), torch.zeros(()))).mean
                return spread_evenly(drawn.numpy(), samples)

        return Components(mean, variance, noise, parts, draw)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Draw outputs."""
        with torch.no_grad():
            return self.rsample(sample_shape)

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Draw outputs; with gradients where `has_rsample`."""
        if self.process is None or not self._physical:
            return super().sample(sample_shape)
        return self.process.rsample(sample_shape)


def nothing_left(modes: Modes) -> ModalState:
    """A first state that is zero for certain."""
    J = 2 * modes.pairs
    return ModalState(torch.zeros_like(modes.poles), torch.zeros(J, J, dtype=torch.float64))


def spread_evenly(y: np.ndarray, samples: int) -> np.ndarray:
    """So many of the samples y (R, S, n, n_y), as many of each draw S as of any other, or nearly.

    Those that not all draws give come from draws spread evenly over all of them.
    """
    whole, rest = divmod(samples, y.shape[1])
    evenly = ((np.arange(rest) + 0.5) * y.shape[1] / max(rest, 1)).astype(int)
    return np.concatenate([y[:whole].reshape(-1, *y.shape[2:]), y[-1, evenly]])
