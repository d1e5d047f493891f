"""What a test looks at, and what it finds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

# Entries of `Evidence.where` that say where an effect is, in order of how much they say.
PLACES = ("channel", "what", "time", "period", "frequency", "low", "form")


@dataclass(frozen=True, eq=False)
class Residuals:
    """What a model leaves of one output along a record, beside all that may explain it.

    Attributes:
        time: (n,) [time unit]. stamps: (n,) time stamps with a zone, or None.
        output: (n,) measured, NaN where missing [output].
        mean: (n,) simulated from the inputs alone [output].
        deviations: (S, n) simulated means of posterior draws less `mean` [output]: what the
            uncertainty of the parameters leaves.
        innovations: (n,) standardised one-step prediction errors, NaN where missing.
        poles: (P,) complex, of the model's dynamic layers, one of each conjugate pair [1 / time
            unit].
        inputs: (n, n_u) that the model uses. input_names: of them.
        candidates: (n,) recorded channels that it does not use, by name; NaN where missing.
        held_out: (n,) True where neither fit nor scaling has seen the output.
        output_name, output_unit, time_unit: for sentences.
        step: sampling step [time unit].
        linear: whether the model is linear, without static functions.
    """

    time: np.ndarray
    output: np.ndarray
    mean: np.ndarray
    deviations: np.ndarray
    innovations: np.ndarray
    poles: np.ndarray
    inputs: np.ndarray
    input_names: tuple[str, ...]
    candidates: Mapping[str, np.ndarray]
    held_out: np.ndarray
    output_name: str
    output_unit: str
    time_unit: str
    step: float
    stamps: pd.DatetimeIndex | None = None
    linear: bool = True

    @property
    def residual(self) -> np.ndarray:
        """(n,): simulation residual, output less mean [output]."""
        return self.output - self.mean

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, eq=False)
class Curve:
    """The picture of a piece of evidence: points, and the effect that was fitted to them.

    Attributes:
        x, y: (m,) what the data say. fitted: (m,) what the effect says, NaN for nothing.
        x_label, y_label: with units.
    """

    x: np.ndarray
    y: np.ndarray
    fitted: np.ndarray
    x_label: str
    y_label: str


@dataclass(frozen=True, eq=False)
class Evidence:
    """What one test says about one effect.

    Attributes:
        effect: its name.
        statistic: standardised gain in log-likelihood, the largest over what the effect leaves
            open (lag, frequency, time, shape).
        p_value: probability of as large a statistic where the effect is absent.
        gain: in log-likelihood of the whitened residual at that place [nats].
        size: root mean square of the fitted effect [output].
        where: what was left open, as found: channel, delay, period, time, limits, ...
        sentence: what it says, in an engineer's words, with units.
        curve: its picture, or None. output: name of the output that was tested; the search sets it.
    """

    effect: str
    statistic: float
    p_value: float
    gain: float
    size: float
    where: Mapping[str, float | str] = field(default_factory=dict)
    sentence: str = ""
    curve: Curve | None = None
    output: str = ""

    @property
    def place(self) -> str:
        """The channel, or else the instant, period, ... that suits best, in words; "" for none."""
        for name in PLACES:
            value = self.where.get(name)
            if value not in (None, ""):
                said = f"{value:.4g}" if isinstance(value, float) else str(value)
                return said if name in ("channel", "what") else f"{name.replace('_', ' ')} {said}"
        return ""
