"""Cascades of dynamic and static Gaussian-process layers as Pyro models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.data.channels import Channel
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.layers.functions import StaticFunction
from pyro_dynogp.layers.noise import Gaussian, Likelihood
from pyro_dynogp.layers.static import sample_static
from pyro_dynogp.models.explicit import observe_explicit
from pyro_dynogp.models.limits import at_limits, count_as_probabilities, scaled_limits
from pyro_dynogp.models.linear import (
    check_direct,
    check_records,
    past_input_covariance,
    prepare,
)
from pyro_dynogp.models.outputs import observe_collapsed
from pyro_dynogp.models.priors import FLAT, PriorName, TimeScale, sample_direct, sample_modes
from pyro_dynogp.models.system import CascadeSystem, DynamicSystem, StaticSystem, scaled_inputs
from pyro_dynogp.models.wiring import Dynamic, Layer, Static, Wire, wire
from pyro_dynogp.support.errors import invalid

Integrate = Literal["none", "last", "all"]


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
    (``g_0``, ``y_0``, ...). ``direct`` (n_y, K) for inputs that act at once. Where the last layer
    has limits, a factor ``at_limits`` makes probabilities of outputs that are exactly there.

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
                systems.append(self._sample_static(one, one.layer, scaling))
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
            return self._sample_static(one, layer, self.scaling).function

    def _sample_static(self, one: Wire, layer: Static, scaling: Scaling | None) -> StaticSystem:
        function = sample_static(
            one.name,
            channels=one.channels,
            outputs=layer.outputs,
            inducing=layer.inducing,
            kernel=layer.kernel,
            mean=layer.mean or "constant",
            learn_locations=layer.learn_locations,
        )
        if layer.limits is not None:
            function = replace(function, limits=scaled_limits(layer.limits, scaling))
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
                observe_collapsed(here, scaling, record, suffix, u)
            else:
                last = self.integrate == "last"
                observe_explicit(here, scaling, record, suffix, u, last_integrated=last)
            count_as_probabilities(at_limits(self.layers, record), here, record, suffix, u)

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
