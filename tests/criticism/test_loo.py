"""The hook: importance sampling against refits and known answers, targets, units, refusals."""

from dataclasses import dataclass, replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro.infer import SVI, Trace_ELBO
from pyro.infer.autoguide import AutoNormal
from scipy.special import logsumexp
from scipy.stats import norm

import pyro_dynogp as dgp
from pyro_dynogp.criticism import posterior_draws
from pyro_dynogp.criticism.densities import pointwise_log_density
from pyro_dynogp.criticism.left_out import monte_carlo_error
from pyro_dynogp.criticism.posterior_draws import draws_of
from pyro_dynogp.criticism.subjects import FitSubject, fingerprint_of, no_refit
from pyro_dynogp.inference.pareto import good_k, psis
from pyro_dynogp.inference.posterior_draws import PosteriorDraws
from tests.conftest import simulate_record

QUIET = {"workers": 1, "progress": False}


# Without process noise the posterior is near a normal, and a refit takes a second.
MODEL = dgp.LinearDynamicGP(inputs=1, pairs=1, process_noise=False)


@pytest.fixture(scope="module")
def short():
    quiet = dgp.Modes([-0.5 + 2.0j], [[1.0 + 0.3j]], [1.0], [[1e-4]])
    return simulate_record(quiet, 0.1, n=60, seed=2)


@pytest.fixture(scope="module")
def linear(short):
    return dgp.fit(MODEL, short, restarts=2, **QUIET, method="map")


@pytest.fixture(scope="module")
def left_out(linear):
    return dgp.loo(linear, target="missing sample", draws=250, **QUIET)


@dataclass(frozen=True, eq=False)
class ArraySubject:
    """Densities (S, N) by kind that are known beforehand, for targets that need no refit."""

    draws: PosteriorDraws
    densities: dict
    places: dict
    data: str

    def pointwise(self, kind, horizon=1):
        return self.densities[kind]

    def fresh(self, record, first, last):
        raise no_refit()

    def without(self, left_out):
        raise no_refit()


class NormalMean:
    """y_i ~ N(mu, 1), mu ~ N(0, 10^2): everything is known."""

    def __init__(self, n=40, S=3000, wide=1.0, seed=0):
        rng = np.random.default_rng(seed)
        self.y = rng.standard_normal(n) + 0.7
        self.variance = 1.0 / (n + 0.01)
        self.mean = self.variance * self.y.sum()
        sd = np.sqrt(self.variance) * wide
        mu = self.mean + sd * rng.standard_normal(S)
        density = norm.logpdf(self.y, mu[:, None], 1.0)
        draws = PosteriorDraws(
            {"mu": torch.tensor(mu)},
            density.sum(1) + norm.logpdf(mu, 0.0, 10.0),
            norm.logpdf(mu, self.mean, sd),
            np.zeros(S, dtype=int),
            "test",
        )
        places = {"record": np.zeros(n, int), "sample": np.arange(n), "output": np.zeros(n, int)}
        kinds = {"missing sample": density, "forecast": density}
        self.subject = ArraySubject(draws, kinds, places, fingerprint_of([self.y]))

    def exact(self, kept):
        variance = 1.0 / (kept.sum() + 0.01)
        return variance * self.y[kept].sum(), variance

    def missing_sample(self):
        n = len(self.y)
        found = []
        for i in range(n):
            mean, variance = self.exact(np.arange(n) != i)
            found.append(norm.logpdf(self.y[i], mean, np.sqrt(1.0 + variance)))
        return np.array(found)

    def forecast(self, first):
        n = len(self.y)
        found = []
        for i in range(first, n):
            mean, variance = self.exact(np.arange(n) < i)
            found.append(norm.logpdf(self.y[i], mean, np.sqrt(1.0 + variance)))
        return np.array(found)


