"""The prior of dead times against pyro's half-Cauchy, and its coordinate against autograd."""

from __future__ import annotations

import pyro.distributions as dist
import torch
from torch.distributions import biject_to

from pyro_dynogp.distributions.dead_time import NONE, DeadTime

MEDIAN = torch.tensor([2.0, 7.0], dtype=torch.float64)
PRIOR = DeadTime(MEDIAN, torch.tensor(0.5, dtype=torch.float64))


def test_density_and_draws_are_half_cauchy():
    d = torch.tensor([[0.0, 0.3], [2.0, 50.0]], dtype=torch.float64)
    torch.testing.assert_close(PRIOR.log_prob(d), dist.HalfCauchy(MEDIAN).log_prob(d))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        drawn = PRIOR.sample((20_000,))
    assert drawn.shape == (20_000, 2)
    quantiles = torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)
    expected = MEDIAN * torch.tan(0.5 * torch.pi * quantiles)[:, None]
    torch.testing.assert_close(drawn.quantile(quantiles, 0), expected, rtol=0.05, atol=0.0)


def test_the_coordinate():
    transform = biject_to(PRIOR.support)
    z = torch.tensor([[-3.0, -0.1], [0.0, 0.2], [1.0, 5.0]], dtype=torch.float64)
    z.requires_grad_()
    d = transform(z)
    assert (d >= 0.0).all()
    torch.testing.assert_close(transform.inv(d)[1:], z[1:])
    (slope,) = torch.autograd.grad(d.sum(), z)
    torch.testing.assert_close(transform.log_abs_det_jacobian(z, d), slope.log())
    # Linear near zero, logarithmic beyond a step.
    few, many = transform.inv(torch.tensor([[0.15, 0.2], [500.0, 1000.0]], dtype=torch.float64))
    assert abs(float(few[1] - few[0]) - 0.1) < 0.03
    assert abs(float(many[1] - many[0]) - torch.log(torch.tensor(2.0)).item()) < 1e-3
    assert float(transform(torch.tensor(-100.0 * NONE).double())[0]) < 1e-20
