"""The command close-loop: what it reads, hands on, prints and writes."""

import json
import re
import shutil
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.discrepancy.result import KEPT
from tests import commands
from tests.discrepancy import reports

COLUMNS = ["--input", "valve", "--output", "level", "--sampling-time", "0.5"]
QUICK = ["--pairs", "1", "--restarts", "1", "--workers", "1", "--quiet"]


run = partial(commands.run, "close-loop")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    rng = np.random.default_rng(0)
    n = 260
    u = np.repeat(rng.normal(size=n // 4), 4)
    y = np.zeros(n)
    for k in range(1, n):
        y[k] = 0.8 * y[k - 1] + 0.3 * u[k - 1]
    frame = pd.DataFrame(
        {
            "stamp": pd.date_range("2024-01-01", periods=n, freq="500ms", tz="UTC").map(
                pd.Timestamp.isoformat
            ),
            "valve": u,
            "level": y + 0.05 * rng.normal(size=n),
            "ambient": rng.normal(size=n),
            "feed": rng.normal(size=n),
            "shift": "day",
            "spare": "",
        }
    )
    path = tmp_path_factory.mktemp("close_loop")
    frame.to_csv(path / "plant.csv", index=False)
    frame[:200].to_csv(path / "short.csv", index=False)
    return path


@pytest.fixture
def seen(monkeypatch):
    """What the command hands to `close_loop`, which is replaced."""
    handed = {}

    def close_loop(fit, record, *, candidates=None, seed=0, max_rounds=4, **options):
        handed.update(
            options, fit=fit, record=record, candidates=candidates, seed=seed, rounds=max_rounds
        )
        return reports.report(fit=fit, base=fit)

    monkeypatch.setattr(dgp, "close_loop", close_loop, raising=False)
    return handed


@pytest.fixture
def unfitted(monkeypatch):
    """Models that the command fits, without the work."""
    models = []

    def fit(model, record, **options):
        models.append((model, record, options))
        return SimpleNamespace(save=lambda path: path.write_bytes(b"fit"))

    monkeypatch.setattr(dgp, "fit", fit)
    return models


def test_end_to_end(folder, seen, tmp_path):
    out = tmp_path / "a" / "report"
    result = run(
        folder / "plant.csv", *COLUMNS, *QUICK, "--unit", "level=m", "--unit", "ambient=K",
        "--seed", 3, "--max-rounds", 2, "--time-limit", 90, "--out", out,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    record, fitted = seen["record"], seen["fit"]
    assert len(record) == 260
    assert (record.input_names, record.output_names) == (("valve",), ("level",))
    assert record.output_units == ("m",)
    assert tuple(record.extra) == ("ambient", "feed")
    assert dict(record.extra_units) == {"ambient": "K", "feed": ""}
    assert fitted.training == (record[:130].fingerprint,)
    assert fitted.model.layers[0].pairs == 1
    assert (seen["seed"], seen["rounds"], seen["candidates"]) == (3, 2, None)
    assert (seen["workers"], seen["progress"]) == (1, False)
    assert seen["time_limit"] == 90.0
    assert "(the extended model; pyro_dynogp.load reads it)" in result.stdout
    report = reports.report(fit=fitted, base=fitted)
    assert str(report) in result.stdout
    assert "stamp, shift, spare" in result.stderr
    assert (out / "report.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert json.loads((out / "report.json").read_text())["outcome"] == "effects added"
    assert dgp.load(out / "model.safetensors").training == fitted.training
    for name in ("report.html", "report.json", "model.safetensors"):
        assert str(out / name) in result.stdout


def test_named_candidates_and_time_stamps(folder, seen, unfitted, tmp_path):
    result = run(
        folder / "plant.csv", "--input", "valve", "--output", "level", "--time", "stamp",
        "--candidates", "feed", "--model", "wiener", "--pairs", 2, "--out", tmp_path, "--seed", 5,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert tuple(seen["record"].extra) == ("feed",)
    assert seen["record"].timestamps is not None
    assert result.stderr == ""
    ((model, record, options),) = unfitted
    assert model == dgp.Wiener(inputs=1, outputs=1, pairs=2)
    assert len(record) == 130
    assert options["seed"] == 5
    assert (tmp_path / "model.safetensors").read_bytes() == b"fit"


@pytest.mark.parametrize(
    ("changes", "which"),
    [({"outcome": KEPT}, "the model before"), ({"extended": None}, "the model as given")],
)
def test_which_model_is_kept_is_said(changes, which, monkeypatch, unfitted, tmp_path):
    def close_loop(fit, record, **options):
        return reports.report(**{"fit": fit, "base": None, "extended": fit, **changes})

    monkeypatch.setattr(dgp, "close_loop", close_loop, raising=False)
    result = run("gas_furnace", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert f"({which}; pyro_dynogp.load reads it)" in result.stdout


def test_a_data_set(seen, unfitted, tmp_path):
    result = run("gas_furnace", "--out", tmp_path)
    assert seen["time_limit"] is None
    assert result.exit_code == 0, result.output
    assert len(seen["record"]) == 296
    assert len(unfitted[0][1]) == 148


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["plant.csv", "--input", "valve", "--sampling-time", "1"], ["--output", "info"]),
        (["plant.csv", "--input", "valve", "--output", "level"], ["--time", "--sampling-time"]),
        (["plant.csv", *COLUMNS, "--candidates", "valve"], ["--candidates", "'valve'"]),
        (["plant.csv", *COLUMNS, "--candidates", "wind"], ["'ambient'", "'wind'"]),
        (["plant.csv", *COLUMNS, "--candidates", "shift"], ["column 'shift'", "'day' in line 2"]),
        (["plant.csv", *COLUMNS, "--unit", "wind=m/s"], ["--unit", "'wind=m/s'"]),
        (["short.csv", *COLUMNS], ["short.csv", "200 samples", "240"]),
        (["missing.csv", *COLUMNS], ["missing.csv", "neither a file"]),
        (["plant.csv", *COLUMNS, "--model", "hammer"], ["--model", "wiener"]),
        (["plant.csv", *COLUMNS, "--max-rounds", "0"], ["--max-rounds"]),
        (["plant.csv", *COLUMNS, "--time-limit", "0"], ["--time-limit"]),
        (["plant.csv", *COLUMNS, "--out", "plant.csv"], ["--out"]),
        (["wh_process_noise"], ["wh_process_noise", "one record"]),
        (["gas_furnace", "--candidates", "wind"], ["--candidates", "wind"]),
        (["gas_furnace", "--sampling-time", "1"], ["--sampling-time", "gas_furnace"]),
    ],
)  # fmt: skip
def test_refuses(arguments, parts, folder, seen, monkeypatch):
    monkeypatch.chdir(folder)
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith("Error: ")
    for part in parts:
        assert part in last
    assert not seen
    assert not (folder / "close_loop_output").exists()


def test_help_has_examples():
    result = run("--help")
    assert result.exit_code == 0
    assert "Examples:\n    pyro-dynogp close-loop " in result.stdout
    assert max(map(len, result.stdout.splitlines())) <= 100


def test_a_report_that_cannot_be_written_is_written_elsewhere(folder, tmp_path, seen, monkeypatch):
    """A disk that fills during the search, which may have taken hours."""
    out, whole = tmp_path / "out", Path.replace

    def full(part, target):
        if Path(target).parent == out:
            raise OSError(28, "No space left on device")
        return whole(part, target)

    monkeypatch.setattr(Path, "replace", full)
    result = run(folder / "plant.csv", *COLUMNS, *QUICK, "--out", out)
    assert result.exit_code == 0, result.output
    assert list(out.iterdir()) == []
    assert result.stderr.count("Saved elsewhere: move ") == 3
    said = re.search(r"Report: (\S+) \(numbers: (\S+)\)\nModel:  (\S+) ", result.stdout)
    page, numbers, model = map(Path, said.groups())
    assert page.read_text().startswith("<!DOCTYPE html>")
    assert "effects" in json.loads(numbers.read_text())
    assert dgp.load(model).method
    for path in (page, numbers, model):
        shutil.rmtree(path.parent)


def test_any_named_model(folder, seen, unfitted, tmp_path):
    for kind in ("wiener-hammerstein", "feedback"):
        result = run(folder / "plant.csv", *COLUMNS, *QUICK, "--model", kind, "--out", tmp_path)
        assert result.exit_code == 0, result.output
    assert [len(model.wires) for model, _, _ in unfitted] == [3, 2]


def test_a_saved_model(folder, seen, tmp_path):
    """Its channels and units need not be named again; the record has the others as candidates."""
    frame = pd.read_csv(folder / "plant.csv")
    record = dgp.Record(
        0.5 * np.arange(260), frame["valve"], frame["level"], input_names="valve",
        output_names="level", input_units="V", output_units="m",
    )  # fmt: skip
    saved = tmp_path / "plant.safetensors"
    quick = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
    fitted = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record[:130], **quick)
    fitted.save(saved)
    options = ["--model", saved, "--sampling-time", "0.5", "--quiet", "--out", tmp_path / "out"]
    result = run(folder / "plant.csv", *options)
    assert result.exit_code == 0, result.output
    assert seen["fit"].training == fitted.training
    assert seen["record"][:130].fingerprint == fitted.training[0]
    assert list(seen["record"].extra) == ["ambient", "feed"]
    assert "parameters at the mode" in result.stderr
    for extra, part in (
        (["--pairs", "2"], "--pairs"),
        (["--input", "feed"], "--input: the saved fit has the inputs ['valve']"),
        (["--model", "nonsense"], "neither a file nor one of linear"),
    ):
        result = run(folder / "plant.csv", *options, *extra)
        assert result.exit_code == 2
        assert part in result.stderr
