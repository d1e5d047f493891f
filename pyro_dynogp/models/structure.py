"""What a model is made of: layers in their places, noise, channels; and which records fit it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, Self, TypedDict, cast, get_args

from pyro_dynogp.data.channels import Channel, Delayed, count_direct, prepared
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.records import as_records
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.layers.noise import Gaussian, Likelihood
from pyro_dynogp.models.arrival import free_delays
from pyro_dynogp.models.prepared import PreparedRecord, Records
from pyro_dynogp.models.priors import PriorName
from pyro_dynogp.models.selection import place_of
from pyro_dynogp.models.wiring import (
    INPUTS,
    Dynamic,
    Known,
    Layer,
    Static,
    StaticLayer,
    Wire,
    substeps_of,
    wire,
)
from pyro_dynogp.support.errors import instance, invalid, one_of, verify, whole

Integrate = Literal["none", "last", "all"]
InitialState = Literal["auto", "site", "integrated", "zero"]


class ModelOptions(TypedDict, total=False):
    """Arguments of `Model` that every architecture takes by name."""

    initial_state: InitialState
    integrate: Integrate
    priors: PriorName
    direct: int
    channels: tuple[Channel, ...]
    scaling: Scaling | None
    output: str | None


@dataclass(frozen=True)
class Structure:
    """What a model is made of. The fields are the arguments of `Model`.

    Raises:
        ValueError: on layers that do not fit together, or unknown options.
    """

    inputs: int
    layers: tuple[Layer, ...]
    likelihood: Likelihood = field(default_factory=Gaussian)
    initial_state: InitialState = "auto"
    integrate: Integrate = "none"
    priors: PriorName = "default"
    direct: int = 0
    channels: tuple[Channel, ...] = ()
    scaling: Scaling | None = None
    output: str | None = None

    def __post_init__(self) -> None:
        verify(inputs=self.inputs)
        for name in ("layers", "channels"):
            given = getattr(self, name)
            if not isinstance(given, Sequence) or isinstance(given, str):
                raise invalid(name, expected="a tuple", got=repr(given))
            object.__setattr__(self, name, tuple(given))
        for channel in self.channels:
            instance("channels", channel, Channel)
        if self.scaling is not None:
            instance("scaling", self.scaling, Scaling)
        object.__setattr__(self, "channels", tuple(self.channels))
        if not isinstance(self.likelihood, Likelihood):
            raise invalid(
                "likelihood",
                expected="Gaussian(), StudentT(...) or Heteroscedastic(...)",
                got=repr(self.likelihood),
            )
        one_of(get_args(PriorName)).check("priors", self.priors)
        one_of(get_args(Integrate)).check("integrate", self.integrate)
        one_of(get_args(InitialState)).check("initial_state", self.initial_state)
        whole(count_direct(self.channels), self.inputs).check("direct", self.direct)
        free_delays(self.channels)  # refuses what is made from them
        end = self.output_wire.layer  # placing the layers refuses those that do not fit together
        if self.is_linear and isinstance(end, Dynamic) and end.real:
            raise invalid(
                f"real of layer {self.wires[0].name!r}",
                expected="False in a model without static layers",
                got="True",
                advice="Pairs can have real poles as well.",
            )
        if self.has_feedback:
            _check_feedback(self.integrate, self.likelihood)
        if self.late and self.substeps > 1:
            raise invalid(
                "substeps", expected="1 beside a dead time that is a parameter",
                got=repr(self.substeps), advice="Give Delayed its dead time, or use substeps=1.",
            )  # fmt: skip
        if self.integrate == "last" and not (
            isinstance(end, Dynamic) and self.likelihood == Gaussian() and not self.direct
        ):
            raise invalid(
                "integrate",
                expected="'none' or 'all': only a dynamic last layer under constant Gaussian "
                "noise and without direct inputs can be integrated by itself",
                got="'last'",
            )

    @cached_property
    def wires(self) -> tuple[Wire, ...]:
        """The layers in their places, with names."""
        return wire(self.inputs - self.direct, self.layers, self.output)

    @property
    def output_wire(self) -> Wire:
        """The layer whose output is measured, in its place."""
        return next(w for w in self.wires if w.last)

    @property
    def measured_signal(self) -> str | None:
        """The signal that is in the units of the outputs, less an offset; None where there is none.

        The output, if it is a dynamic layer's; what a known function sees whose output it is.
        """
        wire = self.output_wire
        if isinstance(wire.layer, Dynamic):
            return wire.name
        sees = isinstance(wire.layer, Known) and (wire.channels, self.outputs) == (1, 1)
        return wire.sources[0] if sees and wire.reads.isdisjoint((INPUTS,)) else None

    @property
    def late(self) -> tuple[Delayed, ...]:
        """Channels whose dead time is a parameter, an entry of the site ``delay``."""
        return free_delays(self.channels)

    @property
    def delayed(self) -> tuple[Delayed, ...]:
        """Channels that act after a dead time, given or free."""
        return tuple(channel for channel in self.channels if isinstance(channel, Delayed))

    @property
    def has_feedback(self) -> bool:
        """Whether a static layer's output comes back to an earlier layer."""
        return any(w.feedback for w in self.wires)

    @property
    def has_real_poles(self) -> bool:
        """Whether a dynamic layer has real poles in place of pairs."""
        return any(isinstance(layer, Dynamic) and layer.real for layer in self.layers)

    @property
    def substeps(self) -> int:
        """Parts of each interval between samples in which feedback is computed anew."""
        return substeps_of(self.wires)

    @property
    def outputs(self) -> int:
        """n_y, the width of the layer that is measured."""
        return self.output_wire.layer.outputs

    @property
    def several_outputs(self) -> bool:
        """Whether outputs have a dimension of their own."""
        return self.outputs > 1

    def reference_of(self, layer: Dynamic, scaling: Scaling) -> int:
        """Place of the signal of a layer by which phases of its modes are told.

        The record's reference output where signals are as many as outputs, else the first one.
        """
        return scaling.reference_output if layer.outputs == self.outputs else 0

    def order_of(self, place: Wire, scaling: Scaling | None) -> tuple[int, ...] | None:
        """Places of a layer's channels in an order that does not depend on the record's.

        Source by source: inputs and what is as many as outputs by how smooth the record's are,
        others as they come. None for a single channel, and without a scaling.
        """
        if scaling is None or place.channels < 2:
            return None
        widths = {name: n for w in self.wires for name, n in w.signals.items()}
        widths[INPUTS] = self.inputs - self.direct
        order: list[int] = []
        for source in place.sources:
            known: tuple[int, ...] = (0,)
            if source == INPUTS:
                known = tuple(u for u in scaling.input_order if u < widths[INPUTS])
            elif place_of(source) is None:
                known = self.order_of_signals(widths[source], scaling)
            order += [len(order) + channel for channel in known]
        return tuple(order)

    def order_of_signals(self, count: int, scaling: Scaling) -> tuple[int, ...]:
        """Places of so many signals: as the record's outputs, where they are as many."""
        return scaling.output_order if count == self.outputs else tuple(range(count))

    @property
    def is_linear(self) -> bool:
        """Whether it is one layer of linear dynamics, whatever the noise."""
        return len(self.layers) == 1 and isinstance(self.layers[0], Dynamic)

    @property
    def has_function(self) -> bool:
        """Whether there is a static layer."""
        return any(isinstance(layer, StaticLayer) for layer in self.layers)

    @property
    def learns_function(self) -> bool:
        """Whether a static layer is a Gaussian process, or one in feedback has parameters."""
        back = {name for wire in self.wires for name in wire.feedback}
        return self.has_gaussian_process or any(
            isinstance(w.layer, Known) and bool(w.layer.parameters) and w.name in back
            for w in self.wires
        )

    @property
    def has_gaussian_process(self) -> bool:
        """Whether there is a static layer whose function is a Gaussian process."""
        return any(isinstance(layer, Static) for layer in self.layers)

    @property
    def dynamic(self) -> tuple[tuple[Wire, Dynamic], ...]:
        """The dynamic layers in their places, first to last."""
        return tuple((w, w.layer) for w in self.wires if isinstance(w.layer, Dynamic))

    @property
    def seen_by_functions(self) -> tuple[Wire, ...]:
        """Dynamic layers with inputs whose trajectory a static layer sees, also through others."""
        names = {
            name
            for place, reader in enumerate(self.wires)
            if any(isinstance(w.layer, StaticLayer) for w in self.wires[place:])
            for name in reader.reads
        }
        return tuple(
            w for w, _ in self.dynamic if w.channels + w.fed and not names.isdisjoint(w.signals)
        )

    @property
    def state_sites(self) -> tuple[Wire, ...]:
        """Dynamic layers whose first state is a site."""
        if self.initial_state == "site":
            return tuple(w for w, _ in self.dynamic if w.channels + w.fed)
        return self.seen_by_functions if self.initial_state == "auto" else ()

    @property
    def collapsed(self) -> Self:
        """The same model with all trajectories integrated out."""
        return replace(self, integrate="all")

    def scaled_to(self, records: Record | Sequence[Record]) -> Self:
        """The same model with the scaling of the given training record(s)."""
        return replace(self, scaling=Scaling.from_records(self._with_channels(records)))

    def _with_channels(self, records: Record | Sequence[Record]) -> tuple[Record, ...]:
        return tuple(prepared(record, self.channels) for record in as_records(records))

    def check(self, records: Record | Sequence[Record]) -> tuple[Record, ...]:
        """Records with the model's channels, whose channels and units fit the model.

        Raises:
            ValueError: where the number of channels or a unit differs.
        """
        checked = self._with_channels(records)
        for record in checked:
            for what, expected, got in (
                ("inputs", self.inputs, record.n_inputs),
                ("outputs", self.outputs, record.n_outputs or self.outputs),
            ):
                if expected != got:
                    raise invalid(
                        "record",
                        expected=f"{expected} {what}, as the model has",
                        got=f"{got}",
                        advice=f"Choose channels with record.select(...) or set {what}={got}.",
                    )
            if self.scaling is not None:
                self.scaling.check(record, outputs=record.n_outputs > 0)
        return checked

    def prepare(self, records: Records) -> tuple[PreparedRecord, ...]:
        """Records as the model sees them; those that are prepared already as they are.

        Args:
            records: one or several. A model without a scaling learns it from them.

        Raises:
            ValueError: as of `check`; where they are prepared with another scaling.
        """
        several = records if isinstance(records, Sequence) else ()
        ready = [record for record in several if isinstance(record, PreparedRecord)]
        if ready and len(ready) == len(several):
            if any(self.scaling not in (None, record.scaling) for record in ready):
                expected = "records prepared with the model's scaling"
                raise invalid("records", expected=expected, got="another scaling")
            return tuple(ready)
        checked = self.check(cast(Record | Sequence[Record], records))
        scaling = self.scaling or Scaling.from_records(checked)
        delayed = bool(self.delayed) and not self.state_sites
        return tuple(PreparedRecord.of(record, scaling, delayed=delayed) for record in checked)


def _check_feedback(integrate: Integrate, likelihood: Likelihood) -> None:
    """Whether a model with feedback can do with these options.

    Raises:
        ValueError: on trajectories as sites, or noise that varies with the output.
    """
    if integrate != "all":
        raise invalid(
            "integrate",
            expected="'all' for a model with feedback, whose trajectories depend on each other "
            "sample by sample and cannot be sample sites",
            got=repr(integrate),
        )
    if likelihood.follows_output:
        raise invalid(
            "likelihood",
            expected="noise of constant size, or one that varies with the inputs, for a model with "
            "feedback",
            got=repr(likelihood),
        )
