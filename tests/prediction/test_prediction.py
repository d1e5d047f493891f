"""Mixture moments, quantiles and densities; scores."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
import scoringrules
from hypothesis import given
from hypothesis import strategies as st
from scipy import optimize, stats

import pyro_dynogp as dgp
from pyro_dynogp.prediction import mixture_score
from pyro_dynogp.prediction.mixture_score import mixture_scores
from pyro_dynogp.prediction.prediction import Parts, Prediction


def mixture(draws=5, n=7, n_y=2, seed=0):
    rng = np.random.default_rng(seed)
    return Prediction(
        time=np.arange(n) * 1.0,
        output_names=("a", "b")[:n_y],
        component_mean=rng.normal(size=(draws, n, n_y)),
        component_variance=rng.uniform(0.1, 1.0, (draws, n, n_y)),
        noise_variance=rng.uniform(0.1, 0.3, (draws, n_y)),
        parts={},
        sampler=lambda: np.zeros((1, n, n_y)),
        kind="test",
    )


def test_moments_and_quantiles_against_sampling_of_the_mixture():
    p = mixture()
    rng = np.random.default_rng(1)
    which = rng.integers(5, size=200_000)
    draws = p.component_mean[which] + p.component_sd[which] * rng.standard_normal((200_000, 7, 2))
    np.testing.assert_allclose(draws.mean(0), p.mean, atol=5 * p.sd.max() / np.sqrt(2e5))
    np.testing.assert_allclose(draws.std(0), p.sd, rtol=0.01)
    for q in (0.025, 0.4):
        below = (draws < p.quantile(q)).mean(0)
        np.testing.assert_allclose(below, q, atol=5 * np.sqrt(q * (1 - q) / 2e5))
    assert p.quantile([0.1, 0.5, 0.9]).shape == (3, 7, 2)
    assert (p.signal_variance < p.variance).all()


def test_single_component_is_the_normal():
    p = mixture(draws=1)
    np.testing.assert_allclose(p.quantile(0.9), stats.norm.ppf(0.9, p.mean, p.sd), rtol=1e-12)
    y = p.mean + 0.3
    np.testing.assert_allclose(p.log_density(y), stats.norm.logpdf(y, p.mean, p.sd), rtol=1e-12)
    np.testing.assert_allclose(p.probability_integral(y), stats.norm.cdf(y, p.mean, p.sd))


def test_normal_scores_are_normal_quantiles_of_the_distribution_function():
    p = mixture()
    y = p.samples[0] + np.linspace(-2.0, 2.0, 7)[:, None]
    expected = stats.norm.ppf(p.probability_integral(y))
    np.testing.assert_allclose(p.normal_scores(y), expected, rtol=1e-9, atol=1e-12)
    assert np.isnan(p.normal_scores(np.full((7, 2), np.nan))).all()


def test_normal_scores_far_in_the_tails():
    same = replace(
        mixture(draws=3), component_mean=np.zeros((3, 7, 2)), component_variance=np.ones((3, 7, 2)),
        noise_variance=np.full((3, 2), 3.0), weights=np.array([0.2, 0.5, 0.3]),
    )  # fmt: skip
    for z in (-40.0, -3.0, 0.0, 12.0, 40.0):
        np.testing.assert_allclose(same.normal_scores(2.0 * np.full((7, 2), z)), z, atol=1e-9)
    # Of two widths the larger one alone reaches far: its tail times its share.
    wide = replace(
        same,
        component_variance=np.array([0.0, 0.0, 3.0])[:, None, None] + 0 * same.component_mean,
        noise_variance=np.full((3, 2), 1.0),
    )
    far = wide.normal_scores(np.full((7, 2), 60.0))
    np.testing.assert_allclose(
        stats.norm.logsf(far), np.log(0.3) + stats.norm.logsf(30.0), rtol=1e-6
    )


@pytest.mark.parametrize("q", [0.0, 1.0, -0.1, [0.5, 1.2]])
def test_quantiles_outside_the_unit_interval(q):
    with pytest.raises(ValueError, match="q: expected probabilities between 0 and 1"):
        mixture().quantile(q)


def test_table_has_a_column_for_each_number():
    frame = mixture().to_frame()
    assert list(frame.columns)[:4] == ["a mean", "a sd", "a 2.5 %", "a 97.5 %"]
    assert frame.index.name == "time"


def scored(draws, n=400, seed=3):
    p = mixture(draws=draws, n=n, n_y=1, seed=seed)
    rng = np.random.default_rng(seed + 1)
    which = rng.integers(draws, size=n)
    index = np.arange(n)
    y = p.component_mean[which, index] + p.component_sd[which, index] * rng.standard_normal((n, 1))
    return p, dgp.Record(time=p.time, outputs=y, output_names=p.output_names)


def test_scores_against_their_definitions():
    p, record = scored(4)
    s = dgp.scores(p, record)
    error = record.outputs - p.mean
    assert s["rmse"] == pytest.approx(np.sqrt(np.mean(error**2)))
    assert s["mae"] == pytest.approx(np.mean(np.abs(error)))
    assert s["nrmse"] == pytest.approx(s["rmse"] / record.outputs.std())
    assert s["fit_percent"] == pytest.approx(100 * (1 - s["nrmse"]))
    density = stats.norm.pdf(record.outputs[None], p.component_mean, p.component_sd).mean(0)
    assert s["negative_log_density"] == pytest.approx(-np.log(density).mean())
    assert s["count"] == 400


@pytest.mark.parametrize("draws", [1, 4])
def test_crps_is_the_integral_of_the_squared_error_of_the_distribution(draws):
    p, record = scored(draws, n=25)
    grid = np.linspace(-12, 12, 24_001)
    F = stats.norm.cdf(
        grid[:, None], p.component_mean[:, None, :, 0], p.component_sd[:, None, :, 0]
    ).mean(0)
    step = (grid[:, None] >= record.outputs[:, 0]).astype(float)
    crps = np.trapezoid((F - step) ** 2, grid, axis=0)
    assert dgp.scores(p, record)["crps"] == pytest.approx(crps.mean(), rel=1e-3)


@given(
    draws=st.integers(1, 12),
    spread=st.floats(0.0, 30.0),
    ratio=st.floats(1.0, 1000.0),
    seed=st.integers(0, 2**31),
)
def test_crps_and_quantiles_of_any_mixture(draws, spread, ratio, seed):
    """Beside scoringrules, and a root found by Brent's method in each distribution function."""
    rng = np.random.default_rng(seed)
    mean = spread * rng.standard_normal((draws, 5))
    sd = ratio ** rng.uniform(-0.5, 0.5, (draws, 5))
    weight = rng.dirichlet(np.ones(draws))
    y = spread * rng.standard_normal(5)
    expected = scoringrules.crps_mixnorm(y, mean.T, sd.T, np.broadcast_to(weight, (5, draws)))
    found = mixture_scores(y, mean, sd, weight).crps
    # The closed form subtracts numbers as large as the spread and the widest component.
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * (spread + ratio))

    p = replace(
        mixture(draws=draws, n=5, n_y=1, seed=0), component_mean=mean[..., None],
        component_variance=sd[..., None] ** 2, noise_variance=np.zeros((draws, 1)), weights=weight,
    )  # fmt: skip
    for level, ours in zip((0.001, 0.5, 0.95), p.quantile([0.001, 0.5, 0.95]), strict=True):
        for k in range(5):
            ends = mean[:, k] + stats.norm.ppf(level) * sd[:, k]
            arguments = (weight, mean[:, k], sd[:, k], level)
            low, high = ends.min() - 1e-9, ends.max() + 1e-9
            root = optimize.brentq(excess, low, high, args=arguments, xtol=1e-13)
            # Where a gap between components leaves no density, many points have the level.
            near = abs(ours[k, 0] - root) <= 1e-8 * (1.0 + abs(root))
            assert near or abs(excess(ours[k, 0], *arguments)) < 1e-14


