"""Linear systems of a fit for python-control: state space or transfer functions, with draws."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import scipy.signal
import torch

from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.views import (
    discrete_state_space,
    real_state_space,
    transfer_function,
)
from pyro_dynogp.models.system import DynamicSystem
from pyro_dynogp.support.errors import COUNT, POSITIVE, invalid, one_of

Kind = Literal["state space", "transfer function"]
Names = dict[str, list[str]]
Matrices = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def to_control(
    fit: Fitted, kind: Kind, step: float | None, draws: int | None, layer: str | None
) -> Any:
    """See `Fit.to_control`."""
    one_of(("state space", "transfer function")).check("kind", kind)
    if step is not None:
        step = POSITIVE.check("step", step)
    if layer is not None and not isinstance(layer, str):
        raise invalid("layer", expected="the name of a dynamic layer", got=repr(layer))
    if fit.model.late:
        raise invalid(
            "fit", expected="a model without dead times that are parameters",
            got=f"dead times of {[channel.channel for channel in fit.model.late]}",
            advice="python-control has no dead times: take its pade() of fit.draws['delay'] and "
            "fit without them.",
        )  # fmt: skip
    modes, names = modes_of(fit, draws, layer)
    try:
        import control
    except ImportError as error:
        raise ImportError(
            "to_control needs the package control: pip install control", name="control"
        ) from error
    make = _state_space if kind == "state space" else _transfer_function
    found = [make(control, one, step, names) for one in modes]
    return found if draws is not None else found[0]


def modes_of(fit: Fitted, draws: int | None, layer: str | None) -> tuple[list[Modes], Names]:
    """Modes at the best optimum or of draws spread evenly, and names of inputs and outputs.

    Raises:
        ValueError: no such dynamic layer, several layers and none named, a number of draws that is
            none.
    """
    if draws is None:
        count, system = 1, fit.system_at(fit.mode)
    else:
        some = fit.thinned(COUNT.check("draws", draws))
        count, system = some.n_draws, some.system
    wires = [wire.name for wire, _ in system.dynamic]
    if layer is not None and layer not in wires:
        raise invalid("layer", expected=f"a dynamic layer among {wires}", got=repr(layer))
    if layer is None and not system.is_linear:
        raise invalid(
            "layer", expected=f"the name of a dynamic layer among {wires}, as there are other ones",
            got="None", advice="Signals of a layer are in standard deviations of theirs.",
        )  # fmt: skip
    names: Names = {}
    if layer is None or system.is_linear:
        modes = system.physical(fit.scaling).modes
        if modes.inputs == len(fit.scaling.input_names):
            names["inputs"] = list(fit.scaling.input_names)
        names["outputs"] = list(fit.scaling.output_names)
    else:
        found = system.layer(layer)
        assert isinstance(found, DynamicSystem)
        modes = found.modes
    if not modes.inputs:
        raise invalid("fit", expected="a layer with inputs", got="one without inputs")
    # At the mode parameters have no dimension of draws, or one of length one.
    batch = modes.expand((count,))
    return [batch[k] for k in range(count)], names


def matrices(modes: Modes, step: float | None) -> Matrices:
    """A (k, k), B (k, n_u), C (n_y, k) and D (n_y, n_u), exactly sampled at a step [time]."""
    with torch.no_grad():
        one = real_state_space(modes) if step is None else discrete_state_space(modes, step)
    A, B, C, D = (x.numpy() for x in (one.A, one.B, one.C, one.D))
    return A, B, C.reshape(-1, len(A)), D.reshape(-1, B.shape[1])


def _state_space(control: Any, modes: Modes, step: float | None, names: Names) -> Any:
    return control.ss(*matrices(modes, step), 0 if step is None else step, **names)


def _transfer_function(
    control: Any, modes: Modes, step: float | None, names: dict[str, Any]
) -> Any:
    A, B, C, D = matrices(modes, step)
    if step is None:
        with torch.no_grad():
            found = transfer_function(modes)
        numerator = found.numerator.numpy().reshape(len(C), B.shape[1], -1)
        denominator = found.denominator.numpy()
    else:
        columns = [scipy.signal.ss2tf(A, B, C, D, input=k) for k in range(B.shape[1])]
        numerator = np.stack([above for above, _ in columns], axis=1)
        denominator = columns[0][1]
    below = [[denominator] * B.shape[1]] * len(C)
    return control.tf([list(row) for row in numerator], below, 0 if step is None else step, **names)
