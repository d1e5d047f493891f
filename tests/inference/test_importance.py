"""Posteriors by importance sampling: weights of optima, quadrature, which way is taken, files."""

import dataclasses
import math
from types import SimpleNamespace

import cloudpickle
import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy.integrate import dblquad
from scipy.special import logsumexp

import pyro_dynogp as dgp
from pyro_dynogp.criticism.posterior_draws import draws_of
from pyro_dynogp.inference import importance_sampling
from pyro_dynogp.inference.cascade_coordinates import StraightPotential
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.importance_sampling import pooled, proposal_of, sample_around, weighed
from pyro_dynogp.inference.methods import importance
from pyro_dynogp.inference.methods.annealed import Annealed
from pyro_dynogp.inference.pareto import effective, good_k, psis
from pyro_dynogp.inference.run import Run

QUICK = {"restarts": 2, "workers": 1, "progress": False}
MODEL = dgp.LinearDynamicGP(1, pairs=1, process_noise=False)


def tensor(x):
    return torch.tensor(x, dtype=torch.float64)


@pytest.fixture(scope="module")
def fit(record):
    return dgp.fit(MODEL, record[:60], **QUICK)


def same(one, other):
    return all(torch.equal(one.draws[name], other.draws[name]) for name in one.draws)


class TestPsis:
    @pytest.mark.parametrize("count", [30, 100, 1000])
    @pytest.mark.parametrize("spread", [0.001, 0.3, 1.0, 3.0, 10.0])
    def test_weights_and_k_are_those_of_arviz(self, count, spread):
        az = pytest.importorskip("arviz")
        ratio = spread * np.random.default_rng(count).standard_normal((3, count))
        ours, k = psis(ratio)
        theirs, theirs_k = az.psislw(ratio.copy())
        np.testing.assert_allclose(np.exp(ours), np.exp(theirs), rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(k, theirs_k, rtol=1e-9)

    def test_equal_ratios_and_few_draws(self):
        weights, k = psis(np.zeros(50))
        assert k == 0.0
        assert effective(weights) == pytest.approx(50.0)
        assert np.isnan(psis(np.arange(10.0))[1])


def test_optima_weigh_what_their_masses_do():
    """Two normals in the plane, of masses 1 to 3 and of heights 5 to 3, known exactly."""
    heights = {"low": 0.25, "high": 0.75}
    centres = tensor([[-6.0, 0.0], [6.0, 1.0]])
    sds = tensor([0.3, 1.0])

    class Plane(dist.TorchDistribution):
        support = dist.constraints.independent(dist.constraints.real, 1)
        arg_constraints = {}  # noqa: RUF012

        def __init__(self):
            super().__init__(torch.Size(), torch.Size([2]), validate_args=False)

        def log_prob(self, x):
            each = dist.Normal(centres, sds[:, None]).log_prob(x.unsqueeze(-2)).sum(-1)
            return torch.logsumexp(each + tensor(list(heights.values())).log(), -1)

        def sample(self, shape=()):
            return torch.zeros((*shape, 2), dtype=torch.float64)

    def model():
        return pyro.sample("x", Plane())

    optima = [{"x": centre} for centre in centres]
    potential = Potential(model, (), optima[0])
    leading, weights = weighed(potential, optima)
    assert torch.equal(leading[0]["x"], centres[1])  # the larger mass, though lower
    assert float(weights[0]) == pytest.approx(0.75, abs=0.01)  # d = 2: nothing is tempered
    proposal = proposal_of(potential, leading, tensor([0.5, 0.5]))
    z = proposal.draw(4000, seed=0)
    ratio = Plane().log_prob(z) - proposal(z)[0]
    share = np.exp(logsumexp(ratio[z[:, 0] > 0].numpy()) - logsumexp(ratio.numpy()))
    assert float(share) == pytest.approx(0.75, abs=0.02)
    assert float(ratio.exp().mean()) == pytest.approx(1.0, abs=0.03)  # the normalising constant


def test_runs_that_found_more_of_the_posterior_give_more_of_the_draws():
    def run(level, log_evidence):
        z = torch.full((100, 1), level, dtype=torch.float64)
        return Annealed(z, log_evidence, (1.0,), (1.0,), np.repeat(np.arange(10), 10))

    z, ancestor = pooled([run(0.0, -5.0), run(1.0, -5.0 + math.log(3.0))], 100)
    assert float(z.mean()) == pytest.approx(0.75, abs=0.011)
    assert len(np.unique(ancestor)) == 20
    assert len(z) == len(ancestor) == 100


def test_two_parameters_against_quadrature(record):
    """A model of which all but the noise and the offset is known: moments on a grid."""
    full = dgp.fit(MODEL, record[:30], method="map", **QUICK)
    free = ("noise_sd", "offset")
    known = {name: value for name, value in full.mode.items() if name not in free}
    target = pyro.poutine.condition(full.model.collapsed, data=known)
    prepared = (full.model.prepare(full.records),)
    at = {name: full.mode[name] for name in free}
    potential = Potential(target, prepared, at)
    names = [site.name for site in potential.sites]
    leading, weights = weighed(potential, [at])
    proposal = proposal_of(potential, leading, weights)
    z = proposal.draw(1000, seed=1)
    energy = potential.values_and_gradients(z.numpy(), jacobian=True)[0]
    log_weights, k = psis(-energy - proposal(z)[0].numpy())
    assert k < 0.5
    centre = potential.pack(at).numpy()
    lowest = potential.value_and_gradient(centre, jacobian=True)[0]

    def density(y, x):
        return math.exp(lowest - potential.value_and_gradient(np.array([x, y]), jacobian=True)[0])

    sd = proposal.scale_tril[0].square().sum(-1).sqrt().numpy()
    (a, b), (c, d) = ((m - 6 * s, m + 6 * s) for m, s in zip(centre, sd, strict=True))
    exact = {"epsabs": 1e-4, "epsrel": 1e-4}
    mass = dblquad(density, a, b, c, d, **exact)[0]
    for i, name in enumerate(names):
        mean = dblquad(lambda y, x, i=i: (x, y)[i] * density(y, x), a, b, c, d, **exact)[0] / mass
        found = float(np.exp(log_weights) @ z[:, i].numpy())
        assert found == pytest.approx(mean, abs=0.12 * sd[i]), name


class TestWays:
    def test_a_good_k_is_not_annealed(self, fit, monkeypatch):
        """The limit decides, on the same ratios."""
        records = tuple(fit.model.prepare(fit.records))
        arguments = (fit.model.collapsed, records, [fit.mode])

        def never(*args, **options):
            raise AssertionError("annealed")

        with monkeypatch.context() as patched:
            patched.setattr(importance_sampling, "anneal", never)
            patched.setattr(importance_sampling, "good_k", lambda count: 10.0)
            plain = sample_around(*arguments, count=200)
            assert not plain.annealed
            assert plain.draws.kind == "Student-t around the mode"
            assert plain.draws.log_q is not None
            # Rounds lower k: one alone, as of models whose densities cost more.
            patched.setattr(importance_sampling, "ROUNDS", 1)
            patched.setattr(importance_sampling, "good_k", lambda count: plain.k - 1e-9)
            with pytest.raises(AssertionError, match="annealed"):
                sample_around(*arguments, count=200)

    def test_short_records_begin_at_the_prior_too(self, fit, monkeypatch):
        records = tuple(fit.model.prepare(fit.records))
        monkeypatch.setattr(importance_sampling, "good_k", lambda count: -1.0)
        found = sample_around(fit.model.collapsed, records, [fit.mode], count=60)
        assert found.annealed
        assert found.draws.kind == "annealed from Student-t around the mode and from the prior"
        assert found.draws.log_q is None
        monkeypatch.setattr(importance_sampling, "SHORT", 59)
        found = sample_around(fit.model.collapsed, records, [fit.mode], count=60)
        assert found.draws.kind == "annealed from Student-t around the mode"

    def test_where_annealing_would_take_too_long(self):
        linear, noisy = MODEL, dgp.LinearDynamicGP(1, pairs=1, likelihood=dgp.StudentT())
        can = importance_sampling.can_anneal
        assert can(linear, 20_000)
        assert not can(linear, 20_001)
        assert can(noisy, 2_000)
        assert not can(noisy, 2_001)
        assert not can(dgp.Wiener(1, pairs=1), 10)

    def test_what_cannot_be_trusted_is_said(self, record, monkeypatch):
        monkeypatch.setattr(importance_sampling, "good_k", lambda count: -1.0)
        monkeypatch.setattr(importance_sampling, "can_anneal", lambda *args: False)
        with pytest.warns(UserWarning, match=r"fit: Pareto's k of the posterior's draws is"):
            dgp.fit(MODEL, record[:60], **QUICK)


def test_draws_have_the_density_that_is_said(fit):
    """Log p of the proposal's draws is the model's; the mode is one of the optima."""
    source = fit.posterior.source
    potential = Potential(fit.model.collapsed, (fit.model.prepare(fit.records),), fit.mode)
    with torch.no_grad():
        again = potential.log_density(dict(source.values), len(source))
    np.testing.assert_allclose(source.log_p, again.numpy(), atol=1e-8)
    straight = StraightPotential(fit.model.collapsed, potential.args, fit.mode)
    z = straight.pack(source.values)[:5]
    root = torch.autograd.functional.jacobian(
        lambda x: torch.cat([v.reshape(-1) for v in straight.unpack(x).values()]), z[0]
    )
    exact = float(torch.linalg.slogdet(root)[1])
    assert float(straight.log_jacobian(z)[0]) == pytest.approx(exact, abs=1e-8)


def test_the_default_of_linear_models(fit):
    assert fit.method == "importance"
    assert all(len(value) == 300 for value in fit.draws.values())
    assert fit.diagnostics["optima"] >= 1.0
    assert "300 draws: " in fit.summary()
    assert "Pareto k" in fit.summary()
    assert draws_of(fit) is fit.posterior.source
    mode = fit.at_mode()
    assert mode.method == "map"
    assert "bands leave out their uncertainty" in mode.summary()


def test_bits_with_processes_checkpoints_files_and_pickles(fit, record, tmp_path):
    options = {**QUICK, "workers": 2}
    assert same(fit, dgp.fit(MODEL, record[:60], **options))
    kept = dgp.fit(MODEL, record[:60], checkpoint=tmp_path / "run", **QUICK)
    assert same(fit, kept)
    again = dgp.fit(MODEL, record[:60], checkpoint=tmp_path / "run", **QUICK)
    assert same(fit, again)
    assert again.posterior.kind == fit.posterior.kind
    fit.save(tmp_path / "fit.safetensors")
    for other in (
        dgp.load(tmp_path / "fit.safetensors"),
        cloudpickle.loads(cloudpickle.dumps(fit)),
    ):
        assert same(fit, other)
        for name in ("log_p", "log_q", "ancestor"):
            ours, theirs = (getattr(each.posterior.source, name) for each in (fit, other))
            assert (ours is None) == (theirs is None)
            assert ours is None or np.array_equal(ours, theirs)
        assert other.posterior.kind == fit.posterior.kind
        assert dict(other.diagnostics) == dict(fit.diagnostics)
    assert not same(fit, dgp.fit(MODEL, record[:60], seed=1, **QUICK))


def test_another_set_of_data(fit, record):
    from pyro_dynogp.inference.refit import refit

    other = refit(fit, record[:50])
    assert other.method == "importance"
    assert len(other.records[0]) == 50
    assert not same(fit, other)
    assert len(other.draws["offset"]) == 300


@pytest.mark.parametrize("n", [5, 12])
def test_few_samples(record, n):
    """Priors decide; bands are wider than those of the mode, and finite."""
    train, test = record[3:].split(n)  # the input changes between the third and the fourth of them
    fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), train, **QUICK)
    wide, narrow = (one.forecast(train, test[:20]) for one in (fit, fit.at_mode()))
    low, high = wide.quantile([0.025, 0.975])
    assert np.isfinite(low).all()
    assert (high > low).all()
    assert np.median(wide.sd / narrow.sd) > 1.5


