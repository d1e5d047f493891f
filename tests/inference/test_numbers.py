"""Posterior of numbers that a model is made with.

Tolerances beside quadrature are in standard deviations of the number: what one curvature of the
gain for all numbers, and a grid, may cost.
"""

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy import stats

from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.numbers import Number, number_posterior

TIME = np.linspace(0.0, 4.0, 30)
SD = 0.3


def column(values):
    """A bump of some place and, with a second number, width."""
    place, width = (*values, 1.0)[:2]
    return np.exp(-0.5 * ((TIME - place) / width) ** 2)


def data(seed, *truth):
    rng = np.random.default_rng(seed)
    return 1.2 * column(truth) + SD * rng.standard_normal(len(TIME))


def potential_of(y):
    """Gain normal, noise known: given the numbers everything is normal."""

    def at(values):
        x = torch.tensor(column(values))

        def model():
            gain = pyro.sample("gain", dist.Normal(torch.tensor(0.0).double(), 1.0))
            pyro.sample("y", dist.Normal(gain * x, SD).to_event(1), obs=torch.tensor(y))

        return Potential(model, (), {"gain": torch.tensor(1.0).double()})

    return at


def exact(y, grids):
    """Mean and sd of each number from the marginal density on a fine grid."""
    mesh = np.stack([g.ravel() for g in np.meshgrid(*grids, indexing="ij")], -1)
    eye = SD**2 * np.eye(len(y))
    heights = np.array([
        stats.multivariate_normal(np.zeros(len(y)), eye + np.outer(x, x)).logpdf(y)
        for x in (column(values) for values in mesh)
    ])  # fmt: skip
    share = np.exp(heights - heights.max())
    share /= share.sum()
    mean = share @ mesh
    return mean, np.sqrt(share @ (mesh - mean) ** 2)


