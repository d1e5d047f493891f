"""The synthetic plants are what they say: effect and its size, decoys, floor, seeds."""

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.lti.response import mean_response
from tests.discrepancy import plants
from tests.discrepancy.plant_absorption import absorbed, unexplained, unexplained_by_fit
from tests.discrepancy.plant_dynamics import (
    System,
    looped_response,
    mode,
    mode_slope,
    play,
    process_noise,
    response,
)
from tests.discrepancy.plants import CATALOGUE, EFFECTS, MULTIPLES, OUTSIDE, plant

FEW = 600
SLOW = ("dead time", "unmodelled dynamics", "integrator")  # their size is that of a nonlinear fit
MODES = System(np.array([-0.05 + 0.2j, -0.1 + 0.6j]), np.array([[1.0 + 0.3j], [0.4 - 1.0j]]))


@pytest.fixture(scope="module")
def one_of_each():
    return {e: plant(e, "strong", 3, samples=FEW) for e in (None, *EFFECTS)}


def coloured(n=900, seed=0):
    rng = np.random.default_rng(seed)
    return np.convolve(rng.standard_normal(n + 7), np.ones(8) / 8, "valid")[:, None]


def test_the_catalogue_has_the_names_of_the_search():
    assert set(EFFECTS) - set(CATALOGUE) == {OUTSIDE}
    from pyro_dynogp.effects import CATALOGUE as SEARCHED

    assert set(CATALOGUE) == {effect.name for effect in SEARCHED}


def test_response_is_that_of_the_package():
    u = coloured()
    ones = torch.ones(2, dtype=torch.complex128)
    modes = dgp.Modes(torch.tensor(MODES.poles), torch.tensor(MODES.gains), ones)
    theirs = mean_response(modes, np.arange(len(u)) * 1.0, u).output.numpy().reshape(-1)
    ours = response(MODES, u)
    np.testing.assert_allclose(theirs, ours, atol=1e-9 * np.abs(theirs).max())


@pytest.mark.parametrize("delay", [0.4, 1.0, 2.75])
def test_delayed_response_is_that_of_finer_steps(delay):
    u, parts = coloured(200), 20
    finer = System(MODES.poles / parts, MODES.gains / parts)
    late = round(delay * parts)
    fine = np.concatenate([np.zeros((late, 1)), np.repeat(u, parts, axis=0)])
    expected = response(finer, fine)[: len(u) * parts : parts]
    np.testing.assert_allclose(response(MODES, u, delay), expected, atol=1e-10)


def test_a_line_in_feedback_is_another_linear_system():
    """In discrete time: x' = (a + back c) x with c the sum of real parts."""
    u, back = coloured(200), np.array([-0.02 + 0.01j, 0.01j])
    found = looped_response(MODES, u, back, lambda y: 0.5 * y, np.zeros(len(u)))
    a = np.exp(MODES.poles)
    gamma = (a - 1) / MODES.poles
    A = np.diag(np.concatenate([a, a.conj()]))
    both = np.concatenate([gamma * back, (gamma * back).conj()])
    A = A + 0.5 * np.outer(both, np.ones(4))
    B = np.concatenate([gamma * MODES.gains[:, 0], (gamma * MODES.gains[:, 0]).conj()])
    x, expected = np.zeros(4, dtype=complex), []
    for value in u[:, 0]:
        expected.append(x.sum().real)
        x = A @ x + B * value
    np.testing.assert_allclose(found, expected, atol=1e-12)
    free = looped_response(MODES, u, 0.0 * back, np.tanh, np.zeros(len(u)))
    np.testing.assert_allclose(free, response(MODES, u), atol=1e-10)


def test_slope_of_a_mode_is_its_difference_quotient():
    u, pole, h = coloured(100)[:, 0], -0.05 + 0.2j, 1e-6
    quotient = (mode(pole + h, u) - mode(pole - h, u)) / (2 * h)
    np.testing.assert_allclose(mode_slope(pole, u, mode(pole, u)), quotient, atol=1e-6)


def test_play_turns_only_after_its_gap():
    x = np.array([0.0, 1.0, 2.0, 1.5, 1.0, 0.0, -1.0, 0.5])
    np.testing.assert_allclose(play(x, 0.5), [0.0, 0.5, 1.5, 1.5, 1.5, 0.5, -0.5, 0.0])


