"""Layers as a file has them: a kind and its options, never code."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

from pyro_dynogp.models.forms import FORMS, Form, form_of
from pyro_dynogp.models.product import Product, factors, is_product
from pyro_dynogp.models.wiring import Dynamic, Known, Layer, Static

LAYERS: dict[str, Callable[..., Layer]] = {
    "Dynamic": Dynamic, "Static": Static, "Product": Product,
    **{form.capitalize(): functools.partial(Form, form) for form in FORMS},
}  # fmt: skip


def plain_layer(layer: Layer) -> dict[str, Any] | None:
    """A layer as JSON has it; None for a function of the user's."""
    if not isinstance(layer, Known):
        names = [f.name for f in fields(layer)]
        return {"kind": type(layer).__name__, **{name: getattr(layer, name) for name in names}}
    wired = {name: getattr(layer, name) for name in ("skip", "sees", "name")}
    if form := form_of(layer):
        return {"kind": form.capitalize(), **wired}
    if is_product(layer):
        first = factors(layer)
        return {"kind": "Product", "first": first, "others": layer.outputs // first, **wired}
    return None


def layer_of(options: Mapping[str, Any]) -> Layer:
    """Inverse of `plain_layer`."""
    given = dict(options)
    kind = given.pop("kind")
    if kind not in LAYERS:
        raise ValueError(f"load: unknown layer {kind!r}; known are {sorted(LAYERS)}.")
    given |= {name: tuple(v) for name, v in given.items() if isinstance(v, list)}
    return LAYERS[kind](**given)
