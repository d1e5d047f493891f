"""Divergence of a trajectory given pseudo-observations from its prior, against dense normals."""

import warnings

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro.infer import Trace_ELBO, TraceMeanField_ELBO
from torch.distributions import MultivariateNormal, kl_divergence

from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.state import ModalState
from tests.distributions.cases import START, make
from tests.distributions.test_conditioned import jitter_of, posterior
from tests.lti.oracles import assert_close, tensor


def dense(mean, covariance):
    return MultivariateNormal(tensor(mean), tensor(0.5 * (covariance + covariance.T)))


def some_missing(case, seed=0):
    """Pseudo-observations, a few of them missing, and standard deviations of their noise."""
    y = case.draw(seed=seed)
    y[[0, 4, 5]] = np.nan
    return y, np.random.default_rng([seed, 3]).uniform(0.2, 2.0, case.size)


@pytest.mark.parametrize("noise", ["shared", "independent"])
@pytest.mark.parametrize("start", START)
@pytest.mark.parametrize("outputs", [None, 2])
@pytest.mark.parametrize("relative", [1e-3, 0.3])  # large enough to be seen
def test_dense(outputs, start, noise, relative):
    case = make(outputs=outputs, start=start, noise=noise, n=12, offset=True, jitter=relative)
    y, sd = some_missing(case)
    q = case.process.condition(case.event(y), case.event(sd), varying=True)
    jitter = jitter_of(case, relative)
    Q = dense(*posterior(case, y, sd**2, jitter=jitter))
    P = dense(case.mean, case.covariance + jitter * np.eye(case.size))
    ours = kl_divergence(q, case.process)
    assert ours.shape == ()
    assert ours.item() == pytest.approx(kl_divergence(Q, P).item(), rel=1e-10)


@pytest.mark.parametrize("outputs", [None, 2])
def test_monte_carlo(outputs):
    case = make(outputs=outputs, n=12, jitter=1e-4)
    y, sd = some_missing(case)
    q = case.process.condition(case.event(y), case.event(sd), varying=True)
    torch.manual_seed(0)
    h = q.sample((4000,))
    ratio = (q.log_prob(h) - case.process.log_prob(h)).numpy()
    error = ratio.std() / np.sqrt(len(ratio))
    assert kl_divergence(q, case.process).item() == pytest.approx(ratio.mean(), abs=4.5 * error)
    assert error < 0.05


def test_batches():
    # Systems (particles) of batch (2, 1), records (3,), each with missing samples of its own.
    systems = [make(seed=k, jitter=1e-4) for k in range(2)]
    stacked = {
        name: torch.stack([getattr(c.system.modes, name) for c in systems]).unsqueeze(1)
        for name in ("poles", "B", "output_gain", "L", "feedthrough")
    }
    modes = Modes(*stacked.values())
    case = systems[0]
    u = np.stack([case.inputs * (k + 1) for k in range(3)])
    y = case.draw(3)
    y[0, 1] = y[2, 8] = np.nan
    prior = LTIProcess(modes, case.time, u, jitter=1e-4)
    together = kl_divergence(prior.condition(tensor(y), 0.4), prior)
    assert together.shape == (2, 3)
    for i in range(2):
        for k in range(3):
            one = LTIProcess(systems[i].system.modes, case.time, u[k], jitter=1e-4)
            alone = kl_divergence(one.condition(tensor(y[k]), 0.4), one)
            assert together[i, k].item() == pytest.approx(alone.item(), rel=1e-12)


def test_expanded():
    case = make()
    q = case.process.condition(tensor(case.draw()), 0.4)
    alone = kl_divergence(q, case.process)
    wide = kl_divergence(q.expand((3, 4)), case.process.expand((3, 4)))
    assert_close(wide, alone.expand(3, 4))
    # As a plate does it: records as an event of the site.
    events = kl_divergence(q.expand((4,)).to_event(1), case.process.expand((4,)).to_event(1))
    assert events.item() == pytest.approx(4.0 * alone.item(), rel=1e-12)


def test_nothing_said_and_everything_said():
    case = make()
    y = tensor(case.draw())
    nothing = case.process.condition(torch.full((10,), torch.nan, dtype=torch.float64), 0.3)
    assert kl_divergence(nothing, case.process).item() == 0.0
    # The last bits of n terms of size one are all that is left where the noise is enormous.
    weak = kl_divergence(case.process.condition(y, 1e7), case.process).item()
    assert -1e-12 < weak < 1e-9
    sharp = case.process.condition(y, 1e-2)
    Q = dense(*posterior(case, y.numpy(), 1e-4, jitter=jitter_of(case, 1e-9)))
    P = dense(case.mean, case.covariance + jitter_of(case, 1e-9) * np.eye(10))
    assert kl_divergence(sharp, case.process).item() == pytest.approx(
        kl_divergence(Q, P).item(), rel=1e-7
    )