def test_process_noise_has_the_spectrum_of_the_modes():
    n = 100_000
    w = process_noise(MODES, n, np.random.default_rng(0))
    # The same weights, drawn first; the stationary covariance of x and of its conjugate.
    L = np.random.default_rng(0).standard_normal((2, 2)) @ [1, 1j]
    L = np.concatenate([L, L.conj()]) * np.sqrt(np.abs(np.tile(MODES.poles.real, 2)))
    poles = np.concatenate([MODES.poles, MODES.poles.conj()])
    stationary = -np.outer(L, L) / (poles[:, None] + poles)
    for lag in (0, 3, 10):
        expected = (np.exp(poles * lag)[:, None] * stationary).sum().real
        assert np.mean(w[500 : n - lag] * w[500 + lag :]) == pytest.approx(
            expected, abs=0.05 * stationary.sum().real
        )


def test_what_a_model_absorbs():
    u, window = coloured(), slice(200, 800)
    basis = absorbed(MODES, u, window, None)
    near = System(MODES.poles * 1.001, MODES.gains * 3.0)
    own = response(near, u)[window]
    assert unexplained(own + 2.0 + u[window, 0], basis) < 1e-4 * own.std()
    far = System(MODES.poles * [0.8, 1.3], MODES.gains)
    effect = response(far, u)[window] - response(MODES, u)[window]
    assert unexplained_by_fit(effect, MODES, u, window, None, [MODES.poles]) < 1e-4
    assert unexplained(effect, basis) > 0.01


def test_fit_agrees_with_first_order_for_a_small_effect():
    u, window = coloured(), slice(200, 800)
    added = 0.05 * np.sin(np.arange(600) / 7.0)
    first = unexplained(added, absorbed(MODES, u, window, np.tanh))
    fitted = unexplained_by_fit(added, MODES, u, window, np.tanh, [MODES.poles])
    assert fitted == pytest.approx(first, rel=0.02)


@pytest.mark.parametrize("effect", [e for e in plants.PLANTINGS if e not in SLOW])
@pytest.mark.parametrize("strength", ["weak", "strong"])
def test_effect_has_its_size(effect, strength):
    for seed in range(3):
        found = plant(effect, strength, seed, samples=FEW)
        assert found.truth["size"] == pytest.approx(MULTIPLES[strength], rel=0.01)
        clean = np.std(found.noise_free)
        assert plants.NOISE[0] <= found.noise_sd / clean <= plants.NOISE[1]


@pytest.mark.parametrize("effect", SLOW)
def test_effect_that_poles_may_absorb_has_its_size(effect):
    found = plant(effect, "middle", 1, samples=FEW)
    assert found.truth["size"] == pytest.approx(2.0, rel=0.01)


def test_size_is_what_least_squares_leaves():
    """The strength is that of an independent fit of the base's structure to the record."""
    found = next(
        p
        for p in (plant("extra input", "strong", s) for s in range(20))
        if p.base["kind"] == "linear" and p.base["pairs"] == 1
    )
    u, y = found.record.inputs - found.record.inputs.mean(axis=0), found.noise_free
    columns = [np.ones(len(y))]
    for lag in range(150):  # a long finite impulse response explains no less than one pair
        columns += [*np.roll(u, lag, axis=0).T]
    X, y = np.column_stack(columns)[150:], y[150:]
    left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    lost = np.sqrt(1 - X.shape[1] / len(y))
    assert 0.7 * lost * 4 < left.std() / found.noise_sd < 1.05 * 4


@pytest.mark.parametrize("effect", [None, *EFFECTS])
def test_record_holds_what_the_effect_needs(one_of_each, effect):
    found = one_of_each[effect]
    record = found.record
    assert len(record) == FEW
    assert record.n_inputs in (1, 2)
    assert not record.missing.any()
    decoys = set(record.extra) - {found.truth.get("channel")}
    assert 2 <= len(decoys) <= 4
    assert (effect == "extra input") == (found.truth.get("channel") in record.extra)
    if effect in ("calendar", "clock shift"):
        assert str(record.start.tz) == "Europe/Berlin"
    assert found.base["process_noise"] == (effect != "process noise")
    assert found.base["kind"] in ("linear", "wiener")
    assert found.base["pairs"] in (1, 2)
    assert found.effect == effect


