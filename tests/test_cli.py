"""Command line, end to end: what is printed, written and refused, and the exit codes."""

import dataclasses
import gzip
import json
import lzma
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.cli import demonstration as demo
from pyro_dynogp.cli.data import DATASETS
from pyro_dynogp.examples import datasets
from tests.commands import run

QUICK = ["--pairs", "1", "--restarts", "1", "--steps", "15", "--workers", "1", "--quiet"]
COLUMNS = ["--input", "valve", "--output", "level", "--sampling-time", "0.5"]


def refused(result, *parts):
    """One line on standard error, exit code 2, nothing on standard output."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    lines = result.stderr.strip().splitlines()
    assert lines[-1].startswith("Error: ")
    for part in parts:
        assert part in lines[-1]
    return lines


@pytest.fixture(scope="module")
def table():
    rng = np.random.default_rng(0)
    n = 90
    u = np.repeat(rng.normal(size=n // 3), 3)
    y = np.zeros(n)
    for k in range(1, n):
        y[k] = 0.8 * y[k - 1] + 0.3 * u[k - 1]
    stamps = pd.date_range("2024-01-01", periods=n, freq="500ms", tz="UTC")
    return pd.DataFrame(
        {
            "stamp": stamps.map(pd.Timestamp.isoformat),
            "valve": u,
            "level": y + 0.05 * rng.normal(size=n),
            "shift": ["day"] * n,
        }
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory, table):
    path = tmp_path_factory.mktemp("cli")
    table.to_csv(path / "plant.csv", index=False)
    table.drop(columns="level").to_csv(path / "inputs.csv", index=False)
    return path


@pytest.fixture(scope="module")
def fitted(folder):
    """The fit that all tests use, made by the command itself."""
    result = run(
        "fit", folder / "plant.csv", *COLUMNS, "--train", 60, *QUICK,
        "--unit", "valve=V", "--unit", "level=m",
        "--save", folder / "plant.safetensors", "--figures", folder / "figures",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    return result


# fit


def test_fit_prints_saves_and_draws(fitted, folder, table):
    loaded = dgp.load(folder / "plant.safetensors")
    assert fitted.stderr == ""
    assert loaded.summary() in fitted.stdout
    assert "Scores on 30 samples:" in fitted.stdout
    record = dgp.Record(
        np.arange(90) * 0.5, table["valve"], table["level"],
        input_names=["valve"], output_names=["level"], input_units=["V"], output_units=["m"],
    )  # fmt: skip
    train, test = record.split(60)
    assert loaded.training == (train.fingerprint,)
    expected = dgp.scores(loaded.forecast(train, test), test)
    line = next(x for x in fitted.stdout.splitlines() if x.startswith("forecast"))
    assert line.split()[-6:] == [
        "[m]",
        f"{expected['rmse']:.4g}",
        f"{expected['mae']:.4g}",
        f"{expected['fit_percent']:.1f}",
        f"{expected['crps']:.4g}",
        f"{100 * expected['coverage_95']:.1f}",
    ]
    names = {path.name for path in (folder / "figures").iterdir()}
    assert names == {
        f"{name}.png"
        for name in ("record", "poles", "residuals", "quantiles", "history", "starts", "bode",
                     "impulse_response", "simulation", "forecast", "one_step")
    }  # fmt: skip


def test_fit_without_held_out_samples(folder):
    result = run("fit", folder / "plant.csv", *COLUMNS, *QUICK)
    assert result.exit_code == 0
    assert "Scores" not in result.stdout


def test_fit_without_inputs_on_time_stamps(folder, tmp_path):
    result = run(
        "fit", folder / "plant.csv", "--output", "level", "--time", "stamp",
        "--timezone", "Europe/Vienna", *QUICK, "--figures", tmp_path / "new" / "figures",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "0 inputs ->" in result.stdout
    assert "6 figures in" in result.stdout
    assert not (tmp_path / "new" / "figures" / "bode.png").exists()


def test_fit_of_a_data_set(tmp_path):
    result = run("fit", "gas_furnace", *QUICK, "--train", 100)
    assert result.exit_code == 0, result.output
    assert "Scores on 196 samples:" in result.stdout
    result = run("fit", "coupled_drives", *QUICK)
    assert "Scores on 100 samples (the first 4 are not counted):" in result.stdout


def test_progress_goes_to_standard_error(folder):
    result = run("fit", folder / "plant.csv", *COLUMNS, *QUICK[:-1])
    assert result.exit_code == 0
    assert "optimum" in result.stderr
    assert "optimum" not in result.stdout


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["plant.csv", "--input", "valv", "--output", "level", "--sampling-time", "1"],
         ["--input", "'valve'", "'valv'"]),
        (["plant.csv", "--input", "valve", "--sampling-time", "1"], ["--output", "info"]),
        (["plant.csv", "--input", "valve", "--output", "level"], ["--time", "--sampling-time"]),
        (["plant.csv", *COLUMNS, "--time", "stamp"], ["one of the two"]),
        (["plant.csv", *COLUMNS, "--train", "90"], ["1 to 89", "90"]),
        (["plant.csv", "--input", "shift", "--output", "level", "--sampling-time", "1"],
         ["column 'shift'", "'day' in line 2"]),
        (["plant.csv", "--output", "level", "--time", "shift"], ["ISO 8601"]),
        (["plant.csv", "--output", "level", "--time", "stamp", "--timezone", "Vienna"],
         ["timezone", "'Vienna'"]),
        (["plant.csv", *COLUMNS, "--unit", "valve"], ["--unit", "NAME=UNIT", "'valve'"]),
        (["plant.csv", *COLUMNS, "--unit", "lever=m"], ["--unit", "'lever=m'"]),
        (["plant.csv", *COLUMNS, "--save", "nowhere/fit.safetensors"], ["--save", "no folder"]),
        (["missing.csv", *COLUMNS], ["missing.csv", "neither a file", "gas_furnace"]),
        (["gas_furnace", "--sampling-time", "1"], ["--sampling-time", "gas_furnace"]),
        (["gas_furnace", "--time-unit", "h"], ["--time-unit", "gas_furnace"]),
        (["gas_furnace", "--input", "u"], ["--input", "'u'"]),
        (["wh_process_noise", "--train", "100"], ["--train", "not one record"]),
        (["plant.csv", *COLUMNS, "--pairs", "0"], ["--pairs"]),
        (["plant.csv", *COLUMNS, "--method", "mcmc"], ["--method", "nuts"]),
        (["plant.csv", *COLUMNS, "--figures", "plant.csv"], ["--figures"]),
    ],
)  # fmt: skip
def test_fit_refuses(arguments, parts, folder, monkeypatch):
    monkeypatch.chdir(folder)
    refused(run("fit", *arguments, "--workers", 1, "--quiet"), *parts)


def test_one_line_even_where_the_message_has_several(folder, monkeypatch):
    path = folder / "empty.csv"
    path.write_text("# nothing\n\n")
    lines = refused(run("fit", path, *COLUMNS), "a line of data")
    assert len(lines) == 1


def test_unexpected_errors_keep_their_trace(folder, monkeypatch):
    def broken(*arguments, **options):
        raise ValueError("not the package's words")

    monkeypatch.setattr(dgp, "fit", broken)
    result = run("fit", folder / "plant.csv", *COLUMNS)
    assert result.exit_code == 1
    assert isinstance(result.exception, ValueError)
    assert "not the package's words" not in result.stderr


# simulate


def test_simulate_without_measured_outputs(fitted, folder, table):
    out = folder / "simulated.csv"
    arguments = ["simulate", folder / "plant.safetensors", folder / "inputs.csv"]
    result = run(*arguments, "--sampling-time", 0.5, "--out", out)
    assert result.exit_code == 0, result.output
    assert result.stdout == f"90 rows in {out}\n"
    frame = pd.read_csv(out, index_col="time")
    assert list(frame) == ["level mean", "level sd", "level 2.5 %", "level 97.5 %"]
    loaded = dgp.load(folder / "plant.safetensors")
    record = dgp.Record(
        np.arange(90) * 0.5, table["valve"], table["level"],
        input_names=["valve"], output_names=["level"], input_units=["V"], output_units=["m"],
    )  # fmt: skip
    expected = loaded.simulate(record)
    np.testing.assert_allclose(frame.index, expected.time)
    np.testing.assert_allclose(frame["level mean"], expected.mean[:, 0], rtol=1e-12)
    np.testing.assert_allclose(frame["level 97.5 %"], expected.quantile(0.975)[:, 0], rtol=1e-12)
    result = run(*arguments, "--sampling-time", 0.5, "--no-process-noise", "--out", "-")
    quiet = pd.read_csv(pd.io.common.StringIO(result.stdout), index_col="time")
    assert (quiet["level sd"] <= frame["level sd"] + 1e-12).all()
    expected = loaded.simulate(record, process_noise=False)
    np.testing.assert_allclose(quiet["level sd"], expected.sd[:, 0], rtol=1e-12)


def test_simulate_ahead_on_time_stamps(fitted, folder, table):
    result = run(
        "simulate", folder / "plant.safetensors", folder / "plant.csv", "--time", "stamp",
        "--horizon", 3, "--out", "-",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    frame = pd.read_csv(pd.io.common.StringIO(result.stdout))
    assert (
        pd.to_datetime(frame["time"], format="ISO8601").to_numpy()
        == pd.to_datetime(table["stamp"], format="ISO8601").to_numpy()
    ).all()
    error = frame["level mean"] - table["level"]
    assert error[10:].std() < table["level"][10:].std()


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["plant.safetensors", "inputs.csv", "--sampling-time", "0.5", "--horizon", "2"],
         ["--horizon", "measured outputs ['level']"]),
        (["plant.safetensors", "plant.csv", "--sampling-time", "0.5", "--horizon", "2",
          "--no-process-noise"], ["--no-process-noise", "--horizon"]),
        (["plant.safetensors", "plant.csv"], ["--time", "--sampling-time"]),
        (["plant.csv", "plant.csv", "--sampling-time", "0.5"], ["plant.csv", "not a safetensors"]),
        (["missing.safetensors", "plant.csv"], ["missing.safetensors", "does not exist"]),
        (["plant.safetensors", "gas_furnace"], ["--input", "'valve'"]),
        (["plant.safetensors", "gas_furnace", "--time", "t"], ["--time", "gas_furnace"]),
    ],
)  # fmt: skip
def test_simulate_refuses(arguments, parts, fitted, folder, monkeypatch):
    monkeypatch.chdir(folder)
    refused(run("simulate", *arguments, "--out", "out.csv"), *parts)
    assert not (folder / "out.csv").exists()


def test_an_output_without_a_folder(fitted, folder):
    model, data = folder / "plant.safetensors", folder / "plant.csv"
    for nowhere in (data / "out.csv", folder / "missing" / "out.csv"):
        arguments = (model, data, "--sampling-time", 0.5, "--out", nowhere)
        refused(run("simulate", *arguments), "--out", f"no folder {nowhere.parent}")


def test_errors_of_the_system_name_the_file(fitted, folder, tmp_path, monkeypatch):
    def denied(*arguments, **options):
        raise PermissionError(13, "Permission denied", "out.csv")

    monkeypatch.setattr(pd.DataFrame, "to_csv", denied)
    arguments = (folder / "plant.safetensors", folder / "plant.csv", "--sampling-time", 0.5)
    result = run("simulate", *arguments, "--out", tmp_path / "out.csv")
    refused(result, f"{tmp_path}/out.csv (Permission denied).")


# info


def test_info():
    result = run("info")
    assert result.exit_code == 0
    assert dgp.__version__ in result.stdout
    assert "torch 2" in result.stdout
    assert tuple(DATASETS) == datasets.names()
    for name in datasets.names():
        assert name in result.stdout


def test_info_of_a_data_set():
    result = run("info", "gas_furnace")
    data = datasets.load("gas_furnace")
    assert data.source in result.stdout
    assert data.protocol in result.stdout
    assert data.test.summary() in result.stdout


def test_info_of_a_file(folder, table):
    result = run("info", folder / "plant.csv")
    assert result.exit_code == 0
    rows = {line.split()[0]: line for line in result.stdout.splitlines()[2 : 2 + table.shape[1]]}
    assert list(rows) == list(table)
    assert "time stamps" in rows["stamp"]
    assert "text" in rows["shift"]
    assert "shift: day ... day" in result.stdout
    assert f"{table['valve'].min():.5g}" in rows["valve"]
    assert rows["valve"].split()[-1] == "0"


def test_info_of_a_fit(fitted, folder):
    result = run("info", folder / "plant.safetensors")
    loaded = dgp.load(folder / "plant.safetensors")
    assert loaded.summary() in result.stdout
    assert "inputs: valve [V]" in result.stdout
    assert loaded.training[0] in result.stdout
    refused(run("info", folder / "nothing"), "neither a file")


# Help


@pytest.mark.parametrize("command", [[], ["demo"], ["info"], ["fit"], ["simulate"]])
def test_help_has_examples(command):
    result = run(*command, "--help")
    assert result.exit_code == 0
    assert "Examples:\n    pyro-dynogp " in result.stdout
    assert max(map(len, result.stdout.splitlines())) <= 100


def test_commands_import_nothing_heavy():
    """The module itself needs click alone, so that --help need not wait for torch."""
    folder = Path(dgp.__file__).parent
    code = (
        "import sys, types\n"
        "package = types.ModuleType('pyro_dynogp')\n"
        f"package.__path__ = [{str(folder)!r}]\n"
        "sys.modules['pyro_dynogp'] = package\n"
        "import pyro_dynogp.cli\n"
        "print(sorted({'torch', 'pyro', 'numpy', 'pandas', 'matplotlib'} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_version():
    result = run("--version")
    assert result.exit_code == 0
    assert dgp.__version__ in result.stdout


# demo


def test_demo(tmp_path, capsys, monkeypatch):
    data = datasets.load("coupled_drives")
    # A shorter record, so that the test takes seconds.
    data = dataclasses.replace(
        data, train=data.full[:150], test=data.full[150:220], full=data.full[:220]
    )
    monkeypatch.setattr(datasets, "load", lambda name: data)
    out = tmp_path / "a" / "demo"
    result = demo.run_demo(out, progress=False, pairs=1, restarts=1, steps=60, rounds=0, workers=1)
    printed = capsys.readouterr()
    assert printed.err == ""
    for kind in ("simulation", "forecast", "one-step"):
        assert kind in printed.out
    assert "absolute value" in printed.out
    assert all(path.stat().st_size > 0 for path in result["files"])
    assert {path.parent for path in result["files"]} == {out}
    written = json.loads((out / "scores.json").read_text())
    loaded = dgp.load(out / "drives.safetensors")
    again = dgp.scores(loaded.predict(data.test), data.test, skip=4)
    assert written["one-step"] == pytest.approx(again)
    assert written["one-step"]["count"] == 66
    assert written["one-step"]["rmse"] < 0.5 * written["simulation"]["rmse"]


def test_demo_command(tmp_path, monkeypatch):
    seen = {}
    monkeypatch.setattr(
        demo, "run_demo", lambda directory, progress: seen.update(at=directory, progress=progress)
    )
    assert run("demo", "--output", tmp_path / "x", "--quiet").exit_code == 0
    assert seen == {"at": tmp_path / "x", "progress": False}
    assert run("demo").exit_code == 0
    assert seen == {"at": Path("demo_output"), "progress": True}


def test_what_is_too_short_to_fit_ends_in_a_sentence(folder):
    refused(run("fit", folder / "plant.csv", *COLUMNS, "--train", 2, *QUICK), "3 samples or more")


def test_damaged_files_end_in_a_sentence(tmp_path):
    whole = gzip.compress(b"a,b\n" + b"1,2\n" * 500)
    cases = {
        "short.csv.gz": (whole[:-20], "a whole compressed file"),
        "other.csv.gz": (b"a,b\n1,2\n", "a whole compressed file"),
        "flipped.csv.gz": (whole[:20] + bytes([whole[20] ^ 255]) + whole[21:], "compressed file"),
        "short.csv.xz": (lzma.compress(b"a,b\n1,2\n")[:-20], "a whole compressed file"),
        "other.csv.bz2": (b"a,b\n1,2\n", "a whole compressed file"),
        "quoted.csv": (b'a,b\n"' + b"1" * 140_000 + b'",2\n', "field larger than field limit"),
        "long.csv": (b"a,b\n" + b"1" * 2_000_000 + b",2\n", "fewer than 1048576 characters"),
    }
    for name, (content, expected) in cases.items():
        (tmp_path / name).write_bytes(content)
        refused(run("info", tmp_path / name), expected)


BLANK = """
import resource, sys
from pathlib import Path
from pyro_dynogp.data.text_table import read_table

