"""The protocol of the benchmarks: what it sees of a test, and what it counts."""

from types import SimpleNamespace

import numpy as np
import pytest

import pyro_dynogp as dgp
from tests.benchmarks.leaderboard import drives, record_of, score


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal(60), 5)
    y = np.zeros(300)
    for k in range(1, 300):
        y[k] = 0.9 * y[k - 1] + 0.1 * u[k - 1]
    y += 0.01 * rng.standard_normal(300)
    record = record_of((u, y), 0.1)
    fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record[:200], workers=1, progress=False)
    return fit, u[200:], y[200:]


def test_it_is_the_error_after_the_first_outputs(case):
    fit, u, y = case
    test = record_of((u, y), 0.1)
    found = score(fit, (u, y), 20, 0.1)
    forecast = fit.forecast(test[:20], test[20:])
    assert found["rmse"] == np.sqrt(np.mean((y[20:] - forecast.mean[:, 0]) ** 2))
    low, high = forecast.quantile([0.025, 0.975])[..., 0]
    assert found["coverage_95"] == np.mean((low <= y[20:]) & (y[20:] <= high))
    assert 0.0 < found["crps"] < found["rmse"]


def test_later_outputs_are_not_seen(case):
    """With all later outputs moved by a constant the prediction stays and the error is that."""
    fit, u, y = case
    moved = np.where(np.arange(len(y)) < 20, y, y + 1e6)
    assert score(fit, (u, moved), 20, 0.1)["rmse"] == pytest.approx(1e6, rel=1e-5)
    early = y + np.where(np.arange(len(y)) < 20, 1.0, 0.0)
    assert score(fit, (u, early), 20, 0.1)["rmse"] > score(fit, (u, y), 20, 0.1)["rmse"]


def test_objects_of_nonlinear_benchmarks_are_taken(case):
    fit, u, y = case
    data = SimpleNamespace(u=u, y=y, sampling_time=0.1)
    assert score(fit, data, 20) == score(fit, (u, y), 20, 0.1)
    with pytest.raises(ValueError, match="sampling time"):
        record_of((u, y))


def test_the_records_of_the_drives():
    benchmark = drives(2)
    assert len(benchmark.train) == 400
    assert [len(test) for test in benchmark.tests.values()] == [100]
    assert benchmark.first == 4
