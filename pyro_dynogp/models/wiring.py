"""What a cascade is made of: dynamic and static layers, and how they are wired."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pyro_dynogp.models.layer import HIDDEN as HIDDEN
from pyro_dynogp.models.layer import Dynamic as Dynamic
from pyro_dynogp.models.layer import Known as Known
from pyro_dynogp.models.layer import Layer as Layer
from pyro_dynogp.models.layer import Limits as Limits
from pyro_dynogp.models.layer import Static as Static
from pyro_dynogp.models.layer import StaticLayer as StaticLayer
from pyro_dynogp.models.layer_rules import check_layer, check_limits, check_signals
from pyro_dynogp.models.selection import part, place_of, signal_of, twice, with_channels
from pyro_dynogp.support.errors import instance, invalid, whole

INPUTS = "inputs"
# Most parts of an interval between samples.
MOST_SUBSTEPS = 64


@dataclass(frozen=True)
class Wire:
    """One layer in its place.

    Attributes:
        name: of the layer. layer: its specification, nothing left to default.
        sources: names of the signals it sees, or of single channels of them as in "g[0]", in order.
        channels: how many channels they are.
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
    def reads(self) -> frozenset[str]:
        """Names of the signals of which the layer sees something."""
        return frozenset(map(signal_of, self.sources))

    @property
    def signals(self) -> dict[str, int]:
        """Names of the signals that the layer makes, and how many channels each has."""
        return _signals(self.name, self.layer)

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
            "output": "output" if self.last and len(self.signals) == 1 else f"{self.name}_output",
        }
        names["level"] = names["output"]  # of integrators, which hidden signals have not
        if len(self.signals) > 1:
            names["level"] = "output" if self.last else f"{self.name}_level"
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
    for name, layer in zip(names, layers, strict=True):
        check_layer(name, layer)
    back = {source for layer in layers if isinstance(layer, Dynamic) for source in layer.feedback}
    width = with_channels({INPUTS: inputs})
    wires: list[Wire] = []
    before: str = INPUTS
    for place, (name, layer) in enumerate(zip(names, layers, strict=True)):
        sources = layer.sees or (before, *layer.skip)
        _check_sources(name, layer, width, before)
        channels = sum(width[s] for s in sources)
        if isinstance(layer, StaticLayer) and channels == 0:
            raise invalid(
                f"layer {name!r}", expected="inputs for a static layer", got="no channels"
            )
        check_signals(name, layer, channels)
        if isinstance(layer, Static):
            looped = name in back and channels > 1
            linear = place == 0 or looped or layer.limits is not None
            layer = replace(layer, mean=layer.mean or ("linear" if linear else "constant"))
            if layer.limits is not None:
                end = name == output == names[-1] and name not in back
                check_limits(name, layer, channels, end)
        elif (
            isinstance(layer, Dynamic)
            and channels == 0
            and not (layer.process_noise or layer.feedback)
        ):
            raise invalid(
                f"process_noise of layer {name!r}",
                expected="True for a layer without inputs",
                got="False",
            )
        last = name == output
        fed = sum(widths[source] for source in getattr(layer, "feedback", ()))
        single = sum(_letter(other) == _letter(layer) for other in layers) == 1
        wires.append(Wire(name, layer, sources, channels, False, last, single, fed))
        width |= with_channels(_signals(name, layer))
        before = name
    _check_that_all_matter(wires, output)
    _check_hidden(wires)
    _check_substeps(wires)
    feeds = set(back)
    for place in range(len(wires) - 1, -1, -1):
        here = wires[place]
        pathwise = not feeds.isdisjoint(here.signals)
        wires[place] = replace(here, pathwise=pathwise)
        if isinstance(here.layer, Dynamic) or pathwise:
            feeds.update(here.reads)
    return tuple(wires)


def _signals(name: str, layer: Layer) -> dict[str, int]:
    """Signals that a layer makes and their widths."""
    hidden = _hidden(layer)
    return {name: layer.outputs, name + HIDDEN: hidden} if hidden else {name: layer.outputs}


