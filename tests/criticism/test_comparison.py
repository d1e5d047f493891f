"""Tables, block standard errors, refusals, weights; predictions of several fits together."""

import numpy as np
import pytest
from scipy.special import ndtr

import pyro_dynogp as dgp
from pyro_dynogp.criticism import arviz_bridge
from pyro_dynogp.criticism.comparison import block_standard_error, mix
from tests.conftest import simulate_record

QUIET = {"workers": 1, "progress": False}


def elpd(values, data="a", target="forecast", horizon=1, warning=False):
    n = len(values)
    return arviz_bridge.elpd_data(
        np.asarray(values, dtype=float), np.zeros(n), lppd=float(np.sum(values)) + 1.0, draws=400,
        warning=warning, coords={"sample": np.arange(n)},
        extra={"target": target, "horizon": horizon, "data": data},
    )  # fmt: skip


def autoregression(n, phi, rng):
    e = rng.standard_normal(n + 200)
    x = np.zeros(n + 200)
    for k in range(1, len(x)):
        x[k] = phi * x[k - 1] + e[k]
    return x[200:]


@pytest.mark.parametrize("phi", [0.0, 0.6, 0.9])
def test_block_standard_errors_of_autocorrelated_differences(phi):
    """Intervals of two errors around the sum of an AR(1) of mean zero hold 95 % or nearly so.

    Errors that take samples as independent hold far fewer.
    """
    rng = np.random.default_rng(1)
    n, runs = 400, 300
    inside, naive, ratio = 0, 0, []
    exact = np.sqrt(n) / (1.0 - phi)
    for _ in range(runs):
        d = autoregression(n, phi, rng)
        error, effective = block_standard_error(d)
        inside += abs(d.sum()) < 2.0 * error
        naive += abs(d.sum()) < 2.0 * np.sqrt(n * d.var())
        ratio.append(error / exact)
        assert 1.0 <= effective <= n
    assert inside / runs > (0.93 if phi < 0.9 else 0.89)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.12)
    if phi:
        assert naive / runs < inside / runs - 0.1


def test_constant_differences_have_no_error():
    assert block_standard_error(np.full(20, 3.0)) == (0.0, 20.0)


def test_table_and_verdict():
    rng = np.random.default_rng(0)
    base = rng.standard_normal(200)
    models = {
        "bad": elpd(base - 0.5 + 0.3 * rng.standard_normal(200)),
        "good": elpd(base),
        "like it": elpd(base - 0.005 + 0.3 * rng.standard_normal(200)),
    }
    found = dgp.compare(models, target="forecast")
    assert list(found.table.index)[-1] == "bad"
    assert bool(found.table.loc["bad", "clear"])
    assert not found.table["clear"].iloc[:2].any()
    assert sum(found.weights.values()) == pytest.approx(1.0)
    assert found.weights["bad"] < 0.05
    assert found.table.loc["bad", "dse_block"] == pytest.approx(
        found.table.loc["bad", "dse"], rel=0.4
    )
    assert "clearly worse: bad by" in found.verdict
    assert "a tie within errors" in found.verdict
    assert "dse_block" in str(found)


def test_a_small_difference_is_not_clear_however_small_its_error():
    base = np.zeros(100)
    found = dgp.compare({"a": elpd(base), "b": elpd(base - 0.03)}, target="forecast")
    assert found.table.loc["b", "elpd_diff"] == pytest.approx(3.0)
    assert not found.table.loc["b", "clear"]


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"data": "b"}, "data .* differ"),
        ({"target": "missing sample"}, "targets differ"),
        ({"horizon": 3}, "horizons differ"),
    ],
)
def test_what_cannot_be_compared(other, message):
    models = {"a": elpd(np.zeros(50)), "b": elpd(np.ones(50), **other)}
    with pytest.raises(ValueError, match=f"(?i){message}"):
        dgp.compare(models, target="forecast")


def test_other_numbers_of_samples_and_models():
    with pytest.raises(ValueError, match=r"(?i)other samples were scored"):
        dgp.compare({"a": elpd(np.zeros(50)), "b": elpd(np.zeros(40))}, target="forecast")
    with pytest.raises(ValueError, match="models: expected two models or more"):
        dgp.compare({"a": elpd(np.zeros(50))}, target="forecast")
    with pytest.raises(ValueError, match="target: expected 'forecast'"):
        dgp.compare({"a": elpd(np.zeros(9)), "b": elpd(np.zeros(9))}, target="missing sample")


