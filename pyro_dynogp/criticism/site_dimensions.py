"""What the dimensions of the sites of a model are called, and the labels along them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pyro_dynogp.criticism.labelled import Coordinate, clock_of
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.models.linear import LinearDynamicGP
from pyro_dynogp.models.model import Cascade
from pyro_dynogp.models.wiring import INPUTS, Dynamic, Layer

# The two numbers of a gain (see `sample_modes`), and of a complex number.
TERM = ("derivative", "steady state")
PART = ("real", "imaginary")


@dataclass(frozen=True)
class Place:
    """A layer and the names of its dimensions.

    Attributes:
        name: prefix of its sites. layer: what it is.
        inputs: name of the dimension of what it sees. outputs: of what it gives.
        alone: whether it is the only dynamic, or the only static, layer.
        channels: labels of what it sees.
    """

    name: str
    layer: Layer
    inputs: str
    outputs: str
    alone: bool
    channels: tuple[str, ...]

    def own(self, dim: str) -> str:
        """Name of a dimension that other layers of its kind have with another length."""
        return dim if self.alone else f"{self.name}_{dim}"


def places_of(model: LinearDynamicGP | Cascade, scaling: Scaling) -> tuple[Place, ...]:
    """All layers of a model; a linear one is a dynamic layer g."""
    if isinstance(model, LinearDynamicGP):
        layer = Dynamic(outputs=model.outputs, pairs=model.pairs)
        return (Place("g", layer, "input", "output", True, scaling.input_names),)
    widths = {INPUTS: scaling.input_names}
    places = []
    for one in model.wires:
        kinds = [type(layer) for layer in model.layers]
        places.append(
            Place(
                one.name,
                one.layer,
                "input" if one.sources == (INPUTS,) else f"{one.name}_input",
                "output" if one.last else f"{one.name}_output",
                kinds.count(type(one.layer)) == 1,
                tuple(label for source in one.sources for label in widths[source]),
            )
        )
        several = one.layer.outputs > 1
        widths[one.name] = tuple(
            f"{one.name}[{a}]" if several else one.name for a in range(one.layer.outputs)
        )
    return tuple(places)


def site_dimensions(
    model: LinearDynamicGP | Cascade, scaling: Scaling, records: Sequence[Record]
) -> dict[str, tuple[str, ...]]:
    """Names of the dimensions of each site that a model may have, and of its trajectories.

    Sites that are not here, hyperparameters of a user's kernel, have no names for theirs.
    """
    out: dict[str, tuple[str, ...]] = {"offset": ("output",), "noise_sd": ("output",)}
    suffixes = suffixes_of(records)
    for place in places_of(model, scaling):
        name, several = place.name, place.layer.outputs > 1
        if isinstance(place.layer, Dynamic):
            out |= _dynamic(place)
        else:
            own_kernel = place.layer.kernel is not None
            out |= _static(name, place.inputs, place.outputs, place.own("inducing"), own_kernel)
            out[f"{name}_residual"] = (place.outputs, place.own("support"))
        for suffix in suffixes:
            out[f"{name}{suffix}"] = (f"time{suffix}", *([place.outputs] if several else []))
            linear = isinstance(model, LinearDynamicGP)
            state = f"initial_state{suffix}" if linear else f"{name}_initial_state{suffix}"
            out[state] = (place.own("state"),)
    follows = isinstance(model, Cascade) and model.likelihood.of == "output"
    driver = "output" if follows else "input"
    return out | _static("log_noise", driver, "output", "log_noise_inducing", False)


def _dynamic(place: Place) -> dict[str, tuple[str, ...]]:
    pair, brownian = place.own("pair"), place.own("brownian")
    several = place.layer.outputs > 1
    sites = {
        "log_decay": (pair,),
        "log_frequency": (pair,),
        "input_gain": (pair, place.inputs, "term"),
        "output_gain": (place.outputs, pair, "part"),
        "feedthrough": (place.outputs, place.inputs) if several else (place.inputs,),
        "noise_gain_local_scale": (pair,),
        "noise_gain_unit": (pair, brownian, "term"),
    }
    return {f"{place.name}_{site}": dims for site, dims in sites.items()}


def _static(
    name: str, inputs: str, outputs: str, inducing: str, own_kernel: bool
) -> dict[str, tuple[str, ...]]:
    sites: dict[str, tuple[str, ...]] = {
        "output_scale": (outputs,),
        "constant": (outputs,),
        "slope": (outputs, inputs),
        "center": (inputs,),
        "half_width": (inputs,),
        "locations": (inducing, inputs),
        "values": (outputs, inducing),
    }
    if not own_kernel:
        sites["lengthscale"] = (inputs,)
    return {f"{name}_{site}": dims for site, dims in sites.items()}


def suffixes_of(records: Sequence[Record]) -> tuple[str, ...]:
    """What is added to the names of what belongs to one of several records."""
    return ("",) if len(records) == 1 else tuple(f"_{index}" for index in range(len(records)))


def labels_of(
    model: LinearDynamicGP | Cascade, scaling: Scaling, records: Sequence[Record]
) -> dict[str, Coordinate]:
    """Labels of all dimensions that have a meaning: channels with their units, time, terms."""
    labels: dict[str, Coordinate] = {
        "term": ("term", np.array(TERM), {}),
        "part": ("part", np.array(PART), {}),
    }
    channels = {
        "input": (scaling.input_names, scaling.input_units),
        "output": (scaling.output_names, scaling.output_units),
    }
    for dim, (names, units) in channels.items():
        if names:
            labels[dim] = (dim, np.array(names), {})
            labels[f"{dim}_unit"] = (dim, np.array(units), {})
    for place in places_of(model, scaling):
        if place.inputs != "input" and place.channels:
            labels[place.inputs] = (place.inputs, np.array(place.channels), {})
    for suffix, record in zip(suffixes_of(records), records, strict=True):
        labels |= clock_of(record, f"time{suffix}")
    return labels


def dimensions_for(
    name: str, shape: Sequence[int], known: dict[str, tuple[str, ...]]
) -> tuple[str, ...]:
    """Names of the dimensions of a site, numbered ones (as ArviZ's) where it has none of its own.

    Args:
        name: of the site. shape: of one draw. known: as `site_dimensions` has them.
    """
    return known.get(name, tuple(f"{name}_dim_{axis}" for axis in range(len(shape))))
