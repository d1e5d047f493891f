"""Models in words, part by part."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from pyro_dynogp.data.channels import Channel
from pyro_dynogp.layers.noise import Likelihood
from pyro_dynogp.models.forms import form_of
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.product import is_product
from pyro_dynogp.models.wiring import Dynamic, Known, Layer


@dataclass(frozen=True)
class Part:
    """One part of a model in words; as a string it is one line.

    Attributes:
        kind: of two models, parts of one kind are the same part with other numbers.
        heading: what it is. details: its numbers, "" for none.
        joins: whether it is added to what comes before it, rather than acting on that.
        separator: between heading and details in a line.
    """

    kind: str
    heading: str
    details: str = ""
    joins: bool = False
    separator: str = ", "

    def __str__(self) -> str:
        return f"{self.heading}{self.separator}{self.details}" if self.details else self.heading


def describe(model: Model) -> tuple[Part, ...]:
    """Each part of a model, inputs first, measured output last."""
    channels = [(in_words(channel), channel) for channel in model.channels]
    driving = [part for part, channel in channels if not channel.direct]
    direct = [
        replace(part, heading=f"plus {part.heading}")
        for part, channel in channels
        if channel.direct
    ]
    count = model.inputs - model.direct
    inputs = Part("inputs", f"{count} input{'s' if count != 1 else ''}")
    back = {name for wire in model.wires for name in wire.feedback}
    layers = [_layer(wire.layer, fed_back=wire.name in back) for wire in model.wires]
    plain = model.direct - sum(len(channel.names) for channel in model.channels if channel.direct)
    if plain:
        direct.append(Part("direct inputs", f"plus {plain} direct inputs", joins=True))
    return (inputs, *driving, *layers, *direct, _noise(model.likelihood))


def kind_of(layer: Known) -> str:
    """What a function that is known is called."""
    return form_of(layer) or ("product" if is_product(layer) else "known function")


def _layer(layer: Layer, *, fed_back: bool) -> Part:
    if isinstance(layer, Dynamic):
        noise = "process noise" if layer.process_noise else "no process noise"
        plural = "s" if layer.pairs != 1 else ""
        pairs = f"{layer.pairs} pair{plural} of poles"
        if layer.real:
            pairs = f"{layer.pairs} real pole{plural}"
        integrates = ", an integrator" if layer.integrators else ""
        return Part("dynamics", "linear dynamics", f"{pairs}{integrates}, {noise}")
    if isinstance(layer, Known):
        kind = kind_of(layer)
        heading = f"{kind} in feedback" if fed_back else kind
        return Part("function", heading, ", ".join(layer.parameters))
    limits = [f"{at:.4g}" for at in layer.limits or () if at is not None]
    stops = f", stops at {' and '.join(limits)}" if limits else ""
    heading = "static function in feedback" if fed_back else "static function"
    return Part("function", heading, f"{layer.inducing} inducing values{stops}")


def _noise(likelihood: Likelihood) -> Part:
    if likelihood.varying:
        return Part("noise", f"Gaussian noise that varies with the {likelihood.of}", joins=True)
    if likelihood.degrees_of_freedom is not None:
        details = f"{likelihood.degrees_of_freedom:.3g} degrees of freedom"
        return Part("noise", "Student-t noise", details, joins=True)
    return Part("noise", "Gaussian noise", joins=True)


def in_words(channel: Channel) -> Part:
    """What a channel is, with its numbers."""
    kind = "".join(f" {c.lower()}" if c.isupper() else c for c in type(channel).__name__).strip()
    values = []
    for field in fields(channel):
        value = getattr(channel, field.name)
        if isinstance(value, tuple):
            value = ", ".join(f"{v:.4g}" for v in value)
        values.append(
            f"{field.name.replace('_', ' ')} {value:.4g}"
            if isinstance(value, float)
            else f"{field.name.replace('_', ' ')} {value}"
        )
    return Part(kind, kind, "; ".join(values), joins=not channel.replaces, separator=": ")
