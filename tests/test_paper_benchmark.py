"""The comparison with peers: its scores, what methods are given, its page."""

import math
from dataclasses import replace

import numpy as np
import pytest

import pyro_dynogp as dgp
from tests.benchmarks import circumstances
from tests.benchmarks.paper import bound, ours, run
from tests.benchmarks.paper.experiments import CIRCUIT_VARIABLE, EXPERIMENTS
from tests.benchmarks.paper.figures import complete_seeds
from tests.benchmarks.paper.page import number, page, spread
from tests.benchmarks.paper.prediction import Predicted, scores

SHORT = ("circuit", "drives_1", "drives_2", "electricity")


def test_scores_of_samples_are_those_of_the_library():
    data = dgp.datasets.load("coupled_drives")
    fit = dgp.fit(
        dgp.LinearDynamicGP(1, pairs=2),
        data.train,
        restarts=2,
        steps=60,
        progress=False,
        method="map",
    )
    forecast = fit.forecast(data.train, data.test, samples=4000)
    samples = np.asarray(forecast.samples)[:, :, 0]
    found = scores(Predicted(forecast.mean[:, 0], samples), data.test.outputs[:, 0], skip=4)
    exact = dgp.scores(forecast, data.test, skip=4)
    assert found["rmse"] == pytest.approx(exact["rmse"], rel=1e-12)
    assert found["mae"] == pytest.approx(exact["mae"], rel=1e-12)
    # These are of 4000 draws, those of the library exact: Monte Carlo errors of about 1 %.
    assert found["crps"] == pytest.approx(exact["crps"], rel=0.02)
    assert found["coverage_95"] == pytest.approx(exact["coverage_95"], abs=0.03)
    assert found["log_density"] == pytest.approx(-exact["negative_log_density"], abs=0.05)


def test_scores_of_a_point_and_of_gaps():
    y = np.array([1.0, np.nan, 3.0, 5.0])
    found = scores(Predicted(np.array([0.0, 0.0, 3.0, 4.0])), y, skip=1)
    assert found["mae"] == found["crps"] == pytest.approx(0.5)
    assert found["rmse"] == pytest.approx(math.sqrt(0.5))
    assert math.isnan(found["coverage_95"])
    assert math.isnan(found["log_density"])


@pytest.mark.parametrize("name", SHORT)
def test_methods_get_inputs_and_no_test_outputs(name):
    experiment = EXPERIMENTS[name]
    task, tests, _ = experiment.task(experiment.seeds[0])
    assert task.architecture == experiment.architecture
    for record, inputs, blank in zip(
        tests.values(), task.inputs, ours.test_records(task), strict=True
    ):
        np.testing.assert_array_equal(record.inputs, inputs)
        np.testing.assert_array_equal(blank.inputs, inputs)
        assert blank.n_outputs == 0
        if experiment.follows:
            np.testing.assert_allclose(blank.time, record.time, rtol=1e-9)
    model = ours.cascade_model(task)
    model.check(task.train)
    noisy = [one.process_noise for one in model.layers if isinstance(one, dgp.Dynamic)]
    assert tuple(noisy) == experiment.noisy
    assert set(experiment.paper) <= {"rmse", "mae", "crps"}


def test_electricity_has_the_papers_inputs():
    train, tests, _ = EXPERIMENTS["electricity"].load(0)
    assert (len(train), len(tests["test"]), train.n_inputs) == (26304, 8736, 22)
    # Harmonics go on where the training record ends.
    whole = np.concatenate([train.inputs[:, 2], tests["test"].inputs[:, 2]])
    days = np.arange(len(whole)) / 48.0
    np.testing.assert_allclose(whole, np.cos(2.0 * np.pi * days), atol=1e-9)


