"""The layers of a model given their parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.layers.functions import StaticFunction
from pyro_dynogp.layers.noise import Noise
from pyro_dynogp.lti.covariance import state_covariance
from pyro_dynogp.lti.grid import TimeGrid, time_grid
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.response import Response, mean_response
from pyro_dynogp.lti.state import ModalState
from pyro_dynogp.models.arrival import Delays
from pyro_dynogp.models.known import KnownFunction
from pyro_dynogp.models.past_inputs import initial_mean, past_input_covariance, with_direct
from pyro_dynogp.models.selection import seen
from pyro_dynogp.models.wiring import INPUTS, Wire, substeps_of
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.shown import shown
from pyro_dynogp.support.tensors import Numbers, as_tensor, broadcast, joined


@shown
@dataclass(repr=False, frozen=True, eq=False)
class DynamicSystem:
    """A dynamic layer given its parameters: scaled inputs to scaled outputs, time in record units.

    Attributes:
        modes: poles and gains.
        past: (*b, 2P, 2P) covariance that unknown past inputs give the first state; or for how long
            inputs are alike [time], from which it follows.
        first_state: (*b, P) complex, what past inputs left at the first sample of the record at
            hand; None where it is not known.
    """

    modes: Modes
    past: Tensor | float
    first_state: Tensor | None = None

    @cached_property
    def past_inputs(self) -> Tensor:
        """Covariance (*b, 2P, 2P) that unknown past inputs give the first state."""
        if isinstance(self.past, Tensor):
            return self.past
        return past_input_covariance(self.modes, self.past)

    @property
    def is_known(self) -> bool:
        """Whether known inputs determine the trajectory: no process noise, first state known."""
        return self.first_state is not None and not self.modes.has_process_noise

    @property
    def without_process_noise(self) -> DynamicSystem:
        """The same layer with deterministic dynamics."""
        return replace(self, modes=self.modes.without_process_noise(), past=self.past_inputs)

    def prior_state(self) -> ModalState:
        """Gaussian state at the first sample: what past inputs left, and past process noise."""
        if self.first_state is not None:
            return ModalState(self.first_state, state_covariance(self.modes))
        past = self.past_inputs
        return ModalState(torch.zeros_like(self.modes.poles), state_covariance(self.modes) + past)

    def response(self, x: Tensor, time: Numbers | TimeGrid) -> Response:
        """What x (*b, n, d) alone causes, from the known first state or rest."""
        driven = x if self.modes.inputs else None
        return mean_response(self.modes, time, driven, self.first_state)

    def mean(self, x: Tensor, time: Numbers | TimeGrid) -> Tensor:
        """Output (*b, n, w) that x (*b, n, d) alone causes, from the known first state or rest."""
        value = self.response(x, time).output
        return value if self.modes.several_outputs else value.unsqueeze(-1)

    def after(self, standard: Tensor) -> DynamicSystem:
        """The system after past inputs that standard normal numbers (*b, 2P) describe."""
        return replace(self, first_state=initial_mean(self.past_inputs, standard))


@shown
@dataclass(repr=False, frozen=True, eq=False)
class StaticSystem:
    """A static layer given its parameters.

    Attributes:
        function: the Gaussian process given its inducing values, or the user's own function.
        support: (*b, K, d), residual: (*b, e, K): innovations of the rest of the function, drawn
            where the layer feeds a dynamic one and is not integrated out; else None.
    """

    function: StaticFunction | KnownFunction
    support: Tensor | None = None
    residual: Tensor | None = None

    def mean(self, x: Tensor, time: Numbers | TimeGrid) -> Tensor:
        """Mean of the function along x (*b, n, d): (*b, n, e), at whatever times."""
        return self.function.mean(x)

    def __call__(self, x: Tensor) -> Tensor:
        """One function along x (*b, n, d): (*b, n, e)."""
        if (
            isinstance(self.function, KnownFunction)
            or self.residual is None
            or self.support is None
        ):
            return self.function.mean(x)
        return self.function.path(x, self.residual, self.support)


@shown
@dataclass(repr=False, frozen=True, eq=False)
class PhysicalSystem:
    """A linear system with its noise in the units of the record; batch shape *b.

    Its state is that of the scaled system: units of inputs and outputs are in the gains.

    Attributes:
        modes: poles and gains of all inputs, direct ones too.
        offset: (*b,) or (*b, n_y): mean output at the mean inputs of the training record.
        noise_sd: (*b,) or (*b, n_y): measurement noise [output]; None where it varies.
    """

    modes: Modes
    offset: Tensor
    noise_sd: Tensor | None


@shown
@dataclass(repr=False, frozen=True, eq=False)
class System:
    """All layers given their parameters, in units of the scaled record.

    Attributes:
        wires: how they are connected. layers: a system for each wire.
        noise: measurement noise. offset: (*b, n_y), or None where a static layer comes last.
        direct: (*b, n_y, K) weights of the last K inputs, which act on the output at once.
        delays: dead times of inputs that are parameters; None for none. Inputs that methods take
            are those that have arrived.
    """

    wires: tuple[Wire, ...]
    layers: tuple[DynamicSystem | StaticSystem, ...]
    noise: Noise
    offset: Tensor | None
    direct: Tensor | None = None
    delays: Delays | None = None
    _in_units: tuple[Scaling, PhysicalSystem] | None = field(default=None, init=False, repr=False)

    @cached_property
    def batch_shape(self) -> torch.Size:
        """The common batch shape of all parameters and known first states."""
        shapes = [self.noise.batch_shape]
        if self.offset is not None:
            shapes.append(self.offset.shape[:-1])
        if self.direct is not None:
            shapes.append(self.direct.shape[:-2])
        if self.delays is not None:
            shapes.append(self.delays.values.shape[:-1])
        for layer in self.layers:
            if isinstance(layer, DynamicSystem):
                shapes.append(layer.modes.batch_shape)
                if layer.first_state is not None:
                    shapes.append(layer.first_state.shape[:-1])
            else:
                shapes.append(layer.function.batch_shape)
        return broadcast(*shapes)

    def driving(self, inputs: Tensor) -> Tensor:
        """What the layers see of scaled inputs (*b, n, n_u): all but those that act at once."""
        return inputs if self.direct is None else inputs[..., : -self.direct.shape[-1]]

    def level(self, inputs: Tensor) -> Tensor | None:
        """What is added to the last layer's output: offset and direct inputs (*b, n or 1, n_y)."""
        level = None if self.offset is None else self.offset.unsqueeze(-2)
        if self.direct is None:
            return level
        direct = inputs[..., -self.direct.shape[-1] :] @ self.direct.mT
        return direct if level is None else level + direct

    def undisturbed(self, inputs: Tensor, time: Numbers | TimeGrid) -> Tensor:
        """Output (*b, n, n_y) that inputs (*b, n, n_u) alone cause, static layers at their mean.

        Dynamic layers start from the first state that is known of them, else at rest.
        """
        grid, signals = time_grid(time), {INPUTS: self.driving(inputs)}
        for place, layer in zip(self.wires, self.layers, strict=True):
            signals[place.name] = layer.mean(see(signals, place), grid)
        output = signals[self.wires[-1].name]
        level = self.level(inputs)
        return output if level is None else output + level

    def noise_sd(self, inputs: Tensor, time: Numbers | TimeGrid) -> Tensor:
        """Scale (*b, n, n_y) of the measurement noise along scaled inputs (*b, n, n_u).

        Args:
            inputs: scaled. time: (n,) their times in the record's unit, or a `TimeGrid`.
        """
        likelihood = self.noise.likelihood
        if likelihood.follows_output:
            return self.noise.sd(self.undisturbed(inputs, time))
        return self.noise.sd(self.driving(inputs))

    def after(self, states: Mapping[str, Tensor]) -> System:
        """The system after past inputs, given by standard normal numbers (*b, 2P) by layer."""
        if not states:
            return self
        return self.with_layers(
            lambda wire, layer: layer.after(states[wire.name]) if wire.name in states else layer
        )

    @property
    def without_process_noise(self) -> System:
        """The same system with deterministic dynamics."""
        return self.with_layers(lambda wire, layer: layer.without_process_noise)

    def with_layers(self, change: Callable[[Wire, DynamicSystem], DynamicSystem]) -> System:
        """The system with other dynamic layers."""
        layers = tuple(
            change(wire, layer) if isinstance(layer, DynamicSystem) else layer
            for wire, layer in zip(self.wires, self.layers, strict=True)
        )
        return replace(self, layers=layers)

    @property
    def dynamic(self) -> tuple[tuple[Wire, DynamicSystem], ...]:
        """The dynamic layers with their places, first to last."""
        pairs = zip(self.wires, self.layers, strict=True)
        return tuple((wire, layer) for wire, layer in pairs if isinstance(layer, DynamicSystem))

    @property
    def output(self) -> tuple[Wire, DynamicSystem | StaticSystem]:
        """The layer whose output is the model's, with its place."""
        return next(p for p in zip(self.wires, self.layers, strict=True) if p[0].last)

    @property
    def has_feedback(self) -> bool:
        """Whether a static layer's output comes back to an earlier layer."""
        return any(wire.feedback for wire in self.wires)

    @property
    def substeps(self) -> int:
        """Parts of each interval between samples in which feedback is computed anew."""
        return substeps_of(self.wires)

    @property
    def is_linear(self) -> bool:
        """Whether it is one layer of linear dynamics, whatever the noise."""
        return len(self.layers) == 1 and isinstance(self.layers[0], DynamicSystem)

    def physical(self, scaling: Scaling) -> PhysicalSystem:
        """One layer of linear dynamics, with its direct inputs, in the units of the record.

        Computed once: several records share it, and its gradient.

        Raises:
            ValueError: for other systems, whose layers have scales of their own.
        """
        if self._in_units is None or self._in_units[0] is not scaling:
            object.__setattr__(self, "_in_units", (scaling, self._physical(scaling)))
        assert self._in_units is not None
        return self._in_units[1]

    def _physical(self, scaling: Scaling) -> PhysicalSystem:
        (layer, *more) = self.layers
        if more or not isinstance(layer, DynamicSystem):
            raise invalid(
                "modes",
                expected="a model that is one layer of linear dynamics",
                got="layers that have modes of their own, or none",
                advice='Use fit.system.layer("g").modes.',
            )
        assert self.offset is not None
        modes = layer.modes if self.direct is None else with_direct(layer.modes, self.direct)
        y_scale, y_offset = as_tensor(scaling.output_scale), as_tensor(scaling.output_offset)
        sd = self.noise.constant_sd
        several = modes.several_outputs

        def outputs(x: Tensor) -> Tensor:
            return x if several else x.squeeze(-1)

        level, noise = y_offset + y_scale * self.offset, None if sd is None else y_scale * sd
        return PhysicalSystem(
            modes=modes.rescale(
                inputs=as_tensor(scaling.input_scale), outputs=y_scale if several else y_scale[0]
            ),
            offset=outputs(level),
            noise_sd=None if noise is None else outputs(noise),
        )

    def layer(self, name: str) -> DynamicSystem | StaticSystem:
        """The system of a layer by name.

        Raises:
            ValueError: where there is no such layer.
        """
        for place, system in zip(self.wires, self.layers, strict=True):
            if place.name == name:
                return system
        names = [place.name for place in self.wires]
        raise invalid("name", expected=f"one of the layers {names}", got=repr(name))


def see(signals: dict[str, Tensor], place: Wire) -> Tensor:
    """What a layer sees (*b, n, channels): its sources side by side."""
    parts = [seen(signals, source) for source in place.sources]
    return parts[0] if len(parts) == 1 else joined(parts, 2, -1)
