"""The strength of effects in machines, and the noise of machines, computed a second time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import minimize
from scipy.stats import kstest, t

from tests.discrepancy.machine_drafts import MULTIPLES, NOISE_EFFECTS, Draft
from tests.discrepancy.machine_inputs import Array
from tests.discrepancy.machine_noise import SHARES, controlled_input
from tests.discrepancy.machine_planting import BEYOND_LAGS, BEYOND_ORDER, INTEGRAL, limited, run
from tests.discrepancy.machine_rigs import LEAD
from tests.discrepancy.machine_solutions import exact
from tests.discrepancy.machines import KINDS, STRENGTHS, drawn, machine

IN_OUTPUT = [
    (kind, effect)
    for kind, effects in KINDS.items()
    for effect in effects
    if effect not in NOISE_EFFECTS.get(kind, ()) and kind != "loop"
]


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
    np.testing.assert_array_equal(
        controlled_input(made.rig, louder, (), 0.0)[LEAD:], made.u
    )  # fmt: skip
    assert machine("loop", 0, samples=300).accepted == {}


def test_friction_in_a_loop_has_its_strength() -> None:
    made, _ = drawn("loop", 0, effects=["feedback", "nonlinear feedback"], samples=400)
    assert size_of(made) == pytest.approx(4, rel=0.05)


@pytest.mark.parametrize("strength", STRENGTHS)
def test_noise_has_the_law_that_is_asked_for(strength: str) -> None:
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
    made = machine("tanks", 3, samples=2000)
    e = ((made.record.outputs - made.noise_free) / made.noise_sd)[:, 0]
    assert kstest(e, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(e[1:], e[:-1])[0, 1]) < 4 / np.sqrt(len(e))
