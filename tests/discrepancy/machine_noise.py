"""Measurement noise, process noise, and machines under a controller that both disturb."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tests.discrepancy.machine_inputs import Array, Generator
from tests.discrepancy.machine_planting import Planted
from tests.discrepancy.machine_rigs import LEAD, Rig
from tests.discrepancy.machine_systems import System, solve, solve_loop

DEGREES = {"weak": 8.0, "middle": 4.0, "strong": 2.5}
SPREADS = {"weak": 0.25, "middle": 0.5, "strong": 1.0}
SHARES = {"weak": 0.1, "middle": 0.2, "strong": 0.3}
# First noise that is tried in a loop, over the size of the set point, and how many are.
FIRST, ITERATIONS = 0.05, 15
# Of a loop with noise, largest size of a sample over that of the set point.
BOUNDED = 100.0


def gaussian(rng: Generator, n: int, n_y: int) -> Array:
    """Noise (n, n_y) of unit size."""
    return np.asarray(rng.standard_normal((n, n_y)))


def heavy_tailed(rng: Generator, n: int, n_y: int, degrees: float) -> Array:
    """Student-t noise (n, n_y), scaled so that its variance is one."""
    return np.asarray(rng.standard_t(degrees, (n, n_y)) * np.sqrt((degrees - 2) / degrees))


def profile(rng: Generator, u: Array, clean: Array, spread: float) -> Array:
    """Standard deviations (n, n_y) of noise that grows along the input or the output.

    Their logarithm has the standard deviation `spread`; their root mean square is one.
    """
    of_output = bool(rng.uniform() < 0.5)
    driver = clean if of_output else np.repeat(u[-len(clean) :], clean.shape[1], axis=1)
    z = (driver - driver.mean(axis=0)) / driver.std(axis=0)
    sd = np.exp(float(rng.choice([-1.0, 1.0])) * spread * z)
    return np.asarray(sd / np.sqrt(np.mean(sd**2, axis=0)))


def process_noise(rng: Generator, rig: Rig) -> Array:
    """What white noise in all states makes of the outputs, (total, n_y), of unit size.

    Every state is shaken in proportion to its rate, so that slow ones do not outweigh the others.
    """
    system = rig.system
    shaken = System(
        system.A, np.diag(np.sqrt(np.abs(np.diag(system.A)) + 1e-12)), system.C,
        np.zeros(len(system.C)), np.zeros(len(system.A)),
    )  # fmt: skip
    white = rng.standard_normal((rig.total, len(system.A)))
    states = solve(shaken, np.repeat(white, rig.parts, axis=0), rig.step, rig.parts)
    w = shaken.output(states)
    return np.asarray(w / w[LEAD:].std(axis=0))


@dataclass(frozen=True, eq=False)
class Loop:
    """A PI controller around a machine with one input and one output.

    Attributes:
        wanted: (total,) set point [output]. gains: K [input / output] and T [s].
        white, slow: (total, 1) measurement noise and load disturbance at the output, unit size.
        ratio: of the disturbance to the measurement noise.
    """

    wanted: Array
    gains: tuple[float, float]
    white: Array
    slow: Array
    ratio: float

    def disturbance(self, noise_sd: float) -> Array:
        """Noise and disturbance (total,) of the measured output."""
        return np.asarray(noise_sd * (self.white + self.ratio * self.slow)[:, 0])


def random_loop(rng: Generator, rig: Rig) -> Loop:
    """A controller for a machine whose set point takes random steps."""
    system = rig.system
    gain = float((-system.C @ np.linalg.solve(system.A, system.B[:, 0]))[0])
    mean = float(system.level[0] + (system.C @ system.rest)[0])
    swing = gain * float(np.abs(rig.u - rig.u.mean()).max()) * rng.uniform(0.5, 0.9)
    held = 1 + rng.geometric(1 / (rig.memory * rng.uniform(1.0, 3.0)), rig.total)
    wanted = mean + swing * np.repeat(rng.uniform(-1, 1, rig.total), held)[: rig.total]
    slow = rig.memory * rig.step
    gains = (rng.uniform(0.5, 2.5) / gain, slow * rng.uniform(0.7, 1.5))
    return Loop(
        wanted, gains, gaussian(rng, rig.total, 1), process_noise(rng, rig), rng.uniform(2.0, 6.0)
    )  # fmt: skip


def controlled_input(rig: Rig, loop: Loop, planted: Planted, noise_sd: float) -> Array:
    """Input (total, 1) that the controller makes of set point, noise and disturbance."""
    system, parts = rig.system, rig.parts
    for planting, amount in planted:
        if planting.system:
            system = planting.system(system, amount)
    bias = float(rig.u.mean()) if "inflow" not in rig.numbers else rig.numbers["inflow"]
    parts = 2 * parts if system.terms else parts
    u = solve_loop(
        system, loop.wanted, loop.disturbance(noise_sd), loop.gains, bias, rig.step, parts
    )  # fmt: skip
    return u[:, None]


def fed_back(rig: Rig, loop: Loop, planted: Planted, share: float) -> tuple[Rig, float] | None:
    """The machine with the input of its loop, and the noise which makes that share of the input.

    The share is the standard deviation of what noise and disturbance make of the input over that of
    the input. None where the loop is not stable, or no noise makes it.
    """
    quiet = controlled_input(rig, loop, planted, 0.0)
    size = float(loop.wanted.std())

    if not np.isfinite(quiet).all() or np.abs(quiet - quiet.mean()).max() > BOUNDED * rig.u.std():
        return None
    level = FIRST * size
    for _ in range(ITERATIONS):
        u = controlled_input(rig, loop, planted, level)
        if not np.isfinite(u).all():
            return None
        found = float((u - quiet)[LEAD:].std() / u[LEAD:].std())
        if abs(found / share - 1) < 1e-3:
            return replace(rig, u=u), level
        # Of independent parts the share is a L / sqrt(b + a^2 L^2), of which this is Newton's step.
        change = np.log(share / found) / max(1 - found**2, 0.05)
        level *= float(np.exp(np.clip(change, -2.0, 2.0)))
    return None