@pytest.mark.parametrize("seed", range(4))
def test_one_number_against_quadrature(seed):
    y = data(seed, 1.7)
    ((mean, sd),) = number_posterior(potential_of(y), [Number(1.9, 1e-3)])
    expected = exact(y, [np.linspace(0.5, 3.0, 600)])
    # The curvature for the gain is taken to be the same at every place; it varies a little.
    assert mean == pytest.approx(float(expected[0][0]), abs=0.1 * sd)
    assert sd == pytest.approx(float(expected[1][0]), rel=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_two_numbers_against_quadrature(seed):
    y = data(seed, 1.7, 0.6)
    found = number_posterior(potential_of(y), [Number(1.7, 0.1), Number(0.6, 0.1, low=0.05)])
    expected = exact(y, [np.linspace(0.6, 2.8, 90), np.linspace(0.05, 1.8, 90)])
    for k, (mean, sd) in enumerate(found):
        assert mean == pytest.approx(float(expected[0][k]), abs=0.2 * sd)
        assert sd == pytest.approx(float(expected[1][k]), rel=0.15)


def test_the_first_guess_of_its_spread_does_not_matter():
    y = data(5, 1.7)
    pairs = [number_posterior(potential_of(y), [Number(1.8, step)])[0] for step in (1e-4, 0.1, 2.0)]
    for pair in pairs[1:]:
        assert pair == pytest.approx(pairs[0], rel=0.02)


def test_a_bound_is_kept():
    y = data(6, 0.05)
    ((mean, sd),) = number_posterior(potential_of(y), [Number(0.1, 0.05, low=0.0)])
    expected = exact(y, [np.linspace(0.0, 2.5, 600)])
    assert mean == pytest.approx(float(expected[0][0]), abs=0.15 * sd)
    assert sd == pytest.approx(float(expected[1][0]), rel=0.1)


def test_numbers_that_make_no_model_have_no_density():
    """Widths below zero raise; the range ends there as at a bound."""
    y = data(7, 1.7, 0.3)
    plain = potential_of(y)

    def strict(values):
        if values[1] <= 0.2:
            raise ValueError("too narrow")
        return plain(values)

    numbers = [Number(1.7, 0.1), Number(0.3, 0.1)]
    found = number_posterior(strict, numbers)
    bounded = number_posterior(plain, [numbers[0], Number(0.3, 0.1, low=0.2)])
    assert found[1][0] > 0.2
    assert found[1][0] == pytest.approx(bounded[1][0], abs=0.5 * bounded[1][1])
    with pytest.raises(ValueError, match="too narrow"):
        number_posterior(strict, [numbers[0], Number(0.1, 0.1)])


def test_intervals_cover_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(0)
    z = []
    for seed in range(100):
        truth = float(rng.uniform(1.2, 2.8))
        ((mean, sd),) = number_posterior(potential_of(data(seed, truth)), [Number(truth, 0.05)])
        z.append((mean - truth) / sd)
    inside = np.mean(np.abs(z) < 1.645)
    # 100 intervals of 90 %: three standard errors of such a share, and of the sd of 100 errors.
    assert inside == pytest.approx(0.9, abs=3 * np.sqrt(0.09 / 100))
    assert np.std(z) == pytest.approx(1.0, abs=0.22)


def log_comb(x):
    """Peaks half a unit apart and 30 nats high under a wide one."""
    return -15.0 * (1.0 - np.cos(4.0 * np.pi * x)) - 0.5 * ((x - 2.2) / 0.3) ** 2


def at_height(log_density):
    """A model of that log-density, whose one site does not matter."""

    def model():
        pyro.sample("gain", dist.Normal(torch.tensor(0.0).double(), 1.0))
        pyro.factor("height", torch.tensor(float(log_density)))

    return Potential(model, (), {"gain": torch.tensor(0.0).double()})


def comb(values):
    return at_height(log_comb(values[0]))


@pytest.mark.parametrize(("at", "step"), [(2.0, 1.0), (2.52, 1.0), (1.5, 1.0)])
def test_all_peaks_of_a_comb_are_found(at, step):
    ((mean, sd),) = number_posterior(comb, [Number(at, step)])
    fine = np.linspace(0.0, 4.4, 20_000)
    share = np.exp(log_comb(fine))
    share /= share.sum()
    expected = share @ fine
    # A tenth of the sd: no interval that was left holds more than a tenth of the mass.
    assert mean == pytest.approx(expected, abs=0.03)
    # A twentieth: what interpolation between such points may misplace.
    assert sd == pytest.approx(np.sqrt(share @ (fine - expected) ** 2), rel=0.05)


def stairs(values):
    """Whole numbers are told apart: a slope of one nat a step above three, none below two."""
    (x,) = values
    assert x == round(x)
    return at_height(-np.inf if x < 2 else -abs(x - 3.0))


@pytest.mark.parametrize("cell", [(-1.0, 0.0), (-0.5, 0.5)])
@pytest.mark.parametrize("at", [3.0, 8.0])
def test_a_number_of_which_multiples_are_told_is_uniform_between_them(cell, at):
    ((mean, sd),) = number_posterior(stairs, [Number(at, 1.0, low=0.0, cell=cell)])
    whole = np.arange(2, 40)
    share = np.exp(-np.abs(whole - 3.0))
    share /= share.sum()
    rng = np.random.default_rng(0)
    drawn = rng.choice(whole, 400_000, p=share) + rng.uniform(*cell, 400_000)
    # Four standard errors of the draws, and e^-9 of the density that is left out.
    assert mean == pytest.approx(drawn.mean(), abs=4 * drawn.std() / np.sqrt(400_000) + 2e-3)
    assert sd == pytest.approx(drawn.std(), rel=0.01)


def test_a_cell_ends_at_the_bound():
    """Of a dead time none is below zero: the first cell stands for zero alone."""
    found = []
    for bound in (0.0, -np.inf):
        energies = {0: 0.0, 1: 1.0}

        def at(values, known=energies):
            return at_height(-known.get(round(values[0]), 50.0))

        found.append(number_posterior(at, [Number(0.0, 1.0, low=bound, cell=(-1.0, 0.0))])[0])
    share = 1.0 / (1.0 + np.exp(-1.0))
    assert found[0][0] == pytest.approx((1.0 - share) * 0.5)
    assert found[1][0] == pytest.approx(share * -0.5 + (1.0 - share) * 0.5)


@pytest.mark.parametrize("strong", [4.0, 0.1])
def test_between_two_instants_a_number_is_evaluated_once(strong):
    """A level that steps between samples: each of these is tried once, and nothing is lost."""
    rng = np.random.default_rng(1)
    clock = np.cumsum(rng.uniform(0.5, 1.5, 120)) + 3.0
    nats = strong * np.abs(clock - clock[70])
    tried = []

    def at(values):
        tried.append(values[0])
        return at_height(-nats[min(np.searchsorted(clock, values[0]), 119)])

    options = {"low": float(clock[0]), "high": float(clock[-1])}
    ((mean, sd),) = number_posterior(at, [Number(clock[70], 1.0, instants=clock, **options)])
    assert set(tried) <= set(clock)
    assert len(tried) == len(set(tried)) + 1  # the first is asked for its mode as well
    edges, wide = clock, np.diff(clock)
    share = np.exp(-nats[1:]) * wide
    share /= share.sum()
    middle = 0.5 * (edges[1:] + edges[:-1])
    expected = share @ middle
    spread = np.sqrt(share @ ((middle - expected) ** 2 + wide**2 / 12.0))
    # Between one point of each cell the density is interpolated.
    assert mean == pytest.approx(expected, abs=0.05 * spread)
    assert sd == pytest.approx(spread, rel=0.1)
    assert len(tried) < (16 if strong > 1.0 else 80)
