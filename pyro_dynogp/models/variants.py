"""A model with one block more: pure functions from models to models."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from pyro_dynogp.data.channels import Channel, count_direct
from pyro_dynogp.layers.noise import Likelihood
from pyro_dynogp.models.forms import Form, form_of, forms_of, usual_substeps
from pyro_dynogp.models.layer import INDUCING, fed_back
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.product import Product, factors, is_product
from pyro_dynogp.models.wiring import (
    HIDDEN,
    INPUTS,
    Dynamic,
    Known,
    Layer,
    Limits,
    Static,
    StaticLayer,
    Wire,
)

# Names of functions that act back: of a layer's output, and of a signal of it that is hidden, and
# of a step of the latter, and products of inputs with the output or with the hidden signal.
FEEDBACK, HIDDEN_FEEDBACK, STEP = "feedback", "hidden_feedback", "feedback_step"
PRODUCT, HIDDEN_PRODUCT = "feedback_product", "hidden_product"


def with_channel(model: Model, channel: Channel) -> Model:
    """The model with a channel more, or with one that replaces an input."""
    more = 0 if channel.replaces else len(channel.names)
    return replace(
        model,
        layers=_layers_of(model, more - count_direct([channel])),
        inputs=model.inputs + more,
        direct=model.direct + count_direct([channel]),
        channels=(*model.channels, channel),
    )


def with_channels(model: Model, channels: Iterable[Channel]) -> Model:
    """The model with several channels more, each of which may build on those before it."""
    return functools.reduce(with_channel, channels, model)


def without_channel(model: Model, channel: Channel) -> Model:
    """The model without a channel that no other one builds on."""
    less = 0 if channel.replaces else len(channel.names)
    return replace(
        model,
        layers=_layers_of(model, count_direct([channel]) - less),
        inputs=model.inputs - less,
        direct=model.direct - count_direct([channel]),
        channels=tuple(other for other in model.channels if other != channel),
    )


def _layers_of(model: Model, more: int) -> tuple[Layer, ...]:
    """The layers with so many driving inputs more: products are of all of them."""

    def wider(layer: Layer) -> Layer:
        first = factors(layer)
        if not (first and layer.sees[:1] == (INPUTS,)):
            return layer
        others = layer.outputs // first
        return Product(first + more, others, sees=layer.sees, skip=layer.skip, name=layer.name)

    return tuple(wider(layer) for layer in model.layers)


def with_channels_of(model: Model, other: Model, base: Model) -> Model | None:
    """The model with the channels that another one adds to a base.

    None where that one adds none or differs in more than them, and where the model has others than
    the base: what they replace has another name.
    """
    if model.channels != base.channels:
        return None
    added = other.channels[len(base.channels) :]
    return with_channels(model, added) if added and with_channels(base, added) == other else None


def without_channels_of(model: Model, other: Model, base: Model) -> Model | None:
    """The model without the channels that another one adds to a base.

    None where that one adds none or differs in more than them, and where the model lacks one of
    them, or has another that is made from it.
    """
    added = [channel for channel in other.channels if channel not in base.channels]
    made = {name for channel in added for name in channel.names}
    kept = [channel for channel in model.channels if channel not in added]
    if len(model.channels) - len(kept) < len(added):
        return None
    if made & {value for one in kept for value in vars(one).values() if isinstance(value, str)}:
        return None
    for channel in added:
        other, model = without_channel(other, channel), without_channel(model, channel)
    return model if added and other == base else None


def with_dynamics(model: Model, change: Callable[[Wire, Dynamic], Dynamic]) -> Model:
    """The model with other dynamic layers."""
    layers = tuple(
        change(wire, layer) if isinstance(layer, Dynamic) else layer
        for wire, layer in zip(model.wires, model.layers, strict=True)
    )
    return replace(model, layers=layers)


def with_pairs(model: Model, count: int) -> Model:
    """The model with more pairs of poles in every dynamic layer."""
    return with_dynamics(model, lambda _, layer: replace(layer, pairs=layer.pairs + count))


def with_integrator(model: Model) -> Model | None:
    """The model with a pole at zero in its last dynamic layer.

    None where there is one already or no such layer, and beside real poles.
    """
    if not model.dynamic or not model.dynamic[-1][0].channels:
        return None
    last = model.dynamic[-1][0].name
    if model.has_real_poles or any(layer.integrators for _, layer in model.dynamic):
        return None
    return with_dynamics(
        model, lambda wire, layer: replace(layer, integrators=1) if wire.name == last else layer
    )


def with_process_noise(model: Model) -> Model:
    """The model with process noise in every dynamic layer."""
    return with_dynamics(model, lambda _, layer: replace(layer, process_noise=True))


def without_process_noise(model: Model) -> Model:
    """The model with deterministic dynamics, but where process noise is all that drives them."""
    return with_dynamics(
        model,
        lambda wire, layer: replace(layer, process_noise=False) if wire.channels else layer,
    )


def without_noise_below_functions(model: Model) -> Model:
    """The model with deterministic dynamics; the same one where no static layer sees noise.

    Layers that nothing else drives keep their process noise.
    """
    static = [place for place, layer in enumerate(model.layers) if isinstance(layer, StaticLayer)]
    below = model.layers[: static[-1] if static else 0]
    seen = any(isinstance(layer, Dynamic) and layer.process_noise for layer in below)
    return without_process_noise(model) if seen else model


def has_process_noise(model: Model) -> bool:
    """Whether every dynamic layer has process noise."""
    return all(layer.process_noise for _, layer in model.dynamic)


def with_output_function(model: Model, limits: Limits | None = None) -> Model | None:
    """The model with a static layer after its last dynamic one.

    None where there is one already, or feedback. Its prior mean is a straight line, to which it
    goes back beyond the data; or one that stops at limits [output].
    """
    if isinstance(model.layers[-1], StaticLayer) or model.has_feedback:
        return None
    last = Static(outputs=model.outputs, inducing=INDUCING, mean="linear", limits=limits)
    return replace(model, layers=(*model.layers, last), scaling=None, output=None)


def with_input_function(model: Model) -> Model | None:
    """The model with a static layer before its first dynamic one.

    None where there is one already, or feedback, or layers name what they see.
    """
    driving = model.inputs - model.direct
    if (
        any(layer.sees for layer in model.layers)
        or isinstance(model.layers[0], StaticLayer)
        or model.has_feedback
        or not driving
    ):
        return None
    first = Static(outputs=driving, inducing=INDUCING)
    return replace(model, layers=(first, *model.layers), scaling=None, output=None)


def with_feedback(
    model: Model, *, output: bool = True, hidden: bool = False, step: bool = True
) -> Model | None:
    """The model with static layers that see its last dynamic layer and act back on it.

    Static layers may follow that layer: they are what measures it. None where there is nothing to
    add, with feedback to another layer, and under noise that feedback does not allow.

    Args:
        model: to extend. output: whether one function sees the output of the layer.
        hidden: whether one sees a further signal of the same states, which nothing measures.
        step: whether a step of that comes back as well.
    """
    if not model.dynamic:
        return None
    seen, layer = model.dynamic[-1]
    own, unseen = (seen.name,), (seen.name + HIDDEN,)
    back: list[Static | Known] = []
    if output:
        back.append(fed_back(layer.outputs, sees=own, name=FEEDBACK))
    if hidden:
        back.append(fed_back(1, sees=unseen, name=HIDDEN_FEEDBACK))
        back += [Form("step", sees=unseen, name=STEP)] if step else []
    return _fed_back(model, back, hidden=hidden)


def with_forms(model: Model, *, hidden: bool = False) -> Model | None:
    """The model with parametric forms of its last dynamic layer that act back on it.

    None for several outputs or hidden signals, and where `with_feedback` is None.

    Args:
        model: to extend. hidden: whether some see a further signal of the same states, which
            nothing measures; see `forms_of`.
    """
    if not model.dynamic:
        return None
    seen, layer = model.dynamic[-1]
    if layer.outputs > 1 or layer.hidden > 1:
        return None
    return _fed_back(model, forms_of(seen.name, hidden=hidden), hidden=hidden)


def with_products(model: Model, *, hidden: bool = False) -> Model | None:
    """The model with products of inputs and its last dynamic layer's output that act back on it.

    None without inputs, and where `with_feedback` is None.

    Args:
        model: to extend. hidden: whether inputs multiply a further signal of the same states, which
            nothing measures, in place of the output.
    """
    driving = model.inputs - model.direct
    if not model.dynamic or not driving:
        return None
    seen, layer = model.dynamic[-1]
    other, count = seen.name, layer.outputs
    if hidden:
        other, count = seen.name + HIDDEN, max(layer.hidden, 1)
    name = HIDDEN_PRODUCT if hidden else PRODUCT
    extended = _fed_back(
        model, [Product(driving, count, sees=(INPUTS, other), name=name)], hidden=hidden
    )
    return None if extended is None else with_usual_substeps(extended)


def noise_allows_feedback(model: Model) -> bool:
    """Whether functions may be put in feedback beside the model's measurement noise."""
    return model.likelihood.gaussian and not model.likelihood.follows_output


