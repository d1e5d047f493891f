"""Effects in the machines' dynamics, actuators and sensors; each builder draws what is random."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from tests.discrepancy import machine_disturbances as disturbances
from tests.discrepancy.machine_inputs import Array, Generator, without_slow_part
from tests.discrepancy.machine_planting import (
    BEYOND_LAGS,
    BEYOND_ORDER,
    INTEGRAL,
    Ground,
    Planting,
)
from tests.discrepancy.machine_rigs import LEAD, Rig, coupled
from tests.discrepancy.machine_sizes import number_of_lags
from tests.discrepancy.machine_systems import CUBE, ROOT, TANH, System, Term

Builder = Callable[[Ground, Generator], Planting]
# Half width of Coulomb friction's change of sign, over the standard deviation of the speed.
STICTION = 0.1


def nonlinear_feedback(base: Ground, rng: Generator) -> Planting:
    """Outflow by the square root, Coulomb friction, or a spring that hardens: as the machine is."""
    del rng
    numbers = base.rig.numbers
    if "inflow" in numbers:
        change, amounts = _root_outflow(base), (0.02, 1.0)
    elif "spring" in numbers:
        change, amounts = _cubic_spring(base), (0.003, 30.0)
    else:
        change, amounts = _coulomb_friction(base), (0.01, 1.6)
    return Planting(
        "nonlinear feedback", ("nonlinear feedback",), BEYOND_LAGS, amounts, system=change
    )  # fmt: skip


def _root_outflow(base: Ground) -> Callable[[System, float], System]:
    """Amount: share of the outflow that follows the square root of the level."""
    numbers, tanks = base.rig.numbers, len(base.rig.system.A)

    def change(system: System, amount: float) -> System:
        terms = []
        for j in range(tanks):
            k = numbers[f"outflow {j}"]
            flow = amount * k * np.sqrt(numbers["inflow"] / k)
            acts = np.zeros(tanks)
            acts[j] = -flow / numbers[f"area {j}"]
            if j + 1 < tanks:
                acts[j + 1] = flow / numbers[f"area {j + 1}"]
            terms.append(Term(ROOT, np.eye(tanks)[j], acts))
        return replace(system, A=(1 - amount) * system.A).with_terms(*terms)

    return change


def _cubic_spring(base: Ground) -> Callable[[System, float], System]:
    """Amount: force of the cubic part over that of the linear one, at one standard deviation."""
    numbers, place = base.rig.numbers, base.states[LEAD:, 0].std()
    cubic = numbers["spring"] / numbers["mass"] / place**2

    def change(system: System, amount: float) -> System:
        unit = np.eye(len(system.A))
        return system.with_terms(Term(CUBE, unit[0], -amount * cubic * unit[1]))

    return change


def _coulomb_friction(base: Ground) -> Callable[[System, float], System]:
    """Amount: torque of friction over the root mean square of that which drives."""
    numbers, states = base.rig.numbers, base.states[LEAD:]
    torque = numbers["constant"] * np.sqrt(np.mean(base.rig.u[LEAD:] ** 2)) / numbers["resistance"]
    scale = STICTION * float(states[:, 1].std())

    def change(system: System, amount: float) -> System:
        unit = np.eye(len(system.A))
        acts = -amount * torque / numbers["inertia"] * unit[1]
        return system.with_terms(Term(TANH, unit[1], acts, scale))

    return change


def unmodelled_dynamics(base: Ground, rng: Generator) -> Planting:
    """A second mass on the first; amount: its mass over that of the first."""
    numbers, tuned, damped = base.rig.numbers, rng.uniform(0.7, 1.6), rng.uniform(0.03, 0.15)

    def change(system: System, amount: float) -> System:
        m, k, c = numbers["mass"], numbers["spring"], numbers["damper"]
        m2 = amount * m
        rate = tuned * np.sqrt(k / m)
        A = coupled(m, k, c, m2, m2 * rate**2, 2 * damped * m2 * rate)
        wider = np.zeros((2, 2))
        terms = (
            replace(t, sees=np.pad(t.sees, (0, 2)), acts=np.pad(t.acts, (0, 2)))
            for t in system.terms
        )
        return System(
            A, np.vstack([system.B, wider]), np.pad(system.C, ((0, 0), (0, 2))), system.level,
            np.pad(system.rest, (0, 2)), tuple(terms),
        )  # fmt: skip

    name = "unmodelled dynamics"
    return Planting(name, (name,), BEYOND_ORDER, (0.01, 1.5), system=change)


def integrator(base: Ground, rng: Generator) -> Planting:
    """The angle is measured in place of the speed; amount: what is left of the slow voltage."""
    del base, rng

    def prepare(rig: Rig, amount: float) -> Rig:
        width = max(number_of_lags(rig) // 6, 3)
        return replace(rig, u=without_slow_part(rig.u[:, 0], width, amount)[:, None])

    return Planting("integrator", ("integrator",), INTEGRAL, (1e-3, 1.0), prepare=prepare)


def dead_time(base: Ground, rng: Generator) -> Planting:
    """The input acts later; amount: by how many samples."""
    del rng
    parts = base.rig.parts

    def acting(v: Array, amount: float) -> Array:
        late = round(amount * parts)
        return np.asarray(np.concatenate([np.repeat(v[:1], late, axis=0), v[: len(v) - late]]))

    return Planting("dead time", ("dead time",), BEYOND_ORDER, (0.3, 30.0), acting=acting)


def dead_zone(base: Ground, rng: Generator) -> Planting:
    """An amplifier without output around zero; amount: its half width over the input's size."""
    del rng
    size = float(base.rig.u.std())
    return Planting(
        "dead zone", ("dead zone", "input nonlinearity"), BEYOND_LAGS, (0.02, 1.5),
        acting=lambda v, amount: v - np.clip(v, -amount * size, amount * size),
    )  # fmt: skip


