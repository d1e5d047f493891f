"""An effect in the noise-free output of a plant, still of any amount."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.discrepancy.plant_dynamics import Array
from tests.discrepancy.plant_setting import Setting


@dataclass(frozen=True, eq=False)
class Planting:
    """An effect in a setting, still of any amount.

    Attributes:
        clean: amount, disturbance of the linear output -> output (n,) without measurement noise.
        amounts: smallest and largest, or all there are where `discrete`.
        truth: amount -> true values, in samples and standard deviations of the signals.
        linear: whether the effect is proportional to the amount.
        recorded: amount -> inputs as the record has them; None: as they were.
        extra: a further channel with lead and tail, which belongs into the record.
        starts: where poles may move far to absorb the effect, the sets of poles to fit from.
        limits: amount -> lowest and highest output that the sensor can show, noise included.
    """

    clean: Callable[[float, Array], Array]
    amounts: tuple[float, ...]
    truth: Callable[[float], dict[str, Any]]
    linear: bool = True
    discrete: bool = False
    recorded: Callable[[float], Array] | None = None
    extra: Array | None = None
    starts: tuple[NDArray[np.complex128], ...] = ()
    limits: Callable[[float], tuple[float, float]] | None = None


def inside(setting: Setting, added: Array, **truth: Any) -> Planting:
    """Add to the linear output."""
    return Planting(
        lambda amount, w: setting.observe(setting.linear + w + amount * added),
        (1e-4, 10.0),
        lambda amount: {"amount": amount, **truth},
        linear=setting.shape is None,
    )


def outside(setting: Setting, added: Array, **truth: Any) -> Planting:
    """Add (n,) to the output, behind any nonlinearity."""
    return Planting(
        lambda amount, w: setting.observe(setting.linear + w) + amount * added,
        (1e-4, 10.0),
        lambda amount: {"height": amount, **truth},
    )
