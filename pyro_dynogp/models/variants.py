"""A model with one block more: pure functions from models to models."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from pyro_dynogp.data.channels import Channel, count_direct
from pyro_dynogp.layers.noise import Likelihood
from pyro_dynogp.models.layer import INDUCING
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.product import Product, factors
from pyro_dynogp.models.wiring import (
    INPUTS,
    Dynamic,
    Layer,
    Limits,
    Static,
    StaticLayer,
    Wire,
)


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


def without_change_of(model: Model, other: Model, base: Model) -> Model | None:
    """The model without the channels and poles that another one adds to a base.

    None where that one adds none or differs in more than them, and where the model lacks one of
    them, or has another channel that is made from one.
    """
    added = [channel for channel in other.channels if channel not in base.channels]
    made = {name for channel in added for name in channel.names}
    kept = [channel for channel in model.channels if channel not in added]
    if len(model.channels) - len(kept) < len(added):
        return None
    if made & {value for one in kept for value in vars(one).values() if isinstance(value, str)}:
        return None
    more = {wire.name: _poles(layer) - _poles_of(base, wire) for wire, layer in other.dynamic}
    for channel in added:
        other, model = without_channel(other, channel), without_channel(model, channel)
    there = all((_poles_of(model, wire) >= _poles(layer)).all() for wire, layer in other.dynamic)
    if not there or not (added or any(count.any() for count in more.values())):
        return None

    def less(wire: Wire, layer: Dynamic) -> Dynamic:
        pairs, integrators = _poles(layer) - more.get(wire.name, 0)
        return replace(layer, pairs=int(pairs), integrators=int(integrators))

    return with_dynamics(model, less) if with_dynamics(other, less) == base else None


def _poles(layer: Dynamic) -> np.ndarray:
    """Pairs and integrators."""
    return np.array([layer.pairs, layer.integrators])


def _poles_of(model: Model, wire: Wire) -> np.ndarray:
    """The same of the layer with the name of another, none where there is none."""
    same = (_poles(layer) for own, layer in model.dynamic if own.name == wire.name)
    return next(same, np.zeros(2))


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