def test_the_right_number_of_pairs_and_process_noise(one_pair):
    """Process noise that the data have is preferred to none, by fits of the package itself."""
    record = simulate_record(one_pair, 0.05, n=80, seed=1)
    fits = {
        "with": dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, restarts=2, **QUIET, method="map"),
        "without": dgp.fit(
            dgp.LinearDynamicGP(1, pairs=1, process_noise=False),
            record,
            restarts=2,
            **QUIET,
            method="map",
        ),
    }
    found = dgp.compare(fits, target="missing sample", draws=100, refits=0, **QUIET)
    assert found.table.index[0] == "with"
    assert found.table.loc["without", "elpd_diff"] > 10.0
    together = dgp.stack(fits, found)
    one, both = fits["with"].predict(record), together.predict(record)
    weight = together.weights.get("without", 0.0)
    other = fits["without"].predict(record)
    np.testing.assert_allclose(both.mean, (1 - weight) * one.mean + weight * other.mean, rtol=1e-9)


class TestMixtures:
    def predictions(self):
        rng = np.random.default_rng(3)

        def one(S, shift):
            mean = shift + rng.standard_normal((S, 6, 1))
            variance, noise = np.full((S, 6, 1), 0.3), np.full((S, 1), 0.2)
            parts = {
                "parameters": mean.var(0),
                "state": variance.mean(0),
                "measurement noise": np.full((6, 1), 0.2),
            }
            draws = shift + rng.standard_normal((500, 6, 1))
            return dgp.Prediction(
                np.arange(6.0), ("y",), mean, variance, noise, parts, lambda: draws, "test"
            )

        return one(5, 0.0), one(3, 4.0)

    def test_moments_quantiles_and_parts(self):
        a, b = self.predictions()
        both = mix([a, b], np.array([0.25, 0.75]))
        np.testing.assert_allclose(both.mean, 0.25 * a.mean + 0.75 * b.mean)
        second = 0.25 * (a.variance + a.mean**2) + 0.75 * (b.variance + b.mean**2)
        np.testing.assert_allclose(both.variance, second - both.mean**2)
        np.testing.assert_allclose(sum(both.parts.values()), both.variance)
        y = np.linspace(-1, 5, 6)[:, None]
        cdf = 0.25 * a.probability_integral(y) + 0.75 * b.probability_integral(y)
        np.testing.assert_allclose(both.probability_integral(y), cdf)
        density = 0.25 * np.exp(a.log_density(y)) + 0.75 * np.exp(b.log_density(y))
        np.testing.assert_allclose(np.exp(both.log_density(y)), density)
        median = both.quantile(0.5)
        np.testing.assert_allclose(both.probability_integral(median), 0.5, atol=1e-6)
        drawn = both.samples
        assert drawn.shape == (500, 6, 1)
        assert np.mean(drawn > 2.0) == pytest.approx(0.75, abs=0.06)

    def test_equal_weights_are_the_plain_mixture(self):
        a, _ = self.predictions()
        same = mix([a], np.array([1.0]))
        y = np.linspace(-1, 1, 6)
        record = dgp.Record(np.arange(6.0), None, y)
        one, two = dgp.scores(a, record), dgp.scores(same, record)
        for name, value in one.items():
            assert two[name] == pytest.approx(value, rel=1e-9), name

    def test_crps_of_a_weighted_mixture_by_its_definition(self):
        a, b = self.predictions()
        both = mix([a, b], np.array([0.3, 0.7]))
        record = dgp.Record(np.arange(6.0), None, np.linspace(-1, 5, 6))
        found = dgp.scores(both, record)["crps"]
        x = np.linspace(-15.0, 20.0, 20001)
        total = 0.0
        for k, y in enumerate(record.outputs[:, 0]):
            z = (x[:, None] - both.component_mean[:, k, 0]) / both.component_sd[:, k, 0]
            F = ndtr(z) @ both.component_weights
            total += np.trapezoid((F - (x >= y)) ** 2, x)
        assert found == pytest.approx(total / 6, rel=1e-3)


def test_weights_that_are_refused():
    fits = {"a": None, "b": None}
    with pytest.raises(ValueError, match="weights: expected numbers >= 0"):
        dgp.stack(fits, {"a": 1.0})
    with pytest.raises(ValueError, match="target: expected a target of loo"):
        dgp.stack(fits)
