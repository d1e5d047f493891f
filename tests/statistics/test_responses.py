"""Filters and shapes: against exact solutions, at irregular steps too."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.signal import cont2discrete, lfilter

from pyro_dynogp.data import signals
from pyro_dynogp.statistics.responses import filtered, responses, time_constants
from pyro_dynogp.statistics.shares_of_inputs import paths
from tests.discrepancy.made import coloured, lag, residuals_of

rng = np.random.default_rng(0)
STEP = 0.1
TIME = np.arange(200) * STEP
IRREGULAR = np.cumsum(rng.uniform(0.02, 0.2, 200))
U = rng.standard_normal((200, 2)) + 5.0


def held_at(u, time, t):
    return u[max(np.searchsorted(time, t, side="right") - 1, 0)]


def test_first_order_response_of_a_held_signal_is_exact():
    found = filtered(U, STEP, TIME, np.array([-1 / 0.7]), lags=0)
    np.testing.assert_allclose(found[:, :, 0], U - U.mean(0))
    np.testing.assert_allclose(found[:, :, 1], lag(U, 0.7, STEP), atol=1e-10)


def test_irregular_steps_by_quadrature():
    u = U[:, 0] - U[:, 0].mean()
    found = filtered(U[:, :1], STEP, IRREGULAR, np.array([-1 / 0.7]), lags=0)[:, 0, 1]
    k = 12
    exact = sum(
        u[i] * quad(lambda s: np.exp(-(IRREGULAR[k] - s) / 0.7) / 0.7, *IRREGULAR[i : i + 2])[0]
        for i in range(k)
    )
    # Steps are rounded to a millionth of one.
    assert found[k] == pytest.approx(exact, rel=1e-5)


def test_a_complex_rate_is_an_oscillator():
    rate = 3.0 * (-0.1 + 1j * np.sqrt(0.99))
    both = filtered(U[:, :1], STEP, TIME, np.array([rate]), lags=0)[:, 0, 1:]
    system = cont2discrete(([9.0], [1.0, 0.6, 9.0]), STEP)
    exact = lfilter(system[0].ravel(), system[1], U[:, 0] - U[:, 0].mean())
    left = exact - both @ np.linalg.lstsq(both, exact, rcond=None)[0]
    assert np.abs(left).max() < 1e-10


def test_the_bank_is_causal_standardised_and_signal_by_signal():
    columns = responses(U, STEP, TIME)
    assert columns.shape == (200, 16)
    np.testing.assert_allclose(columns.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(columns.std(0), 1)
    np.testing.assert_allclose(columns[:, 8:], responses(U[:, 1], STEP, TIME))
    changed = U.copy()
    changed[150:] += 1.0
    rates = -1 / time_constants(STEP, TIME, 6)
    late = filtered(changed - changed.mean(0), STEP, TIME, rates)
    early = filtered(U - changed.mean(0), STEP, TIME, rates)
    # Both are about their own means, which differ by a constant input.
    one = filtered(np.where(np.arange(200) >= 150, 1.0, 0.0)[:, None], STEP, TIME, rates)
    np.testing.assert_allclose(late - early, np.concatenate([one, one], axis=1), atol=1e-10)


@pytest.mark.parametrize("tau", [0.15, 0.8, 3.0])
def test_the_bank_spans_poles_that_are_not_its_own(tau):
    time = np.arange(600) * STEP
    u = coloured(np.random.default_rng(1), 600, 0.8)
    columns, exact = responses(u, STEP, time), lag(u, tau)
    left = (exact - exact.mean()) - columns @ np.linalg.lstsq(columns, exact, rcond=None)[0]
    assert left.std() < 0.02 * exact.std()


def test_units_of_time_do_not_matter_and_constant_signals_are_zero():
    np.testing.assert_allclose(responses(U, STEP, TIME), responses(U, 60 * STEP, 60 * TIME))
    assert not responses(np.full(200, 3.0), STEP, TIME).any()
    assert responses(np.zeros((200, 0)), STEP, TIME).shape == (200, 0)


def test_rates_that_grow_are_refused():
    with pytest.raises(ValueError, match="rates: expected negative real parts"):
        filtered(U, STEP, TIME, np.array([0.1]))


@pytest.mark.parametrize("time", [TIME, IRREGULAR])
@pytest.mark.parametrize("delay", [0.0, 0.03, 0.1, 0.77, -0.25])
def test_a_delayed_held_signal_is_its_mean_over_the_step(time, delay):
    u = U[:, 0]
    found = signals.delayed(u, time, delay)
    for k in (0, 3, 50, 120):
        fine = np.linspace(time[k] - delay, time[k + 1] - delay, 20001)[:-1]
        exact = np.mean([held_at(u, time, t) for t in fine])
        assert found[k] == pytest.approx(exact, abs=1e-3)


def test_a_delay_of_whole_steps_shifts():
    np.testing.assert_allclose(signals.delayed(U[:, 0], TIME, 0.3)[3:], U[:-3, 0])
    np.testing.assert_allclose(signals.delayed(U[:, 0], TIME, 0.3)[:3], U[0, 0])
    with pytest.raises(ValueError, match="time: expected two or more increasing values"):
        signals.delayed(U[:, 0], TIME[::-1], 0.1)


def test_play_of_a_triangle():
    u = np.concatenate([np.linspace(0, 2, 21), np.linspace(1.9, -2, 40), np.linspace(-1.9, 0, 20)])
    z = signals.play(u, 1.0)
    assert z[0] == 0.0
    assert z[20] == pytest.approx(1.5)  # half the width behind on the way up
    assert z[30] == pytest.approx(1.5)  # the gap is crossed: nothing moves
    assert z[60] == pytest.approx(-1.5)
    np.testing.assert_array_equal(signals.play(u, 0.0), u)
    with pytest.raises(ValueError, match="width"):
        signals.play(u, -1.0)


def test_shapes():
    u = np.array([-2.0, -0.5, 0.0, 0.4, 3.0])
    np.testing.assert_allclose(signals.dead_zone(u, -1.0, 0.5), [-1.0, 0, 0, 0, 2.5])
    np.testing.assert_allclose(signals.clip(u, -1.0, 0.5), [-1.0, -0.5, 0, 0.4, 0.5])
    with pytest.raises(ValueError, match="low"):
        signals.dead_zone(u, 1.0, 0.0)
    np.testing.assert_array_equal(signals.held(np.array([np.nan, 1, np.nan, 2])), [1, 1, 1, 2])
    np.testing.assert_allclose(signals.hermite(9 * U[:, 0] + 4), signals.hermite(U[:, 0]))
    bends = signals.hinges(U[:, 0], 3)
    assert bends.shape == (200, 3)
    np.testing.assert_allclose((bends > 0).mean(0), [0.75, 0.5, 0.25], atol=0.01)


@pytest.mark.parametrize("damping", [0.05, 0.3, 1.0])
def test_paths_of_a_linear_model_are_its_own(damping):
    u = np.repeat(np.random.default_rng(2).standard_normal((100, 2)), 5, axis=0)
    shares = []
    for j, w in enumerate((3.0, 4.0)):
        system = cont2discrete(([w * w], [1.0, 2 * damping * w, w * w]), STEP)
        shares.append(lfilter(system[0].ravel(), system[1], u[:, j] - u[:, j].mean()))
    shares = np.column_stack(shares)
    mean = shares.sum(1)
    found = paths(residuals_of(mean + 0.1 * rng.standard_normal(500), mean, u))
    assert np.abs(found.shares - shares).max() < 1e-3 * shares.std()
    changed = found(1, np.abs(u[:, 1:]))
    assert np.abs(found(1, 2 * np.abs(u[:, 1:])) - 2 * changed).max() < 1e-9
