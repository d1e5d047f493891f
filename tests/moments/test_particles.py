"""The moment filter against a particle filter, where functions in feedback are not straight."""

import numpy as np
import pytest

from tests.moments.particles import PLANTS, filtered, make_loop, particle_filter


@pytest.mark.parametrize("name", PLANTS)
def test_the_filter_is_within_a_nat_of_the_particles(name):
    """300 samples, process and measurement noise of 10 %."""
    model, values, loop, function, y, record = make_loop(PLANTS[name], 0.1, 300, 0)
    found = filtered(model, values, record, y)
    each = [particle_filter(loop, function, y, 4000, np.random.default_rng(s)) for s in range(3)]
    assert np.std(each) < 0.5  # each run's own error
    assert found == pytest.approx(np.mean(each), abs=0.5)
    # What the bound is worth: the best straight line in the place of the function.
    grid = np.linspace(y.min(), y.max(), 101)
    line = np.polynomial.Polynomial.fit(grid, function(grid), 1)
    straight = particle_filter(loop, line, y, 4000, np.random.default_rng(9))
    assert straight < np.mean(each) - 2.0


def test_particles_agree_with_the_kalman_filter_of_a_line():
    _, _, loop, _, _, _ = make_loop(PLANTS["friction"], 0.1, 300, 1)
    y = loop.simulate(np.zeros_like, np.random.default_rng(1))[0]
    exact, _, _ = loop.filter(y)
    found = particle_filter(loop, np.zeros_like, y, 4000, np.random.default_rng(0))
    assert found == pytest.approx(exact, abs=0.5)