@pytest.mark.parametrize("wide", [1.0, 1.3])
def test_importance_sampling_against_the_conjugate_answer(wide):
    """From a proposal wider than the posterior too: the ratios p/q correct it."""
    case = NormalMean(wide=wide)
    found = dgp.loo(case.subject, target="missing sample", **QUIET)
    exact = case.missing_sample()
    assert found.elpd_loo == pytest.approx(exact.sum(), abs=4 * found["monte_carlo_error"])
    np.testing.assert_allclose(found.loo_i.values, exact, atol=0.02)
    assert found["corrected"]
    assert (found.pareto_k.values < 0.5).all()
    assert found["refits"] == 0


def test_without_the_ratios_a_wide_proposal_is_wrong():
    case = NormalMean(wide=2.5)
    right = dgp.loo(case.subject, target="missing sample", **QUIET)
    plain = replace(case.subject, draws=replace(case.subject.draws, log_q=None))
    wrong = dgp.loo(plain, target="missing sample", **QUIET)
    exact = case.missing_sample().sum()
    assert abs(right.elpd_loo - exact) < 0.1 < abs(wrong.elpd_loo - exact)


def test_forecasts_against_the_conjugate_answer():
    case = NormalMean(n=60, S=6000)
    found = dgp.loo(case.subject, target="forecast", begin=40, refits=0, **QUIET)
    exact = case.forecast(40)
    assert found.n_data_points == 20
    assert found.elpd_loo == pytest.approx(exact.sum(), abs=4 * found["monte_carlo_error"] + 0.02)
    assert list(found.loo_i["sample"].values) == list(range(40, 60))


def test_monte_carlo_error_is_the_spread_over_repetitions():
    totals, errors = [], []
    for seed in range(60):
        rng = np.random.default_rng([seed, 9])
        y = np.linspace(-1, 1, 20)
        mu = 0.3 * rng.standard_normal(200)
        density = norm.logpdf(y, mu[:, None], 1.0)
        log_weights = np.full((20, 200), -np.log(200.0))
        elpd = logsumexp(log_weights + density.T, axis=1)
        totals.append(elpd.sum())
        errors.append(monte_carlo_error(log_weights, density, elpd))
    assert np.mean(errors) == pytest.approx(np.std(totals), rel=0.25)


def test_exact_refits_of_single_samples(linear, left_out):
    """Brute force: the samples that matter most, and some others, fitted without them."""
    subject = FitSubject(linear, linear.records, 250, 0)
    N = len(subject.places["sample"])
    chosen = [int(np.argmax(left_out.pareto_k.values)), 0, 17]
    for i in chosen:
        other = subject.without(np.arange(N) == i)
        density = other.pointwise("missing sample")[:, i]
        weights = psis(other.draws.log_ratio)[0]
        exact = float(logsumexp(weights + density))
        assert float(left_out.loo_i[i]) == pytest.approx(exact, abs=0.15)


def test_entries(linear, left_out, short):
    assert left_out["target"] == "missing sample"
    assert left_out["data"] == fingerprint_of([short.outputs[:, 0]])
    assert 1.0 < left_out.p_loo < 12.0  # ten parameters
    assert 0.0 < left_out["monte_carlo_error"] < 0.5
    assert left_out.loo_i.dims == ("observation",)
    assert "60 observations" in str(left_out)
    assert left_out["draws_from"] == "Laplace's approximation"
    assert left_out["corrected"]


def test_a_smooth_signal_is_easier_to_fill_in_than_to_forecast(one_pair):
    record = simulate_record(one_pair, 0.02, n=60, seed=2)
    fit = dgp.fit(dgp.LinearDynamicGP(inputs=1, pairs=1), record, restarts=2, **QUIET, method="map")
    options = {"parameters": "mode", **QUIET}
    ahead = dgp.loo(fit, target="forecast", begin=30, **options)
    far = dgp.loo(fit, target="forecast", begin=30, horizon=6, **options)
    own = dgp.loo(fit, target="missing sample", **options).loo_i.values[30:].sum()
    assert own > ahead.elpd_loo + 5.0 > far.elpd_loo + 10.0
    assert far.n_data_points == 30 - 5