def test_bands_of_the_default_hold_and_those_of_the_mode_do_not():
    """Six systems of 40 samples: forecasts of the next 100, against bands of 95 %."""
    from tests.benchmarks.coverage import linear_record

    shares = {"default": [], "map": []}
    for seed in range(2000, 2006):
        train, test = linear_record(seed, 40)
        fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), train, **QUICK)
        for name, one in (("default", fit), ("map", fit.at_mode())):
            shares[name].append(dgp.scores(one.forecast(train, test), test)["coverage_95"])
    assert np.mean(shares["default"]) > 0.88
    assert np.mean(shares["map"]) < 0.85


def test_good_k_grows_with_the_draws():
    assert good_k(10) == 0.0
    assert good_k(200) < good_k(1000) == pytest.approx(2 / 3)
    assert good_k(10**6) == 0.7


def test_options():
    with pytest.raises(ValueError, match="draws: expected a whole number >= 1"):
        dgp.Importance(draws=0)
    assert dataclasses.astuple(dgp.Importance()) == (300, None, None)


@pytest.mark.parametrize(
    ("model", "longest"),
    [
        (dgp.LinearDynamicGP(1), 2000),
        (dgp.Cascade(1, (dgp.Dynamic(),), dgp.StudentT()), 1000),
        (dgp.Wiener(1), 1000),
        (dgp.NonlinearFeedback(1), 150),
    ],
)
def test_how_long_a_record_may_be_for_annealing(model, longest, monkeypatch):
    assert importance.usual_longest(model) == longest
    if model.has_gaussian_process:
        return

    class AskedError(Exception):
        """Raised in place of sampling."""

    def asked(*args, longest, **options):
        raise AskedError(longest)

    monkeypatch.setattr(importance, "sample_around", asked)
    problem = SimpleNamespace(model=model, target=model, records=())
    for given, most in ((None, longest), (70, 70)):
        with pytest.raises(AskedError, match=f"^{most}$"):
            importance.with_draws_around(problem, [], Run(0), 10, given)


def test_where_annealing_gets_nowhere(fit, monkeypatch):
    """The draws of the proposal stay, and their k says what they are worth."""

    def fails(*args, **options):
        raise RuntimeError("annealing: after 60 steps")

    records = tuple(fit.model.prepare(fit.records))
    monkeypatch.setattr(importance_sampling, "good_k", lambda count: -1.0)
    monkeypatch.setattr(importance_sampling, "anneal", fails)
    found = sample_around(fit.model.collapsed, records, [fit.mode], count=60)
    assert not found.annealed
    assert found.draws.log_q is not None
    assert found.draws.kind == "Student-t around the mode"


def test_flat_priors_are_no_start(fit, record):
    model = dataclasses.replace(MODEL, priors="paper")
    found = dgp.fit(model, record[:60], **QUICK)
    assert "prior" not in found.posterior.kind