@pytest.mark.parametrize(("spread", "ratio"), [(0.01, 1.01), (0.3, 1.5), (5.0, 3.0), (30.0, 2.0)])
def test_crps_of_many_components(spread, ratio, monkeypatch):
    """The sum over nodes beside scoringrules' sum over pairs of components, and beside ours."""
    rng = np.random.default_rng(1)
    mean = 1e3 + spread * rng.standard_normal((150, 20))
    sd = ratio ** rng.uniform(-1.0, 1.0, (150, 20))
    weight = rng.dirichlet(np.ones(150))
    y = 1e3 + (1.0 + spread) * rng.standard_normal(20)
    expected = scoringrules.crps_mixnorm(y, mean.T, sd.T, np.broadcast_to(weight, (20, 150)))
    nodes = mixture_scores(y, mean, sd, weight).crps
    np.testing.assert_allclose(nodes, expected, rtol=1e-10, atol=1e-10)
    monkeypatch.setattr(mixture_score, "NODES", 1)  # no room: pairs of components
    pairs = mixture_scores(y, mean, sd, weight).crps
    np.testing.assert_allclose(nodes, pairs, rtol=1e-10, atol=1e-10)
    assert not np.array_equal(nodes, pairs)


def test_log_density_and_level_of_a_mixture():
    """Beside the prediction's own, far out, too."""
    p, record = scored(7, n=60)
    y = record.outputs[:, 0] * np.linspace(0.0, 40.0, 60)
    found = mixture_scores(
        y, p.component_mean[:, :, 0], p.component_sd[:, :, 0], p.component_weights
    )
    np.testing.assert_allclose(found.log_density, p.log_density(y[:, None])[:, 0], rtol=1e-12)
    np.testing.assert_allclose(found.level, p.probability_integral(y[:, None])[:, 0], atol=1e-14)