def test_forecasts_with_refits_against_fits_to_the_past(linear, short):
    """Ratios and refits forwards, against fits to the past alone of some forecasts.

    Compared are those whose own weights have a variance (Pareto shape below 1/2).
    """
    found = dgp.loo(linear, target="forecast", begin=30, draws=250, **QUIET)
    subject = FitSubject(linear, linear.records, 250, 0)
    assert found["not_refitted"] == 0
    assert 1 < found["refits"] < 15
    compared = 0
    for i in (30, 35, 38, 41, 45, 48, 50, 55):
        other = subject.without(np.arange(60) >= i)
        density = other.pointwise("forecast")[:, i]
        weights, k = psis(other.draws.log_ratio)[:2]
        if k < 0.5:
            exact = float(logsumexp(weights + density))
            # Monte Carlo errors of 250 weighted draws on either side.
            assert float(found.loo_i[i - 30]) == pytest.approx(exact, abs=0.15)
            compared += 1
    assert compared >= 2


def test_forecasts_without_refits_flatter(linear):
    """Draws that have seen the future, where no fit to the past is allowed."""
    options = {"target": "forecast", "begin": 30, "draws": 250, **QUIET}
    forwards, backwards = (dgp.loo(linear, refits=many, **options) for many in (30, 0))
    assert backwards["refits"] == 0
    assert backwards["not_refitted"] > 0
    assert backwards.elpd_loo > forwards.elpd_loo + 1.0


def test_at_the_mode(linear, short, left_out):
    """One-step densities add up to the likelihood; parameters that have seen the data flatter."""
    found = dgp.loo(linear, target="forecast", begin=2, parameters="mode", **QUIET)
    process = dgp.loo(linear, target="missing sample", parameters="mode", **QUIET)
    assert process.n_samples == 1
    assert process.elpd_loo > left_out.elpd_loo
    first = FitSubject(linear, linear.records, 1, 0, "mode").pointwise("forecast")[0, :2].sum()
    assert found.elpd_loo + first == pytest.approx(linear.log_likelihood(short)[0], rel=1e-9)
    assert found["refits"] == found["not_refitted"] == 0


def test_new_records(linear):
    found = dgp.loo(linear, target="new record", folds=2, draws=100, **QUIET)
    assert found["refits"] == 2
    assert found.n_data_points == 60
    assert np.isfinite(found.loo_i.values).all()


def test_a_change_of_units_enters_by_the_jacobian(short, linear, left_out):
    """Volts to millivolts, seconds to minutes: the same fit, -log(1000) for each sample."""
    other = dgp.Record(short.time / 60.0, 5.0 * short.inputs - 2.0, 1000.0 * short.outputs + 7.0)
    fit = dgp.fit(MODEL, other, restarts=2, **QUIET, method="map")
    found = dgp.loo(fit, target="missing sample", draws=250, **QUIET)
    expected = left_out.elpd_loo - 60 * np.log(1000.0)
    assert found.elpd_loo == pytest.approx(expected, abs=4 * left_out["monte_carlo_error"])


def test_gaps_and_several_records(one_pair):
    records = [simulate_record(one_pair, 0.1, n=50, seed=s) for s in (3, 4)]
    y = records[0].outputs.copy()
    y[10:14] = np.nan
    records[0] = records[0].with_outputs(y)
    fit = dgp.fit(MODEL, records, restarts=2, **QUIET, method="map")
    found = dgp.loo(fit, target="missing sample", refits=0, draws=100, **QUIET)
    assert found.n_data_points == 96
    assert set(found.loo_i["record"].values) == {0, 1}
    assert not np.isin(found.loo_i["sample"].values[:46], range(10, 14)).any()
    whole = dgp.loo(fit, target="new record", draws=100, **QUIET)
    assert whole["refits"] == 2
    assert np.isfinite(whole.loo_i.values).all()
    with pytest.raises(ValueError, match="record: expected one record for 'forecast'"):
        dgp.loo(fit, target="forecast", **QUIET)


