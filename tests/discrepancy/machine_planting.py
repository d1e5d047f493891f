"""What an effect changes in a machine, by its amount, and how a machine with effects runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tests.discrepancy.machine_inputs import Array
from tests.discrepancy.machine_rigs import LEAD, Rig
from tests.discrepancy.machine_systems import System, solve

# How the size of an effect is measured; see `machine_sizes`.
PLAIN, BEYOND_LAGS, BEYOND_ORDER, INTEGRAL = "plain", "beyond lags", "beyond order", "integral"


@dataclass(frozen=True, eq=False)
class Planting:
    """One effect; what it does not change is None.

    Attributes:
        effect: its name. accepted: names that say it right. measure: of its size.
        amounts: smallest and largest amount, or all that there are where `discrete`.
        system: of the system without the effect. acting: of the input in each part of a sample,
            (total parts, 1). drive: the last drive of the system, (total,).
        sensor: of the outputs (n, n_y), in the order of `stage`.
        limit: of outputs with their noise, which the sensor does last.
        recorded: of the input (total, 1) that acts, what is recorded in its place.
        prepare: of the machine, which has another input then.
        channel: (n,) that acts and is recorded beside the inputs.
    """

    effect: str
    accepted: tuple[str, ...]
    measure: str
    amounts: tuple[float, ...]
    discrete: bool = False
    system: Callable[[System, float], System] | None = None
    acting: Callable[[Array, float], Array] | None = None
    drive: Callable[[float], Array] | None = None
    sensor: Callable[[Array, float], Array] | None = None
    stage: int = 0
    limit: Callable[[Array, float], Array] | None = None
    recorded: Callable[[Array, float], Array] | None = None
    prepare: Callable[[Rig, float], Rig] | None = None
    channel: Callable[[float], Array] | None = None


Planted = Sequence[tuple[Planting, float]]


@dataclass(frozen=True, eq=False)
class Run:
    """What a machine without noise does.

    Attributes:
        u: (total, 1) recorded input.
        linear: (n, n_y) output of the dynamics, in front of the sensor.
        output: (n, n_y) behind the sensor, but for its limits.
    """

    u: Array
    linear: Array
    output: Array


def states_of(rig: Rig, planted: Planted = ()) -> Array:
    """States (total, s) of a machine with effects."""
    system, parts = rig.system, rig.parts
    v = np.repeat(rig.u, parts, axis=0)
    other = np.zeros(rig.total)
    for planting, amount in planted:
        if planting.system:
            system = planting.system(system, amount)
        if planting.acting:
            v = planting.acting(v, amount)
        if planting.drive:
            other = other + planting.drive(amount)
    if system.terms:  # which may be faster than the linear part
        parts, v = 2 * parts, np.repeat(v, 2, axis=0)
    drives = np.column_stack([v, np.repeat(other, parts)])
    return solve(system, drives, rig.step, parts)


def run(rig: Rig, planted: Planted = ()) -> Run:
    """Run a machine with effects and without noise.

    Args:
        rig: the machine; it is prepared for the effects already.
        planted: effects with their amounts.
    """
    states = states_of(rig, planted)
    system, u = rig.system, rig.u
    for planting, amount in planted:
        if planting.system:
            system = planting.system(system, amount)
        if planting.recorded:
            u = planting.recorded(u, amount)
    linear = system.output(states)[LEAD:]
    output = rig.curve(linear) if rig.curve else linear
    for planting, amount in sorted(planted, key=lambda p: p[0].stage):
        if planting.sensor:
            output = planting.sensor(output, amount)
    return Run(u, linear, output)


def limited(output: Array, planted: Planted) -> Array:
    """Outputs (n, n_y) within the limits of the sensors."""
    for planting, amount in planted:
        if planting.limit:
            output = planting.limit(output, amount)
    return output


@dataclass(frozen=True, eq=False)
class Ground:
    """A machine that runs without effects, from which they take their scales.

    Attributes:
        rig: the machine. states: (total, s). output: (n, n_y) behind the curve of the sensor.
    """

    rig: Rig
    states: Array
    output: Array

    @property
    def sd(self) -> Array:
        """Standard deviations (n_y,) of the outputs."""
        return np.asarray(self.output.std(axis=0))

    def unit_drive(self, drive: Array) -> Array:
        """A drive (total,) scaled so that the output changes by its own standard deviation.

        Of several outputs, the one that changes most.
        """
        quiet = replace(self.rig, u=np.zeros_like(self.rig.u), curve=None)
        system = replace(self.rig.system, rest=np.zeros_like(self.rig.system.rest))
        one = Planting("", (), PLAIN, (1.0,), drive=lambda _: drive)
        change = run(replace(quiet, system=system), [(one, 1.0)]).linear.std(axis=0)
        before = self.rig.system.output(self.states)[LEAD:].std(axis=0)
        return np.asarray(drive / (change / before).max())


def ground(rig: Rig) -> Ground:
    """The machine as it runs without effects."""
    states = states_of(rig)
    linear = rig.system.output(states)[LEAD:]
    return Ground(rig, states, rig.curve(linear) if rig.curve else linear)