def most():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

before = most()
read_table(Path(sys.argv[1]))
print(most() - before)
"""


def test_blank_lines_take_no_memory(tmp_path):
    """4 MB of blank lines, 4 kB compressed, in a process of its own."""
    path = tmp_path / "blank.csv.gz"
    path.write_bytes(gzip.compress(b"a,b\n1,2\n" + b"\n" * 4_000_000))
    command = [sys.executable, "-c", BLANK, path]
    grown = subprocess.run(command, capture_output=True, check=True, cwd=Path(__file__).parents[1])
    assert int(grown.stdout) < 8_000  # kB; a list of the lines took 160 MB


def test_a_fit_that_cannot_be_saved_is_saved_elsewhere(folder, tmp_path, monkeypatch):
    """The folder is tried before the work; what happens to it meanwhile loses nothing."""
    for path in ("/proc/fit.safetensors", "/proc/absent/fit.safetensors"):
        refused(run("fit", folder / "plant.csv", *COLUMNS, "--save", path, *QUICK), "--save: ")
    target = tmp_path / "there" / "fit.safetensors"
    target.parent.mkdir()
    fit = dgp.fit

    def fit_and_lose_the_folder(*arguments, **options):
        found = fit(*arguments, **options)
        target.parent.rmdir()
        return found

    monkeypatch.setattr(dgp, "fit", fit_and_lose_the_folder)
    done = run("fit", folder / "plant.csv", *COLUMNS, "--save", target, *QUICK)
    assert done.exit_code == 0
    assert "Saved elsewhere" in done.stderr
    other = Path(done.stdout.split("saved to ")[1].split("\n")[0])
    assert dgp.load(other).method == "importance"
    shutil.rmtree(other.parent)