def test_conditional_loo_is_wrong_by_tens_of_nats():
    """A latent Matern-like signal in little noise: what a smoother has seen it does not predict.

    Leave-one-out from densities given the trajectory, log p(y_t | h_t), against the exact one.
    """
    modes = dgp.Modes([-8.0 + 4.0j], np.zeros((1, 0)), [1.0], [[3.0]])
    time, sd = 0.05 * np.arange(150), 0.1
    process = dgp.LTIProcess(modes, time)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        y = process.observed(sd).sample()
        exact = float(np.sum(pointwise_log_density(process.observed(sd), y, "missing sample")))
        h = process.condition(y, sd).sample((2000,)).numpy()
    conditional = norm.logpdf(y.numpy(), h, sd)
    log_weights, k = psis(-conditional.T)
    naive = float(logsumexp(log_weights + conditional.T, axis=1).sum())
    assert naive - exact > 20.0  # and that is after smoothing the weights
    assert np.mean(k > good_k(2000)) > 0.3


def test_what_is_refused(linear, short):
    with pytest.raises(ValueError, match=r"target: expected one of .* Name what the model is for"):
        dgp.loo(linear, target="loo", **QUIET)
    with pytest.raises(TypeError):
        dgp.loo(linear)  # no default target
    with pytest.raises(ValueError, match="record: expected the training record"):
        dgp.loo(linear, short[:40], target="missing sample", **QUIET)
    with pytest.raises(ValueError, match="begin: expected a share between 0 and 1"):
        dgp.loo(linear, target="forecast", begin=1.5, **QUIET)
    with pytest.raises(ValueError, match="folds: expected a whole number >= 2"):
        dgp.loo(linear, target="new record", folds=1, **QUIET)
    with pytest.raises(ValueError, match="parameters: expected 'posterior' or 'mode'"):
        dgp.loo(linear, target="missing sample", parameters="map", **QUIET)
    with pytest.raises(ValueError, match="refits: expected a whole number"):
        dgp.loo(linear, target="missing sample", refits=-1, **QUIET)
    with pytest.raises(ValueError, match="fit: expected a Fit, or a Subject"):
        dgp.loo("fit", target="missing sample", **QUIET)
    with pytest.raises(ValueError, match="has its training records"):
        dgp.loo(replace(linear, records=()), target="missing sample", **QUIET)
    with pytest.raises(ValueError, match="without refits for a model of your own"):
        dgp.loo(NormalMean().subject, target="new record", **QUIET)


def test_draws_are_moved_on_to_more_data(linear):
    """Beside a fit to these data: what both say of the samples to come, and of parameters."""
    subject = FitSubject(linear, linear.records, 600, 0)
    past = subject.without(np.arange(60) >= 25)
    assert past.carries
    moved, fresh = (one(np.arange(60) >= 50) for one in (past.carried, subject.without))
    assert moved.draws.kind == "annealed from draws given other data"
    assert len(moved.fit.records[0]) == 50
    assert set(moved.draws.ancestor) < set(range(600))
    weights = [np.exp(psis(one.draws.log_ratio)[0]) for one in (moved, fresh)]
    ahead = [np.log(w @ np.exp(one.pointwise("forecast")[:, 50:]))
             for w, one in zip(weights, (moved, fresh), strict=True)]  # fmt: skip
    # Monte Carlo errors of 600 draws, weighted or moved, on either side.
    np.testing.assert_allclose(ahead[0], ahead[1], atol=0.15)
    early = np.log(np.exp(past.pointwise("forecast")[:, 50:]).mean(0))
    assert np.abs(early - ahead[1]).max() > 1.0  # what the move has changed
    for name in ("noise_sd", "g_log_decay", "g_log_frequency"):
        draws = [one.draws.values[name].log() if name == "noise_sd" else one.draws.values[name]
                 for one in (moved, fresh)]  # fmt: skip
        first, second = (w @ x.numpy() for w, x in zip(weights, draws, strict=True))
        np.testing.assert_allclose(first, second, atol=0.35 * float(draws[1].std(0).max()))


