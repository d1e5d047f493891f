"""What is measured along a record given all parameters: a Pyro distribution, its predictions."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch
from pyro.distributions import TorchDistribution, constraints
from torch import Tensor

from pyro_dynogp.distributions.pointwise import Moments
from pyro_dynogp.distributions.trajectory import real_or_missing
from pyro_dynogp.models.draw_shares import decompose
from pyro_dynogp.models.draws import (
    JointState,
    Randomness,
    Switches,
    first_state,
    noise_variance,
)
from pyro_dynogp.models.feedback_draws import draw_outputs
from pyro_dynogp.models.late_systems import arrive
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.system import DynamicSystem, System
from pyro_dynogp.support.parallel import seeded
from pyro_dynogp.support.tensors import as_tensor, broadcast


@dataclass(frozen=True, eq=False)
class LayerMoments:
    """Posterior of a layer's output for each draw of the parameters, in the layer's own scale.

    Attributes:
        mean, sd: (S, n, w).
    """

    mean: np.ndarray
    sd: np.ndarray


@dataclass(frozen=True, eq=False)
class Components:
    """Outputs ahead of a known or unknown state as a mixture of S Gaussians, in record units.

    Attributes:
        mean, variance: (S, n, n_y) of the noise-free output in each component.
        noise_variance: (S, n_y), or (S, n, n_y) where it changes over time.
        parts: gives the share of the variance (n, n_y) by cause.
        draw: joint samples (S', n, n_y) of measured outputs.
    """

    mean: np.ndarray
    variance: np.ndarray
    noise_variance: np.ndarray
    parts: Callable[[], Mapping[str, np.ndarray]]
    draw: Callable[[], np.ndarray]


class OutputProcess(TorchDistribution):
    """Measured outputs along a record, all trajectories integrated out.

    Event shape (n,), or (n, n_y) for several outputs, in the units of the record; batch shape that
    of the parameters. NaN marks a missing sample. `output_process` makes one, and chooses the
    engine: `ExactOutputs` or `MomentOutputs`.

    Args:
        system: layers given their parameters, at the beginning of the record.
        record: times and inputs.
        start: state of all dynamic layers at the first time, where it is not what the system says.
    """

    arg_constraints: dict[str, constraints.Constraint] = {}  # noqa: RUF012 (torch's own attribute)
    has_rsample = False

    def __init__(
        self,
        system: System,
        record: PreparedRecord,
        start: JointState | None = None,
        *,
        validate_args: bool | None = None,
    ) -> None:
        seen = arrive(system, record)
        self.system, self.scaling, self.start = seen.system, seen.scaling, start
        self.grid, self.inputs, self.scaled_inputs = record.grid, seen.inputs, seen.scaled
        n_y = len(self.scaling.output_scale)
        self.several = n_y > 1
        event = (len(self.grid), n_y) if self.several else (len(self.grid),)
        batch = broadcast(system.batch_shape, self.inputs.shape[:-2])
        if start is not None:
            batch = broadcast(batch, start.mean.shape[:-1])
        super().__init__(batch, torch.Size(event), validate_args=validate_args)

    @property
    def support(self) -> constraints.Constraint:
        """Real trajectories in which NaN marks a missing sample."""
        return constraints.independent(real_or_missing, len(self.event_shape))

    def expand(self, batch_shape: Any, _instance: Any = None) -> Self:
        """Broadcast to a larger batch shape."""
        new: Self = self._get_checked_instance(type(self), _instance)
        new.__dict__.update(self.__dict__)
        new._batch_shape = torch.Size(batch_shape)
        return new

    @cached_property
    def scale(self) -> Tensor:
        """(n_y,): one standard deviation of the training outputs."""
        return as_tensor(self.scaling.output_scale)

    @cached_property
    def shift(self) -> Tensor:
        """(n_y,): mean of the training outputs."""
        return as_tensor(self.scaling.output_offset)

    @cached_property
    def noise_sd(self) -> Tensor:
        """Scale (*b, n, n_y) of the measurement noise, of scaled outputs."""
        return self.system.noise_sd(self.scaled_inputs, self.grid)

    def columns(self, value: Tensor) -> Tensor:
        """Outputs (..., n) or (..., n, n_y) with their dimension."""
        return value if self.several else value.unsqueeze(-1)

    def scaled(self, value: Tensor) -> Tensor:
        """Outputs (..., *event) as (..., n, n_y) in standard deviations of the training record."""
        return (self.columns(value) - self.shift) / self.scale

    @abstractmethod
    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (*s, *batch) of outputs (*s, *batch, *event) [nats]."""

    @abstractmethod
    def innovations(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Errors of one-step predictions, their variances, and what is not normal about them.

        Each (*batch, *event), in units of the record, with noise; the last is the log-density less
        that of the normal one of these moments [nats]. Of outputs of one time those that follow are
        given those before. Of a missing sample they are without meaning.
        """

    @abstractmethod
    def one_step(self, y: Tensor) -> Moments:
        """Of each measured output (*batch, n, n_y) given those before it; with its noise.

        Outputs of one time follow one another: the log-densities add up to that of the record.
        """

    @abstractmethod
    def ahead(self, y: Tensor, horizon: int) -> Moments:
        """Of each noise-free output (*batch, n, n_y) given those at least `horizon` before it."""

    @abstractmethod
    def left_out(self, y: Tensor) -> Moments:
        """Of each output (*batch, n, n_y) given all others."""

    @abstractmethod
    def smooth(self, y: Tensor | None) -> dict[str, LayerMoments]:
        """Every layer's trajectory given the outputs, or given the inputs alone."""

    @abstractmethod
    def state_after(
        self, y: Tensor, gap: float, next_inputs: Tensor, *, process_noise: bool = True
    ) -> JointState:
        """State of all dynamic layers given the outputs, `gap` after the last time.

        Args:
            y: outputs (*event). gap: [time unit]. next_inputs: u (n_u,) [input] at that time.
            process_noise: whether there is any in the gap.
        """

    def components(self, *, samples: int, seed: int, several_channels: bool = False) -> Components:
        """Outputs from the inputs and the first state: a Gaussian for each of many draws.

        Trajectories of all layers are drawn, so that there are at least `samples` of them; the
        variance of the last layer given those below it is exact.

        Args:
            samples: number of joint samples. seed: of all draws.
            several_channels: whether static functions of several channels are drawn, too.
        """
        system, grid, inputs, sd = self.system, self.grid, self.scaled_inputs, self.noise_sd
        batch = system.batch_shape
        shape = torch.Size((max(2, -(-samples // max(1, batch.numel()))), *batch))
        start = self.start or first_state(system)
        switches = Switches.all_on(system, several_channels=several_channels)

        def random() -> Randomness:  # the same each time: cheaper to draw again than to keep
            with seeded(seed):
                return Randomness.draw(system, len(grid), shape)

        drawn = draw_outputs(system, grid, inputs, start, random(), switches)
        scale, shift = self.scaling.output_scale, self.scaling.output_offset
        mean, variance = shift + scale * flat(drawn.mean), scale**2 * flat(drawn.variance)
        generator = np.random.default_rng(seed)
        noise = scale**2 * noise_variance(system.noise.likelihood, sd, len(mean), generator)
        joint, spread = mean, variance
        wire, layer = system.output
        if isinstance(layer, DynamicSystem):  # its own draw is joint in time
            level = system.level(inputs)
            signal = drawn.signals[wire.name]
            joint = shift + scale * flat(signal if level is None else signal + level)
            spread = np.zeros_like(variance)

        def draw() -> np.ndarray:
            y = joint + np.sqrt(spread + noise) * generator.standard_normal(mean.shape)
            return y[generator.permutation(len(y))[:samples]]

        def parts() -> Mapping[str, np.ndarray]:
            numbers = random()

            def at(some: Switches) -> Any:
                used = numbers if some.any else numbers.first
                return draw_outputs(system, grid, inputs, start, used, some)

            with torch.no_grad():
                shares = decompose(system, at, switches, scale)
            return shares | {"measurement noise": noise.mean(0)}

        return Components(mean, variance, noise, parts, draw)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Draw outputs: every trajectory from its own distribution, layer by layer, then noise."""
        shape = torch.Size(sample_shape) + self.batch_shape
        system, grid, inputs = self.system, self.grid, self.scaled_inputs
        with torch.no_grad():
            start = self.start or first_state(system)
            random = Randomness.draw(system, len(grid), shape)
            on = Switches.all_on(system, several_channels=True)  # the model as it is stated
            drawn = draw_outputs(system, grid, inputs, start, random, on)
            wire, layer = system.output
            signal = drawn.signals[wire.name]
            if isinstance(layer, DynamicSystem):
                level = system.level(inputs)
                signal = signal if level is None else signal + level
            else:
                signal = drawn.mean + drawn.variance.sqrt() * torch.randn_like(drawn.mean)
            y = system.noise.distribution(signal, self.noise_sd, None).sample()
        y = self.shift + self.scale * y
        return y if self.several else y.squeeze(-1)


def flat(x: Tensor) -> np.ndarray:
    """(*shape, n, w) to (S, n, w)."""
    return x.reshape(-1, *x.shape[-2:]).numpy()
