"""A prior whose entries share an unknown size, against Student-t distributions of libraries."""

import numpy as np
import pyro.distributions as dist
import pytest
import scipy.stats
import torch

from pyro_dynogp.distributions.shared_scale import SharedScaleNormal


def student(df: float, scale: float, d: int) -> dist.MultivariateStudentT:
    zero = torch.zeros(d, dtype=torch.float64)
    return dist.MultivariateStudentT(zero.new_tensor(df), zero, scale * torch.eye(d).double())


@pytest.mark.parametrize("apart", [0, 1, 2, -1])
def test_density_is_that_of_a_student_t_for_each_slice(apart):
    df, scale = torch.tensor([2.5, 6.0]).double(), torch.tensor([0.3, 2.0]).double()
    prior = SharedScaleNormal(df, scale, (4, 3, 2), apart)
    x = torch.randn(5, 2, 4, 3, 2, dtype=torch.float64)
    found = prior.log_prob(x)
    assert found.shape == (5, 2)
    for b in range(2):
        slices = x[:, b].movedim(1 + apart % 3, 1).flatten(2)
        of_one = student(float(df[b]), float(scale[b]), slices.shape[-1])
        torch.testing.assert_close(found[:, b], of_one.log_prob(slices).sum(-1))


def test_of_a_vector_every_entry_has_a_size_of_its_own():
    prior = SharedScaleNormal(3.0, 0.7, (4,), apart=-1)
    x = torch.randn(5, 4, dtype=torch.float64)
    exact = scipy.stats.t(3.0, scale=0.7).logpdf(x.numpy()).sum(1)
    torch.testing.assert_close(prior.log_prob(x), torch.from_numpy(exact))
    torch.testing.assert_close(prior.log_prob(x[0]), torch.as_tensor(exact[0]))
    assert prior.sample((6,)).shape == (6, 4)


def test_draws_have_the_marginals_and_share_their_size_within_a_slice_only():
    torch.manual_seed(0)
    prior = SharedScaleNormal(5.0, 0.7, (2, 3), apart=1)
    x = prior.rsample((4000,))
    assert x.shape == (4000, 2, 3)
    for a in range(2):
        for b in range(3):
            exact = scipy.stats.t(5.0, scale=0.7).cdf
            assert scipy.stats.kstest(x[:, a, b].numpy(), exact).pvalue > 1e-3
    rank = scipy.stats.spearmanr(x.abs().reshape(4000, 6).numpy()).statistic
    same = np.arange(6)[:, None] % 3 == np.arange(6) % 3
    other = ~same
    assert rank[same & ~np.eye(6, dtype=bool)].min() > 0.08
    assert np.abs(rank[other]).max() < 0.06


def test_gradients_expansion_and_no_entries():
    prior = SharedScaleNormal(3.0, 0.3, (2, 2, 2), apart=1)
    x = torch.randn(2, 2, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(prior.log_prob, (x,))
    wide = prior.expand([4])
    assert wide.batch_shape == (4,)
    assert wide.sample().shape == (4, 2, 2, 2)
    torch.testing.assert_close(wide.log_prob(x.detach()), prior.log_prob(x.detach()).expand(4))
    none = SharedScaleNormal(3.0, 0.3, (2, 0, 2), apart=1)
    assert none.log_prob(none.sample()) == 0.0


def test_large_entries_are_not_held_down():
    """A thousand times the scale costs tens of nats, not half a million as of a normal."""
    prior = SharedScaleNormal(3.0, 0.3, (5, 1, 2), apart=1)
    small = torch.full((5, 1, 2), 0.1, dtype=torch.float64)
    cost = prior.log_prob(small) - prior.log_prob(3000.0 * small)
    assert 0.0 < float(cost) < 150.0
