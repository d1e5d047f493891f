"""What the dimensions of the sites of a model are called, and the labels along them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pyro_dynogp.criticism.labelled import Coordinate, clock_of
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.models.arrival import LATE
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.selection import part, signal_of
from pyro_dynogp.models.wiring import INPUTS

# The two numbers of a gain (see `sample_modes`), and of a complex number.
TERM = ("derivative", "steady state")
PART = ("real", "imaginary")


def site_dimensions(
    model: Model, scaling: Scaling, records: Sequence[Record]
) -> dict[str, tuple[str, ...]]:
    """Names of the dimensions of each site of a model, and of its trajectories."""
    # With what is drawn beside the parameters.
    explicit = model if model.has_feedback else replace(model, integrate="none")
    out = {site.name: site.dims for site in explicit.all_sites(scaling, len(records))}
    for wire in model.wires:
        several = (wire.dims["output"],) if wire.layer.outputs > 1 else ()
        for suffix in suffixes_of(records):
            out[f"{wire.name}{suffix}"] = (f"time{suffix}", *several)
    return out


def suffixes_of(records: Sequence[Record]) -> tuple[str, ...]:
    """What is added to the names of what belongs to one of several records."""
    return ("",) if len(records) == 1 else tuple(f"_{index}" for index in range(len(records)))


def labels_of(model: Model, scaling: Scaling, records: Sequence[Record]) -> dict[str, Coordinate]:
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
    signals = {INPUTS: scaling.input_names}
    for wire in model.wires:
        for name, width in wire.signals.items():
            several = tuple(f"{name}[{a}]" for a in range(width))
            signals[name] = several if width > 1 else (name,)
        if len(wire.signals) > 1:
            dim, own = wire.dims["output"], [signals[name] for name in wire.signals]
            labels[dim] = (dim, np.array([label for names in own for label in names]), {})
    for wire in model.wires:
        sources = [(source, signals[signal_of(source)]) for source in wire.sources]
        seen = tuple(label for one, names in sources for label in names[part(one, len(names))])
        fed = tuple(label for source in wire.feedback for label in signals[source])
        for role, names in (("direct", seen), ("input", seen + fed)):
            dim = wire.dims[role]
            if dim != "input" and names:
                labels[dim] = (dim, np.array(names), {})
    late = {channel.names[0] for channel in model.late}
    for dim, chosen in ((LATE, True), ("prompt input", False)):
        names = tuple(n for n in scaling.input_names if (n in late) == chosen) if late else ()
        if names:
            labels[dim] = (dim, np.array(names), {})
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
