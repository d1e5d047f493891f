"""Annealed particles: normalising constants and moments of known densities, models, what breaks."""

import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy.stats import f

import pyro_dynogp as dgp
from pyro_dynogp.criticism.left_out import spread_of
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.annealed import Joint, anneal
from pyro_dynogp.inference.methods.moves import ACCEPTANCE, CHANGE, chains_from, next_size, root_of
from pyro_dynogp.inference.student_mixture import FREEDOM, StudentMixture


def tensor(x):
    return torch.tensor(x, dtype=torch.float64)


class Known:
    """A density by torch, counted."""

    def __init__(self, log_density):
        self.log_density, self.calls = log_density, 0

    def __call__(self, z):
        self.calls += 1
        x = z.detach().requires_grad_()
        value = self.log_density(x)
        (gradient,) = torch.autograd.grad(value.sum(), x)
        return value.detach(), gradient


def normal(count, d, seed=0):
    return torch.randn(count, d, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def standard(z):
    return -0.5 * z.square().sum(-1) - 0.5 * z.shape[-1] * math.log(2 * math.pi)


def banana(z):
    """A ridge bent like a parabola, of known moments: z0 ~ N(0, 1), z1 | z0 ~ N(z0^2, 0.3^2)."""
    first = -0.5 * z[:, 0] ** 2 - 0.5 * math.log(2 * math.pi)
    off = (z[:, 1] - z[:, 0] ** 2) / 0.3
    return first - 0.5 * off**2 - math.log(0.3) - 0.5 * math.log(2 * math.pi)


def two_peaks(z):
    """Equal peaks at -3 and 3 in the first coordinate, twice the mass of a density."""
    return (
        math.log(2.0)
        + torch.logaddexp(standard(z - tensor([3.0, 0.0])), standard(z + tensor([3.0, 0.0])))
        - math.log(2.0)
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_bent_ridge(seed):
    found = anneal(2.0 * normal(3200, 2, seed), Known(lambda z: standard(z / 2) - 2 * math.log(2)),
                   Known(banana), seed=seed)  # fmt: skip
    assert found.log_evidence == pytest.approx(0.0, abs=0.25)
    x, y = found.z.T
    assert float(x.mean()) == pytest.approx(0.0, abs=0.2)
    assert float(x.var()) == pytest.approx(1.0, abs=0.3)
    assert float(y.mean()) == pytest.approx(1.0, abs=0.3)
    assert float((y - x**2).std()) == pytest.approx(0.3, rel=0.15)
    assert found.temperatures[-1] == 1.0
    assert all(0.4 < rate <= 1.0 for rate in found.acceptance)
    assert len(np.unique(found.ancestor)) > 80


def test_two_peaks_keep_their_shares():
    wide = Known(lambda z: standard(z / 4) - 2 * math.log(4))
    found = anneal(4.0 * normal(1000, 2), wide, Known(two_peaks))
    assert found.log_evidence == pytest.approx(math.log(2.0), abs=0.2)
    assert float((found.z[:, 0] > 0).double().mean()) == pytest.approx(0.5, abs=0.1)


def test_the_evidence_is_unbiased():
    """Over repeated runs the mean of exp(log evidence) is the constant, 1."""
    target = Known(lambda z: standard((z - 1.5) / 0.5) - 3 * math.log(0.5))
    values = [
        math.exp(anneal(normal(60, 3, seed), Known(standard), target, seed=seed).log_evidence)
        for seed in range(60)
    ]
    error = np.std(values) / np.sqrt(len(values))
    assert error < 0.2
    assert np.mean(values) == pytest.approx(1.0, abs=4 * error)


def test_the_same_density_needs_one_step_and_changes_nothing_but_by_moves():
    z = normal(300, 2)
    found = anneal(z, Known(standard), Known(standard))
    assert found.temperatures == (1.0,)
    assert found.log_evidence == pytest.approx(0.0, abs=1e-12)
    again = anneal(z, Known(standard), Known(standard))
    assert torch.equal(found.z, again.z)  # the same seed


def test_a_target_that_no_particle_can_reach():
    nowhere = Known(lambda z: standard(z) - torch.inf)
    with pytest.raises(RuntimeError, match="no particle has a density"):
        anneal(normal(50, 2), Known(standard), nowhere)


def test_student_start():
    loc, root = tensor([1.0, -2.0]), tensor([[1.0, 0], [0.5, 2]])
    student = StudentMixture(tensor([1.0]), loc[None], root[None])
    z = student.draw(4000, seed=1)
    value, gradient = student(z)
    exact = dist.MultivariateStudentT(tensor(FREEDOM), loc, root).log_prob(z)
    torch.testing.assert_close(value, exact)
    x = z[:5].clone().requires_grad_()
    (slope,) = torch.autograd.grad(student(x)[0].sum(), x)
    torch.testing.assert_close(gradient[:5], slope)
    inside = torch.linalg.solve_triangular(root, (z - loc).mT, upper=False)
    # Squared radii over d are F(2, FREEDOM).
    radius = float((inside.square().sum(0) / 2).median())
    assert radius == pytest.approx(f.ppf(0.5, 2, FREEDOM), abs=0.06)


def test_a_mixture_of_starts():
    """Density, gradient and the shares of the components, against Pyro's distributions."""
    weights, loc = tensor([0.7, 0.3]), tensor([[1.0, -2.0], [-20.0, 5.0]])
    root = tensor([[[1.0, 0], [0.5, 2]], [[0.2, 0], [0.1, 0.3]]])
    mixture = StudentMixture(weights, loc, root)
    z = mixture.draw(1000, seed=2)
    assert float((z[:, 0] < -10.0).double().mean()) == pytest.approx(0.3, abs=1e-3)
    x = z[::50].clone().requires_grad_()
    each = [dist.MultivariateStudentT(tensor(FREEDOM), loc[k], root[k]).log_prob(x) for k in (0, 1)]
    exact = torch.logsumexp(torch.stack(each, -1) + weights.log(), -1)
    value, gradient = mixture(x.detach())
    torch.testing.assert_close(value, exact)
    torch.testing.assert_close(gradient, torch.autograd.grad(exact.sum(), x)[0])


def test_posterior_of_a_conjugate_model():
    """Sites with transforms: a precision with a gamma prior, a mean given it."""
    y = tensor([0.3, 1.2, -0.4, 2.0, 0.9])

    def model():
        tau = pyro.sample("tau", dist.Gamma(tensor(3.0), tensor(2.0)))
        mu = pyro.sample("mu", dist.Normal(tensor(0.0), (2.0 / tau).sqrt()))
        pyro.sample("y", dist.Normal(mu.unsqueeze(-1), tau.rsqrt().unsqueeze(-1)).expand(
            [*mu.shape, 5]).to_event(1), obs=y)  # fmt: skip

    potential = Potential(model, (), {"tau": tensor(1.0), "mu": tensor(0.5)})
    loc = tensor([math.log(1.2), 0.8])
    start = StudentMixture(tensor([1.0]), loc[None], 0.6 * torch.eye(2, dtype=torch.float64)[None])
    found = anneal(start.draw(1500, 0), start, Joint(potential))
    values = potential.unpack(found.z)
    n, lam = 5, 0.5
    mean = n * y.mean() / (n + lam)
    a = 3.0 + n / 2
    b = 2.0 + 0.5 * ((y - y.mean()) ** 2).sum() + 0.5 * lam * n / (lam + n) * y.mean() ** 2
    assert float(values["mu"].mean()) == pytest.approx(float(mean), abs=0.06)
    assert float(values["tau"].mean()) == pytest.approx(float(a / b), rel=0.06)
    exact = (
        math.lgamma(a) - math.lgamma(3.0) + 3.0 * math.log(2.0) - a * math.log(b)
        + 0.5 * math.log(lam / (n + lam)) - 0.5 * n * math.log(2 * math.pi)
    )  # fmt: skip
    assert found.log_evidence == pytest.approx(float(exact), abs=0.15)


def drawn(model, record):
    """Values of all sites, drawn from the prior."""
    with torch.random.fork_rng(), torch.no_grad(), pyro.poutine.block():
        torch.manual_seed(0)
        trace = pyro.poutine.trace(model).get_trace(record)
    return {n: s["value"] for n, s in trace.nodes.items() if s["type"] == "sample" and n != "y"}


def test_one_bad_particle_does_not_spoil_the_others(record):
    model = dgp.LinearDynamicGP(inputs=1, pairs=1).scaled_to(record)
    values = drawn(model, record)
    potential = Potential(model, (record,), values)
    joint = Joint(potential, len(record))
    z = potential.pack(values)
    batch = torch.stack([z, z + 0.01, torch.full_like(z, 1e3), z.clone()])
    batch[3, 0] = torch.nan
    value, gradient = joint(batch)
    assert torch.isinf(value[2:]).all()
    assert not gradient[2:].any()
    for k in (0, 1):
        energy, slope = potential.value_and_gradient(batch[k].numpy(), jacobian=True)
        assert float(value[k]) == pytest.approx(-energy, rel=1e-10)
        np.testing.assert_allclose(gradient[k].numpy(), -slope, rtol=1e-7, atol=1e-7)


def test_the_error_of_a_mean_is_its_spread_over_seeds():
    """Shares of two peaks: far from each other, so that only the first particles make them."""
    wide = Known(lambda z: standard(z / 4) - 2 * math.log(4))
    shares, errors, naive = [], [], []
    for seed in range(60):
        found = anneal(4.0 * normal(200, 2, seed), wide, Known(two_peaks), seed=seed)
        right = (found.z[:, 0] > 0).double().numpy()
        influence = (right - right.mean()) / len(right)
        shares.append(right.mean())
        errors.append(spread_of(influence, found.ancestor))
        naive.append(spread_of(influence, None))
    spread = np.std(shares)
    assert np.mean(naive) < 0.8 * spread
    assert np.mean(errors) == pytest.approx(spread, rel=0.3)


@pytest.mark.parametrize("seed", range(3))
def test_step_sizes_are_those_at_which_moves_would_be_accepted(seed):
    """Of chances erfc(c h^2) the next step has the chance aimed at, whatever c is."""
    generator = torch.Generator().manual_seed(seed)
    factor = (2.4 * torch.rand(200, generator=generator, dtype=torch.float64) - 1.2).exp()
    for c in (0.02, 0.3, 5.0, 40.0):
        chance = torch.erfc(c * (0.5 * factor).square())
        size = next_size(0.5, factor, chance)
        assert math.erfc(c * size**2) == pytest.approx(ACCEPTANCE, abs=1e-4) or size == 1.5
    assert next_size(0.5, factor, torch.zeros(200).double()) == pytest.approx(0.5 * CHANGE[0])
    assert next_size(0.1, factor, torch.ones(200).double()) == pytest.approx(0.1 * CHANGE[1])


def test_steps_that_are_far_too_long_at_first_are_shortened_at_once():
    """A target a thousand times narrower than its start: nearly all moves count."""
    narrow = Known(lambda z: standard(z / 1e-3) - 2 * math.log(1e-3))
    found = anneal(normal(2000, 2), Known(standard), narrow)
    assert found.log_evidence == pytest.approx(0.0, abs=0.8)
    assert np.mean(found.acceptance[1:]) == pytest.approx(ACCEPTANCE, abs=0.08)
    assert float(found.z.std()) == pytest.approx(1e-3, rel=0.2)


class TestChains:
    def test_moments_and_r_hat_of_a_known_normal(self):
        """From its own covariance's root; began far out, the chains forget it."""
        root = tensor([[2.0, 0.0], [1.5, 0.5]])
        inverse = torch.linalg.inv(root)
        target = Known(lambda z: standard(z @ inverse.mT))
        found = chains_from(4.0 * normal(40, 2), target, root, burnt=30, kept=60, seed=1)
        assert found.z.shape == (60, 40, 2)
        z = found.z.flatten(0, 1)
        np.testing.assert_allclose(z.mean(0), 0.0, atol=0.15)
        np.testing.assert_allclose(torch.cov(z.mT), root @ root.mT, rtol=0.12)
        assert found.r_hat < 1.05
        assert torch.allclose(found.log_target.flatten(), standard(z @ inverse.mT))

    def test_r_hat_of_chains_that_stay_where_they_are(self):
        """Two wells that no move crosses, of which one is far deeper."""

        def wells(z):
            apart = torch.stack([30.0 + standard(z - 20.0), standard(z + 20.0)])
            return torch.logsumexp(apart, 0)

        begin = torch.cat([normal(10, 2) + 20.0, normal(10, 2) - 20.0])
        found = chains_from(begin, Known(wells), torch.eye(2).double(), burnt=5, kept=20, seed=0)
        assert found.r_hat > 5.0


def test_what_few_particles_say_of_a_covariance_counts_little():
    """With as many as dimensions half of it is that of the base, or only its variances are."""
    d = 6
    base = torch.linalg.cholesky(0.98 * torch.ones(d, d).double() + 0.02 * torch.eye(d).double())
    exact = base @ base.mT
    z = normal(12, d) @ base.mT
    weight = torch.full((12,), 1.0 / 12, dtype=torch.float64)

    def off(root):
        whitened = torch.linalg.solve_triangular(root, base, upper=False)
        return float(torch.linalg.svdvals(whitened).log().abs().max())

    assert off(root_of(z, weight, base)) < 0.8 < off(root_of(z, weight))
    many = normal(20_000, d) @ base.mT
    even = torch.full((20_000,), 1.0 / 20_000, dtype=torch.float64)
    for root in (root_of(many, even, torch.eye(d).double()), root_of(many, even)):
        np.testing.assert_allclose(root @ root.mT, exact, atol=0.05 * float(exact.abs().max()))


def test_a_gain_may_be_as_large_as_at_the_optimum_and_more(record):
    """Logarithms of scales have a reach of 40; a gain of 100 had none, and no draw a density."""
    model = dgp.LinearDynamicGP(inputs=1, pairs=1).scaled_to(record)
    values = drawn(model, record)

    def with_gains(size: float) -> dict[str, torch.Tensor]:
        return values | {"g_input_gain": torch.full((1, 1, 2), size, dtype=torch.float64)}

    for at, most in ((with_gains(0.5), 40.0), (with_gains(100.0), 4000.0)):
        potential = Potential(model, (record,), at)
        z, place = potential.pack(at), potential.places(["g_input_gain"])[0]
        assert float(potential.reach[place]) == most
        for gain, inside in ((0.99 * most, True), (1.01 * most, False)):
            moved = z.clone()
            moved[place] = gain
            assert np.isfinite(Joint(potential, len(record)).log_prob(moved[None])[0]) == inside
