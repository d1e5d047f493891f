"""A model with one function more that acts back on it: pure functions from models to models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pyro_dynogp.models.forms import Form, FormName, each_form, form_of, forms_of, usual_substeps
from pyro_dynogp.models.layer import fed_back
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.product import Product, is_product
from pyro_dynogp.models.selection import each_channel, signal_of
from pyro_dynogp.models.variants import with_dynamics
from pyro_dynogp.models.wiring import HIDDEN, INPUTS, Dynamic, Known, Layer, Static, Wire

# Names of functions that act back: of a layer's outputs, of signals of it that are hidden, steps of
# the latter, of all outputs together, a hysteresis of two hidden signals, products of three, and
# products of inputs with the output or with a hidden signal.
FEEDBACK, HIDDEN_FEEDBACK, STEP = "feedback", "hidden_feedback", "feedback_step"
JOINT_FEEDBACK = "joint_feedback"
HYSTERESIS, STATE_PRODUCTS = "feedback_hysteresis", "feedback_products"
PRODUCT, HIDDEN_PRODUCT = "feedback_product", "hidden_product"


def with_feedback(
    model: Model, *, output: bool = True, hidden: bool = False, step: bool = True
) -> Model | None:
    """The model with static layers that see its last dynamic layer and act back on it.

    Static layers may follow that layer: they are what measures it. Each function sees one signal.
    None where there is nothing to add, with feedback to another layer, and under noise that
    feedback does not allow.

    Args:
        model: to extend. output: whether functions see the outputs of the layer.
        hidden: whether others see as many further signals of the same states, which nothing
            measures.
        step: whether steps of these come back as well.
    """
    if not model.dynamic:
        return None
    seen, layer = model.dynamic[-1]
    count, unseen = _hidden(layer) if hidden else 0, seen.name + HIDDEN
    functions = each_channel(FEEDBACK, seen.name, layer.outputs) if output else {}
    functions |= each_channel(HIDDEN_FEEDBACK, unseen, count)
    steps = each_channel(STEP, unseen, count) if step else {}
    back: list[Static | Known] = [fed_back(1, sees=(x,), name=n) for n, x in functions.items()]
    back += [Form("step", sees=(x,), name=name) for name, x in steps.items()]
    return _fed_back(model, back, hidden=count)


def with_joint_feedback(model: Model) -> Model | None:
    """The model with a function of all outputs of its last dynamic layer that acts back on it.

    As many values as outputs: a spring between two masses. None for a single output, see
    `with_feedback`, where that is None, and where something acts back already.
    """
    if not model.dynamic or model.dynamic[-1][1].outputs == 1 or model.has_feedback:
        return None
    seen, layer = model.dynamic[-1]
    return _fed_back(
        model, [fed_back(layer.outputs, sees=(seen.name,), name=JOINT_FEEDBACK)], hidden=0
    )


def with_forms(model: Model, *, hidden: bool = False) -> Model | None:
    """The model with parametric forms of its last dynamic layer that act back on it.

    None beside more hidden signals than outputs, and where `with_feedback` is None.

    Args:
        model: to extend. hidden: whether some see as many further signals of the same states as it
            has outputs, which nothing measures; see `forms_of`.
    """
    if not model.dynamic:
        return None
    seen, layer = model.dynamic[-1]
    if layer.mostly_hidden:
        return None
    count = _hidden(layer) if hidden else 0
    forms = forms_of(seen.name, outputs=layer.outputs, hidden=count)
    return _fed_back(model, forms, hidden=count)


def with_form(model: Model, form: FormName, *, hidden: bool = False) -> Model | None:
    """The model with one form of each output of its last dynamic layer that acts back on it.

    A cube is a spring that hardens or softens, a step friction, a root an outflow. They have a
    place and at most a width, are fitted in seconds, and hold beyond the data, where a Gaussian
    process keeps its value. None where `with_feedback` is None.

    Args:
        model: to extend. form: of one signal, see `Form`.
        hidden: whether they are of as many further signals of the same states as it has outputs,
            which nothing measures, in place of the outputs.
    """
    if not model.dynamic:
        return None
    seen, layer = model.dynamic[-1]
    outputs, count = (0, _hidden(layer)) if hidden else (layer.outputs, 0)
    given = each_form(form, seen.name, outputs=outputs, hidden=count)
    return _fed_back(model, given, hidden=count)


def with_hysteresis(model: Model) -> Model | None:
    """The model with a hysteresis of two further signals of its dynamics that acts back on them.

    None for less than two pairs of poles, which have no state for it, for several outputs or a
    hidden signal that there is, and where `with_feedback` is None.
    """
    seen = _hidden_name(model)
    return _of_several(model, Form("hysteresis", sees=(seen,), name=HYSTERESIS), 2)


def with_products_of_states(model: Model) -> Model | None:
    """The model with products of one signal of its dynamics with two others that act back on them.

    Nothing measures the three. Predator and prey, a current with itself and with a speed. None
    where `with_hysteresis` is None.
    """
    seen = _hidden_name(model)
    return _of_several(model, Product(1, 2, sees=(seen,), name=STATE_PRODUCTS), 3)


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
        model, [Product(driving, count, sees=(INPUTS, other), name=name)], hidden=int(hidden)
    )
    return None if extended is None else with_usual_substeps(extended)


def acting_back(model: Model) -> set[str]:
    """Names of what acts back on the dynamics."""
    return {name for _, layer in model.dynamic for name in layer.feedback}


def has_other_dynamics(model: Model) -> bool:
    """Whether dynamics are a chain of lags, or have more hidden signals than outputs."""
    return any(layer.real or layer.mostly_hidden for _, layer in model.dynamic)


def is_parametric(model: Model) -> bool:
    """Whether functions with parameters are in feedback, and none is a Gaussian process."""
    return model.learns_function and not model.has_gaussian_process


def noise_allows_feedback(model: Model) -> bool:
    """Whether functions may be put in feedback beside the model's measurement noise."""
    return model.likelihood.gaussian and not model.likelihood.follows_output


