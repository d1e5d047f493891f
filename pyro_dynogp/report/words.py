"""Models and ties between effects, in words."""

from __future__ import annotations

from dataclasses import fields

from pyro_dynogp.data.channels import Channel
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.wiring import Dynamic

# In a tie, what products of inputs at two times, or responses that change with time, speak for.
OUTSIDE = "a cause outside the catalogue"
# Which experiment tells two effects apart.
EXPERIMENTS: dict[frozenset[str], str] = {
    frozenset({"dead time", "unmodelled dynamics"}): (
        "a step of the input, sampled several times faster: after a dead time nothing moves at "
        "first, more dynamics begin at once"
    ),
    frozenset({"output nonlinearity", "input nonlinearity"}): (
        "the same slow sweep once more with fast steps on it: a nonlinear sensor follows the "
        "output, a nonlinear actuator the input, whatever the speed"
    ),
    frozenset({"saturation", "output nonlinearity"}): (
        "inputs that hold the output beyond the suspected limit"
    ),
    frozenset({"dead zone", "input nonlinearity"}): (
        "slow ramps of the input through zero, smaller and larger than the suspected zone"
    ),
    frozenset({"dead zone", "hysteresis"}): (
        "a slow triangle of the input: play opens a loop, a dead zone does not"
    ),
    frozenset({"drift", "level shift"}): "a longer record at rest",
    frozenset({"drift", "process noise"}): "a longer record at constant inputs",
    frozenset({"extra input", "process noise"}): "a record in which the extra channel is moved",
}


def experiment(first: str, others: tuple[str, ...]) -> str:
    """Which experiment tells an effect from others; "" for no others."""
    known = [EXPERIMENTS[pair] for o in others if (pair := frozenset({first, o})) in EXPERIMENTS]
    if OUTSIDE in others:
        known.append(
            "the same input twice, at another time and at half the size: what is constant responds "
            "alike, what is linear half as much"
        )
    if known:
        return "; ".join(dict.fromkeys(known))
    return "a record with inputs for which their predictions differ" if others else ""


def describe(model: Model) -> tuple[str, ...]:
    """A line for each part of a model, inputs first, measured output last."""
    driving = [one for one in model.channels if not one.direct]
    direct = [one for one in model.channels if one.direct]
    count = model.inputs - model.direct
    lines = [f"{count} input{'s' if count != 1 else ''}"]
    lines += [in_words(one) for one in driving]
    for layer in model.layers:
        if isinstance(layer, Dynamic):
            noise = "process noise" if layer.process_noise else "no process noise"
            plural = "s" if layer.pairs != 1 else ""
            lines.append(f"linear dynamics, {layer.pairs} pair{plural} of poles, {noise}")
        else:
            limits = [f"{at:.4g}" for at in layer.limits or () if at is not None]
            stops = f", stops at {' and '.join(limits)}" if limits else ""
            lines.append(f"static function, {layer.inducing} inducing values{stops}")
    lines += [f"plus {in_words(one)}" for one in direct]
    plain = model.direct - sum(len(one.names) for one in direct)
    if plain:
        lines.append(f"plus {plain} direct inputs")
    likelihood = model.likelihood
    noise = "Gaussian noise"
    if likelihood.varying:
        noise = f"Gaussian noise that varies with the {likelihood.of}"
    elif likelihood.degrees_of_freedom is not None:
        noise = f"Student-t noise, {likelihood.degrees_of_freedom:.3g} degrees of freedom"
    return (*lines, noise)


def in_words(channel: Channel) -> str:
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
    return f"{kind}: {'; '.join(values)}"
