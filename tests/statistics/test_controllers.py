"""Inputs that are computed from the output."""

import numpy as np
import pytest
from scipy.signal import lfilter

from pyro_dynogp.statistics.controllers import controller_of
from tests.discrepancy.made import SETTINGS


def loop(seed, gains, *, n=300, late=0, noise=0.3):
    """Input, output and set point of a plant of first order under P, I and D terms."""
    rng = np.random.default_rng(seed)
    proportional, integral, derivative = gains
    r = np.repeat(rng.standard_normal(n // 20), 20)
    y, u, x, level = np.zeros(n), np.zeros(n), 0.0, 0.0
    disturbance = lfilter([0.2], [1.0, -0.9], rng.standard_normal(n))
    for k in range(n):
        y[k] = x + disturbance[k] + noise * rng.standard_normal()
        seen = max(k - late, 0)
        e, before = r[seen] - y[seen], r[max(seen - 1, 0)] - y[max(seen - 1, 0)]
        level += integral * e
        u[k] = proportional * e + level + derivative * (e - before)
        x = 0.9 * x + 0.1 * u[k]
    return u, y, r


def open_loop(seed, direct, *, n=300, noise=0.01):
    """A plant with a direct path, a channel that acts, and little noise."""
    rng = np.random.default_rng(seed)
    u, c = rng.standard_normal((2, n))
    if seed % 2:
        u = np.repeat(u[: n // 10], 10)
    y = direct * u + lfilter([0.0, 0.3], [1.0, -0.7], u) + lfilter([0.2], [1.0, -0.8], c)
    return u, y + noise * y.std() * rng.standard_normal(n), c


@pytest.mark.parametrize("gains", [(2.0, 0.0, 0.0), (1.0, 0.2, 0.0), (1.0, 0.2, 0.5)])
@pytest.mark.parametrize("late", [0, 1])
def test_the_set_point_is_found_among_channels(gains, late):
    u, y, r = loop(0, gains, late=late)
    walk = np.random.default_rng(1).standard_normal(len(u)).cumsum()
    found = controller_of(u, y, {"walk": walk, "r": r, "late": np.roll(r, 7)})
    assert found.set_point == "r"
    assert found.share < 1e-12


def test_signals_that_are_logged_with_three_decimals():
    u, y, r = (x.round(3) for x in loop(0, (1.0, 0.2, 0.0)))
    found = controller_of(u, y, {"r": r})
    assert found.set_point == "r"
    assert found.share < 0.3 * SETTINGS.controller


def test_a_constant_set_point_is_no_channel():
    u, y, _ = loop(0, (1.0, 0.2, 0.0))
    _, _, r = loop(1, (1.0, 0.2, 0.0))
    assert controller_of(u, y, {"r": r}).share > 1e-2  # that of another loop
    constant = lfilter([1.2, -1.0], [1.0, -1.0], -y)
    found = controller_of(constant, y, {"r": r})
    assert found.share < 1e-12
    missing = y.copy()
    missing[::7] = np.nan
    assert controller_of(constant, missing, {}).set_point == ""
    assert controller_of(constant, missing, {}).share < 1e-12


@pytest.mark.parametrize("direct", [0.0, 0.3, 1.0, 3.0])
def test_without_feedback_nothing_is_computed(direct):
    """As much of an input is left as the noise hides, far above what a controller leaves."""
    shares = []
    for seed in range(40):
        u, y, c = open_loop(seed, direct)
        shares.append(controller_of(u, y, {"c": c}).share)
    assert min(shares) > 10.0 * SETTINGS.controller


def test_an_input_that_its_own_past_foretells_says_nothing():
    t = np.arange(300.0)
    assert controller_of(np.sin(0.3 * t), np.random.default_rng(0).standard_normal(300), {}) is None
    assert controller_of(np.sin(t[:10]), t[:10], {}) is None  # too few samples
