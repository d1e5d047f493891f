"""The second generator of plants: its machines, the strength of effects, and what it refuses."""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import pyro_dynogp as dgp
from tests.discrepancy.machine_inputs import Array, temperature
from tests.discrepancy.machine_rigs import LEAD
from tests.discrepancy.machine_solutions import exact
from tests.discrepancy.machines import KINDS, OUTSIDE, Machine, drawn, machine, outside

EVERY = [(kind, effect) for kind, effects in KINDS.items() for effect in effects]
CHANNELS = ("undeclared input",)
IMPORTS = {"numba", "numpy", "pandas", "zlib", "functools", "pyro_dynogp"}


@pytest.mark.parametrize("kind", KINDS)
def test_machines_without_effects_solve_their_equations(kind: str) -> None:
    for seed in (0, 1):
        made, _ = drawn(kind, seed, samples=300)
        y = exact(made, made.rig.u)
        np.testing.assert_allclose((made.clean - y) / y.std(axis=0), 0, atol=1e-6)


def rk45(slope: Callable[[float, Array, float], Array], x: Array, u: Array, step: float) -> Array:
    """States (n, s) by an adaptive solver, from one sample to the next."""
    states = [np.asarray(x, dtype=float)]
    for value in u[:-1]:
        solution = solve_ivp(slope, (0, step), states[-1], args=(value,), rtol=1e-8, atol=1e-10)
        states.append(solution.y[:, -1])
    return np.array(states)


def test_root_outflow_against_an_adaptive_solver() -> None:
    made, _ = drawn("tanks", 0, effects=["nonlinear feedback"], samples=200)
    numbers, ((_, share),) = made.rig.numbers, made.planted
    count = len(made.rig.system.A)
    S = np.array([numbers[f"area {i}"] for i in range(count)])
    k = np.array([numbers[f"outflow {i}"] for i in range(count)])

    def slope(_: float, h: Array, inflow: float) -> Array:
        out = (1 - share) * k * h + share * np.sqrt(k * numbers["inflow"] * np.maximum(h, 0))
        return np.asarray((np.append(inflow, out[:-1]) - out) / S)

    h = rk45(slope, numbers["inflow"] / k, made.rig.u[:, 0], made.rig.step)[LEAD:, -1]
    np.testing.assert_allclose(made.clean[:, 0], h, rtol=0, atol=1e-4 * h.std())
    assert np.abs(exact(made, made.rig.u)[:, 0] - h).max() > 0.02 * h.std()


def test_friction_against_an_adaptive_solver() -> None:
    made, _ = drawn("motor", 1, effects=["nonlinear feedback"], samples=200)
    p, ((planting, amount),) = made.rig.numbers, made.planted
    u = made.rig.u[:, 0]
    without = exact(made, made.rig.u)[:, 0]
    torque = amount * p["constant"] * np.sqrt(np.mean(u[LEAD:] ** 2)) / p["resistance"]
    scale = 0.1 * without.std()

    def slope(_: float, x: Array, volts: float) -> Array:
        current, speed = x
        back = p["friction"] * speed + torque * np.tanh(speed / scale)
        return np.array(
            [
                (volts - p["resistance"] * current - p["constant"] * speed) / p["inductance"],
                (p["constant"] * current - back) / p["inertia"],
            ]
        )

    speed = rk45(slope, np.zeros(2), u, made.rig.step)[LEAD:, 1]
    np.testing.assert_allclose(made.clean[:, 0], speed, rtol=0, atol=1e-4 * speed.std())
    assert np.abs(without - speed).max() > 0.02 * speed.std()
    assert planting.accepted == ("nonlinear feedback",)


def test_cubic_spring_against_an_adaptive_solver() -> None:
    drafts = (drawn("masses", s, effects=["nonlinear feedback"], samples=200)[0] for s in range(9))
    made = next(d for d in drafts if len(d.rig.system.A) == 2)
    p, ((_, amount),) = made.rig.numbers, made.planted
    without = exact(made, made.rig.u)[:, 0]

    def slope(_: float, x: Array, force: float) -> Array:
        spring = p["spring"] * x[0] * (1 + amount * x[0] ** 2 / without.var())
        return np.array([x[1], (force - spring - p["damper"] * x[1]) / p["mass"]])

    x = rk45(slope, np.zeros(2), made.rig.u[:, 0], made.rig.step)[LEAD:, 0]
    np.testing.assert_allclose(made.clean[:, 0], x, rtol=0, atol=1e-4 * x.std())
    assert np.abs(without - x).max() > 0.02 * x.std()


@pytest.mark.parametrize(("kind", "effect"), EVERY)
def test_every_effect_can_be_planted(kind: str, effect: str) -> None:
    known = {effect.name for effect in dgp.effects.CATALOGUE}
    for seed in (0, 1):
        made = machine(kind, seed, effects=[effect], samples=400)
        share = made.noise_sd / made.noise_free.std(axis=0)
        assert (share >= 0.01).all()
        assert (share <= 0.12).all()
        assert made.effects == (effect,)
        assert set(made.accepted) == {effect}
        assert set(made.accepted[effect]) & known == set(made.accepted[effect]) != set()
        assert (made.channel is not None) == (effect in CHANNELS)
        assert made.channel is None or made.channel in made.record.extra
        acting = effect in CHANNELS
        assert len(made.record.extra) - acting - (kind == "loop") in (2, 3)
        assert (len(made.record), made.training) == (400, 200)
        assert made.record.n_outputs == made.model.outputs == (2 if kind == "two outputs" else 1)
        assert made.record.is_regular