def _names(layers: Sequence[Layer]) -> list[str]:
    for layer in layers:
        if not isinstance(layer, Layer):
            raise invalid("layers", expected="Dynamic, Static and Known layers", got=repr(layer))
        named = layer.name is None or (isinstance(layer.name, str) and layer.name.isidentifier())
        if not named:
            expected = "None, or letters, digits and underscores"
            raise invalid("name of a layer", expected=expected, got=repr(layer.name))
    letters = [_letter(layer) for layer in layers]
    names = []
    for place, (letter, layer) in enumerate(zip(letters, layers, strict=True)):
        number = "" if letters.count(letter) == 1 else str(letters[: place + 1].count(letter))
        names.append(layer.name or letter + number)
    reserved = {INPUTS, "y", "offset", "noise_sd", "log_noise", "delay"}
    reserved |= {n + HIDDEN for n, layer in zip(names, layers, strict=True) if _hidden(layer)}
    if len(set(names)) < len(names) or set(names) & reserved:
        raise invalid(
            "layers",
            expected=f"a name of its own for each layer, none of {sorted(reserved)}",
            got=str(names),
        )
    return names


def _check_sources(name: str, layer: Layer, width: Mapping[str, int], before: str) -> None:
    option = "sees" if layer.sees else "skip"
    named = layer.sees or layer.skip
    expected = set(width) if layer.sees else set(width) - {before}
    repeated = isinstance(named, str) or twice(named) is not None
    for signal in [named] if repeated else [n for n in named if n not in expected]:
        raise invalid(
            f"{option} of layer {name!r}",
            expected="names of earlier signals, or of channels of them as in 'g[0]', each once: a "
            f"tuple of {sorted(name for name in expected if place_of(name) is None)}",
            got=repr(signal),
        )
    if layer.sees and layer.skip:
        raise invalid(f"layer {name!r}", expected="sees or skip", got="both")


def _letter(layer: Layer) -> str:
    return "g" if isinstance(layer, Dynamic) else "f"


def substeps_of(wires: Sequence[Wire]) -> int:
    """Parts of an interval in which feedback is computed anew: the most that a layer has."""
    return max((w.layer.substeps for w in wires if isinstance(w.layer, Dynamic)), default=1)


def _hidden(layer: Layer) -> int:
    return layer.hidden if isinstance(layer, Dynamic) else 0


def _check_feedback(names: Sequence[str], layers: Sequence[Layer]) -> None:
    for place, layer in enumerate(layers):
        for option in ("skip", "sees"):
            instance(f"{option} of layer {names[place]!r}", getattr(layer, option), tuple)
        if not isinstance(layer, Dynamic):
            continue
        instance(f"feedback of layer {names[place]!r}", layer.feedback, tuple)
        later = [n for n, other in zip(names, layers, strict=True) if _letter(other) == "f"]
        later = [n for n in later if names.index(n) > place]
        given = layer.feedback
        if len(set(given)) < len(given) or not set(given) <= set(later):
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
        seen = {s for w in wires if w.name in new for s in (*w.reads, *w.feedback)}
        new = {w.name for w in wires if not seen.isdisjoint(w.signals)} - matter
    idle = [w.name for w in wires if w.name not in matter]
    if idle:
        raise invalid(
            "layers",
            expected=f"layers that lead to the output {output!r}, or back to one that does",
            got=f"{idle} without effect on it",
        )


def _check_hidden(wires: Sequence[Wire]) -> None:
    """Refuse hidden signals that no function sees, or without feedback: nothing depends on them."""
    sources = {source for w in wires for source in w.sources}
    for w in wires:
        count, own = _hidden(w.layer), w.name + HIDDEN
        seen = {k for s in sources if signal_of(s) == own for k in range(count)[part(s, count)]}
        if count and not (len(seen) == count and w.feedback):
            raise invalid(
                f"hidden of layer {w.name!r}",
                expected=f"0, or functions that see all of {own!r} in a layer with feedback",
                got=repr(_hidden(w.layer)),
            )


def _check_substeps(wires: Sequence[Wire]) -> None:
    """Refuse substeps of a layer without feedback: they change nothing."""
    for w in wires:
        if isinstance(w.layer, Dynamic):
            whole(1, MOST_SUBSTEPS).check(f"substeps of layer {w.name!r}", w.layer.substeps)
            if w.layer.substeps > 1 and not w.feedback:
                raise invalid(
                    f"substeps of layer {w.name!r}",
                    expected="1, or feedback to the layer",
                    got=repr(w.layer.substeps),
                )
