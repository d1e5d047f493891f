"""The machines without an effect: parameters, excitation and sampling, drawn by a generator.

Every parameter lies between 70 and 130 % of its nominal value.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from tests.discrepancy.machine_inputs import Array, Generator, excitation, temperature
from tests.discrepancy.machine_systems import System, parts_of

# Samples before the record, so that it does not start at rest.
LEAD = 320
HOUR = 3600.0


@dataclass(frozen=True, eq=False)
class Rig:
    """A machine, ready to be run.

    Attributes:
        system: its linear dynamics.
        u: (LEAD + n, 1) input, as it acts and as it is recorded.
        step: between samples [s]. samples: n. parts: steps of the solver within a sample.
        pairs: of poles that a model needs, one for each real pole or each pair.
        memory: slowest time constant [samples].
        split: "development" or "final".
        names: of input and outputs. units: of input and outputs.
        curve: of a sensor that the model accounts for, or None.
        stamps: (n,) of the record, or None.
        numbers: physical quantities that effects need, by name.
    """

    system: System
    u: Array
    step: float
    samples: int
    parts: int
    pairs: int
    memory: float
    split: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    curve: Callable[[Array], Array] | None = None
    stamps: pd.DatetimeIndex | None = None
    numbers: Mapping[str, float] = field(default_factory=dict)

    @property
    def total(self) -> int:
        """Samples with the lead."""
        return len(self.u)


def near(rng: Generator, nominal: float) -> float:
    """A parameter between 70 and 130 % of its nominal value."""
    return float(nominal * rng.uniform(0.7, 1.3))


def slowest(system: System) -> float:
    """Slowest time constant [time unit], poles at zero left out."""
    rates = -system.rates.real
    return float(1 / rates[rates > 1e-9 * rates.max()].min())


def _system(A: Array, B: Array, C: Array, level: Array, u0: float = 0.0) -> System:
    """At rest for an input u0 and no other drive; level: of the output at state zero."""
    rest = -np.linalg.solve(A, B[:, 0] * u0) if u0 else np.zeros(len(A))
    return System(A, B, C, level, rest)


def tanks(rng: Generator, samples: int, split: str) -> Rig:
    """One to three tanks in a chain; inflow [cm3/s] to level of the last [cm]."""
    count = int(rng.integers(1, 4))
    areas = np.array([near(rng, 200.0) for _ in range(count)])
    k = np.array([near(rng, 2.0) for _ in range(count)])
    inflow = near(rng, 40.0)
    A = np.diag(-k / areas) + np.diag((k[:-1] / areas[1:]), -1)
    B = np.zeros((count, 2))
    B[0, 0] = 1 / areas[0]
    entry = int(rng.integers(count))
    B[entry, 1] = 1 / areas[entry]
    system = _system(A, B, np.eye(count)[[-1]], np.zeros(1), inflow)
    memory = rng.uniform(5.0, 12.0)
    u = excitation(rng, LEAD + samples, memory, split)
    swing = rng.uniform(0.5, 0.85)
    numbers = {"inflow": inflow} | {f"area {i}": float(areas[i]) for i in range(count)}
    numbers |= {f"outflow {i}": float(k[i]) for i in range(count)}
    return _rig(
        system, inflow * (1 + swing * u), slowest(system) / memory, samples, count, split,
        ("inflow", "level"), ("cm3/s", "cm"), numbers,
    )  # fmt: skip


def motor(rng: Generator, samples: int, split: str, *, position: bool = False) -> Rig:
    """A motor with direct current: voltage [V] to speed [rad/s], or to angle [rad]."""
    resistance, inductance = near(rng, 1.0), near(rng, 0.01)
    constant, inertia, friction = near(rng, 0.05), near(rng, 2e-4), near(rng, 2e-4)
    A = np.array(
        [
            [-resistance / inductance, -constant / inductance],
            [constant / inertia, -friction / inertia],
        ]
    )
    B = np.array([[1 / inductance, 0.0], [0.0, 1 / inertia]])
    speed = System(A, B, np.array([[0.0, 1.0]]), np.zeros(1), np.zeros(2))
    memory = rng.uniform(5.0, 12.0)
    u = near(rng, 12.0) * excitation(rng, LEAD + samples, memory, split)
    numbers = {
        "constant": constant, "resistance": resistance, "inductance": inductance,
        "inertia": inertia, "friction": friction,
    }  # fmt: skip
    rig = _rig(
        speed, u, slowest(speed) / memory, samples, 2, split, ("voltage", "speed"), ("V", "rad/s"),
        numbers,
    )  # fmt: skip
    if not position:
        return rig
    turned = np.zeros((3, 3))
    turned[:2, :2], turned[2, 1] = A, 1.0
    system = System(
        turned, np.vstack([B, np.zeros(2)]), np.eye(3)[[2]], np.zeros(1), np.zeros(3)
    )  # fmt: skip
    return replace(rig, system=system, names=("voltage", "angle"), units=("V", "rad"))


def masses(rng: Generator, samples: int, split: str, *, count: int | None = None) -> Rig:
    """One or two masses with springs and dampers: force [N] to position of the first [m]."""
    count = int(rng.integers(1, 3)) if count is None else count
    m, k, c = near(rng, 1.0), near(rng, 100.0), near(rng, 4.0)
    if count == 1:
        A = np.array([[0.0, 1.0], [-k / m, -c / m]])
    else:
        A = coupled(m, k, c, near(rng, 0.6), near(rng, 120.0), near(rng, 3.0))
    B = np.zeros((len(A), 2))
    B[1] = 1 / m
    system = System(A, B, np.eye(len(A))[[0]], np.zeros(1), np.zeros(len(A)))
    per_period = rng.uniform(10.0, 20.0)
    step = 2 * np.pi / (per_period * np.sqrt(k / m))
    suited = slowest(system) / step
    u = near(rng, 10.0) * excitation(rng, LEAD + samples, 0.5 * suited, split)
    numbers = {"mass": m, "spring": k, "damper": c}
    return _rig(
        system, u, step, samples, count, split, ("force", "position"), ("N", "m"), numbers
    )  # fmt: skip


def coupled(m: float, k: float, c: float, m2: float, k2: float, c2: float) -> Array:
    """Matrix of a mass on a wall with a second one on it: (x1, v1, x2, v2)."""
    return np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [-(k + k2) / m, -(c + c2) / m, k2 / m, c2 / m],
            [0.0, 0.0, 0.0, 1.0],
            [k2 / m2, c2 / m2, -k2 / m2, -c2 / m2],
        ]
    )


def exchanger(rng: Generator, samples: int, split: str) -> Rig:
    """Two time constants from flow [l/s] to temperature [degC], which falls as the flow grows."""
    first, second = near(rng, 20.0), near(rng, 6.0)
    slope, flow, inlet = -near(rng, 40.0), near(rng, 0.4), near(rng, 90.0)
    A = np.array([[-1 / first, 0.0], [1 / second, -1 / second]])
    B = np.array([[slope / first, 1 / first], [0.0, 0.0]])
    # The state is the difference to the temperature without flow.
    system = _system(A, B, np.array([[0.0, 1.0]]), np.array([inlet]), flow)
    memory = rng.uniform(5.0, 12.0)
    u = flow * (1 + rng.uniform(0.6, 0.9) * excitation(rng, LEAD + samples, memory, split))
    return _rig(
        system, u, slowest(system) / memory, samples, 2, split, ("flow", "temperature"),
        ("l/s", "degC"), {"flow": flow},
    )  # fmt: skip


def load(rng: Generator, samples: int, split: str) -> Rig:
    """Electric heating of a building [kW] from the outdoor temperature [degC], every hour."""
    values, stamps = temperature(rng, LEAD + samples, split)
    quick, slow = near(rng, 2.0) * HOUR, near(rng, 15.0) * HOUR
    share, slope, base = near(rng, 0.6), -near(rng, 5.0), near(rng, 300.0)
    A = np.diag([-1 / quick, -1 / slow])
    B = np.array([[1 / quick, 0.0], [1 / slow, 0.0]])
    C = slope * np.array([[share, 1 - share]])
    system = _system(A, B, C, np.array([base]), float(values[:48].mean()))
    rig = _rig(
        system, values, HOUR, samples, 2, split, ("outdoor temperature", "load"), ("degC", "kW"), {}
    )
    return replace(rig, stamps=stamps[LEAD:])


def two_outputs(rng: Generator, samples: int, split: str) -> Rig:
    """One or two masses with position and speed measured, or a motor with speed and current."""
    if rng.uniform() < 0.6:
        rig = masses(rng, samples, split)
        C = np.eye(len(rig.system.A))[[0, 1]]
        names, units = ("force", "position", "speed"), ("N", "m", "m/s")
    else:
        rig = motor(rng, samples, split)
        C = np.eye(2)[[1, 0]]
        names, units = ("voltage", "speed", "current"), ("V", "rad/s", "A")
    system = replace(rig.system, C=C, level=np.zeros(2))
    return replace(rig, system=system, names=names, units=units)


def sensor(rng: Generator, samples: int, split: str) -> Rig:
    """A motor whose speed is measured by a sensor with a smooth curve, which the model has [V]."""
    rig = motor(rng, samples, split)
    size = float(np.abs(rig.u).max() / rig.numbers["constant"])
    kind, bend = str(rng.choice(["bounded", "rectified"])), rng.uniform(1.0, 2.0)

    def curve(speed: Array) -> Array:
        z = bend * speed / size
        return np.asarray(5 * np.tanh(z) if kind == "bounded" else np.logaddexp(0.0, 4 * z))

    return replace(rig, curve=curve, names=("voltage", "signal"), units=("V", "V"))


def loop(rng: Generator, samples: int, split: str) -> Rig:
    """Tanks or a motor, whose input a controller will make."""
    return tanks(rng, samples, split) if rng.uniform() < 0.5 else motor(rng, samples, split)


def _rig(
    system: System, u: Array, step: float, samples: int, pairs: int, split: str,
    names: tuple[str, ...], units: tuple[str, ...], numbers: Mapping[str, float],
) -> Rig:  # fmt: skip
    return Rig(
        system, u[:, None], step, samples, parts_of(system, step), pairs, slowest(system) / step,
        split, names, units, numbers=numbers,
    )  # fmt: skip
