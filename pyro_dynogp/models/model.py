"""The model: dynamic and static Gaussian-process layers, then measurement noise, in Pyro."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.data.scaling import Scaling, TimeScale
from pyro_dynogp.layers.functions import StaticFunction, support_points
from pyro_dynogp.layers.sites import Site, Values, sample
from pyro_dynogp.layers.static import StaticPrior
from pyro_dynogp.models.arrival import DELAY, Delays, columns_of, delay_site
from pyro_dynogp.models.explicit import observe_explicit
from pyro_dynogp.models.known import known_function, known_sites
from pyro_dynogp.models.limits import at_limits, log_probability_scale, scaled_limits
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.past_inputs import first_levels, past_input_covariance
from pyro_dynogp.models.prepared import PreparedRecord, Records
from pyro_dynogp.models.priors import FLAT, ModesPrior, direct_site
from pyro_dynogp.models.structure import Structure
from pyro_dynogp.models.system import DynamicSystem, StaticSystem, System
from pyro_dynogp.models.wiring import INPUTS, Dynamic, Known, Static, Wire
from pyro_dynogp.support.shown import shown


@shown
@dataclass(frozen=True)
class Model(Structure):
    """Dynamic and static layers in any order, then measurement noise: a Pyro model.

    `LinearDynamicGP`, `Wiener`, `Hammerstein`, `WienerHammerstein`, `HammersteinWiener` and
    `Cascade` make one. Calling the model with a record (or several, which share all parameters)
    runs it; a record without outputs leaves ``y`` unobserved, to be sampled. Signals are scaled
    inside: layers see inputs of unit standard deviation, and priors are stated so.

    Sites, for a dynamic layer g those of `ModesPrior` (``g_log_decay``, ...), for a static layer f
    those of `StaticPrior` (``f_values``, the whitened inducing values, ...); ``direct`` (n_y, K)
    for inputs that act at once; ``offset`` (n_y,) where a dynamic layer comes last; the
    likelihood's sites (``noise_sd`` (n_y,), log-normal around 0.1); ``delay`` (K,), dead times in
    the record's unit of time, of inputs that channels delay by no given number (`Delayed`); ``y``.
    Where trajectories are not integrated out: the trajectory ``g`` (n,) or (n, width), and ``f``,
    in a last layer a site of its own, the conditional given the inducing values; below a dynamic
    layer one function along the path, which ``f_residual`` completes (`pyro.deterministic`). With
    several records first states, trajectories and outputs are numbered (``g_0``, ``y_0``, ...).
    Where the last layer has limits, a factor ``at_limits`` makes probabilities of outputs that are
    exactly there.

    Args:
        inputs: n_u, may be 0; those that channels make included.
        layers: `Dynamic` and `Static` layers, first to last.
        likelihood: `Gaussian()`, `StudentT(...)` or `Heteroscedastic(...)`.
        initial_state: what past inputs left in a dynamic layer at the first sample. "auto": in a
            layer that a static layer sees it is a site, ``g_initial_state`` (2P,), standard
            normal (of an integrator one number); in other layers it is integrated out. "site": a
            site in every layer. "integrated": everywhere (below a static layer moment matching is
            then poor at the beginning of a record: the state is too uncertain for it). "zero":
            nothing is left. Past process noise is always there.
        integrate: "none" keeps every trajectory as a site; "last" integrates a dynamic last layer
            under Gaussian noise, exactly; "all" integrates all trajectories, exactly where they are
            linear, else by the moment-matching filter.
        priors: "default", or "paper" for flat ones but for the horseshoe on the noise gains: fit
            with them, but do not sample from them, their draws exceed floating-point range.
        direct: the last K inputs act on the output at once and without dynamics (trends, steps,
            calendars), and the layers do not see them: their weights are the site ``direct``,
            normal(0, 1) in standard deviations.
        channels: made from each record before the model sees it, see `pyro_dynogp.data.channels`.
        scaling: learnt by `fit` from the training record; else from the record at hand.
        output: name of the layer whose output is measured, where it is not the last. With feedback
            trajectories are always integrated out (``integrate="all"``).

    Raises:
        ValueError: on layers that do not fit together, or unknown options.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> model = dgp.LinearDynamicGP(1, pairs=1).scaled_to(record)
        >>> trace = pyro.poutine.trace(model).get_trace(record)
        >>> trace.nodes["y"]["value"].shape
        torch.Size([60])
    """

    # Sites may have a batch dimension on the left: many points go through the model at once.
    takes_batches: ClassVar[bool] = True

    def sites(self, scaling: Scaling) -> tuple[Site, ...]:
        """Sites of the parameters, in the order in which they are sampled.

        Args:
            scaling: of the training record.
        """
        return tuple(self._sites(scaling))

    def _sites(self, scaling: Scaling) -> Iterator[Site]:
        time_scale, flat = TimeScale.of(scaling), self.priors == "paper"
        for w in self.wires:
            if isinstance(w.layer, Dynamic):
                yield from self._modes_prior(w, w.layer, scaling).sites(w.dims)
            elif isinstance(w.layer, Known):
                yield from known_sites(w.name, w.layer)
            else:
                yield from self.static_prior(w, w.layer, scaling).sites(w.dims)
                if self._has_residual(w):
                    zero = torch.zeros(w.layer.outputs, w.layer.support, dtype=torch.float64)
                    prior = dist.Normal(zero, zero + 1.0).to_event(2)
                    dims = (w.dims["output"], w.dims["support"])
                    yield Site(f"{w.name}_residual", prior, dims, role="free")
        if self.direct:
            yield direct_site(self.direct, self.outputs, flat=flat)
        if self.measured_signal is not None:
            zero = torch.zeros(self.outputs, dtype=torch.float64)
            prior = dist.Normal(zero, zero + (FLAT if flat else time_scale.brevity)).to_event(1)
            yield Site("offset", prior, ("output",))
        driving = self.inputs - self.direct
        order = tuple(u for u in scaling.input_order if u < driving)
        order = scaling.output_order if self.likelihood.follows_output else order
        yield from self.likelihood.sites(self.outputs, driving, flat=flat, order=order)
        if self.late:
            yield delay_site(self.late, scaling)

    def state_sites_of(self, suffix: str) -> tuple[Site, ...]:
        """Sites of what past inputs left at the first sample of a record.

        Args:
            suffix: of the record's sites: empty, or its number where there are several.
        """
        sites = []
        for w, layer in self.dynamic:
            if w in self.state_sites:
                zero = torch.zeros(len(layer.past_states), dtype=torch.float64)
                prior = dist.Normal(zero, zero + 1.0).to_event(1)
                name, dims = f"{w.name}_initial_state{suffix}", (w.dims["state"],)
                sites.append(Site(name, prior, dims, role="free", growth=0.0))
        return tuple(sites)

    def all_sites(self, scaling: Scaling, records: int) -> tuple[Site, ...]:
        """Sites of parameters and first states for so many training records."""
        suffixes = [""] if records == 1 else [f"_{index}" for index in range(records)]
        states = [site for suffix in suffixes for site in self.state_sites_of(suffix)]
        return (*self.sites(scaling), *states)

    def system(self, values: Values, scaling: Scaling) -> System:
        """All layers at values (*b, *shape) of the parameters' sites: no sampling, no Pyro.

        Args:
            values: of the sites of `sites`. scaling: of the training record.
        """
        layers: list[DynamicSystem | StaticSystem] = []
        for w in self.wires:
            if isinstance(w.layer, Dynamic):
                layers.append(self.dynamic_system(w, w.layer, values, scaling))
            elif isinstance(w.layer, Known):
                layers.append(StaticSystem(known_function(self, w, w.layer, values, scaling)))
            else:
                layers.append(self._static_system(w, w.layer, values, scaling))
        noise = self.likelihood.noise(values, self.outputs, self.inputs - self.direct)
        direct = values["direct"] if self.direct else None
        last = isinstance(self.output_wire.layer, Dynamic)
        offset = values["offset"] if last else None
        delays = None
        if self.late:
            delays = Delays(columns_of(self.late, scaling), values[DELAY])
        return System(self.wires, tuple(layers), noise, offset, direct, delays)

    def sample_system(self, scaling: Scaling) -> System:
        """Sample the parameters of all layers."""
        return self.system(sample(self.sites(scaling)), scaling)

    def dynamic_system(
        self, place: Wire, layer: Dynamic, values: Values, scaling: Scaling
    ) -> DynamicSystem:
        """One dynamic layer at values of its sites."""
        modes = self._modes_prior(place, layer, scaling).modes(values)
        memory = 1.0 / TimeScale.of(scaling).typical_rate
        if layer.real and place.fed:
            return DynamicSystem(modes, first_levels(modes))
        if place.fed and place.channels:
            return DynamicSystem(modes, past_input_covariance(modes, memory, place.channels))
        return DynamicSystem(modes, memory)

    def static_function(
        self, place: Wire, layer: Static, values: Values, scaling: Scaling | None = None
    ) -> StaticFunction:
        """The function of a static layer at values of its sites.

        Args:
            place, layer: which one. values: of its sites.
            scaling: of the training record, by default the model's.
        """
        function = self.static_prior(place, layer, scaling).function(values)
        if layer.limits is None:
            return function
        return replace(function, limits=scaled_limits(layer.limits, scaling or self.scaling))

    def _static_system(
        self, place: Wire, layer: Static, values: Values, scaling: Scaling
    ) -> StaticSystem:
        function = self.static_function(place, layer, values, scaling)
        if not self._has_residual(place):
            return StaticSystem(function)
        support = support_points(function, layer.support)
        return StaticSystem(function, support, values[f"{place.name}_residual"])

    def _modes_prior(self, place: Wire, layer: Dynamic, scaling: Scaling) -> ModesPrior:
        columns = columns_of(self.late, scaling) if place.sources == (INPUTS,) else ()
        return ModesPrior(
            place.name,
            inputs=place.channels + place.fed,
            pairs=layer.pairs,
            outputs=layer.width if layer.width > 1 else None,
            brownian=layer.brownian or layer.outputs,
            noise=layer.noise,
            feedthrough=layer.feedthrough,
            process_noise=layer.process_noise,
            time_scale=TimeScale.of(scaling),
            priors=self.priors,
            fed=place.fed,
            levels=layer.levels,
            late=tuple(column for column in columns if column < place.channels),
            reference=self.reference_of(layer, scaling),
            real=layer.real,
        )

    def static_prior(
        self, place: Wire, layer: Static, scaling: Scaling | None = None
    ) -> StaticPrior:
        """Prior of the function of a static layer."""
        return StaticPrior(
            place.name,
            channels=place.channels,
            outputs=layer.outputs,
            inducing=layer.inducing,
            kernel=layer.kernel,
            mean=layer.mean or "constant",
            learn_locations=layer.learn_locations,
            smoothness=layer.smoothness,
            order=self.order_of(place, scaling or self.scaling),
            least_lengthscale=layer.least_lengthscale,
        )

    def _has_residual(self, place: Wire) -> bool:
        """Whether what the inducing values leave open of a static layer is drawn, too."""
        return place.pathwise and self.integrate != "all"

    def __call__(self, records: Records) -> None:
        """Run the Pyro model on one record or on several.

        Args:
            records: with inputs and outputs; prepared ones are not checked again.
        """
        several = self.begun(self.prepare(records))
        system = self.sample_system(several[0].scaling)
        for index, record in enumerate(several):
            suffix = "" if len(several) == 1 else f"_{index}"
            here = self.begin(system, self.sample_states(suffix))
            outputs = output_process(here, record)
            if self.integrate == "all":
                y = record.observations if record.has_outputs else None
                pyro.sample(f"y{suffix}", outputs, obs=y)
            else:
                last = self.integrate == "last"
                observe_explicit(outputs, record, suffix, last_integrated=last)
            at = at_limits(self.layers, record.record)
            if at.any():
                pyro.factor(f"at_limits{suffix}", log_probability_scale(at, outputs))

    def begun(self, records: tuple[PreparedRecord, ...]) -> tuple[PreparedRecord, ...]:
        """Records as the density has them, see `PreparedRecord.begun`.

        Models without dead times, and those whose first states or trajectories are sites along the
        whole record, have all of it.
        """
        if not self.delayed or self.state_sites or self.integrate != "all":
            return records
        return tuple(record.begun if record.has_outputs else record for record in records)

    def sample_states(self, suffix: str) -> dict[str, Tensor]:
        """Sample what past inputs left at the first sample of a record, by layer."""
        values = sample(self.state_sites_of(suffix))
        return self.states_of(values, suffix)

    def states_of(self, values: Mapping[str, Tensor], suffix: str) -> dict[str, Tensor]:
        """Standard normal numbers (*b, 2P) behind the first state of a record, by layer."""
        layers = dict(self.dynamic)
        return {
            w.name: _placed(values[f"{w.name}_initial_state{suffix}"], layers[w])
            for w in self.state_sites
        }

    def begin(self, system: System, states: Mapping[str, Tensor]) -> System:
        """The system at the beginning of a record, as `initial_state` has it."""
        if self.initial_state == "zero":
            zeros = {
                w.name: torch.zeros(2 * layer.modes, dtype=torch.float64)
                for w, layer in self.dynamic
            }
            return system.after(zeros)
        return system.after(states)


def _placed(standard: Tensor, layer: Dynamic) -> Tensor:
    """Numbers of the states that past inputs moved among those of all (*b, 2P), others zero."""
    if len(layer.past_states) == 2 * layer.modes:
        return standard
    whole = standard.new_zeros((*standard.shape[:-1], 2 * layer.modes))
    return whole.index_copy(-1, torch.tensor(layer.past_states), standard)
