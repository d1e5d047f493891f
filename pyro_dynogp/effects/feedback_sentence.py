"""What a model's functions in feedback see, in a sentence."""

from __future__ import annotations

from pyro_dynogp.data.channels import Product
from pyro_dynogp.models.forms import form_of
from pyro_dynogp.models.product import is_product
from pyro_dynogp.models.selection import place_of, signal_of
from pyro_dynogp.models.variants import Model
from pyro_dynogp.models.wiring import HIDDEN, INPUTS


def what_acts_back(model: Model, output: str, tested: str) -> str:
    """Of which signals it is a function.

    Args:
        model: with feedback. output: name of the one that was tested.
        tested: what its test said, of a function of it.
    """
    wires = {wire.name: wire for wire in model.wires}
    back = [wires[name] for wire in model.wires for name in wire.feedback]
    past = [one for one in back if form_of(one.layer) == "hysteresis"]
    smooth = [one for one in back if not is_product(one.layer) and one not in past]
    functions = {s for one in smooth for s in one.sources}
    multiplied = [one for one in back if is_product(one.layer)]
    factors = {one.sources[-1] for one in multiplied if INPUTS in one.reads}
    states = any(INPUTS not in one.reads for one in multiplied)
    if model.has_real_poles and not multiplied:
        return (
            f"'{output}' is the level of the last of {len(model.dynamic)} compartments: what flows "
            "out of one, by a root and over an edge, enters the next."
        )
    unseen = f"a signal of the dynamics of '{output}' that is not measured"
    hidden = {name for name in functions if signal_of(name).endswith(HIDDEN)}
    several = len(hidden) > 1
    if several:
        unseen = "signals of the dynamics that are not measured"
    each = any(place_of(name) is not None for name in functions - hidden)
    said = []
    if hidden and hidden == functions:
        what, act = ("Nonlinear functions", "act") if several else ("A nonlinear function", "acts")
        said.append(f"{what} of {unseen} {act} back on them.")
    elif hidden:
        own = "each output" if each else f"'{output}'"
        said.append(f"Nonlinear functions of {own}, and of {unseen}, act back on them.")
    elif functions or not (factors or past or states):
        said.append(tested)
        said += ["The model has a function of each output."] if each else []
    if past:
        said.append(
            "It depends on the past: a hysteresis of two signals of the dynamics of "
            f"'{output}' that are not measured acts back on them."
        )
    if states:
        said.append(
            f"Products of signals of the dynamics of '{output}' that are not measured act back on "
            "them."
        )
    for factor in sorted(factors):
        other = unseen if signal_of(factor).endswith(HIDDEN) else f"'{output}'"
        said.append(f"Inputs times {other} act back on its dynamics.")
    if factors and any(isinstance(channel, Product) for channel in model.channels):
        said.append("Products of inputs drive them as well.")
    return " ".join(said)