def _fed_back(model: Model, given: Sequence[Static | Known], *, hidden: bool) -> Model | None:
    """The model with functions that act back on its last dynamic layer, but those that do.

    Args:
        hidden: whether one sees a signal that nothing measures.
    """
    seen, layer = model.dynamic[-1]
    if not noise_allows_feedback(model) or (hidden and layer.real):
        return None
    sources = {wire.name: wire.sources for wire in model.wires}
    before = {sources[name] for name in layer.feedback}
    back = [one for one in given if one.sees not in before]
    if not back or (model.has_feedback and not layer.feedback):
        return None
    names = (*layer.feedback, *(str(one.name) for one in back))
    layers: list[Layer] = []
    for wire, other in zip(model.wires, model.layers, strict=True):
        sees = () if wire.sources == (INPUTS,) and not layers else wire.sources
        if isinstance(other, Dynamic) and wire.name == seen.name:
            other = replace(other, feedback=names, hidden=max(layer.hidden, int(hidden)))
        layers.append(replace(other, name=wire.name, sees=sees, skip=()))
        layers += back if wire.name == seen.name else []
    return replace(
        model, layers=tuple(layers), scaling=None, output=model.output_wire.name, integrate="all"
    )


def with_usual_substeps(model: Model, base: Model | None = None) -> Model:
    """The model with feedback computed as often between samples as is usual for what is in it.

    As it is where it extends a base that has fewer: whoever made that one wants it so.
    """
    if base is not None and with_usual_substeps(base) != base:
        return model

    def finer(_: Wire, layer: Dynamic) -> Dynamic:
        forms = any(
            w.name in layer.feedback and (form_of(w.layer) is not None or is_product(w.layer))
            for w in model.wires
        )
        parts = usual_substeps(model.channels, forms=forms)
        return replace(layer, substeps=max(layer.substeps, parts))

    return with_dynamics(model, finer)


def have_same_parameters(model: Model, other: Model) -> bool:
    """Whether two models differ in their units, and how often they compute feedback, at most."""
    one, two = (
        with_dynamics(replace(m, scaling=None), lambda _, layer: replace(layer, substeps=1))
        for m in (model, other)
    )
    return one == two


def with_likelihood(model: Model, likelihood: Likelihood) -> Model:
    """The model with other measurement noise."""
    return replace(model, likelihood=likelihood, scaling=None)


def used_channels(model: Model) -> set[str]:
    """Names that the model's channels are made from or make."""
    names: set[str] = set()
    for channel in model.channels:
        names |= set(channel.names)
        for field in ("channel", "first", "second"):
            names |= {str(getattr(channel, field))} if hasattr(channel, field) else set()
    return names