def _hidden_name(model: Model) -> str:
    """Name of the hidden signals of the last dynamic layer."""
    return f"{model.dynamic[-1][0].name if model.dynamic else ''}{HIDDEN}"


def _of_several(model: Model, given: Known, hidden: int) -> Model | None:
    """The model with a function of so many hidden signals, see `with_hysteresis`."""
    if not model.dynamic:
        return None
    _, layer = model.dynamic[-1]
    if layer.pairs < 2 or layer.outputs > 1 or layer.hidden:
        return None
    extended = _fed_back(model, [given], hidden=hidden)
    return None if extended is None else with_usual_substeps(extended)


def _hidden(layer: Dynamic) -> int:
    """Signals that nothing measures: those that there are, or one for each output."""
    return layer.hidden or layer.outputs


def _fed_back(model: Model, given: Sequence[Static | Known], *, hidden: int) -> Model | None:
    """The model with functions that act back on its last dynamic layer, but those that do.

    Args:
        hidden: how many signals that nothing measures they see.
    """
    seen, layer = model.dynamic[-1]
    if not noise_allows_feedback(model) or (hidden and layer.real):
        return None
    sources = {wire.name: wire.sources for wire in model.wires}
    before = {sources[name] for name in layer.feedback}
    # Nor functions of a channel of what one of them sees as a whole.
    back = [one for one in given if before.isdisjoint((one.sees, (signal_of(one.sees[0]),)))]
    if not back or (model.has_feedback and not layer.feedback):
        return None
    names = (*layer.feedback, *(str(one.name) for one in back))
    layers: list[Layer] = []
    for wire, other in zip(model.wires, model.layers, strict=True):
        sees = () if wire.sources == (INPUTS,) and not layers else wire.sources
        if isinstance(other, Dynamic) and wire.name == seen.name:
            other = replace(other, feedback=names, hidden=max(layer.hidden, hidden))
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
