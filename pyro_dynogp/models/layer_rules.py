"""What the options of one layer have to be."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from numbers import Real

from pyro_dynogp.layers.kernels import KernelPrior
from pyro_dynogp.models.forms import form_of
from pyro_dynogp.models.layer import Dynamic, Known, Layer, Static, in_double
from pyro_dynogp.models.product import factors
from pyro_dynogp.support.errors import COUNT, RULES, instance, invalid


def check_layer(name: str, layer: Layer) -> None:
    """Refuse options of a layer that are not what they have to be."""
    for option in fields(layer):
        value = getattr(layer, option.name)
        if option.name in RULES and not (value is None and option.default is None):
            RULES[option.name].check(f"{option.name} of layer {name!r}", value)
    if isinstance(layer, Static):
        COUNT.check(f"support of layer {name!r}", layer.support)
        # Refuses what is no kernel of one function.
        KernelPrior(name, layer.kernel, 1, layer.smoothness)
    elif isinstance(layer, Known):
        _check_known(name, layer)
    else:
        _check_real(name, layer)


def _check_known(name: str, layer: Known) -> None:
    if not callable(layer.function):
        got = repr(layer.function)
        raise invalid(f"function of layer {name!r}", expected="a function of torch", got=got)
    instance(f"parameters of layer {name!r}", layer.parameters, Mapping)
    for parameter, prior in layer.parameters.items():
        instance(f"parameters of layer {name!r}: a name", parameter, str)
        in_double(prior, f"parameters of layer {name!r}: {parameter}")
    ends = (0.0, 1.0) if layer.range is None else layer.range
    numbers = isinstance(ends, tuple | list) and all(isinstance(end, Real) for end in ends)
    if not (numbers and len(ends) == 2 and ends[0] < ends[1]):
        raise invalid(
            f"range of layer {name!r}", expected="(low, high) with low < high", got=repr(ends)
        )


def _check_real(name: str, layer: Dynamic) -> None:
    """Refuse real poles of several signals, and beside an integrator."""
    if layer.real and (layer.width > 1 or layer.integrators or (layer.brownian or 1) > 1):
        raise invalid(
            f"real of layer {name!r}",
            expected="False for several outputs, hidden signals, Brownian motions or integrators",
            got=f"True, outputs={layer.outputs}, hidden={layer.hidden}, "
            f"brownian={layer.brownian}, integrators={layer.integrators}",
            advice="A layer of pairs can have real poles as well.",
        )


def check_signals(name: str, layer: Layer, channels: int) -> None:
    """Refuse a product, or a form, of another number of signals than it sees."""
    first = factors(layer)
    if first and channels != first + layer.outputs // first:
        raise invalid(
            f"layer {name!r}",
            expected=f"{first} signals that come first and {layer.outputs // first} others",
            got=f"{channels} signals",
        )
    form = form_of(layer)
    needed = {None: channels, "hysteresis": 2}.get(form, 1)
    if channels != needed:
        raise invalid(
            f"layer {name!r}",
            expected=f"{needed} signals for the form {form!r}", got=f"{channels} signals",
            advice="sees names them: outputs of layers, or hidden signals of a dynamic layer.",
        )  # fmt: skip


def check_limits(name: str, layer: Static, channels: int, last: bool) -> None:
    """Refuse limits that are none, and of a layer that is no sensor."""
    assert layer.limits is not None
    limits = layer.limits if isinstance(layer.limits, tuple | list) else ()
    known = [limit for limit in limits if limit is not None]
    numbers = all(isinstance(limit, Real) and not math.isnan(limit) for limit in known)
    if len(limits) != 2 or not known or not numbers or known != sorted(set(known)):
        raise invalid(
            f"limits of layer {name!r}",
            expected="(low, high) with low < high; None for one that is not there",
            got=repr(layer.limits),
        )
    if not last or layer.mean != "linear" or (channels, layer.outputs) != (1, 1):
        raise invalid(
            f"limits of layer {name!r}",
            expected="a last layer with a linear mean, of one signal, one output, not fed back",
            got=f"mean {layer.mean!r}, {channels} signals, {layer.outputs} outputs"
            + ("" if last else ", not the last layer, or fed back"),
        )