def test_draws_where_a_normal_will_not_do(short):
    """Two pairs for a system of one: Laplace's draws are no posterior, annealed ones are."""
    model = dgp.LinearDynamicGP(inputs=1, pairs=2)
    fit = dgp.fit(model, short, restarts=1, steps=60, **QUIET, method="map")
    own = draws_of(fit, count=200, anneal=False)
    assert float(psis(own.log_ratio)[1]) > 0.7
    found = draws_of(fit, count=200)
    assert found.kind.startswith("annealed from Student-t around the mode and from the prior; ")
    assert found.log_q is None
    # -log p over draws of a d-dimensional posterior spreads by about sqrt(d/2), d = 17. Quartiles,
    # as these draws descend from some 20 particles, of which one may lie far out.
    own_spread, spread = (
        np.subtract(*np.percentile(one.log_p, [75, 25])) / 1.35 for one in (own, found)
    )
    assert 1.5 < spread < 6.0
    assert own_spread > 2.0 * spread


def test_the_mode_of_a_cascade_is_no_posterior(bent, monkeypatch):
    """Its Laplace draws are put in place, heavy-tailed: only what follows is looked at."""
    options = {"restarts": 1, "steps": 5, "method": "map"}
    fit = dgp.fit(dgp.Wiener(1, pairs=1, inducing=4), bent[:30], **options, **QUIET)
    values = {name: value.repeat_interleave(100, 0) for name, value in fit.draws.items()}
    ratio = np.random.default_rng(0).standard_normal(100) ** 3
    bad = PosteriorDraws(values, ratio, np.zeros(100), np.zeros(100, int), "Laplace")
    monkeypatch.setattr(posterior_draws, "_own", lambda *args: bad)
    with pytest.raises(ValueError, match=r"fit: expected a posterior that can be drawn from"):
        dgp.loo(fit, target="missing sample", draws=100, **QUIET)
    found = dgp.loo(fit, target="missing sample", parameters="mode", **QUIET)
    assert np.isfinite(found.elpd_loo)


def test_a_cascade_with_its_optima(bent, monkeypatch):
    """Ratios of inducing values and first states are good; what they leave out is said."""
    monkeypatch.setattr("pyro_dynogp.inference.refit.ADAM_STEPS", 60)
    N = 40
    options = {"restarts": 1, "steps": 60}
    fit = dgp.fit(dgp.Wiener(1, pairs=1, inducing=5), bent[:N], method="svi", **options, **QUIET)
    found = dgp.loo(fit, target="missing sample", draws=200, refits=0, **QUIET)
    assert found["posterior_k"] < 1.0
    assert "fit with method='importance'" in " ".join(found["notes"])
    subject = FitSubject(fit, fit.records, 200, 0)
    i = int(np.argsort(found.pareto_k.values)[N // 2])
    other = subject.without(np.arange(N) == i)
    density = other.pointwise("missing sample")[:, i]
    exact = float(logsumexp(psis(other.draws.log_ratio)[0] + density))
    assert float(found.loo_i[i]) == pytest.approx(exact, abs=0.3)


def test_a_fit_and_a_model_of_the_user_are_compared(short, linear):
    """On the same record, by the same densities."""

    def model(record):
        data = record.tensors()
        scale = dgp.TimeScale(step=record.sampling_time, duration=record.duration)
        modes = dgp.sample_modes("g", inputs=1, pairs=1, process_noise=False, time_scale=scale)
        sigma = pyro.sample("sigma", dist.HalfNormal(torch.tensor(1.0).double()))
        process = dgp.LTIProcess(modes, data.time, data.inputs)
        pyro.sample("y", process.observed(sigma), obs=data.outputs[:, 0])

    with pyro.get_param_store().scope(), torch.random.fork_rng():
        torch.manual_seed(0)
        guide = AutoNormal(model)
        svi = SVI(model, guide, pyro.optim.Adam({"lr": 0.05}), Trace_ELBO())
        for _ in range(150):
            svi.step(short)
        own = dgp.from_pyro(model, guide, short, draws=150)
    models = {"own": own, "linear": linear}
    found = dgp.compare(models, target="missing sample", draws=150, refits=0, **QUIET)
    assert set(found.table.index) == {"own", "linear"}
    assert found.elpds["own"].n_data_points == 60
