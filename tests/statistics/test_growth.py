"""Records of unstable plants are told from those of stable ones."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

from pyro_dynogp.inference.stability import is_unstable
from pyro_dynogp.statistics.growth import least_stable_pole


def closed_loop(seed, pole=1.0, n=260, step=0.05, noise=0.02):
    """A plant with a real pole [1/s] under proportional control: its input and output."""
    rng = np.random.default_rng(seed)
    reference = np.repeat(rng.choice([-1.0, 1.0], size=n // 20 + 1), 20)[:n]
    e, x = np.exp(pole * step), 0.0
    states, inputs = np.empty(n), np.empty(n)
    for k in range(n):
        states[k] = x
        inputs[k] = -3 * (x + noise * rng.standard_normal()) + 2 * reference[k]
        x = e * x + (e - 1) / pole * inputs[k] + 0.5 * noise * rng.standard_normal()
    return inputs[:, None], states + noise * rng.standard_normal(n)


def stable(seed, n=300):
    """A random plant of one to three pairs, its slowest time constant a tenth of the record."""
    rng = np.random.default_rng(seed)
    u = rng.choice([-1.0, 1.0], size=n)
    y = np.zeros(n)
    for _ in range(rng.integers(1, 4)):
        rate = np.exp(rng.uniform(np.log(10 / n), np.log(0.5)))
        A = np.array([[0.0, 1.0], [-(rate**2) * rng.uniform(1.0, 20.0), -2.0 * rate]])
        phi = expm(A)
        y += lfilter([0.0, 1.0], [1.0, -np.trace(phi), np.linalg.det(phi)], u)
    return u[:, None], y + 0.1 * y.std() * rng.standard_normal(n)


@pytest.mark.parametrize("seed", range(5))
def test_the_pole_of_an_unstable_plant_is_found(seed):
    u, y = closed_loop(seed)
    rate, error = least_stable_pole([u], [y])
    assert abs(rate / 0.05 - 1.0) < 0.1
    assert abs(rate / 0.05 - 1.0) < 4.0 * error / 0.05
    assert is_unstable(rate, error, len(y))


def test_stable_plants_raise_no_alarm():
    records = (stable(seed) for seed in range(100))
    assert not any(is_unstable(*least_stable_pole([u], [y]), len(y)) for u, y in records)


@pytest.mark.parametrize("seed", range(20))
def test_integrators_raise_no_alarm(seed):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], size=26), 10)
    level = np.cumsum(np.concatenate([[0.0], u[:-1]]))
    y = level + 0.1 * level.std() * rng.standard_normal(len(u))
    assert not is_unstable(*least_stable_pole([u[:, None]], [y]), len(y))


@pytest.mark.parametrize(
    ("rate", "error", "expected"),
    [(0.031, 0.01, True), (0.029, 0.001, False), (0.031, 0.0104, False), (-0.1, 0.001, False)],
)
def test_growth_has_to_matter_and_to_be_sure(rate, error, expected):
    assert is_unstable(rate, error, 100.0) == expected


def test_the_standard_error_is_that_of_repeated_records():
    found = [least_stable_pole(*([x] for x in closed_loop(seed))) for seed in range(60)]
    rates, errors = np.transpose(found)
    assert 0.6 < errors.mean() / rates.std() < 1.6


def test_missing_samples_and_several_records():
    u, y = closed_loop(3, n=400)
    y[50] = np.nan
    whole, error = least_stable_pole([u], [y])
    parts, _ = least_stable_pole([u[:200], u[200:]], [y[:200], y[200:]])
    assert abs(whole - parts) < 3.0 * error
    assert least_stable_pole([u[:20]], [y[:20]]) is None
    assert least_stable_pole([u[:5]], [y[:5]]) is None