def test_nothing_is_planted_in_null_plants(one_of_each):
    found = one_of_each[None]
    assert found.truth == {}
    assert plant(None, "weak", 3, samples=FEW).record == found.record
    assert found.process_sd < 0.7 * found.noise_sd


@pytest.mark.parametrize("effect", [None, *EFFECTS])
def test_floor_is_attained_by_who_knows_the_truth(one_of_each, effect):
    found = one_of_each[effect]
    expected = np.hypot(found.noise_sd, found.process_sd)
    if effect != "heavy tails":  # where one outlier may outweigh all other samples
        assert found.floor(found.record) == pytest.approx(expected, rel=0.15)
    part = found.record[450:]
    error = part.outputs[:, 0] - found.noise_free[450:]
    assert found.floor(part) == pytest.approx(np.sqrt(np.mean(error**2)))
    with pytest.raises(ValueError, match="part"):
        found.floor(plant(effect, "weak", 4, samples=FEW + 1).record)


def test_same_arguments_same_bits_and_no_plant_twice():
    first, again = plant("drift", "weak", 5, samples=FEW), plant("drift", "weak", 5, samples=FEW)
    assert first.record == again.record
    assert first.truth == again.truth
    prints = {
        plant(e, s, seed, samples=FEW, split=split).record.fingerprint
        for e in ("drift", "level shift")
        for s in ("weak", "strong")
        for seed in range(3)
        for split in ("development", "final")
    }
    assert len(prints) == 2 * 2 * 3 * 2


def test_decoys_have_nothing_to_do_with_the_output():
    """Correlations with the output have mean zero: what remains is chance of coloured signals."""
    found = []
    for seed in range(60):
        one = plant("output nonlinearity", "middle", seed, samples=FEW)
        y = one.record.outputs[:, 0]
        found += [np.corrcoef(channel, y)[0, 1] for channel in one.record.extra.values()]
    correlation = np.array(found)
    assert abs(correlation.mean()) < 4 * correlation.std() / np.sqrt(len(correlation))
    assert np.median(np.abs(correlation)) < 0.1


def test_saturation_repeats_its_limits():
    found = plant("saturation", "strong", 0, samples=FEW)
    low, high = found.truth["limits"]
    y = found.record.outputs[:, 0]
    assert y.min() >= low - 1e-9 * abs(y).max()
    assert y.max() <= high + 1e-9 * abs(y).max()
    assert max((y == y.min()).sum(), (y == y.max()).sum()) > 5


def test_noise_effects_have_their_own_measure():
    tails = plant("heavy tails", "strong", 0)
    e = tails.record.outputs[:, 0] - tails.noise_free
    assert np.abs(e).max() > 5 * np.median(np.abs(e)) / 0.6745
    varying = plant("heteroscedastic noise", "middle", 0, samples=FEW)
    assert np.log(varying.truth["sd"]).std() == pytest.approx(0.5)
    noisy = plant("process noise", "middle", 0, samples=FEW)
    if noisy.base["kind"] == "linear":
        assert noisy.process_sd == pytest.approx(2 * noisy.noise_sd)


def test_shift_of_the_clock_is_an_hour():
    found = plant("clock shift", "middle", 2, samples=FEW)
    assert abs(found.truth["shift"]) == pytest.approx(3600.0)
    assert found.record.time[0] < found.truth["time"] < found.record.time[-1]


def test_feedback_shows_at_negative_lags():
    """Noise of the output comes back in the input, later and not before."""
    after, before = [], []
    for seed in range(8):
        found = plant("feedback", "strong", seed)
        step = found.record.sampling_time
        e = found.record.outputs[:, 0] - found.noise_free
        u, lag = found.record.inputs[:, 0], round(found.truth["delay"] / step)
        after.append(-np.sign(found.truth["gain"]) * np.corrcoef(e[:-lag], u[lag:])[0, 1])
        before.append(np.corrcoef(e[200:], u[:-200])[0, 1])
    assert min(after) > 0.1
    assert np.mean(after) > 2 * np.abs(np.mean(before))


def test_unknown_names_are_refused():
    for arguments in (("friction", "weak", 0), ("drift", "huge", 0)):
        with pytest.raises(ValueError, match="expected one of"):
            plant(*arguments)
    with pytest.raises(ValueError, match="split"):
        plant("drift", "weak", 0, split="test")
