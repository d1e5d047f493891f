"""Cascades of dynamic and static Gaussian-process layers as Pyro models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp._errors import invalid
from pyro_dynogp._tensors import as_tensor, broadcast
from pyro_dynogp.channels import Channel
from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.layers.noise import Gaussian, Likelihood, Noise
from pyro_dynogp.layers.static import StaticFunction, sample_static
from pyro_dynogp.lti.covariance import state_covariance
from pyro_dynogp.lti.grid import time_grid
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.response import mean_response
from pyro_dynogp.lti.state import ModalState
from pyro_dynogp.models.layers import INPUTS, Dynamic, Layer, Static, Wire, wire
from pyro_dynogp.models.linear import (
    check_direct,
    check_records,
    initial_mean,
    past_input_covariance,
    prepare,
)
from pyro_dynogp.models.priors import FLAT, PriorName, TimeScale, sample_direct, sample_modes
from pyro_dynogp.record import Record
from pyro_dynogp.scaling import Scaling

Integrate = Literal["none", "last", "all"]


@dataclass(frozen=True, eq=False)
class DynamicSystem:
    """A dynamic layer given its parameters: scaled inputs to scaled outputs, time in record units.

    Attributes:
        modes: poles and gains.
        past_inputs: (*b, 2P, 2P) covariance that unknown past inputs give the first state.
        first_state: (*b, P) complex, what past inputs left at the first sample of the record at
            hand; None where it is not known.
    """

    modes: Modes
    past_inputs: Tensor
    first_state: Tensor | None = None

    def prior_state(self, process_noise: bool = True) -> ModalState:
        """Gaussian state at the first sample: what past inputs left, and past process noise."""
        modes = self.modes if process_noise else self.modes.without_process_noise()
        covariance = state_covariance(modes)
        if self.first_state is not None:
            return ModalState(self.first_state, covariance)
        return ModalState(torch.zeros_like(modes.poles), covariance + self.past_inputs)

    def mean(self, x: Tensor, time: Any) -> Tensor:
        """Output (*b, n, w) that x (*b, n, d) alone causes, from the known first state or rest."""
        driven = x if self.modes.inputs else None
        value = mean_response(self.modes, time, driven, self.first_state).output
        return value if self.modes.several_outputs else value.unsqueeze(-1)

    def after(self, standard: Tensor) -> DynamicSystem:
        """The system after past inputs that standard normal numbers (*b, 2P) describe."""
        return replace(self, first_state=initial_mean(self.past_inputs, standard))


@dataclass(frozen=True, eq=False)
class StaticSystem:
    """A static layer given its parameters.

    Attributes:
        function: the Gaussian process given its inducing values.
        support: (*b, K, d), residual: (*b, e, K): innovations of the rest of the function, drawn
            where the layer feeds a dynamic one and is not integrated out; else None.
    """

    function: StaticFunction
    support: Tensor | None = None
    residual: Tensor | None = None

    def mean(self, x: Tensor, time: Any) -> Tensor:
        """Mean of the function along x (*b, n, d): (*b, n, e), at whatever times."""
        return self.function.mean(x)

    def __call__(self, x: Tensor) -> Tensor:
        """One function along x (*b, n, d): (*b, n, e)."""
        if self.residual is None or self.support is None:
            return self.function.mean(x)
        return self.function.path(x, self.residual, self.support)


@dataclass(frozen=True, eq=False)
class CascadeSystem:
    """All layers given their parameters, in units of the scaled record.

    Attributes:
        wires: how they are connected. layers: a system for each wire.
        noise: measurement noise. offset: (*b, n_y), or None where a static layer comes last.
        direct: (*b, n_y, K) weights of the last K inputs, which act on the output at once.
    """

    wires: tuple[Wire, ...]
    layers: tuple[DynamicSystem | StaticSystem, ...]
    noise: Noise
    offset: Tensor | None
    direct: Tensor | None = None

    @cached_property
    def batch_shape(self) -> torch.Size:
        """The common batch shape of all parameters and known first states."""
        shapes = [self.noise.batch_shape]
        if self.offset is not None:
            shapes.append(self.offset.shape[:-1])
        if self.direct is not None:
            shapes.append(self.direct.shape[:-2])
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

    def undisturbed(self, inputs: Tensor, time: Any) -> Tensor:
        """Output (*b, n, n_y) that inputs (*b, n, n_u) alone cause, static layers at their mean.

        Dynamic layers start from the first state that is known of them, else at rest.
        """
        grid, signals = time_grid(time), {INPUTS: self.driving(inputs)}
        for one, layer in zip(self.wires, self.layers, strict=True):
            signals[one.name] = layer.mean(see(signals, one), grid)
        output = signals[self.wires[-1].name]
        level = self.level(inputs)
        return output if level is None else output + level

    def noise_sd(self, inputs: Tensor, time: Any) -> Tensor:
        """Scale (*b, n, n_y) of the measurement noise along scaled inputs (*b, n, n_u).

        Args:
            inputs: scaled. time: (n,) their times in the record's unit, or a `TimeGrid`.
        """
        likelihood = self.noise.likelihood
        if likelihood.varying and likelihood.of == "output":
            return self.noise.sd(self.undisturbed(inputs, time))
        return self.noise.sd(self.driving(inputs))

    def after(self, states: Mapping[str, Tensor]) -> CascadeSystem:
        """The cascade after past inputs, given by standard normal numbers (*b, 2P) by layer."""
        layers = tuple(
            layer.after(states[one.name])
            if isinstance(layer, DynamicSystem) and one.name in states
            else layer
            for one, layer in zip(self.wires, self.layers, strict=True)
        )
        return replace(self, layers=layers)

    def layer(self, name: str) -> DynamicSystem | StaticSystem:
        """The system of a layer by name.

        Raises:
            ValueError: where there is no such layer.
        """
        for one, system in zip(self.wires, self.layers, strict=True):
            if one.name == name:
                return system
        names = [one.name for one in self.wires]
        raise invalid("name", expected=f"one of the layers {names}", got=repr(name))


@dataclass(frozen=True)
class Cascade:
    """Dynamic and static layers in any order, then measurement noise: a Pyro model.

    Calling the model with a record (or several, which share all parameters) runs it. Signals are
    scaled inside: layers see inputs of unit standard deviation, and priors are stated so.

    Sites, for a layer g: those of `sample_modes` (``g_log_decay``, ...) and the trajectory ``g``
    (n,) or (n, width). For a static layer f: those of `sample_static` (``f_values``, the whitened
    inducing values, ...), and ``f`` (n,) or (n, width): in a last layer a site of its own, the
    conditional given the inducing values; below a dynamic layer one function along the path, which
    ``f_residual`` completes (`pyro.deterministic`). ``offset`` (n_y,) where a dynamic layer comes
    last; the likelihood's sites; ``y``. With several records trajectories and outputs are numbered
    (``g_0``, ``y_0``, ...). ``direct`` (n_y, K) for inputs that act at once.

    Args:
        inputs: n_u, those that channels make included.
        layers: `Dynamic` and `Static` layers, first to last.
        likelihood: `Gaussian()`, `StudentT(...)` or `Heteroscedastic(...)`.
        initial_state: "site": what past inputs left in a layer that a static layer sees is a site,
            ``g_initial_state`` (2P,), standard normal; in layers from which on all is linear it is
            integrated out. "integrated": everywhere (moment matching is then poor at the beginning
            of a record: the state is too uncertain for it). "zero": nothing is left. Past process
            noise is always there.
        integrate: "none" keeps every trajectory as a site; "last" integrates a dynamic last layer
            under Gaussian noise, exactly; "all" integrates all trajectories by the moment-matching
            filter, exactly where the layers are linear.
        direct, channels: as of `LinearDynamicGP`; the layers do not see direct inputs.
        scaling: learnt by `fit` from the training record; else from the record at hand.

    Raises:
        ValueError: on layers that do not fit together, or unknown options.
    """

    # Sites may have a batch dimension on the left: many points go through the model at once.
    takes_batches: ClassVar[bool] = True

    inputs: int
    layers: tuple[Layer, ...]
    likelihood: Likelihood = field(default_factory=Gaussian)
    initial_state: Literal["site", "integrated", "zero"] = "site"
    integrate: Integrate = "none"
    priors: PriorName = "default"
    direct: int = 0
    channels: tuple[Channel, ...] = ()
    scaling: Scaling | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.inputs, int) or self.inputs < 0:
            raise invalid("inputs", expected="a whole number >= 0", got=repr(self.inputs))
        object.__setattr__(self, "layers", tuple(self.layers))
        if not isinstance(self.likelihood, Likelihood):
            raise invalid(
                "likelihood",
                expected="Gaussian(), StudentT(...) or Heteroscedastic(...)",
                got=repr(self.likelihood),
            )
        if self.priors not in ("default", "paper"):
            raise invalid("priors", expected="'default' or 'paper'", got=repr(self.priors))
        if self.integrate not in ("none", "last", "all"):
            raise invalid("integrate", expected="'none', 'last' or 'all'", got=repr(self.integrate))
        if self.initial_state not in ("site", "integrated", "zero"):
            raise invalid(
                "initial_state",
                expected="'site', 'integrated' or 'zero'",
                got=repr(self.initial_state),
            )
        check_direct(self.inputs, self.direct, self.channels)
        object.__setattr__(self, "_wires", wire(self.inputs - self.direct, self.layers))
        last = self.layers[-1]
        if self.integrate == "last" and not (
            isinstance(last, Dynamic) and self.likelihood == Gaussian() and not self.direct
        ):
            raise invalid(
                "integrate",
                expected="'none' or 'all': only a dynamic last layer under constant Gaussian "
                "noise and without direct inputs can be integrated by itself",
                got="'last'",
            )

    @property
    def wires(self) -> tuple[Wire, ...]:
        """The layers in their places, with names."""
        wires: tuple[Wire, ...] = self.__dict__["_wires"]
        return wires

    @property
    def state_sites(self) -> tuple[Wire, ...]:
        """Dynamic layers whose first state is a site: those that a static layer sees."""
        if self.initial_state != "site":
            return ()
        seen = {
            name
            for place, one in enumerate(self.wires)
            if any(isinstance(w.layer, Static) for w in self.wires[place:])
            for name in one.sources
        }
        return tuple(
            one
            for one in self.wires
            if isinstance(one.layer, Dynamic) and one.name in seen and one.channels
        )

    @property
    def outputs(self) -> int:
        """n_y, the width of the last layer."""
        return self.layers[-1].outputs

    @property
    def several_outputs(self) -> bool:
        """Whether outputs have a dimension of their own."""
        return self.outputs > 1

    @property
    def collapsed(self) -> Cascade:
        """The same model with all trajectories integrated out."""
        return replace(self, integrate="all")

    def scaled_to(self, records: Record | Sequence[Record]) -> Cascade:
        """The same model with the scaling of the given training record(s)."""
        return replace(self, scaling=Scaling.from_records(prepare(self, records)))

    def check(self, records: Record | Sequence[Record]) -> tuple[Record, ...]:
        """Records whose channels and units fit the model.

        Raises:
            ValueError: where the number of channels or a unit differs.
        """
        return check_records(self, records)

    def sample_system(self, scaling: Scaling) -> CascadeSystem:
        """Sample the parameters of all layers."""
        time_scale = TimeScale.of(scaling)
        systems: list[DynamicSystem | StaticSystem] = []
        for one in self.wires:
            if isinstance(one.layer, Dynamic):
                systems.append(self.sample_dynamic_layer(one, one.layer, time_scale))
            else:
                systems.append(self._sample_static(one, one.layer))
        flat = self.priors == "paper"
        offset = None
        if isinstance(self.layers[-1], Dynamic):
            zero = torch.zeros(self.outputs, dtype=torch.float64)
            spread = FLAT if flat else 1.0
            offset = pyro.sample("offset", dist.Normal(zero, zero + spread).to_event(1))
        noise = self.likelihood.sample(self.outputs, self.inputs - self.direct, flat=flat)
        direct = sample_direct(self.direct, self.outputs, flat=flat) if self.direct else None
        return CascadeSystem(self.wires, tuple(systems), noise, offset, direct)

    def sample_dynamic_layer(
        self, one: Wire, layer: Dynamic, time_scale: TimeScale
    ) -> DynamicSystem:
        """Sample the parameters of one dynamic layer."""
        modes = sample_modes(
            one.name,
            inputs=one.channels,
            pairs=layer.pairs,
            outputs=layer.outputs if layer.outputs > 1 else None,
            brownian=layer.brownian or layer.outputs,
            noise=layer.noise,
            feedthrough=layer.feedthrough,
            process_noise=layer.process_noise,
            time_scale=time_scale,
            priors=self.priors,
        )
        return DynamicSystem(modes, past_input_covariance(modes, 1.0 / time_scale.typical_rate))

    def static_given(
        self, one: Wire, layer: Static, values: Mapping[str, Tensor]
    ) -> StaticFunction:
        """The function of a static layer given values of its sites; no trace sees it."""
        with pyro.poutine.block(), pyro.poutine.condition(data=dict(values)):
            return self._sample_static(one, layer).function

    def _sample_static(self, one: Wire, layer: Static) -> StaticSystem:
        function = sample_static(
            one.name,
            channels=one.channels,
            outputs=layer.outputs,
            inducing=layer.inducing,
            kernel=layer.kernel,
            mean=layer.mean or "constant",
            learn_locations=layer.learn_locations,
        )
        if not one.pathwise or self.integrate == "all":
            return StaticSystem(function)
        one_ = torch.ones(layer.outputs, layer.support, dtype=torch.float64)
        residual = pyro.sample(f"{one.name}_residual", dist.Normal(0.0 * one_, one_).to_event(2))
        return StaticSystem(function, support_points(function.locations, layer.support), residual)

    def __call__(
        self, records: Record | Sequence[Record], inputs: Sequence[Tensor] | None = None
    ) -> None:
        """Run the Pyro model on one record or on several; `inputs` as of `LinearDynamicGP`."""
        checked = self.check(records)
        scaling = self.scaling or Scaling.from_records(checked)
        system = self.sample_system(scaling)
        for index, record in enumerate(checked):
            suffix = "" if len(checked) == 1 else f"_{index}"
            states = self.sample_states(suffix)
            here = self.begin(system, states)
            u = scaled_inputs(scaling, record, None if inputs is None else inputs[index])
            if self.integrate == "all":
                from pyro_dynogp.models.collapsed import observe_collapsed

                observe_collapsed(here, scaling, record, suffix, u)
            else:
                self._observe(here, scaling, record, suffix, u)

    def sample_states(self, suffix: str) -> dict[str, Tensor]:
        """Sample what past inputs left at the first sample of a record, by layer."""
        states = {}
        for one in self.state_sites:
            assert isinstance(one.layer, Dynamic)
            one_ = torch.ones(2 * one.layer.pairs, dtype=torch.float64)
            name = f"{one.name}_initial_state{suffix}"
            states[one.name] = pyro.sample(name, dist.Normal(0.0 * one_, one_).to_event(1))
        return states

    def begin(self, system: CascadeSystem, states: Mapping[str, Tensor]) -> CascadeSystem:
        """The cascade at the beginning of a record, as `initial_state` has it."""
        if self.initial_state == "zero":
            zeros = {
                one.name: torch.zeros(2 * one.layer.pairs, dtype=torch.float64)
                for one in self.wires
                if isinstance(one.layer, Dynamic)
            }
            return system.after(zeros)
        return system.after(states)

    def _observe(
        self, system: CascadeSystem, scaling: Scaling, record: Record, suffix: str, inputs: Tensor
    ) -> None:
        """Sample every trajectory, then the outputs, of scaled inputs (*b, n, n_u)."""
        y, missing = outputs_of(record)
        scale, shift = as_tensor(scaling.output_scale), as_tensor(scaling.output_offset)
        signals = {INPUTS: system.driving(inputs)}
        for one, layer in zip(system.wires, system.layers, strict=True):
            x = see(signals, one)
            if isinstance(layer, DynamicSystem):
                driven = x if layer.modes.inputs else None
                process = LTIProcess(layer.modes, record.time, driven, layer.prior_state())
                if one.last and self.integrate == "last":
                    observe_linear(process, system, scaling, record, suffix)
                    return
                value = pyro.sample(one.name + suffix, process)
                signals[one.name] = value if layer.modes.several_outputs else value.unsqueeze(-1)
            else:
                signals[one.name] = self._static(one, layer, x, suffix)
        mean = signals[system.wires[-1].name]
        level = system.level(inputs)
        if level is not None:
            mean = mean + level
        mean = shift + scale * mean
        sd = scale * system.noise_sd(inputs, record.time)
        if not self.several_outputs:
            mean, sd = mean.squeeze(-1), sd.squeeze(-1)
        noise = system.noise.distribution(mean, sd, missing)
        pyro.sample(f"y{suffix}", noise.to_event(1 + self.several_outputs), obs=y)

    @staticmethod
    def _static(one: Wire, layer: StaticSystem, x: Tensor, suffix: str) -> Tensor:
        several = one.layer.outputs > 1
        if one.pathwise:
            value = layer(x)
            value = value if several else value.squeeze(-1)
            value = pyro.deterministic(one.name + suffix, value, event_dim=1 + several)
        else:
            mean, variance = layer.function.mean(x), layer.function.variance(x)
            if not several:
                mean, variance = mean.squeeze(-1), variance.squeeze(-1)
            sd = (variance + TINY).sqrt()
            value = pyro.sample(one.name + suffix, dist.Normal(mean, sd).to_event(1 + several))
        return value if several else value.unsqueeze(-1)


# Least variance of the conditional of a static layer's value (scaled units): its density is finite
# where a sample lies on an inducing location.
TINY = 1e-10


def support_points(locations: Tensor, count: int) -> Tensor:
    """Points (*b, K, d) at which the rest of a function is drawn: over where inducing points lie.

    One channel: an even grid. Several: the inducing locations spread by a Sobol sequence over
    their box. No gradient passes.
    """
    z = locations.detach()
    low, high = z.amin(-2, keepdim=True), z.amax(-2, keepdim=True)
    margin = 0.1 * (high - low) + 1e-3
    if z.shape[-1] == 1:
        unit = torch.linspace(0.0, 1.0, count, dtype=torch.float64).unsqueeze(-1)
    else:
        engine = torch.quasirandom.SobolEngine(z.shape[-1])
        unit = engine.draw(count, dtype=torch.float64)
    return low - margin + (high - low + 2.0 * margin) * unit


def see(signals: dict[str, Tensor], one: Wire) -> Tensor:
    """What a layer sees (*b, n, channels): its sources side by side."""
    parts = [signals[name] for name in one.sources]
    if len(parts) == 1:
        return parts[0]
    batch = broadcast(*(p.shape[:-2] for p in parts))
    return torch.cat([p.expand(batch + p.shape[-2:]) for p in parts], -1)


def scaled_inputs(scaling: Scaling, record: Record, inputs: Tensor | None = None) -> Tensor:
    """Inputs (*b, n, n_u), by default a record's, in standard deviations of the training record."""
    u = record.tensors().inputs if inputs is None else inputs
    if not u.shape[-1]:
        return u
    return (u - as_tensor(scaling.input_offset)) / as_tensor(scaling.input_scale)