def test_the_channel_that_acts_is_the_one_that_is_named() -> None:
    """Lags of input and that channel explain the output; those of no other do."""
    for seed in range(3):
        made = machine("exchanger", seed, effects=["undeclared input"], samples=600)
        u, y, lags = made.record.inputs[:, 0], made.noise_free[:, 0], 60
        rows = np.arange(lags, 600)[:, None] - np.arange(lags + 1)
        left = {}
        for name, w in made.record.extra.items():
            X = np.column_stack([np.ones(len(rows)), u[rows], w[rows]])
            e = y[lags:] - X @ np.linalg.lstsq(X, y[lags:], rcond=1e-10)[0]
            left[name] = float(e.std())
        assert made.channel == min(left, key=lambda name: left[name])
        assert left[made.channel] < 0.1 * sorted(left.values())[1]


def test_a_shifted_clock_is_off_by_whole_hours_from_some_instant_on() -> None:
    made, _ = drawn("load", 0, effects=["clock shift"], samples=400)
    truth, hours = made.rig.u[:, 0], int(made.planted[0][1])
    wrong = np.flatnonzero(made.u[:, 0] != truth[LEAD:])
    first = int(wrong[0])
    assert 80 - 3 <= first <= 303
    k = np.arange(first, 400 - hours)
    both = [np.array_equal(made.u[k, 0], truth[LEAD + k + sign * hours]) for sign in (-1, 1)]
    assert both.count(True) == 1
    np.testing.assert_allclose(made.clean, exact(made, made.rig.u), atol=1e-6)


def same(a: Machine, b: Machine) -> bool:
    return a.record == b.record and np.array_equal(a.noise_free, b.noise_free)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_arguments_give_the_same_bits(kind: str) -> None:
    effect = KINDS[kind][0]
    one = machine(kind, 5, effects=[effect])
    assert same(one, machine(kind, 5, effects=[effect]))
    assert not same(one, machine(kind, 6, effects=[effect]))
    assert not same(one, machine(kind, 5, effects=[effect], split="final"))
    assert 400 <= len(one.record) <= 1500


def test_effects_come_in_any_order() -> None:
    effects = ("drift", "saturation")
    one, other = (machine("tanks", 0, effects=e, samples=300) for e in (effects, effects[::-1]))
    assert same(one, other)


def test_splits_have_no_temperature_in_common() -> None:
    rng = np.random.default_rng(0)
    early = [temperature(rng, 1000, "development")[1][-1] for _ in range(20)]
    late = [temperature(rng, 1000, "final")[1][0] for _ in range(20)]
    assert max(early) < min(late)


def test_floor_is_the_error_of_the_free_run() -> None:
    made = machine("two outputs", 0, samples=300)
    e = made.record.outputs[150:] - made.noise_free[150:]
    assert made.floor(made.record[150:]) == pytest.approx(np.sqrt((e**2).sum() / 300))
    with pytest.raises(ValueError, match="part: expected samples of the machine's record"):
        made.floor(machine("motor", 0, samples=300).record)


def test_outside_the_catalogue() -> None:
    kinds = set()
    for seed in range(4):
        made = outside(seed, samples=300, strength="middle")
        assert made.effects == (OUTSIDE,)
        assert made.accepted == {}
        assert made.record.n_inputs == made.model.inputs
        assert same(made, outside(seed, samples=300, strength="middle"))
        share = made.noise_sd / made.noise_free.std(axis=0)
        assert 0.01 <= share <= 0.12
        kinds.add(made.kind)
        # A long linear model of the record leaves twice the noise, but for what its start hides.
        u, y, lags = made.record.inputs, made.noise_free[:, 0], 50
        rows = np.arange(lags, 300)[:, None] - np.arange(lags + 1)
        X = np.column_stack([np.ones(len(rows)), u[rows].reshape(len(rows), -1)])
        e = y[lags:] - X @ np.linalg.lstsq(X, y[lags:], rcond=1e-10)[0]
        assert 1.0 < np.sqrt(np.mean(e**2)) / made.noise_sd[0] < 2.6
    assert len(kinds) == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "engine"}, "kind: expected among"),
        ({"effects": ["hysteresis"]}, "effects: expected among"),
        ({"effects": ["drift", "drift"]}, "effects: expected up to 3, each once"),
        ({"effects": list(KINDS["tanks"])[:4]}, "effects: expected up to 3"),
        ({"strength": "huge"}, "strength: expected among"),
        ({"split": "test"}, "split: expected among"),
        ({"seed": -1}, "seed: expected a whole number"),
        ({"seed": 1.5}, "seed: expected a whole number"),
        ({"samples": 100}, "samples: expected at least 200"),
    ],
)
def test_bad_arguments(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        machine(**({"kind": "tanks", "seed": 0} | arguments))  # type: ignore[arg-type]
    if "kind" not in arguments and "effects" not in arguments:
        with pytest.raises(ValueError, match=message):
            outside(**({"seed": 0} | arguments))  # type: ignore[arg-type]


def test_nothing_of_the_search_is_imported() -> None:
    allowed = {"dgp.Record", "dgp.datasets", "dgp.Model", "dgp.LinearDynamicGP", "dgp.Wiener"}
    for path in Path(__file__).parent.glob("machine*.py"):
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                names = (
                    [f"{node.module}.{a.name}" for a in node.names]
                    if node.module == "tests.discrepancy"
                    else [str(node.module)]
                )
                for name in names:
                    assert not name.startswith("pyro_dynogp"), path
                    assert not name.startswith("tests.") or ".machine" in name, path
            if isinstance(node, ast.Import):
                assert all(a.name.split(".")[0] in IMPORTS for a in node.names), path
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "dgp":
                assert ast.unparse(node) in allowed, path
