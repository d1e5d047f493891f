"""Starting points of a model that extends a fitted one: what is learnt, and what is new."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.starts.delays import with_delays
from pyro_dynogp.inference.starts.dynamic import Values
from pyro_dynogp.inference.starts.gains import moved_gains
from pyro_dynogp.inference.starts.linear import leading_layers, linear_twin, one_output
from pyro_dynogp.inference.starts.plans import Plan, starting_point
from pyro_dynogp.inference.starts.poles import grown, random_poles, values_given_poles
from pyro_dynogp.models.arrival import DELAY
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.wiring import Dynamic, Static
from pyro_dynogp.support.parallel import seeded

# Random sets of poles that are new, and how many of them linear models start from.
TRIES, KEPT = 24, 3


def extended_starts(
    base: Fitted, model: Model, records: Sequence[PreparedRecord], seed: int
) -> tuple[list[Values], Values]:
    """Starts at what a fit has learnt, and the values of what is new before that is taken over.

    A linear model keeps its poles; its gains come from least squares in one start, from the fit in
    another. Other models keep all values of the layers that they have in common with the fit, and
    what is new does nothing yet: new inputs have no gain, a new function is a straight line. A
    function on top of what was the last layer is also tried as the mean output given its input,
    as a line lets the dynamics first imitate what the function should do.

    Args:
        base: of a model that `model` extends. model, records: what is fitted.
        seed: of new poles.
    """
    scaling = records[0].scaling
    places = _places(base.model, model)
    learnt = {_renamed(site, places): value for site, value in base.mode.items()}
    learnt = moved_gains(learnt, base.model, model, places)
    sites = model.all_sites(scaling, len(records))
    dynamic = base.system_at(base.mode).dynamic
    both = zip(dynamic, base.model.dynamic, strict=True)  # poles of integrators follow the pairs
    old = {
        places.get(w.name): x.modes.poles[: own.pairs].numpy()
        for (w, x), (_, own) in both
        if not own.real  # which are no pairs
    }
    none = np.zeros(0, dtype=complex)
    if model.is_linear:
        ((wire, _),) = model.dynamic
        given = _given_poles(model, records, old.get(wire.name, none), learnt, seed)
        return [*given, grown(learnt, given[0])], given[0]
    leading = next(iter(leading_layers(model)), None)
    name, fresh, linear = None, None, None
    if leading is not None:
        assert isinstance(leading.layer, Dynamic)
        name = leading.name
        twin = linear_twin(model, leading.layer, scaling)
        training = records if twin.outputs == model.outputs else one_output(records)
        twin = replace(twin, scaling=training[0].scaling)
        (fresh, *_) = _given_poles(twin, training, old.get(name, none), learnt, seed)
        own = {_renamed(site, {name: "g"}): value for site, value in learnt.items()}
        linear = grown(own, fresh, twin.all_sites(training[0].scaling, len(training)))
    topped = isinstance(model.layers[-1], Static) and isinstance(base.model.layers[-1], Dynamic)
    hidden, before = (any(d.hidden for _, d in one.dynamic) for one in (model, base.model))
    rescaled = topped or (hidden and not before)
    plans = [Plan(name, fresh, False, seed), Plan(name, linear, False, seed)]
    if hidden:
        plans.append(Plan(name, linear, False, seed, ahead=False))
    elif topped and not model.has_feedback:
        plans.append(Plan(name, linear, True, seed))
    with seeded(seed):  # what has no typical value is drawn
        new, *starts = [starting_point(model, records, plan) for plan in plans]
    if rescaled and leading is not None:  # scaled as the other signals ask for
        learnt = {k: v for k, v in learnt.items() if not k.startswith(f"{leading.name}_")}
    return _distinct([grown(learnt, start, sites) for start in starts]), new


def _distinct(starts: Sequence[Values]) -> list[Values]:
    """Each start once: where no layer is new they do not differ."""
    found: list[Values] = []
    for start in starts:
        if not any(all(torch.equal(x, one[name]) for name, x in start.items()) for one in found):
            found.append(start)
    return found


def _given_poles(
    model: Model,
    records: Sequence[PreparedRecord],
    poles: np.ndarray,
    learnt: Values,
    seed: int,
) -> list[Values]:
    """Values of a linear model by least squares given its poles, and new ones, the best first.

    Inputs arrive after the dead times that are learnt, or typical ones.
    """
    scaling = records[0].scaling
    dead: Values = {}
    if model.late:
        known = learnt if len(learnt.get(DELAY, ())) == len(model.late) else None
        dead[DELAY], records = with_delays(model, records, known)
    ((_, layer),) = model.dynamic
    generator = np.random.default_rng(seed)
    kept, more = poles[: layer.pairs], max(0, layer.pairs - len(poles))
    found = []
    for _ in range(TRIES if more else 1):
        both = np.concatenate([kept, random_poles(more, scaling, generator)])
        found.append(values_given_poles(model, records, scaling, both))
    return [values | dead for _, values in sorted(found, key=lambda one: one[0])[:KEPT]]


def _places(base: Model, model: Model) -> dict[str, str]:
    """Names of layers in an extended model by their names in the model that it extends.

    They are the same where one model has all those of the other. Else the layer more is the first
    one where that is a function and was none before, else the last.
    """
    names, there = ({wire.name for wire in one.wires} for one in (base, model))
    if names <= there or there <= names:
        return {name: name for name in names & there}
    first = isinstance(model.layers[0], Static) and not isinstance(base.layers[0], Static)
    skipped = len(model.layers) - len(base.layers) if first else 0
    pairs = zip(base.wires, model.wires[skipped:], strict=False)
    return {old.name: new.name for old, new in pairs}


def _renamed(site: str, places: Mapping[str, str]) -> str:
    """Name of a layer's site where the layer has another name; that of any other site."""
    layer = max((name for name in places if site.startswith(f"{name}_")), key=len, default=None)
    return site if layer is None else places[layer] + site[len(layer) :]