def test_several_training_records(monkeypatch):
    experiment = EXPERIMENTS["drives_2"]
    train, tests, clean = experiment.load(0)
    several = replace(experiment, load=lambda seed: ((train, train[:100]), tests, clean))
    task, _, _ = several.task(0)
    assert [len(record) for record in task.records] == [len(train), 100]
    assert isinstance(experiment.task(0)[0].records, dgp.Record)
    monkeypatch.delenv(CIRCUIT_VARIABLE, raising=False)
    assert not any(job[0] == "circuit_ten" for job in run.jobs())
    with pytest.raises(FileNotFoundError, match=CIRCUIT_VARIABLE):
        EXPERIMENTS["circuit_ten"].load(0)
    monkeypatch.setenv(CIRCUIT_VARIABLE, "/nowhere")
    assert ("circuit_ten", "pyro_dynogp", 0) in run.jobs()
    with pytest.raises(FileNotFoundError, match="expected a folder"):
        EXPERIMENTS["circuit_ten"].load(0)


def row(experiment, method, seed, rmse, **more):
    found = {"rmse": rmse, "mae": rmse / 2, "crps": rmse / 3, "coverage_95": 0.9}
    return {
        "experiment": experiment, "method": method, "seed": seed,
        "date": "2026-01-02", "commit": "abc1234", "reference_seconds": 0.6,
        "seconds": 10.0, "steps": 5, "step_seconds": 0.1, "memory_gb": 1.0, "note": "",
        "figures": {},
        "scores": {"test": {**found, "log_density": 1.0}}, **more,
    }  # fmt: skip


def test_page(tmp_path):
    rows = [
        row("drives_2", "pyro_dynogp", 0, 0.08),
        row("drives_2", "pyro_dynogp", 1, 0.20),
        row("drives_2", "pyro_dynogp", 2, 0.10),
        row("drives_2", "dynoNet", 0, 0.11, note="time was up"),
        {"experiment": "drives_2", "method": "deep GP", "seed": 0, "failed": "out of memory"},
    ]
    test = EXPERIMENTS["drives_2"].load(0)[1]["test"]
    for one in rows[:4]:
        folder = tmp_path / "drives_2" / one["method"]
        folder.mkdir(parents=True, exist_ok=True)
        mean = test.outputs[:, 0]
        arrays = {"test/mean": mean, "test/low": mean - 1, "test/high": mean + 1}
        np.savez(folder / f"{one['seed']}.npz", **arrays)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    text = page(rows, tmp_path, pictures)
    assert "| pyro_dynogp | 0.1 (0.08 to 0.2) |" in text
    assert "| dynoGP, published | 0.147 | 0.109 | 0.081 |" in text
    assert "RMSE: 0.1, target 0.085: not reached, 17.6% above." in text
    assert "CRPS: 0.03333, target 0.055: reached." in text
    assert "deep GP, seed 0: failed, out of memory" in text
    assert "dynoNet: time was up" in text
    assert (
        "Runs: 4 on 2026-01-02 with commit abc1234 (ten million additions took 0.6 to 0.6 s)."
        in text
    )
    assert text.endswith("![coupled drives, second record](pictures/drives_2.png)")
    picture = pictures / "drives_2.png"
    assert picture.stat().st_size > 10_000
    # Another seed serves where the first one's are gone, if there are those of all methods.
    assert complete_seeds(rows[:4], tmp_path / "drives_2") == [0]
    assert complete_seeds(rows[:3], tmp_path / "drives_2") == [0, 1, 2]
    # Where predictions are gone, the picture stays as it is.
    (tmp_path / "drives_2" / "dynoNet" / "0.npz").unlink()
    before = picture.stat().st_mtime_ns
    assert page(rows, tmp_path, pictures) == text
    assert picture.stat().st_mtime_ns == before


def test_numbers():
    assert [number(x) for x in (0.012345, 12.345, 1234.5, math.nan)] == [
        "0.0123", "12.3", "1234", "",
    ]  # fmt: skip
    assert spread(np.array([np.nan])) == ""
    assert spread(np.array([2.0])) == "2"
    assert spread(np.array([1.0, 2.0, 4.0])) == "2 (1 to 4)"