def excess(x, weight, mean, sd, level):
    """Distribution function of a mixture of normals over a level."""
    return weight @ stats.norm.cdf(x, mean, sd) - level


def test_coverage_of_a_true_prediction_is_nominal():
    p, record = scored(3, n=4000)
    s = dgp.scores(p, record)
    assert s["coverage_95"] == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / 4000))
    assert s["coverage_50"] == pytest.approx(0.50, abs=4 * np.sqrt(0.25 / 4000))


def test_skip_and_missing_samples_are_left_out():
    p, record = scored(2, n=50)
    y = record.outputs.copy()
    y[:10] = 1e6
    y[20] = np.nan
    s = dgp.scores(p, record.with_outputs(y), skip=10)
    assert s["count"] == 39
    assert s["rmse"] < 10


def test_several_outputs_give_arrays():
    p = mixture(n=30)
    y = p.mean + np.array([0.1, 0.2])
    record = dgp.Record(time=p.time, outputs=y, output_names=p.output_names)
    s = dgp.scores(p, record)
    np.testing.assert_allclose(s["rmse"], [0.1, 0.2])
    assert s["coverage_95"].shape == (2,)


def test_scores_refuse_what_does_not_belong_together():
    p, record = scored(1, n=20)
    with pytest.raises(ValueError, match="prediction: expected the 19 times"):
        dgp.scores(p, record[1:])
    shifted = dataclasses.replace(record, time=record.time + 0.5)
    with pytest.raises(ValueError, match="other times of the same number"):
        dgp.scores(p, shifted)
    with pytest.raises(ValueError, match="skip: expected a whole number from 0 to 19"):
        dgp.scores(p, record, skip=20)
    with pytest.raises(ValueError, match=r"record\.output_names: expected \[.a.\]"):
        dgp.scores(p, dgp.Record(time=record.time))
    with pytest.raises(ValueError, match="expected measured samples"):
        dgp.scores(p, record.with_outputs(np.full(20, np.nan)))


def test_shares_of_the_variance_are_computed_once_and_only_where_asked_for():
    calls = []

    def compute():
        calls.append(1)
        return {"noise": np.ones((3, 1))}

    parts = Parts(compute)
    assert not calls
    assert list(parts) == ["noise"]
    assert len(parts) == 1
    assert parts["noise"].shape == (3, 1)
    assert len(calls) == 1


def test_outputs_of_the_wrong_shape_are_refused_and_one_column_is_one_output():
    """(n,) against (S, n, 1) would broadcast to (n, n)."""
    p, record = scored(1, n=20)
    for name in ("log_density", "probability_integral", "normal_scores"):
        found = getattr(p, name)(record.outputs)
        assert found.shape == (20, 1)
        np.testing.assert_array_equal(getattr(p, name)(record.outputs[:, 0]), found)
        for bad in (record.outputs[:19], record.outputs.T, np.zeros((20, 2)), 0.0, None, "text"):
            with pytest.raises(ValueError, match="outputs: expected"):
                getattr(p, name)(bad)


def test_scores_in_other_units_are_refused():
    p, record = scored(1, n=20)
    p = dataclasses.replace(p, output_units=("kV",))
    with pytest.raises(ValueError, match=r"record\.output_units: expected \['kV'\].*\['V'\]"):
        dgp.scores(p, dataclasses.replace(record, output_units=("V",)))
    dgp.scores(p, dataclasses.replace(record, output_units=("kV",)))
