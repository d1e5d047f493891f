"""Plants in feedback against balances and steady states in closed form."""

import math
import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from pyro_dynogp.examples import feedback
from pyro_dynogp.examples.feedback import (
    integrated,
    simulate_bouc_wen,
    simulate_duffing,
    simulate_friction,
    simulate_tanks,
)

SIMULATORS = [simulate_duffing, simulate_tanks, simulate_friction, simulate_bouc_wen]
SHORT = {"samples": 120, "training_samples": 80}


def plant_of(monkeypatch, simulate, seed, **options):
    """The description of a plant and its parameters, without a run."""
    found = []

    def kept(plant, *rest):
        found.append(plant)
        raise InterruptedError

    with monkeypatch.context() as patch:
        patch.setattr(feedback, "_experiment", kept)
        with pytest.raises(InterruptedError):
            simulate(seed, **options)
    return found[0], simulate(seed, **options, **SHORT).parameters


def held_for(plant, p, u, seconds, start=None, steps=400):
    """States under one held input, from the plant's first state."""
    n = int(seconds / plant.step)
    start = plant.start(p) if start is None else start
    return integrated(plant.rates(p), start, np.full(n, u), plant.step, steps // 20, plant.edge(p))


def test_static_deflection_of_the_spring(monkeypatch):
    plant, p = plant_of(monkeypatch, simulate_duffing, 3)
    for force in (-6.0, 0.5, 5.0):
        x = brentq(lambda x, f=force: p["k"] * x + p["k3"] * x**3 - f, -5.0, 5.0)
        np.testing.assert_allclose(held_for(plant, p, force, 80.0)[-1], [x, 0.0], atol=1e-8)


def test_energy_of_the_spring(monkeypatch):
    """What the force has done is in the motion and the spring, or lost to the damper."""
    plant, p = plant_of(monkeypatch, simulate_duffing, 1)
    force, start = 3.0, (0.4, -1.0)
    x, v = held_for(plant, p, force, 2.0, start)[-1]

    def energy(x, v):
        return p["m"] * v**2 / 2 + p["k"] * x**2 / 2 + p["k3"] * x**4 / 4 - force * x

    lossless = {**p, "c": 0.0}
    free = held_for(plant, lossless, force, 2.0, start)
    np.testing.assert_allclose(energy(*free.T), energy(*start), rtol=1e-8)
    fine = integrated(plant.rates(p), start, np.full(20000, force), 1e-4, 1)
    lost = p["c"] * np.trapezoid(fine[:, 1] ** 2, dx=1e-4)
    assert energy(*start) - energy(x, v) == pytest.approx(lost, rel=1e-6)


def test_levels_where_inflow_equals_outflow(monkeypatch):
    plant, p = plant_of(monkeypatch, simulate_tanks, 2)
    for u in (0.5, 1.0, 1.6):
        upper = (p["K"] * u / p["a1"]) ** 2
        lower = (p["a2"] / p["a3"]) ** 2 * upper
        np.testing.assert_allclose(held_for(plant, p, u, 400.0)[-1], [upper, lower], rtol=1e-6)


def test_a_full_tank_overflows(monkeypatch):
    """The upper level is the edge; the lower tank gets its outflow and a share of the rest."""
    plant, p = plant_of(monkeypatch, simulate_tanks, 2, overflow=True)
    top = p["top"] * (p["K"] / p["a1"]) ** 2
    u = 2.0
    over = p["K"] * u - p["a1"] * math.sqrt(top)
    assert over > 0
    lower = ((p["a2"] * math.sqrt(top) + p["share"] * over) / p["a3"]) ** 2
    states = held_for(plant, p, u, 400.0)
    np.testing.assert_allclose(states[-1], [top, lower], rtol=1e-6)
    assert states[:, 0].max() <= top


def test_what_a_tank_overflows_by_in_a_step_is_not_lost(monkeypatch):
    """Across the edge: water that came in is in the tank, ran out below, or over the edge."""
    plant, p = plant_of(monkeypatch, simulate_tanks, 2, overflow=True)
    p = {**p, "a1": p["a2"], "a3": 1e-12, "share": 1.0}  # nothing leaves the lower tank
    u, n = 2.0, 40
    states = integrated(plant.rates(p), (*plant.start(p)[:1], 0.0), np.full(n, u), 1.0, 4,
                        plant.edge(p))  # fmt: skip
    assert states[0, 0] < states[-1, 0] == plant.edge(p)[0]
    np.testing.assert_allclose(np.diff(states.sum(1)), p["K"] * u, rtol=1e-9)


def test_friction_holds_what_is_below_it(monkeypatch):
    plant, p = plant_of(monkeypatch, simulate_friction, 0)
    force = 0.7 * p["F"]
    states = held_for(plant, p, force, 1.0)
    assert 0.0 < states[:, 1].max() < p["w"] * math.atanh(0.7)
    # Without its spring it slides at the speed of closed form, above the force and below.
    for force in (0.7 * p["F"], 2.5 * p["F"]):
        speed = brentq(
            lambda v, f=force: p["c"] * v + p["F"] * math.tanh(v / p["w"]) - f, 0.0, 50.0
        )
        states = held_for(plant, {**p, "k": 0.0}, force, 120.0)
        assert states[-1, 1] == pytest.approx(speed, rel=1e-6)


def test_hysteresis_on_its_first_way_up(monkeypatch):
    """While x', z > 0 dz/dx = a - (b + g) z: z = a / (b + g) (1 - exp(-(b + g) x))."""
    plant, p = plant_of(monkeypatch, simulate_bouc_wen, 4)
    x, v, z = held_for(plant, p, 4.0, 0.8).T
    assert v[1:].min() > 0
    rate = p["beta"] + p["gamma"]
    np.testing.assert_allclose(z, p["alpha"] / rate * -np.expm1(-rate * x), rtol=1e-6, atol=1e-12)
    # And back: dz/dx = a + (b - g) z while x' < 0 < z.
    back = held_for(plant, p, -4.0, 0.6, (x[-1], -1e-9, z[-1]))
    rate, limit = p["beta"] - p["gamma"], p["alpha"] / (p["beta"] - p["gamma"])
    down = back[:, 2] > 0.05
    expected = -limit + (z[-1] + limit) * np.exp(rate * (back[:, 0] - x[-1]))
    assert down.sum() > 5
    np.testing.assert_allclose(back[down, 2], expected[down], rtol=1e-5)
    assert np.abs(simulate_bouc_wen(4).states[:, 2]).max() < p["alpha"] / (p["beta"] + p["gamma"])


@pytest.mark.parametrize("simulate", SIMULATORS)
def test_another_integrator(simulate, monkeypatch):
    plant, p = plant_of(monkeypatch, simulate, 5)
    one = simulate(5, **SHORT)
    rates, u = plant.rates(p), one.full.inputs[:, 0]
    x = plant.start(p)
    for k in range(20):
        np.testing.assert_allclose(one.states[k], x, rtol=1e-4, atol=1e-5)
        span = (0.0, plant.step)
        x = solve_ivp(lambda t, s, k=k: rates(tuple(s), u[k]), span, x, rtol=1e-10, atol=1e-12)
        x = x.y[:, -1]


@pytest.mark.parametrize("simulate", SIMULATORS)
def test_halving_the_steps_changes_next_to_nothing(simulate):
    """The finest noise of the benchmark is 1 % of the output."""
    options = [{}, {"overflow": True}] if simulate is simulate_tanks else [{}]
    for option in options:
        for seed in range(3):
            one, two = (simulate(seed, substeps=n, **option) for n in (10, 20))
            np.testing.assert_array_equal(one.full.inputs[:600], two.full.inputs[:600])
            change = np.abs(one.clean - two.clean)[:600].max() / one.clean.std()
            assert change < (1e-3 if option else 1e-4)


@pytest.mark.parametrize("simulate", SIMULATORS)
def test_record_and_truth(simulate):
    one, same, other = simulate(7), simulate(7), simulate(8)
    np.testing.assert_array_equal(one.full.outputs, same.full.outputs)
    np.testing.assert_array_equal(one.states, same.states)
    assert not np.array_equal(one.clean, other.clean)
    assert one.parameters != other.parameters
    assert (len(one.train), len(one.test)) == (600, 400)
    noise = one.full.outputs[:, 0] - one.clean
    assert one.noise_sd == pytest.approx(0.02 * one.clean.std())
    assert noise.std() == pytest.approx(one.noise_sd, rel=0.1)
    np.testing.assert_array_equal(one.test.outputs, one.full.outputs[600:])
    np.testing.assert_array_equal(one.clean_test, one.clean[600:])
    # Level and length of noise leave the plant as it is.
    quiet = simulate(7, noise_ratio=0.0, **SHORT)
    assert quiet.parameters == one.parameters
    np.testing.assert_array_equal(quiet.clean[:80], one.clean[:80])
    np.testing.assert_array_equal(quiet.full.outputs[:, 0], quiet.clean)


@pytest.mark.parametrize("simulate", SIMULATORS)
def test_the_test_stays_within_the_range_of_the_training(simulate):
    for seed in range(6):
        one = simulate(seed)
        before, later = one.clean[:600], one.clean[601:]
        assert before.min() <= later.min()
        assert later.max() <= before.max()
        assert one.test.inputs.std() > 0.3 * one.train.inputs.std()  # and is still driven


@pytest.mark.parametrize("simulate", SIMULATORS)
def test_parameters_are_thirty_percent_either_way(simulate, monkeypatch):
    plant, _ = plant_of(monkeypatch, simulate, 0)
    drawn = [simulate(seed, samples=3, training_samples=2).parameters for seed in range(40)]
    for name, nominal in plant.nominal.items():
        ratio = np.array([p[name] for p in drawn]) / nominal
        assert 0.7 <= ratio.min() < 0.8
        assert 1.2 < ratio.max() <= 1.3


@pytest.mark.parametrize("simulate", SIMULATORS)
@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("seed", -1),
        ("seed", 0.5),
        ("samples", 0),
        ("samples", "many"),
        ("training_samples", 1000),
        ("training_samples", 1),
        ("training_samples", 2.5),
        ("noise_ratio", -0.1),
        ("noise_ratio", float("nan")),
        ("substeps", 0),
    ],
)
def test_what_is_refused(simulate, argument, value):
    with pytest.raises(ValueError, match=f"^{argument}: expected .*{re.escape(repr(value))}"):
        simulate(**{argument: value})


def test_overflow_is_yes_or_no():
    with pytest.raises(ValueError, match="overflow: expected True or False, got 2"):
        simulate_tanks(overflow=2)
