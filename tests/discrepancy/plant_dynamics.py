"""Linear systems of the synthetic plants, one sample as unit of time.

A system is a sum of conjugate pairs of poles, y = 2 Re sum_m x_m with dx_m/dt = p_m x_m + b_m u and
the inputs held between samples. Everything is exact at the samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.signal import lfilter

from pyro_dynogp.examples.simulators import simulate_states

Array = NDArray[np.float64]
Function = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class System:
    """Poles (P,) [rad/sample] and gains of the inputs (P, n_u), both complex."""

    poles: NDArray[np.complex128]
    gains: NDArray[np.complex128]

    def scaled(self, factor: float) -> System:
        """The same poles, `factor` times the output."""
        return System(self.poles, self.gains * factor)

    @property
    def static_gain(self) -> Array:
        """Output (n_u,) in the long run for a unit of each input."""
        return np.asarray(-2 * (self.gains / self.poles[:, None]).real.sum(axis=0))


def joined(first: System, second: System) -> System:
    """Both systems in parallel, on the same inputs."""
    return System(
        np.concatenate([first.poles, second.poles]), np.concatenate([first.gains, second.gains])
    )


def mode(pole: complex, u: Array, delay: float = 0.0) -> NDArray[np.complex128]:
    """State x of one mode at the samples, from zero, for the inputs u (n, ...), `delay` late."""
    whole = int(np.floor(delay))
    part = delay - whole
    a = np.exp(pole)
    # Over one step the older input acts for the first `part`, the newer one for the rest.
    newer = (np.exp(pole * (1 - part)) - 1) / pole
    older = np.exp(pole * (1 - part)) * (np.exp(pole * part) - 1) / pole
    return np.asarray(lfilter([*([0.0] * (whole + 1)), newer, older], [1, -a], u, axis=0))


def mode_slope(pole: complex, u: Array, x: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Derivative of the state x of a mode by its pole, for the inputs u (n, ...)."""
    a = np.exp(pole)
    slope = (a - (a - 1) / pole) / pole  # of (e^p - 1) / p
    return np.asarray(lfilter([0, 1], [1, -a], a * x + slope * u, axis=0))


def response(system: System, u: Array, delay: float = 0.0) -> Array:
    """Output (n,) for inputs u (n, n_u) that act `delay` samples late; any real delay >= 0."""
    modes = (
        mode(p, u @ b, delay) for p, b in zip(system.poles, system.gains, strict=True)
    )  # fmt: skip
    return np.asarray(2 * sum(x.real for x in modes))


def varying_response(system: System, u: Array, factor: Array) -> Array:
    """Output (n,) where the poles over step k are `factor[k]` times those of the system."""
    poles = factor[:, None] * system.poles
    a = np.exp(poles)
    drive = (a - 1) / poles * (u @ system.gains.T)
    x = np.zeros(len(system.poles), dtype=complex)
    out = np.zeros(len(u))
    for k in range(len(u) - 1):
        x = a[k] * x + drive[k]
        out[k + 1] = 2 * x.real.sum()
    return out


def looped_response(
    system: System, u: Array, back: NDArray[np.complex128], curve: Function, w: Array
) -> Array:
    """Output (n,) where a curve of it, held from sample to sample, acts by gains `back` (P,).

    Args:
        w: (n,) disturbance of the output, which the curve sees as well.
    """
    a = np.exp(system.poles)
    gamma = (a - 1) / system.poles
    drive, back = gamma * (u @ system.gains.T), gamma * back
    x = np.zeros(len(system.poles), dtype=complex)
    out = np.zeros(len(u))
    for k in range(len(u)):
        out[k] = 2 * x.real.sum() + w[k]
        x = a * x + drive[k] + back * float(curve(out[k]))
    return out


def process_noise(system: System, n: int, rng: np.random.Generator) -> Array:
    """Output (n,) of the system's modes driven by one Brownian motion, from zero, no unit."""
    weights = rng.standard_normal((len(system.poles), 2))
    # Slow modes would outweigh all others: each gets about the same variance.
    weights *= np.sqrt(np.abs(system.poles.real))[:, None]
    A = block_diag(*(np.array([[p.real, -p.imag], [p.imag, p.real]]) for p in system.poles))
    order = len(A)
    states = simulate_states(
        A, np.zeros((order, 1)), weights.reshape(order, 1), np.zeros((n, 1)), 1.0, rng
    )
    return np.asarray(2 * states[:, ::2].sum(axis=1))


def play(x: Array, half_width: float) -> Array:
    """Backlash: the output follows x only where x pushes it, through a gap of two half widths."""
    out = np.empty_like(x)
    last = x[0]
    for k, value in enumerate(x):
        last = min(max(last, value - half_width), value + half_width)
        out[k] = last
    return out