def test_finished_jobs_are_not_run_again_and_failures_are_kept(tmp_path, monkeypatch):
    calls = []

    def process(command, **options):
        calls.append(command[3:6])
        raise run.subprocess.TimeoutExpired(command, options["timeout"])

    monkeypatch.setattr(run.subprocess, "run", process)
    monkeypatch.setattr(run, "KEPT", tmp_path / "rows.jsonl")
    monkeypatch.setattr(circumstances, "reference_seconds", lambda: 2.0 * circumstances.USUAL)
    text = run.run(tmp_path, ["electricity"], ["dynoNet"])
    assert calls == [["electricity", "dynoNet", "0"]]
    assert "failed, stopped after" in text
    run.run(tmp_path, ["electricity"], ["dynoNet"])
    assert len(calls) == 1
    ((job, row),) = run.kept_rows(run.KEPT).items()
    assert job == ("electricity", "dynoNet", 0)
    limit = 2.0 * (run.GRACE * EXPERIMENTS["electricity"].seconds + 600.0)
    assert row["failed"] == f"stopped after {limit:.0f} s"


def test_rows_that_are_kept(tmp_path):
    path = tmp_path / "new" / "rows.jsonl"
    assert run.kept_rows(path) == {}
    late, early = row("drives_2", "dynoNet", 1, 0.11), row("drives_1", "dynoNet", 0, 0.123456789)
    for one in (late, early, {**late, "seconds": 20.0}):
        run.keep(path, one)
    found = run.kept_rows(path)
    assert list(found) == [("drives_1", "dynoNet", 0), ("drives_2", "dynoNet", 1)]
    assert found["drives_1", "dynoNet", 0]["scores"]["test"]["rmse"] == 0.123457
    assert found["drives_2", "dynoNet", 1]["seconds"] == 20.0


def test_jobs_cover_everything_but_what_is_left_out():
    found = run.jobs()
    assert len(set(found)) == len(found)
    assert ("drives_1", "pyro_dynogp, stacked", 2) in found
    assert ("circuit", "pyro_dynogp, stacked", 0) not in found
    assert ("wiener_own", "GP-NARX", 49) in found


def test_bound_by_monte_carlo():
    """Generalised least squares on simulated open samples, process noise by Cholesky."""
    rng = np.random.default_rng(0)
    A, C = np.diag([-30.0, -20.0]), np.array([[1.0, 0.5]])
    L, noise_sd = np.array([[1.0], [2.0]]), 0.05
    B = np.array([[40.0, 10.0], [5.0, 30.0]])
    time = bound.STEP * np.arange(2500)
    angle = np.outer(time, bound.FREQUENCIES)
    basis = np.concatenate([np.sin(angle), np.cos(angle)], axis=1)
    g = bound.response(A, B, C, np.sin(angle))
    seen = np.flatnonzero(g[:1500] > 0.0)
    stationary = np.outer(L, L) / (30.0 * np.array([[2, 5 / 3], [5 / 3, 4 / 3]]))
    lags = np.abs(seen[:, None] - seen) * bound.STEP
    K = sum(
        C[0, i] * C[0, j] * stationary[i, j] * np.exp(A[i, i] * lags)
        for i in range(2) for j in range(2)
    )  # fmt: skip
    K = 0.5 * (K + K.T) + noise_sd**2 * np.eye(len(seen))
    errors = np.linalg.cholesky(K) @ rng.standard_normal((len(seen), 400))
    weighted = np.linalg.solve(K, basis[seen])
    wrong = np.linalg.solve(basis[seen].T @ weighted, weighted.T @ errors)
    off = (basis[1500:] @ wrong)[g[1500:] > 0.0]
    found = np.sqrt(np.square(off).sum() / (1000 * 400)) / noise_sd
    # 400 replicates of four numbers: a Monte Carlo error of 2 %.
    assert bound.clean_error_bound((A, B, C, L, noise_sd)) == pytest.approx(found, rel=0.05)