@pytest.mark.parametrize("start", ["stationary", "gaussian"])
def test_gradients(start):
    case = make(n=5, start=start)
    m, state = case.system.modes, case.process.initial_state
    missing = torch.tensor([False, True, False, False, False])
    leaves = (
        m.poles.clone().requires_grad_(),
        m.L.clone().requires_grad_(),
        m.feedthrough.clone().requires_grad_(),
        tensor(case.draw()).requires_grad_(),
        torch.full((5,), 0.4, dtype=torch.float64).requires_grad_(),
    )

    def divergence(poles, L, D, y, sd):
        modes = Modes(poles, m.B, m.output_gain, L, D)
        prior = LTIProcess(modes, case.time, case.inputs, state, jitter=1e-3)
        q = prior.condition(y.masked_fill(missing, torch.nan), sd, varying=True)
        return kl_divergence(q, prior)

    assert torch.autograd.gradcheck(divergence, leaves)
    grad = torch.autograd.grad(divergence(*leaves), leaves)
    assert grad[3][1].item() == grad[4][1].item() == 0.0


class TestIdentity:
    """The divergence is only right, and so only given, where both share one prior."""

    def rebuild(self, poles, L, **change):
        case = make()
        m = case.system.modes
        modes = Modes(-poles.exp() + 2.0j, m.B[:1], m.output_gain[:1], L, m.feedthrough)
        kw = {
            "time": case.time,
            "inputs": case.inputs,
            "initial_state": ModalState(torch.ones(1, dtype=torch.complex128)),
            "offset": 0.3,
        }
        return LTIProcess(modes, **(kw | change))

    def leaves(self):
        return (
            torch.zeros(1, dtype=torch.float64, requires_grad=True),
            torch.ones(1, 1, dtype=torch.complex128, requires_grad=True),
        )

    def accepted(self, a, b):
        q = a.condition(torch.zeros(10, dtype=torch.float64), 0.3)
        try:
            kl_divergence(q, b)
        except NotImplementedError:
            return False
        return True

    def test_computed_twice_from_the_same_leaves(self):
        leaves = self.leaves()
        assert self.accepted(self.rebuild(*leaves), self.rebuild(*leaves))
        plain = [x.detach() for x in leaves]
        assert self.accepted(self.rebuild(*plain), self.rebuild(*[x.clone() for x in plain]))

    @pytest.mark.parametrize(
        "change",
        [
            {"time": np.arange(10.0)},
            {"inputs": np.zeros((10, 2))},
            {"initial_state": None},
            {"initial_state": ModalState(torch.zeros(1, dtype=torch.complex128))},
            {"offset": 0.2},
            {"offset": None},
            {"jitter": 1e-6},
        ],
    )
    def test_other_numbers(self, change):
        leaves = self.leaves()
        assert not self.accepted(self.rebuild(*leaves), self.rebuild(*leaves, **change))

    def test_equal_numbers_from_other_leaves(self):
        # The gradient of each prior would be taken for that of both.
        poles, L = self.leaves()
        ours = self.rebuild(poles, L)
        for other in (poles.detach(), poles.detach().clone().requires_grad_()):
            assert not self.accepted(ours, self.rebuild(other, L))
            assert not self.accepted(self.rebuild(other, L), ours)
        assert not self.accepted(ours, self.rebuild(poles, L.detach().clone().requires_grad_()))

    def test_equal_numbers_by_another_function(self):
        poles, L = self.leaves()
        assert not self.accepted(self.rebuild(poles, L), self.rebuild(poles * 3.0, L))

    def test_elbo_falls_back_on_draws(self):
        # A guide of another prior is legitimate; its divergence is then estimated.
        leaves = [x.detach() for x in self.leaves()]
        p, other = self.rebuild(*leaves), self.rebuild(*leaves, inputs=np.zeros((10, 2)))
        y = torch.ones(10, dtype=torch.float64)

        def model():
            h = pyro.sample("h", p)
            pyro.sample("y", dist.Normal(h, 1.0).to_event(1), obs=y)

        def guide():
            pyro.sample("h", other.condition(y, 1.0))

        losses = {}
        with warnings.catch_warnings(), pyro.validation_enabled(True):
            warnings.simplefilter("error")
            for elbo in (Trace_ELBO, TraceMeanField_ELBO):
                pyro.set_rng_seed(0)
                losses[elbo] = elbo().loss(model, guide)
        assert losses[Trace_ELBO] == pytest.approx(losses[TraceMeanField_ELBO], rel=1e-10)
