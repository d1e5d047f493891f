"""The prior of decay rates: density, support, draws and what it excludes."""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.integrate import quad

from pyro_dynogp.distributions.decay import LogDecayRate


def real(x):
    return torch.tensor(x, dtype=torch.float64)


@pytest.mark.parametrize(("rate", "upper"), [(0.1, 4.0), (3.0, 0.5), (1.0, -1.0)])
class TestDensity:
    def test_integrates_to_one(self, rate, upper):
        p = LogDecayRate(real(rate), real(upper))
        density = lambda z: math.exp(p.log_prob(real(z)).item())  # noqa: E731
        parts = [(upper - 60, upper - 5), (upper - 5, upper)]
        total = sum(quad(density, low, high, limit=200)[0] for low, high in parts)
        assert total == pytest.approx(1.0, rel=1e-8)

    def test_is_the_truncated_inverse_gamma(self, rate, upper):
        p = LogDecayRate(real(rate), real(upper))
        z = np.linspace(upper - 4.0, upper - 1e-9, 9)
        c = np.exp(z)
        law = stats.invgamma(0.5, scale=rate)
        expected = law.logpdf(c) + z - law.logcdf(math.exp(upper))
        np.testing.assert_allclose(p.log_prob(torch.tensor(z)), expected, rtol=1e-10, atol=1e-10)

    def test_draws_follow_the_density(self, rate, upper):
        torch.manual_seed(3)
        p = LogDecayRate(real(rate), real(upper))
        z = p.sample((4000,)).numpy()
        assert z.max() <= upper
        law = stats.invgamma(0.5, scale=rate)
        cdf = lambda x: law.cdf(np.exp(x)) / law.cdf(math.exp(upper))  # noqa: E731
        assert stats.kstest(z, cdf).pvalue > 1e-3


def test_time_constant_is_a_squared_half_normal():
    torch.manual_seed(0)
    p = LogDecayRate(real(2.0), real(30.0))
    root = np.exp(-0.5 * p.sample((5000,)).numpy())
    assert stats.kstest(root, stats.halfnorm(scale=0.5).cdf).pvalue > 1e-3


def test_batches_gradients_and_support():
    p = LogDecayRate(torch.ones(3).double(), torch.zeros(3).double()).expand((2, 3))
    assert p.sample((4,)).shape == (4, 2, 3)
    assert p.log_prob(-torch.ones(2, 3).double()).shape == (2, 3)
    z = torch.tensor(-1.3, dtype=torch.float64, requires_grad=True)
    one = LogDecayRate(real(0.7), real(1.0))
    (slope,) = torch.autograd.grad(one.log_prob(z), z)
    assert slope.item() == pytest.approx(-0.5 + 0.7 * math.exp(1.3))
    with pytest.raises(ValueError, match="support"):
        LogDecayRate(torch.tensor(0.7), torch.tensor(1.0), validate_args=True).log_prob(
            torch.tensor(1.5)
        )