def amplifier_limit(base: Ground, rng: Generator) -> Planting:
    """An amplifier with limits; amount: share of the samples beyond them."""
    del rng
    sizes = np.abs(base.rig.u[LEAD:, 0])

    def acting(v: Array, amount: float) -> Array:
        top = float(np.quantile(sizes, 1 - amount))
        return np.asarray(np.clip(v, -top, top))

    name = "input nonlinearity"
    return Planting(name, (name,), BEYOND_LAGS, (0.001, 0.8), acting=acting)


def curve_of_flow(base: Ground, rng: Generator) -> Planting:
    """Heat follows the logarithm or the root of the flow; amount: share of that curve."""
    flow = base.rig.numbers["flow"]
    root = bool(rng.uniform() < 0.5)

    def acting(v: Array, amount: float) -> Array:
        bent = 2 * (np.sqrt(v / flow) - 1) if root else np.log(v / flow)
        return np.asarray((1 - amount) * v + amount * flow * (1 + bent))

    name = "input nonlinearity"
    return Planting(name, (name,), BEYOND_LAGS, (0.01, 1.0), acting=acting)


def tilted_sensor(base: Ground, rng: Generator) -> Planting:
    """A laser that is tilted; amount: the square term at one standard deviation."""
    sign = float(rng.choice([-1.0, 1.0]))
    middle, sd = base.output.mean(axis=0), base.sd
    name = "output nonlinearity"
    return Planting(
        name, (name,), BEYOND_LAGS, (0.005, 0.25), stage=1,
        sensor=lambda y, amount: y + sign * amount * sd * ((y - middle) / sd) ** 2,
    )  # fmt: skip


def play_of_sensor(base: Ground, rng: Generator) -> Planting:
    """Backlash at the sensor; amount: half its width over the standard deviation."""
    del rng
    sd = base.sd

    def sensor(y: Array, amount: float) -> Array:
        out, half = np.empty_like(y), amount * sd
        last = y[0]
        for k in range(len(y)):
            last = np.clip(last, y[k] - half, y[k] + half)
            out[k] = last
        return out

    return Planting(
        "hysteresis", ("hysteresis",), BEYOND_LAGS, (0.02, 1.0), sensor=sensor, stage=2
    )  # fmt: skip


def saturation(base: Ground, rng: Generator) -> Planting:
    """One sensor ends at a limit; amount: share of the samples beyond it."""
    which = int(rng.integers(base.output.shape[1]))
    signal = base.output[:, which]

    def limit(y: Array, amount: float) -> Array:
        out = y.copy()
        out[:, which] = np.minimum(y[:, which], np.quantile(signal, 1 - amount))
        return out

    return Planting(
        "saturation", ("saturation", "output nonlinearity"), BEYOND_LAGS, (0.01, 0.6), limit=limit
    )  # fmt: skip


# Machine -> effects that change its output, with their builders.
BUILDERS: Mapping[str, Mapping[str, Builder]] = {
    "tanks": {
        "nonlinear feedback": nonlinear_feedback,
        "saturation": saturation,
        "dead time": dead_time,
        "undeclared input": disturbances.undeclared_input,
        "level shift": disturbances.leak_or_offset,
        "drift": disturbances.drift,
    },
    "motor": {
        "nonlinear feedback": nonlinear_feedback,
        "dead zone": dead_zone,
        "input nonlinearity": amplifier_limit,
        "periodic disturbance": disturbances.periodic_torque,
        "integrator": integrator,
    },
    "masses": {
        "nonlinear feedback": nonlinear_feedback,
        "unmodelled dynamics": unmodelled_dynamics,
        "output nonlinearity": tilted_sensor,
        "hysteresis": play_of_sensor,
    },
    "exchanger": {
        "dead time": dead_time,
        "input nonlinearity": curve_of_flow,
        "undeclared input": disturbances.undeclared_input,
        "drift": disturbances.fouling,
    },
    "load": {
        "calendar": disturbances.calendar,
        "undeclared input": disturbances.holidays,
        "clock shift": disturbances.clock_shift,
        "level shift": disturbances.offset,
    },
    "loop": {"nonlinear feedback": nonlinear_feedback},
    "two outputs": {
        "nonlinear feedback": nonlinear_feedback,
        "saturation": saturation,
        "undeclared input": disturbances.undeclared_input,
    },
    "sensor": {
        "dead time": dead_time,
        "undeclared input": disturbances.undeclared_input,
        "level shift": disturbances.offset,
    },
}
