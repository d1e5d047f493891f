"""Gains that are learnt, in the places that they have in a model with more inputs."""

from __future__ import annotations

from collections.abc import Mapping

from pyro_dynogp.inference.starts.dynamic import Values
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.wiring import Wire

# Sites of gains by the ends of their names, and along which axis inputs go.
AXES = {"_input_gain": 1, "_integrator_gain": -1}


def moved_gains(learnt: Values, base: Model, model: Model, places: Mapping[str, str]) -> Values:
    """What is learnt, with room for inputs that are new before what comes back to a layer.

    Gains of what comes back follow those of the inputs. New inputs have no gain, nor have their
    products; all others keep theirs.

    Args:
        learnt: values by the names that sites have in the larger model. base, model: the smaller
            and the larger one. places: names of layers in the larger one by those in the smaller.
    """
    larger = {wire.name: wire for wire in model.wires}
    moved = dict(learnt)
    for wire, _ in base.dynamic:
        other = larger.get(places.get(wire.name, ""))
        if other is None or not wire.fed or other.channels <= wire.channels:
            continue
        columns = [*range(wire.channels), *_fed_back(wire, other, base, model, places)]
        for ending, axis in AXES.items():
            site = f"{other.name}{ending}"
            if site in learnt:
                old = learnt[site].movedim(axis, 0)
                gain = old.new_zeros(other.channels + other.fed, *old.shape[1:])
                gain[columns] = old
                moved[site] = gain.movedim(0, axis)
    return moved


def _fed_back(
    wire: Wire, other: Wire, base: Model, model: Model, places: Mapping[str, str]
) -> list[int]:
    """Where in the larger model's gains those are of what comes back in the smaller one."""
    width, before = (
        {one.name: one.layer.outputs for one in given.wires} for given in (model, base)
    )
    first, at = {}, other.channels
    for name in other.feedback:
        first[name] = at
        at += width[name]
    return [first[places[name]] + k for name in wire.feedback for k in range(before[name])]
