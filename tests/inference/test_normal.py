"""SVI around Laplace's approximation, and where there is nothing for it to do."""

import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy.stats import multivariate_normal

from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.laplace import laplace
from pyro_dynogp.inference.methods.normal import (
    AS_GOOD,
    CLOSE,
    NO_BETTER,
    best_width,
    log_weights,
    variational,
)
from pyro_dynogp.inference.methods.svi import Schedule
from pyro_dynogp.inference.run import Run

X = torch.tensor([[1.0, 0.5], [-0.3, 2.0], [0.7, 0.7]], dtype=torch.float64)
Y = torch.tensor([0.4, -1.1, 0.9], dtype=torch.float64)
NOISE = 0.5


def normal(y):
    zero = torch.zeros(2, dtype=torch.float64)
    w = pyro.sample("w", dist.Normal(zero, 1.0).to_event(1))
    mean = (X @ w[..., None])[..., 0]
    pyro.sample("y", dist.Normal(mean, NOISE).to_event(1), obs=y)


def skewed(y):
    """A scale from three samples: its posterior has a long tail in the logarithm, too."""
    sd = pyro.sample("sd", dist.HalfCauchy(torch.ones((), dtype=torch.float64)))
    pyro.sample("y", dist.Normal(0.0, sd[..., None]).expand(sd.shape + y.shape).to_event(1), obs=y)


def evidence():
    covariance = X @ X.T + NOISE**2 * torch.eye(3, dtype=torch.float64)
    return multivariate_normal(np.zeros(3), covariance.numpy()).logpdf(Y.numpy())


def test_where_the_posterior_is_normal_nothing_is_trained():
    found = variational(
        normal, (Y,), {"w": torch.zeros(2, dtype=torch.float64)}, Run(), Schedule(50)
    )
    assert found.message == AS_GOOD.format(CLOSE)
    assert found.elbo == pytest.approx([evidence()], abs=1e-4)
    precision = torch.eye(2, dtype=torch.float64) + X.T @ X / NOISE**2
    exact = torch.linalg.solve(precision, X.T @ Y / NOISE**2)
    # The climb ends within FLAT standard deviations, by differences of gradients over 1e-4.
    torch.testing.assert_close(found.guide.loc[0], exact, atol=1e-3, rtol=0.0)
    root = found.guide.scale_tril[0]
    torch.testing.assert_close(root @ root.T, torch.linalg.inv(precision), atol=1e-4, rtol=1e-4)


def test_where_it_is_not_svi_raises_the_elbo():
    start = {"sd": torch.ones((), dtype=torch.float64)}
    found = variational(skewed, (Y,), start, Run(), Schedule(300, 32))
    assert "Laplace" not in found.message
    assert len(found.elbo) > 50
    potential = Potential(skewed, (Y,), start)
    centre, root = (torch.as_tensor(x) for x in laplace(potential, start))
    many = torch.cat([log_weights(potential, centre, root, seed) for seed in range(40)])
    assert 0.5 * many.var() > CLOSE
    assert found.elbo[-50:].mean() > many.mean()


def test_what_svi_makes_worse_is_not_taken():
    """Two long steps from the best normal, in units of its standard deviations."""
    start = {"sd": torch.ones((), dtype=torch.float64)}
    schedule = Schedule(2, 2, learning_rate=2.0)
    found = variational(skewed, (Y,), start, Run(), schedule)
    assert found.message == NO_BETTER
    potential = Potential(skewed, (Y,), start)
    centre, root = (torch.as_tensor(x) for x in laplace(potential, start))
    torch.testing.assert_close(found.guide.scale_tril[0], root)
    level = log_weights(potential, centre, root, 0).mean()
    assert found.elbo == pytest.approx([float(level)])


def test_a_divergence_that_svi_would_not_mend_is_left():
    start = {"sd": torch.ones((), dtype=torch.float64)}
    potential = Potential(skewed, (Y,), start)
    centre, root = (torch.as_tensor(x) for x in laplace(potential, start))
    off = 0.5 * float(log_weights(potential, centre, root, 0).var())
    for close, trained in ((0.9 * off, True), (1.1 * off, False)):
        found = variational(skewed, (Y,), start, Run(), Schedule(100, 32), close=close)
        assert (found.message != AS_GOOD.format(close)) == trained


def test_log_weights_are_the_divergence_of_a_wrong_normal():
    """Of a normal that is too wide by known factors: KL in closed form, and half the variance."""
    potential = Potential(normal, (Y,), {"w": torch.zeros(2, dtype=torch.float64)})
    centre, root = laplace(potential, {"w": torch.zeros(2, dtype=torch.float64)})
    wide = torch.as_tensor(root) * 1.1
    many = torch.cat([
        log_weights(potential, torch.as_tensor(centre), wide, seed) for seed in range(60)
    ])  # fmt: skip
    divergence = 2 * (0.5 * (1.1**2 - 1.0) - math.log(1.1))
    # Monte Carlo of 1920 draws: four standard errors of the mean, two of the variance.
    assert evidence() - float(many.mean()) == pytest.approx(divergence, abs=0.02)
    assert 0.5 * float(many.var()) == pytest.approx(0.5 * (1.1**2 - 1.0) ** 2, rel=0.15)


@pytest.mark.parametrize(("factor", "share"), [(1.0, 1.0), (1.9, 0.5), (3.9, 0.25), (30.0, 0.125)])
def test_svi_begins_with_the_width_of_the_highest_elbo(factor, share):
    """A normal that is so many times too wide; of the shares that are tried the nearest."""
    start = {"w": torch.zeros(2, dtype=torch.float64)}
    potential = Potential(normal, (Y,), start)
    centre, root = (torch.as_tensor(x) for x in laplace(potential, start))
    wide = factor * root
    torch.testing.assert_close(best_width(potential, centre, wide, 0), share * wide)


def test_walls_that_the_curvature_at_the_mode_does_not_show():
    """x^4 against a flat middle: Laplace's normal is far too wide, and SVI begins narrower."""

    def walls(y):
        x = pyro.sample("x", dist.Normal(torch.zeros((), dtype=torch.float64), 1.0))
        pyro.factor("walls", -((20.0 * x) ** 4))

    start = {"x": torch.zeros((), dtype=torch.float64)}
    potential = Potential(walls, (Y,), start)
    centre, root = (torch.as_tensor(x) for x in laplace(potential, start))
    # The prior's curvature is 1; differences over 1e-4 see 0.0064 more of the walls.
    assert float(root) == pytest.approx(1.0, rel=0.01)
    narrow = best_width(potential, centre, root, 0)
    before, after = (float(log_weights(potential, centre, r, 1).mean()) for r in (root, narrow))
    assert after > before + 1e4
    found = variational(walls, (Y,), start, Run(), Schedule(20, 16))
    assert found.elbo[0] > before + 1e4
