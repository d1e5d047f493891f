"""Noise of the synthetic plants: what is wrong with it by plan, and a loop closed around it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import brentq

from tests.discrepancy.plant_dynamics import Array, System
from tests.discrepancy.plant_setting import Generator, Setting

# The largest modulus of a closed loop's eigenvalues.
STABLE = 0.985


def heavy_tails(rng: Generator, n: int, degrees: float) -> Array:
    """Student-t noise (n,), scaled to a standard deviation of one (of the distribution)."""
    return np.asarray(rng.standard_t(degrees, n) / np.sqrt(degrees / (degrees - 2)))


def heteroscedastic(
    rng: Generator, setting: Setting, clean: Array, spread: float
) -> tuple[Array, dict[str, Any]]:
    """Gaussian noise (n,) of mean square one, whose log standard deviation follows a signal.

    Args:
        rng: source. setting: plant. clean: noise-free output (n,).
        spread: standard deviation of the logarithm of the noise's standard deviation.
    """
    by = str(rng.choice(["input", "output"]))
    channel = int(rng.integers(setting.u.shape[1]))
    z = setting.u[setting.window, channel] if by == "input" else clean
    z = np.clip((z - z.mean()) / z.std(), -2.0, 2.0)
    sign = float(rng.choice([-1.0, 1.0]))
    sd = np.exp(sign * spread * (z - z.mean()) / z.std())
    sd = sd / np.sqrt(np.mean(sd**2))
    named = f"input {channel}" if by == "input" else "output"
    return sd * rng.standard_normal(len(clean)), {"follows": named, "sign": sign, "sd": sd}


@dataclass(frozen=True, eq=False)
class Loop:
    """A closed loop.

    Attributes:
        u: inputs (N, n_u) as applied. noise_scale: factor of all disturbances.
        gain: of the controller. delay: of the controller [samples].
    """

    u: Array
    noise_scale: float
    gain: float
    delay: int


def close_loop_around(
    setting: Setting, rng: Generator, disturbance: Array, share: float
) -> Loop:  # fmt: skip
    """Close a loop from the measured output to the first input.

    The controller is u[k] = r[k] - gain y[k - delay]; the setting's inputs are the references r.

    Args:
        setting: linear plant. rng: source of the controller.
        disturbance: (N,) all noise at the output, measurement noise included, up to a factor.
        share: root mean square of that part of the first input which the disturbance causes, over
            that of the whole input; the factor of the disturbance is set so.
    """
    delay = int(rng.integers(1, 4))
    sign = float(np.sign(setting.system.static_gain[0])) or 1.0
    gains = np.geomspace(0.05, 20.0, 80)
    stable = [k for k in gains if _radius(setting.system, sign * k, delay) <= STABLE]
    gain = sign * float(rng.uniform(0.4, 0.8) * (max(stable) if stable else gains[0]))
    quiet = _run(setting.system, setting.u, np.zeros(len(setting.u)), gain, delay)
    noisy = _run(setting.system, np.zeros_like(setting.u), disturbance, gain, delay)

    def excess(log_scale: float) -> float:
        part = np.exp(log_scale) * noisy[setting.window, 0]
        whole = quiet[setting.window, 0] + part
        return float(part.std() / whole.std()) - share

    scale = float(np.exp(brentq(excess, -8.0, 8.0)))
    return Loop(quiet + scale * noisy, scale, gain, delay)


def _run(system: System, reference: Array, disturbance: Array, gain: float, delay: int) -> Array:
    """Inputs (N, n_u) of the loop, from rest."""
    a = np.exp(system.poles)
    drive = ((a - 1) / system.poles)[:, None] * system.gains
    x = np.zeros(len(a), dtype=complex)
    measured = np.zeros(len(reference))
    u = reference.copy()
    for k in range(len(u)):
        measured[k] = 2 * x.real.sum() + disturbance[k]
        if k >= delay:
            u[k, 0] -= gain * measured[k - delay]
        x = a * x + drive @ u[k]
    return u


def _radius(system: System, gain: float, delay: int) -> float:
    """Largest modulus of the eigenvalues of the loop."""
    a = np.exp(system.poles)
    drive = (a - 1) / system.poles * system.gains[:, 0]
    order = 2 * len(a)
    A = np.zeros((order + delay, order + delay))
    A[:order, :order] = block_diag(*(np.array([[p.real, -p.imag], [p.imag, p.real]]) for p in a))
    A[:order, -1] = -gain * np.column_stack([drive.real, drive.imag]).ravel()
    A[order, :order:2] = 2.0
    A[order + 1 :, order:-1] = np.eye(delay - 1)
    return float(np.abs(np.linalg.eigvals(A)).max())
