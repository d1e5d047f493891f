"""Where the chains of the no-U-turn sampler begin."""

import math

import pytest
import torch

from pyro_dynogp.inference.methods.nuts import within_reach


def energy(wall: float):
    """A standard normal that falls off a cliff further out than `wall`."""

    def value(parameters):
        x = parameters["x"]
        beyond = (x.norm() - wall).clamp_min(0.0)
        return 0.5 * x.square().sum() + 1e6 * beyond

    return value


START = torch.linspace(-2.0, 2.0, 9, dtype=torch.float64)


def test_a_start_the_posterior_has_weight_at_is_kept():
    assert torch.equal(within_reach(energy(100.0), START), START)


@pytest.mark.parametrize("wall", [2.0, 0.01])
def test_a_start_beyond_a_cliff_is_moved_towards_the_mode(wall):
    moved = within_reach(energy(wall), START)
    assert 0.5 * wall < float(moved.norm()) < wall + 1e-3
    assert torch.allclose(moved / moved.norm(), START / START.norm())


def test_a_start_that_has_no_density_is_moved():
    def value(parameters):
        x = parameters["x"]
        return math.nan * x.sum() if float(x.norm()) > 1.0 else 0.5 * x.square().sum()

    assert 0.0 < float(within_reach(value, START).norm()) <= 1.0
