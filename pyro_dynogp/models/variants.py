"""A model with one block more: pure functions from models to models."""

from __future__ import annotations

from dataclasses import replace

from pyro_dynogp.data.channels import Channel, count_direct
from pyro_dynogp.inference.methods.mode import deterministic
from pyro_dynogp.layers.noise import Likelihood
from pyro_dynogp.models.linear import LinearDynamicGP
from pyro_dynogp.models.model import Cascade
from pyro_dynogp.models.wiring import Dynamic, Limits, Static

Model = LinearDynamicGP | Cascade
# Inducing values of a function that is added.
INDUCING = 32


def with_channel(model: Model, channel: Channel) -> Model:
    """The model with a channel more, or with one that replaces an input."""
    more = 0 if channel.replaces else len(channel.names)
    return replace(
        model,
        inputs=model.inputs + more,
        direct=model.direct + count_direct([channel]),
        channels=(*model.channels, channel),
    )


def without_channel(model: Model, channel: Channel) -> Model:
    """The model without a channel that no other one builds on."""
    less = 0 if channel.replaces else len(channel.names)
    return replace(
        model,
        inputs=model.inputs - less,
        direct=model.direct - count_direct([channel]),
        channels=tuple(one for one in model.channels if one != channel),
    )


def with_pairs(model: Model, count: int) -> Model:
    """The model with more pairs of poles in every dynamic layer."""
    if isinstance(model, LinearDynamicGP):
        return replace(model, pairs=model.pairs + count)
    layers = tuple(
        replace(layer, pairs=layer.pairs + count) if isinstance(layer, Dynamic) else layer
        for layer in model.layers
    )
    return replace(model, layers=layers)


def with_process_noise(model: Model) -> Model:
    """The model with process noise in every dynamic layer."""
    if isinstance(model, LinearDynamicGP):
        return replace(model, process_noise=True)
    layers = tuple(
        replace(layer, process_noise=True) if isinstance(layer, Dynamic) else layer
        for layer in model.layers
    )
    return replace(model, layers=layers)


def without_process_noise(model: Model) -> Model:
    """The model with deterministic dynamics, but where process noise is all that drives them."""
    if isinstance(model, LinearDynamicGP):
        driven = model.inputs > model.direct
        return replace(model, process_noise=False) if driven else model
    return deterministic(model)


def has_process_noise(model: Model) -> bool:
    """Whether every dynamic layer has process noise."""
    if isinstance(model, LinearDynamicGP):
        return model.process_noise
    return all(one.process_noise for one in model.layers if isinstance(one, Dynamic))


def has_function(model: Model) -> bool:
    """Whether there is a static layer."""
    return isinstance(model, Cascade) and any(isinstance(one, Static) for one in model.layers)


def as_cascade(model: Model) -> Cascade:
    """A linear model as a cascade of one dynamic layer; a cascade as it is."""
    if isinstance(model, Cascade):
        return model
    layer = Dynamic(
        outputs=model.outputs,
        pairs=model.pairs,
        noise=model.noise,
        brownian=model.brownian,
        feedthrough=model.feedthrough,
        process_noise=model.process_noise,
    )
    return Cascade(
        model.inputs,
        (layer,),
        direct=model.direct,
        channels=model.channels,
        priors=model.priors,
    )


def with_output_function(model: Model, limits: Limits | None = None) -> Model | None:
    """The model with a static layer after its last dynamic one; None where there is one already.

    Its prior mean is a straight line, to which it goes back beyond the data; or one that stops at
    limits [output].
    """
    cascade = as_cascade(model)
    if isinstance(cascade.layers[-1], Static):
        return None
    last = Static(outputs=cascade.outputs, inducing=INDUCING, mean="linear", limits=limits)
    return replace(cascade, layers=(*cascade.layers, last), scaling=None)


def with_input_function(model: Model) -> Model | None:
    """The model with a static layer before its first dynamic one; None where there is one."""
    cascade = as_cascade(model)
    driving = cascade.inputs - cascade.direct
    if isinstance(cascade.layers[0], Static) or not driving:
        return None
    first = Static(outputs=driving, inducing=INDUCING)
    return replace(cascade, layers=(first, *cascade.layers), scaling=None)


def with_likelihood(model: Model, likelihood: Likelihood) -> Model:
    """The model with other measurement noise."""
    return replace(as_cascade(model), likelihood=likelihood, scaling=None)


def used_channels(model: Model) -> set[str]:
    """Names that the model's channels are made from or make."""
    names: set[str] = set()
    for channel in model.channels:
        names |= set(channel.names)
        for field in ("channel", "first", "second"):
            names |= {str(getattr(channel, field))} if hasattr(channel, field) else set()
    return names