def outputs_of(record: Record) -> tuple[Tensor | None, Tensor | None]:
    """Outputs (n,) or (n, n_y) with zeros where missing, and where that is; None for none."""
    if not record.n_outputs:
        return None, None
    y = record.tensors().outputs
    y = y if record.n_outputs > 1 else y[:, 0]
    missing = torch.isnan(y)
    return (y.masked_fill(missing, 0.0), missing) if bool(missing.any()) else (y, None)


def observe_linear(
    process: LTIProcess, system: CascadeSystem, scaling: Scaling, record: Record, suffix: str
) -> None:
    """Observe a dynamic last layer, its trajectory integrated out."""
    several = process.modes.several_outputs
    scale, shift = as_tensor(scaling.output_scale), as_tensor(scaling.output_offset)
    assert system.offset is not None
    assert system.noise.constant_sd is not None
    level, sd = shift + scale * system.offset, scale * system.noise.constant_sd
    modes = process.modes.rescale(outputs=scale if several else scale[0])
    if not several:
        level, sd = level.squeeze(-1), sd.squeeze(-1)
    driven = process.inputs if modes.inputs else None
    physical = LTIProcess(modes, process.grid, driven, process.initial_state, offset=level)
    y = record.tensors().outputs if record.n_outputs else None
    if y is not None and not several:
        y = y[:, 0]
    pyro.sample(f"y{suffix}", physical.observed(sd), obs=y)


__all__ = ["Cascade", "CascadeSystem", "DynamicSystem", "StaticSystem"]
