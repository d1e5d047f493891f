"""What a cascade is made of: dynamic and static layers, and how they are wired."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from gpytorch.kernels import Kernel

from pyro_dynogp.lti.modes import NoiseStructure
from pyro_dynogp.support.errors import invalid

INPUTS = "inputs"
# Lowest and highest value, None where there is none.
Limits = tuple[float | None, float | None]


@dataclass(frozen=True)
class Dynamic:
    """A stochastic LTI layer: its output is the trajectory of a linear system with process noise.

    Args:
        outputs: width of the layer. pairs: P conjugate pairs (order 2P), shared by all outputs.
        noise: "shared" or "independent" Brownian motions, see `Modes`.
        brownian: number of Brownian motions; by default one for each output.
        feedthrough: whether the layer's input acts on its output at once.
        process_noise: whether there is any.
        integrators: 1 for a pole at zero beside the pairs, one for each output: of a plant that
            integrates its input (a level, a position, a charge).
        skip: names of earlier signals ("inputs", or layers) that the layer sees beside the
            output of the layer before it.
        feedback: names of later static layers whose outputs are further inputs of this layer. Each
            acts from the sample after the one that it is computed at, and never on the output at
            once: the loop has a delay.
        name: prefix of its sites; g, or g1, g2, ... by default.
    """

    outputs: int = 1
    pairs: int = 5
    noise: NoiseStructure = "shared"
    brownian: int | None = None
    feedthrough: bool = True
    process_noise: bool = True
    integrators: int = 0
    skip: tuple[str, ...] = ()
    feedback: tuple[str, ...] = ()
    name: str | None = None

    @property
    def modes(self) -> int:
        """Number of poles that stand for pairs: an integrator counts, and its random walk."""
        return self.pairs + self.integrators * self.outputs * (2 if self.process_noise else 1)


@dataclass(frozen=True)
class Static:
    """A static layer: a Gaussian process of the signals below, with inducing values.

    Args:
        outputs: width of the layer. inducing: number of inducing values for each output.
        kernel: a gpytorch kernel; Matern-3/2 with a lengthscale for each channel by default.
        mean: "linear" or "constant" prior mean; by default linear for a first layer, in feedback
            from several signals and where there are limits, else constant. Beyond the data a
            function goes back to it; in feedback from one signal it goes on as its tangents.
        limits: lowest and highest value of the linear mean [output], None for none: those of a
            sensor that stops. Of a last layer of one signal and one output.
        skip: names of earlier signals that the layer sees too.
        learn_locations: whether the inducing locations are learnt.
        support: number of points at which the residual of the function given its inducing values
            is drawn, where the layer feeds a dynamic one and is not integrated out.
        name: prefix of its sites; f, or f1, f2, ... by default.
    """

    outputs: int = 1
    inducing: int = 32
    kernel: Kernel | None = None
    mean: Literal["constant", "linear"] | None = None
    limits: Limits | None = None
    skip: tuple[str, ...] = ()
    learn_locations: bool = True
    support: int = 64
    name: str | None = None


Layer = Dynamic | Static


@dataclass(frozen=True)
class Wire:
    """One layer in its place.

    Attributes:
        name: of the layer. layer: its specification, nothing left to default.
        sources: names of the signals it sees, in order. channels: how many they are.
        pathwise: whether a dynamic layer sees its output, directly or through static layers.
        last: whether its output is the model's. single: whether no other layer is of its kind.
        fed: number of channels that come back from the layers in `feedback`, after the others.
    """

    name: str
    layer: Layer
    sources: tuple[str, ...]
    channels: int
    pathwise: bool
    last: bool
    single: bool = True
    fed: int = 0

    @property
    def feedback(self) -> tuple[str, ...]:
        """Names of the static layers whose outputs come back to this layer."""
        return self.layer.feedback if isinstance(self.layer, Dynamic) else ()

    @property
    def dims(self) -> dict[str, str]:
        """Names of the dimensions of the layer's sites, by what they are in any layer.

        Inputs and outputs of the model are "input" and "output"; dimensions that another layer of
        the kind has with another length carry the layer's name.
        """
        own, first = f"{self.name}_input", self.sources == (INPUTS,)
        names = {
            "input": "input" if first and not self.fed else own,
            "direct": "input" if first else f"{self.name}_forward" if self.fed else own,
            "output": "output" if self.last else f"{self.name}_output",
        }
        for dim in ("pair", "brownian", "state", "inducing", "support"):
            names[dim] = dim if self.single else f"{self.name}_{dim}"
        return names

    @property
    def described(self) -> str:
        """What to call the layer in a sentence."""
        kind = "dynamic" if isinstance(self.layer, Dynamic) else "static"
        return f"{kind} layer {self.name}"


def wire(inputs: int, layers: Sequence[Layer], output: str | None = None) -> tuple[Wire, ...]:
    """Name the layers, count their channels and say what each feeds.

    Args:
        inputs: number of inputs. layers: first to last. output: name of the layer whose output is
            the model's; None for the last.

    Raises:
        ValueError: for no layers, names that repeat, skips that point nowhere or forward, feedback
            that comes from anything but a later static layer, and layers that lead nowhere.
    """
    if not layers:
        raise invalid("layers", expected="at least one layer", got="none")
    names = _names(layers)
    output = names[-1] if output is None else output
    if output not in names:
        raise invalid("output", expected=f"one of the layers {names}", got=repr(output))
    _check_feedback(names, layers)
    widths = {name: layer.outputs for name, layer in zip(names, layers, strict=True)}
    back = {source for layer in layers if isinstance(layer, Dynamic) for source in layer.feedback}
    width = {INPUTS: inputs}
    wires: list[Wire] = []
    before: str = INPUTS
    for place, (name, layer) in enumerate(zip(names, layers, strict=True)):
        _check_layer(name, layer)
        for skipped in layer.skip:
            if skipped not in width or skipped == before:
                raise invalid(
                    f"skip of layer {name!r}",
                    expected=f"names of earlier signals, {sorted(set(width) - {before})}",
                    got=repr(skipped),
                )
        sources = (before, *layer.skip)
        channels = sum(width[s] for s in sources)
        if isinstance(layer, Static):
            if channels == 0:
                raise invalid(
                    f"layer {name!r}", expected="inputs for a static layer", got="no channels"
                )
            looped = name in back and channels > 1
            linear = place == 0 or looped or layer.limits is not None
            layer = replace(layer, mean=layer.mean or ("linear" if linear else "constant"))
            if layer.limits is not None:
                end = name == output == names[-1] and name not in back
                _check_limits(name, layer, channels, end)
        elif channels == 0 and not (layer.process_noise or layer.feedback):
            raise invalid(
                f"process_noise of layer {name!r}",
                expected="True for a layer without inputs",
                got="False",
            )
        last = name == output
        fed = sum(widths[source] for source in getattr(layer, "feedback", ()))
        single = sum(type(other) is type(layer) for other in layers) == 1
        wires.append(Wire(name, layer, sources, channels, False, last, single, fed))
        width[name] = layer.outputs
        before = name
    _check_that_all_matter(wires, output)
    feeds = set(back)
    for place in range(len(wires) - 1, -1, -1):
        here = wires[place]
        pathwise = here.name in feeds
        wires[place] = replace(here, pathwise=pathwise)
        if isinstance(here.layer, Dynamic) or pathwise:
            feeds.update(here.sources)
    return tuple(wires)


def _names(layers: Sequence[Layer]) -> list[str]:
    letters = {Dynamic: "g", Static: "f"}
    kinds: list[type] = []
    for layer in layers:
        if not isinstance(layer, Dynamic | Static):
            raise invalid("layers", expected="Dynamic and Static layers", got=repr(layer))
        kinds.append(type(layer))
    names = []
    for place, (kind, layer) in enumerate(zip(kinds, layers, strict=True)):
        number = "" if kinds.count(kind) == 1 else str(kinds[: place + 1].count(kind))
        names.append(layer.name or letters[kind] + number)
    reserved = {INPUTS, "y", "offset", "noise_sd", "log_noise"}
    if len(set(names)) < len(names) or set(names) & reserved:
        raise invalid(
            "layers",
            expected=f"a name of its own for each layer, none of {sorted(reserved)}",
            got=str(names),
        )
    return names


def _check_feedback(names: Sequence[str], layers: Sequence[Layer]) -> None:
    for place, layer in enumerate(layers):
        if not isinstance(layer, Dynamic):
            continue
        later = [n for n, other in zip(names, layers, strict=True) if isinstance(other, Static)]
        later = [n for n in later if names.index(n) > place]
        given = layer.feedback
        if isinstance(given, str) or len(set(given)) < len(given) or not set(given) <= set(later):
            raise invalid(
                f"feedback of layer {names[place]!r}",
                expected=f"a tuple of names of later static layers, of {later}",
                got=repr(given),
                advice="Earlier signals come by skip; a loop without a static layer is linear.",
            )


def _check_that_all_matter(wires: Sequence[Wire], output: str) -> None:
    """Refuse layers that lead neither to the output nor back to a layer that does."""
    matter: set[str] = set()
    new = {output}
    while new:
        matter |= new
        new = {s for w in wires if w.name in new for s in (*w.sources, *w.feedback)} - matter
    idle = [w.name for w in wires if w.name not in matter]
    if idle:
        raise invalid(
            "layers",
            expected=f"layers that lead to the output {output!r}, or back to one that does",
            got=f"{idle} without effect on it",
        )


def _check_layer(name: str, layer: Layer) -> None:
    numbers = {"outputs": layer.outputs}
    choices: dict[str, tuple[object, ...]]
    if isinstance(layer, Dynamic):
        numbers["pairs"] = layer.pairs
        choices = {"noise": ("shared", "independent"), "integrators": (0, 1)}
    else:
        numbers |= {"inducing": layer.inducing, "support": layer.support}
        choices = {"mean": (None, "constant", "linear")}
    for argument, allowed in choices.items():
        if getattr(layer, argument) not in allowed:
            expected = " or ".join(repr(choice) for choice in allowed if choice is not None)
            got = repr(getattr(layer, argument))
            raise invalid(f"{argument} of layer {name!r}", expected=expected, got=got)
    for argument, value in numbers.items():
        if not isinstance(value, int) or value < 1:
            raise invalid(
                f"{argument} of layer {name!r}", expected="a whole number >= 1", got=repr(value)
            )


def _check_limits(name: str, layer: Static, channels: int, last: bool) -> None:
    assert layer.limits is not None
    known = [limit for limit in layer.limits if limit is not None]
    if len(layer.limits) != 2 or not known or known != sorted(set(known)):
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
