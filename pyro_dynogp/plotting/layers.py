"""Which dynamic layer a figure shows, and frequencies at which its response is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.models.wiring import INPUTS
from pyro_dynogp.support.errors import invalid

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit

Signals = tuple[tuple[str, str], ...]
# Poles of less damping than this have a peak that an even grid may miss.
LIGHT = 0.1
# Distances from a peak in half-widths of it: 0.2 apart, the peak is met within 0.05 dB.
AROUND = np.arange(-3.0, 3.01, 0.2)


@dataclass(frozen=True)
class Shown:
    """A dynamic layer as it is drawn.

    Attributes:
        title: of what it is; "" of a linear model, which has no other layer.
        draws: its modes, a batch of draws, none for a fit at the mode.
        best: its poles (P,) at the best optimum.
        inputs, outputs: name and unit of each.
    """

    title: str
    draws: Modes
    best: np.ndarray
    inputs: Signals
    outputs: Signals


def chosen_layer(names: Sequence[str], layer: str | None, kind: str) -> str:
    """The layer that a figure is of: the one named, or the only one.

    Args:
        names: of the layers of this kind. layer: which; None for the only one.
        kind: "dynamic" or "static".

    Raises:
        ValueError: no such layer, or several where none is named.
    """
    if layer is not None and layer not in names:
        raise invalid("layer", expected=f"a {kind} layer among {list(names)}", got=repr(layer))
    if layer is None and len(names) != 1:
        raise invalid("layer", expected=f"the name of one among {list(names)}", got="None")
    return layer or names[0]


def shown_layer(fit: Fit, layer: str | None) -> Shown:
    """The dynamic layer of that name; None for the only one.

    Raises:
        ValueError: no such layer, or several where none is named.
    """
    wires = {wire.name: wire for wire, _ in fit.system.dynamic}
    wire = wires[chosen_layer(list(wires), layer, "dynamic")]
    at_mode = fit.system_at(fit.mode)
    scaling = fit.scaling
    if fit.system.is_linear:
        return Shown(
            "", fit.modes, np.asarray(at_mode.physical(scaling).modes.poles).reshape(-1),
            tuple(zip(scaling.input_names, scaling.input_units, strict=True)),
            tuple(zip(scaling.output_names, scaling.output_units, strict=True)),
        )  # fmt: skip
    made: Any = fit.system.layer(wire.name)
    modes = made.modes[0] if fit.method == "map" and made.modes.batch_shape else made.modes
    # Signals between layers are in standard deviations of theirs.
    names = list(scaling.input_names) if wire.sources == (INPUTS,) else list(wire.sources)
    if len(names) != modes.inputs:
        names = [f"input {k + 1}" for k in range(modes.inputs)]
    out = list(scaling.output_names) if wire.last else [wire.name]
    if len(out) != modes.outputs:
        out = [f"{wire.name} {k + 1}" for k in range(modes.outputs)]
    best: Any = at_mode.layer(wire.name)
    return Shown(
        f" of layer {wire.name}", modes, np.asarray(best.modes.poles).reshape(-1),
        tuple((name, "sd") for name in names), tuple((name, "sd") for name in out),
    )  # fmt: skip


def frequency_grid(shown: Shown, low: float, high: float, count: int = 600) -> np.ndarray:
    """Frequencies (m,) that meet every resonance: an even grid, and more of them around peaks.

    The response near a pole -d + i w falls off as 1/sqrt(1 + ((omega - w)/d)^2), so that 0.1 d
    beside the peak 0.04 dB are lost.

    Args:
        shown: its poles at the optimum and of all draws. low, high: ends [rad/time].
        count: of the even grid on a logarithmic scale.
    """
    light = _resonant(np.asarray(shown.draws.poles).reshape(-1))
    some = light[:: max(1, len(light) // 100)]
    grid = np.unique(
        np.concatenate([
            np.geomspace(low, high, count),
            # Where |G| of the pair alone is highest, in each draw.
            np.sqrt(np.maximum(light.imag**2 - light.real**2, 0)),
            *(pole.imag - pole.real * AROUND for pole in _resonant(shown.best)),
            *(pole.imag - pole.real * AROUND[::5] for pole in some),
        ])
    )  # fmt: skip
    return grid[(grid >= low) & (grid <= high)]


def _resonant(poles: np.ndarray) -> np.ndarray:
    """Poles of little damping."""
    size = np.abs(poles)
    return poles[(-poles.real < LIGHT * size) & (size > 0)]
