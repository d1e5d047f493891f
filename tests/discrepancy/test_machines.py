"""The second generator of plants: its machines, the strength of effects, and what it refuses."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lsim

import pyro_dynogp as dgp
from tests.discrepancy.machine_drafts import MULTIPLES, NOISE_EFFECTS, Draft
from tests.discrepancy.machine_inputs import Array, temperature
from tests.discrepancy.machine_noise import SHARES
from tests.discrepancy.machine_planting import BEYOND_LAGS, BEYOND_ORDER, INTEGRAL, limited, run
from tests.discrepancy.machine_rigs import LEAD
from tests.discrepancy.machines import KINDS, OUTSIDE, STRENGTHS, Machine, drawn, machine, outside

EVERY = [(kind, effect) for kind, effects in KINDS.items() for effect in effects]
IN_OUTPUT = [(k, e) for k, e in EVERY if e not in NOISE_EFFECTS.get(k, ()) and k != "loop"]
CHANNELS = ("undeclared input",)


def exact(draft: Draft, u: Array) -> Array:
    """Output (n, n_y) of the linear machine without effects, by matrix exponentials."""
    system, t = draft.rig.system, np.arange(len(u)) * draft.rig.step
    D = np.zeros((len(system.C), u.shape[1]))
    linear = (system.A, system.B[:, : u.shape[1]], system.C, D)
    y = lsim(linear, u, t, X0=system.rest, interp=False)[1].reshape(len(t), -1) + system.level
    return np.asarray(draft.rig.curve(y) if draft.rig.curve else y)[LEAD:]


@pytest.mark.parametrize("kind", KINDS)
def test_machines_without_effects_solve_their_equations(kind: str) -> None:
    for seed in (0, 1):
        made, _ = drawn(kind, seed, samples=300)
        y = exact(made, made.rig.u)
        np.testing.assert_allclose((made.clean - y) / y.std(axis=0), 0, atol=1e-6)


def rk45(slope, x: Array, u: Array, step: float) -> Array:  # type: ignore[no-untyped-def]
    """States (n, s) by an adaptive solver, from one sample to the next."""
    from scipy.integrate import solve_ivp

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


def left_by_lags(draft: Draft, change: Array) -> Array:
    """What is left of a change by lags of the recorded inputs, by projection on their basis."""
    n = len(change)
    lags = min(int(np.ceil(5 * draft.rig.memory)), n // 5)
    u = run(draft.rig, draft.planted).u
    u = (u - u.mean(axis=0)) / u.std()
    columns = [np.ones(n)]
    for j in range(u.shape[1]):
        columns += [u[LEAD - k : LEAD - k + n, j] for k in range(lags + 1)]
    U, s, _ = np.linalg.svd(np.column_stack(columns), full_matrices=False)
    Q = U[:, s > 1e-4 * s[0]]
    return np.asarray(change - Q @ (Q.T @ change))


def size_of(draft: Draft) -> float:
    """Size of the one effect in a machine, over its noise."""
    ((planting, amount),) = draft.planted
    u = run(draft.rig, draft.planted).u
    without = exact(draft, u)
    if planting.measure == INTEGRAL:
        change = left_by_lags(draft, draft.clean)
    elif planting.measure == BEYOND_LAGS:
        change = left_by_lags(draft, draft.clean - without)
    else:
        change = draft.clean - without
        change = change - change.mean(axis=0)
    assert amount > 0
    return float((np.sqrt(np.mean(change**2, axis=0)) / draft.noise_sd).max())


@pytest.mark.parametrize(("kind", "effect"), IN_OUTPUT)
def test_effects_have_the_strength_that_is_asked_for(kind: str, effect: str) -> None:
    for seed, strength in enumerate(STRENGTHS):
        made, _ = drawn(kind, seed, effects=[effect], strength=strength, samples=400)
        if made.planted[0][0].measure == BEYOND_ORDER:
            continue  # the next test
        assert size_of(made) == pytest.approx(MULTIPLES[strength], rel=0.05)


@pytest.mark.parametrize(
    ("kind", "effect"), [("exchanger", "dead time"), ("masses", "unmodelled dynamics")]
)
def test_no_model_of_the_order_explains_more(kind: str, effect: str) -> None:
    """Poles in continuous time from random starts leave no less than the strength says."""
    from scipy.optimize import minimize

    made, _ = drawn(kind, 0, effects=[effect], strength="middle", samples=400)
    rig, y, rng = made.rig, made.clean[:, 0], np.random.default_rng(0)
    u = rig.u[:, 0]

    def left(x: Array) -> float:
        columns = [np.ones(len(y)), u[LEAD:]]
        for decay, turn in x.reshape(-1, 2):
            a = np.exp(-np.exp(decay) + 1j * np.exp(turn))
            state = np.zeros(len(u), dtype=complex)
            for k in range(len(u) - 1):
                state[k + 1] = a * state[k] + u[k]
            columns += [state.real[LEAD:], state.imag[LEAD:]]
        X = np.column_stack(columns)
        X = X / np.abs(X).max(axis=0)
        e = y - X @ np.linalg.lstsq(X, y, rcond=1e-12)[0]
        return float(np.sqrt(np.mean(e**2)))

    options = {"maxfev": 250, "xatol": 1e-3, "fatol": 1e-3 * made.noise_sd[0]}
    rates = np.log([1 / rig.memory, 1 / rig.memory])
    found = min(
        minimize(
            left, (rates + rng.normal(0, 1, (rig.pairs, 2))).ravel(), method="Nelder-Mead",
            options=options,
        ).fun
        for _ in range(3)
    )  # fmt: skip
    # Pairs of poles are a part of all systems of that order.
    assert found / made.noise_sd[0] > 0.95 * 2
    if rig.pairs == 1:
        assert found / made.noise_sd[0] < 1.05 * 2


@pytest.mark.parametrize(
    ("kind", "effects"),
    [
        ("tanks", ("drift", "nonlinear feedback")),
        ("two outputs", ("saturation", "undeclared input", "nonlinear feedback")),
        ("load", ("clock shift", "calendar")),
    ],
)
def test_each_of_several_effects_has_the_strength(kind: str, effects: tuple[str, ...]) -> None:
    made, _ = drawn(kind, 0, effects=effects, strength="middle", samples=400)
    assert {p.effect for p, _ in made.planted} == set(effects)
    for one in made.planted:
        alone = replace(made, planted=[one], clean=limited(run(made.rig, [one]).output, [one]))
        assert size_of(alone) == pytest.approx(2, rel=0.05)


def test_share_of_the_input_that_a_loop_feeds_back() -> None:
    for seed, strength in enumerate(STRENGTHS):
        made, _ = drawn("loop", seed, effects=["feedback"], strength=strength, samples=400)
        rig, loop, system = made.rig, made.loop, made.rig.system
        assert loop is not None
        s = len(system.A)
        whole = np.zeros((s + 1, s + 1))
        whole[:s, :s], whole[:s, s] = system.A * rig.step, system.B[:, 0] * rig.step
        both = expm(whole)
        inputs = []
        for w in (loop.disturbance(float(made.noise_sd[0])), np.zeros(rig.total)):
            x, total, u = system.rest.copy(), 0.0, np.zeros(rig.total)
            for k in range(rig.total):
                e = loop.wanted[k] - float(system.output(x[None])[0, 0]) - w[k]
                total += e
                u[k] = loop.gains[0] * (e + rig.step / loop.gains[1] * total)
                u[k] += rig.numbers["inflow"] if "inflow" in rig.numbers else u[:0].sum()
                x = both[:s, :s] @ x + both[:s, s] * u[k]
            inputs.append(u[LEAD:])
        noisy, quiet = inputs
        # The controller of a motor starts from the mean of another input, which it soon forgets.
        atol = (1e-6 if "inflow" in rig.numbers else 1e-2) * noisy.std()
        np.testing.assert_allclose(made.u[:, 0], noisy, rtol=0, atol=atol)
        assert (noisy - quiet).std() / noisy.std() == pytest.approx(SHARES[strength], rel=0.05)


def test_a_loop_without_feedback_has_an_input_that_noise_does_not_change() -> None:
    made, _ = drawn("loop", 0, samples=300)
    louder = replace(made.loop, ratio=10.0) if made.loop else None
    assert louder is not None
    from tests.discrepancy.machine_noise import controlled_input

    np.testing.assert_array_equal(
        controlled_input(made.rig, louder, (), 0.0)[LEAD:], made.u
    )  # fmt: skip
    assert machine("loop", 0, samples=300).accepted == {}


def test_friction_in_a_loop_has_its_strength() -> None:
    made, _ = drawn("loop", 0, effects=["feedback", "nonlinear feedback"], samples=400)
    assert size_of(made) == pytest.approx(4, rel=0.05)


@pytest.mark.parametrize("strength", STRENGTHS)
def test_noise_has_the_law_that_is_asked_for(strength: str) -> None:
    from scipy.stats import kstest, t

    n = 3000
    degrees = {"weak": 8.0, "middle": 4.0, "strong": 2.5}[strength]
    made, _ = drawn("motor", 0, effects=["heavy tails"], strength=strength, samples=n)
    e = ((made.y - made.clean) / made.noise_sd)[:, 0] / np.sqrt((degrees - 2) / degrees)
    assert kstest(e, t(degrees).cdf).pvalue > 1e-3
    assert kstest(e / e.std(), "norm").pvalue < (0.05 if strength == "weak" else 1e-3)

    made, _ = drawn("exchanger", 0, effects=["process noise"], strength=strength, samples=n)
    e = ((made.y - made.clean) / made.noise_sd)[:, 0]
    assert np.sqrt(np.mean(e**2)) == pytest.approx(np.hypot(1, MULTIPLES[strength]), rel=0.05)
    assert not made.model.dynamic[0][1].process_noise

    made, _ = drawn("masses", 0, effects=["heteroscedastic noise"], strength=strength, samples=n)
    e = ((made.y - made.clean) / made.noise_sd)[:, 0]
    assert np.mean(e**2) == pytest.approx(1, rel=0.25)
    # E log|e| is linear in the driver with slope = spread: regress on output and on input.
    drivers = [made.clean[:, 0], made.u[:, 0]]
    logs = np.log(np.abs(e))
    slopes = [np.polyfit((d - d.mean()) / d.std(), logs, 1)[0] for d in drivers]
    spread = {"weak": 0.25, "middle": 0.5, "strong": 1.0}[strength]
    assert max(np.abs(slopes)) == pytest.approx(spread, abs=0.1)


def test_noise_of_machines_without_an_effect_is_white_and_normal() -> None:
    from scipy.stats import kstest

    made = machine("tanks", 3, samples=2000)
    e = ((made.record.outputs - made.noise_free) / made.noise_sd)[:, 0]
    assert kstest(e, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(e[1:], e[:-1])[0, 1]) < 4 / np.sqrt(len(e))


@pytest.mark.parametrize(("kind", "effect"), EVERY)
def test_every_effect_can_be_planted(kind: str, effect: str) -> None:
    for seed in (0, 1):
        made = machine(kind, seed, effects=[effect], samples=400)
        share = made.noise_sd / made.noise_free.std(axis=0)
        assert (share >= 0.01).all()
        assert (share <= 0.12).all()
        assert made.effects == (effect,)
        assert set(made.accepted) == {effect}
        assert (made.channel is not None) == (effect in CHANNELS)
        assert made.channel is None or made.channel in made.record.extra
        acting = effect in CHANNELS
        assert len(made.record.extra) - acting - (kind == "loop") in (2, 3)
        assert (len(made.record), made.training) == (400, 200)
        assert made.record.n_outputs == made.model.outputs == (2 if kind == "two outputs" else 1)
        assert made.record.is_regular


def test_names_that_are_accepted_are_names_of_the_catalogue() -> None:
    known = {effect.name for effect in dgp.effects.CATALOGUE}
    for kind, effect in EVERY:
        for names in machine(kind, 0, effects=[effect], samples=400).accepted.values():
            assert names
            assert set(names) <= known


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
        assert left[made.channel] < 0.05 * sorted(left.values())[1]


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
    for seed in range(8):
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
    assert len(kinds) >= 3


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


IMPORTS = {"numba", "numpy", "pandas", "zlib", "functools", "pyro_dynogp"}
