"""What a synthetic plant is before anything is planted: inputs, system, clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.signal import lfilter

from tests.discrepancy.plant_dynamics import (
    Array,
    Function,
    System,
    process_noise,
    response,
)

# Samples before and after the record, so that it starts in full swing and inputs can be shifted.
LEAD, TAIL = 400, 16
ZONE = "Europe/Berlin"
STEPS = (0.01, 0.05, 0.1, 0.5, 1.0, 5.0)
STAMPED_STEPS = (600.0, 900.0, 1800.0, 3600.0)
Generator = np.random.Generator


@dataclass(frozen=True, eq=False)
class Setting:
    """A plant without an effect; signals have a standard deviation of one over the record.

    Attributes:
        samples: n, length of the record.
        u: (LEAD + n + TAIL, n_u) inputs.
        system: linear part. shape: static nonlinearity behind it, or None.
        noise_level: of the measurement noise, over the standard deviation of the output.
        step: sampling step [s]. start: instant of the first sample, or None for plain time.
    """

    samples: int
    u: Array
    system: System
    shape: Function | None
    noise_level: float
    step: float
    start: pd.Timestamp | None

    @property
    def window(self) -> slice:
        """Where the record is in the signals."""
        return slice(LEAD, LEAD + self.samples)

    @property
    def linear(self) -> Array:
        """Linear output g, lead and tail included."""
        return response(self.system, self.u)

    def observe(self, g: Array) -> Array:
        """Output (n,) of the record for a linear output g with lead and tail."""
        cut = g[self.window]
        return cut if self.shape is None else self.shape(cut)

    def stamps(self, step: float) -> pd.DatetimeIndex:
        """Time stamps (n,) in local time."""
        assert self.start is not None
        elapsed = pd.to_timedelta(np.arange(self.samples) * step, unit="s")
        return pd.DatetimeIndex(self.start.tz_convert("UTC") + elapsed).tz_convert(ZONE)


@dataclass(frozen=True)
class Wish:
    """What an effect asks of the plant around it.

    Attributes:
        wiener: whether a static nonlinearity may stand behind the system.
        stamps: True for time stamps, None for either.
        step: sampling step [s], or None for any.
        periods: shortest and longest period of the poles [samples].
    """

    wiener: bool = True
    stamps: bool | None = None
    step: float | None = None
    periods: tuple[float, float] = (10.0, 60.0)


def standard(x: Array, window: slice) -> Array:
    """Mean zero and standard deviation one over the window."""
    return np.asarray((x - x[window].mean()) / x[window].std())


def random_pole(rng: Generator, periods: tuple[float, float]) -> complex:
    """Natural period log-uniform [samples], damping ratio uniform in 0.25 to 0.9."""
    frequency = 2 * np.pi / np.exp(rng.uniform(*np.log(periods)))
    damping = rng.uniform(0.25, 0.9)
    return complex(frequency * (-damping + 1j * np.sqrt(1 - damping**2)))


def random_gains(rng: Generator, n_u: int) -> NDArray[np.complex128]:
    """Complex normal gains (1, n_u) of one pair."""
    return np.asarray(rng.standard_normal((1, n_u)) + 1j * rng.standard_normal((1, n_u)))


def random_system(
    rng: Generator, u: Array, window: slice, pairs: int, periods: tuple[float, float]
) -> System:
    """Pairs of comparable size, apart in frequency; output of standard deviation one."""
    poles = [random_pole(rng, periods)]
    while len(poles) < pairs:
        pole = random_pole(rng, periods)
        if all(abs(np.log(abs(pole) / abs(other))) > np.log(1.6) for other in poles):
            poles.append(pole)
    parts = []
    for pole in poles:
        one = System(np.array([pole]), random_gains(rng, u.shape[1]))
        parts.append(one.scaled(rng.uniform(0.5, 1.5) / response(one, u)[window].std()).gains)
    system = System(np.array(poles), np.concatenate(parts))
    return system.scaled(1 / response(system, u)[window].std())


def random_signal(rng: Generator, n: int, kind: str | None = None) -> Array:
    """A signal (n,) of a random spectrum: "autoregressive", "multisine" or "steps"."""
    kind = kind or str(rng.choice(["autoregressive", "multisine", "steps"]))
    if kind == "autoregressive":
        first, second = np.exp(-1 / rng.uniform(2.0, 12.0)), rng.uniform(0.0, 0.6)
        denominator = np.convolve([1, -first], [1, -second])
        return np.asarray(lfilter([1], denominator, rng.standard_normal(n + 200))[200:])
    if kind == "multisine":
        frequencies = rng.uniform(0.002, rng.uniform(0.05, 0.2), int(rng.integers(20, 41)))
        phases = rng.uniform(0, 2 * np.pi, len(frequencies))
        angle = 2 * np.pi * frequencies * np.arange(n)[:, None]
        return np.asarray(np.cos(angle + phases).sum(axis=1))
    held = 1 + rng.geometric(1 / rng.uniform(4.0, 20.0), n)
    return np.repeat(rng.standard_normal(n), held)[:n]


def random_shape(rng: Generator, g: Array) -> Function:
    """A smooth sensor curve, scaled so that its output has mean zero and deviation one on g."""
    curves: Mapping[str, Function] = {
        "bend": lambda x: np.asarray(np.tanh(0.9 * x) + 0.3 * np.tanh(0.9 * x) ** 2),
        "rectifier": lambda x: np.asarray(np.logaddexp(0.0, 3.0 * x) / 3.0),
        "square": lambda x: np.asarray(x + 0.3 * x**2),
    }
    curve = curves[str(rng.choice(list(curves)))]
    mean, sd = curve(g).mean(), curve(g).std()
    return lambda x: np.asarray((curve(x) - mean) / sd)


def random_setting(rng: Generator, samples: int, wish: Wish) -> Setting:
    """A plant without an effect, as the effect to be planted needs it."""
    window = slice(LEAD, LEAD + samples)
    length = LEAD + samples + TAIL
    n_u, pairs = int(rng.integers(1, 3)), int(rng.integers(1, 3))
    u = np.column_stack([standard(random_signal(rng, length), window) for _ in range(n_u)])
    system = random_system(rng, u, window, pairs, wish.periods)
    shape = None
    # Drawn in any case, so that later draws do not depend on it.
    wiener, curve_seed = rng.uniform() < 1 / 3, int(rng.integers(2**31))
    if wish.wiener and wiener:
        curve_rng = np.random.default_rng(curve_seed)
        shape = random_shape(curve_rng, response(system, u)[window])
    noise_level = float(np.exp(rng.uniform(np.log(0.02), np.log(0.1))))
    stamped = bool(rng.uniform() < 0.5) if wish.stamps is None else wish.stamps
    step = float(rng.choice(STAMPED_STEPS if stamped else STEPS))
    start = pd.Timestamp("2023-01-02", tz="UTC") + pd.Timedelta(hours=int(rng.integers(300 * 24)))
    return Setting(
        samples,
        u,
        system,
        shape,
        noise_level,
        wish.step or step,
        start.tz_convert(ZONE) if stamped else None,
    )


def unit_process_noise(setting: Setting, rng: Generator) -> Array:
    """Process noise at the linear output, lead and tail included, deviation one on the record."""
    return standard(process_noise(setting.system, len(setting.u), rng), setting.window)
