"""Commands on messy files and with every model: what is read, told, predicted and judged."""

import re
import shlex
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.cli import main
from pyro_dynogp.cli.data import DATASETS
from pyro_dynogp.cli.demonstration import Result, score_table
from pyro_dynogp.cli.messages import in_flags
from pyro_dynogp.cli.models import MODELS, made
from pyro_dynogp.cli.tables import aligned
from pyro_dynogp.examples import datasets
from tests.commands import run

QUICK = ["--pairs", "1", "--restarts", "1", "--workers", "1", "--quiet", "--method", "map"]
GERMAN = ["--input", "Ventil", "--output", "Temp", "--time", "Zeit"]


@pytest.fixture(scope="module")
def table():
    rng = np.random.default_rng(0)
    n = 60
    u = np.repeat(rng.normal(size=n // 3), 3)
    y = np.zeros(n)
    for k in range(1, n):
        y[k] = 0.8 * y[k - 1] + 0.3 * u[k - 1]
    y += 0.05 * rng.normal(size=n)
    stamps = pd.date_range("2024-11-01 13:00", periods=n, freq="1min")
    return pd.DataFrame({"Zeit": stamps.strftime("%d/%m/%Y %H:%M:%S"), "Ventil": u, "Temp": y})


@pytest.fixture(scope="module")
def folder(tmp_path_factory, table):
    path = tmp_path_factory.mktemp("commands")
    text = "Gerät;X1\n\n" + table.to_csv(sep=";", decimal=",", index=False).replace(
        "Zeit;Ventil;Temp\n", "Zeit;Ventil;Temp\n;V;°C\n"
    )
    lines = text.split("\n")
    lines[8] = lines[8].rsplit(";", 1)[0] + ";-9999"
    (path / "messy.csv").write_bytes("\n".join(lines).encode("cp1252"))
    table.drop(columns="Zeit").to_csv(path / "plain.csv", index=False)
    known = table.drop(columns="Zeit").copy()
    known.loc[50:, "Temp"] = np.nan
    known.to_csv(path / "plan.csv", index=False)
    return path


@pytest.fixture(scope="module")
def fitted(folder):
    result = run("fit", folder / "plain.csv", "--input", "Ventil", "--output", "Temp",
                 "--sampling-time", 60, *QUICK, "--save", folder / "plant.safetensors")  # fmt: skip
    assert result.exit_code == 0, result.output
    return result


def test_advice_is_in_flags_and_works(folder, table):
    """Each complaint names the flag that helps; with all of them the file is fitted."""
    flags = []
    for _ in range(6):
        result = run("fit", folder / "messy.csv", *GERMAN, *flags, *QUICK, "--save",
                     folder / "messy.safetensors")  # fmt: skip
        if result.exit_code == 0 and "Note: column" not in result.stderr:
            break
        assert result.exit_code in (0, 2), result.output
        advice = result.stderr.strip().splitlines()
        advice = next(line for line in advice if line.startswith(("Error: ", "Note: column")))
        assert not re.search(r"\b[a-z_]+=", advice.replace("sep=", "")), advice
        found = re.search(r'(--[a-z-]+) ("[^"]+"|[\w-]+)', advice.partition(", got ")[2] or advice)
        flags += shlex.split(found[0])
    else:
        raise AssertionError(flags)
    names = [flag for flag in flags if flag.startswith("--")]
    assert sorted(names) == [
        "--encoding", "--missing", "--skip-rows", "--time-format", "--timezone"
    ]  # fmt: skip
    loaded = dgp.load(folder / "messy.safetensors")
    record = loaded.records[0]
    assert record.time.tolist() == (60.0 * np.arange(60)).tolist()
    assert (record.input_units, record.output_units) == (("V",), ("°C",))
    np.testing.assert_allclose(record.inputs[:, 0], table["Ventil"])
    expected = table["Temp"].to_numpy(copy=True)
    expected[4] = np.nan
    np.testing.assert_allclose(record.outputs[:, 0], expected)


def test_info_reads_such_files_too(folder):
    result = run("info", folder / "messy.csv", "--encoding", "cp1252", "--skip-rows", 2)
    rows = {line.split()[0]: line.split() for line in result.stdout.splitlines()[1:]}
    assert rows["Ventil"][1:3] == ["numbers", "V"]
    assert rows["Temp"][2:4] == ["°C", "-9999"]


@pytest.mark.parametrize(
    ("message", "expected"),
    [("path: expected 2 cells. If the table begins in line 5, give skip_rows=4.",
      "path: expected 2 cells. If the table begins in line 5, give --skip-rows 4."),
     ("timezone: expected a zone. Give timezone=\"UTC\" or one", "--timezone: expected a zone. "
      "Give --timezone UTC or one"),
     ("read the file with missing=[-9999, 1]; of a table in memory replace it by NaN.",
      "read the file with --missing -9999 --missing 1."),
     ('Give the right one: time_format="%d/%m/%Y %H:%M" or "%m/%d/%Y %H:%M".',
      'Give the right one: --time-format "%d/%m/%Y %H:%M" or "%m/%d/%Y %H:%M".'),
     ("give thousands=','; or decimal=',', where", "give --thousands ,; or --decimal ,, where"),
     ("inputs: expected\n one", "--input: expected one"),
     ("record: expected 3 samples", "record: expected 3 samples"),
     ("set integrators=1 if it integrates", "set integrators=1 if it integrates")],
)  # fmt: skip
def test_messages_in_flags(message, expected):
    assert in_flags(message) == expected


# Models


@pytest.mark.parametrize("kind", MODELS)
def test_every_model_has_a_name(kind):
    model = made(kind, 2, 1, 1)
    assert (model.inputs, len(model.output_names) if hasattr(model, "output_names") else 1) == (
        2,
        1,
    )
    functions = [wire.layer for wire in model.wires if isinstance(wire.layer, dgp.Static)]
    counts = {"linear": 0, "wiener": 1, "hammerstein": 1, "wiener-hammerstein": 1,
              "hammerstein-wiener": 2, "feedback": 1}  # fmt: skip
    assert len(functions) == counts[kind]


def test_a_nonlinear_fit(folder, monkeypatch):
    seen = {}
    real = dgp.fit

    def fit(model, record, **options):
        seen.update(options, model=model)
        return real(dgp.LinearDynamicGP(1, pairs=1), record, method="map", restarts=1, workers=1,
                    progress=False)  # fmt: skip

    monkeypatch.setattr(dgp, "fit", fit)
    columns = ["--input", "Ventil", "--output", "Temp", "--sampling-time", 60]
    result = run("fit", folder / "plain.csv", *columns, "--model", "wiener", "--quiet")
    assert result.exit_code == 0, result.output
    assert [type(w.layer).__name__ for w in seen["model"].wires] == ["Dynamic", "Static"]
    assert seen["method"] is None
    assert seen["restarts"] is None
    assert seen["model"].wires[0].layer.pairs == 5
    run("fit", folder / "plain.csv", *columns, "--model", "feedback", "--method", "nuts", "--quiet")
    assert (seen["method"], seen["model"].wires[0].layer.pairs) == ("nuts", 1)
    result = run("fit", folder / "plain.csv", *columns[2:], "--model", "hammerstein")
    assert result.exit_code == 2
    assert "--model hammerstein: needs inputs" in result.stderr


# Predictions


def test_forecast_of_the_rows_without_outputs(fitted, folder, table):
    out = folder / "forecast.csv"
    result = run("forecast", folder / "plant.safetensors", folder / "plan.csv",
                 "--sampling-time", 60, "--out", out)  # fmt: skip
    assert result.exit_code == 0, result.output
    assert result.stdout == f"10 rows in {out}\n"
    assert "bands leave out" in result.stderr
    loaded = dgp.load(folder / "plant.safetensors")
    record = dgp.Record(60.0 * np.arange(60), table["Ventil"], table["Temp"],
                        input_names="Ventil", output_names="Temp")  # fmt: skip
    expected = loaded.forecast(*record.split(50))
    frame = pd.read_csv(out, index_col="time")
    np.testing.assert_allclose(frame["Temp mean"], expected.mean[:, 0], rtol=1e-12)
    np.testing.assert_allclose(frame.index, record.time[50:])
    # The same samples of a file in which they are measured are scored, too.
    result = run("forecast", folder / "plant.safetensors", folder / "plain.csv",
                 "--sampling-time", 60, "--past", 50, "--out", "-")  # fmt: skip
    again = pd.read_csv(pd.io.common.StringIO(result.stdout), index_col="time")
    np.testing.assert_allclose(again["Temp mean"], frame["Temp mean"], rtol=1e-12)
    rmse = dgp.scores(expected, record[50:])["rmse"]
    assert f"{rmse:.4g}" in result.stderr.split()


def test_forecast_ahead_without_inputs(folder, tmp_path):
    columns = ["--output", "Temp", "--sampling-time", 60]
    model = tmp_path / "own.safetensors"
    run("fit", folder / "plain.csv", *columns, *QUICK, "--save", model)
    result = run("forecast", model, folder / "plain.csv", "--sampling-time", 60, "--ahead", 4,
                 "--out", "-")  # fmt: skip
    assert result.exit_code == 0, result.output
    frame = pd.read_csv(pd.io.common.StringIO(result.stdout), index_col="time")
    assert frame.index.tolist() == [3600.0, 3660.0, 3720.0, 3780.0]
    loaded = dgp.load(model)
    (record,) = loaded.records
    future = dgp.Record(frame.index.to_numpy(), outputs=np.full(4, np.nan), output_names="Temp")
    expected = loaded.forecast(record, future)
    np.testing.assert_allclose(frame["Temp sd"], expected.sd[:, 0], rtol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [(["plain.csv", "--sampling-time", "60"], ["60 of 60", "--past", "--ahead"]),
     (["plain.csv", "--sampling-time", "60", "--past", "60"], ["60 of 60"]),
     (["plain.csv", "--sampling-time", "60", "--ahead", "3"], ["--ahead", "Ventil"]),
     (["plain.csv", "--sampling-time", "60", "--ahead", "3", "--past", "2"], ["one of the two"]),
     (["gas_furnace"], ["--input", "Ventil"]),
     (["plain.csv"], ["--time", "--sampling-time"])],
)  # fmt: skip
def test_forecast_refuses(arguments, parts, fitted, folder, monkeypatch):
    monkeypatch.chdir(folder)
    result = run("forecast", "plant.safetensors", *arguments, "--out", "no.csv")
    assert result.exit_code == 2
    assert all(part in result.stderr for part in parts), result.stderr
    assert not (folder / "no.csv").exists()


def test_a_band_that_is_not_to_be_trusted_is_told(fitted, folder):
    assert "Note: this fit has its parameters at the mode" in fitted.stderr
    result = run("simulate", folder / "plant.safetensors", folder / "plain.csv", "--sampling-time",
                 60, "--out", folder / "simulated.csv")  # fmt: skip
    assert "Note: this fit has its parameters at the mode" in result.stderr


def test_warnings_of_a_fit_are_notes(folder, tmp_path):
    """A ramp: its pole decays within no record of this length."""
    n = 80
    rng = np.random.default_rng(1)
    u = rng.normal(size=n)
    ramp = pd.DataFrame({"u": u, "y": np.cumsum(u) + 0.01 * rng.normal(size=n)})
    ramp.to_csv(tmp_path / "ramp.csv", index=False)
    model = tmp_path / "ramp.safetensors"
    result = run("fit", tmp_path / "ramp.csv", "--input", "u", "--output", "y",
                 "--sampling-time", 1, *QUICK, "--save", model)  # fmt: skip
    assert result.exit_code == 0, result.output
    said = [line for line in result.stderr.splitlines() if "not to be trusted" in line]
    assert len(said) == 1
    assert said[0].startswith("Note: layer g: ")
    result = run("simulate", model, tmp_path / "ramp.csv", "--sampling-time", 1, "--out", "-")
    assert "not to be trusted" in result.stderr


# Judgement


def test_check(fitted, folder):
    result = run("check", folder / "plant.safetensors", "--no-forecasts", "--quiet")
    assert result.exit_code == 0, result.output
    expected = dgp.check(dgp.load(folder / "plant.safetensors"), forecasts=False, progress=False)
    assert result.stdout == f"{expected}\n"


def test_compare(fitted, folder, tmp_path):
    other = tmp_path / "plant.safetensors"
    columns = ["--input", "Ventil", "--output", "Temp", "--sampling-time", 60]
    two = [*QUICK[2:], "--pairs", 2]
    run("fit", folder / "plain.csv", *columns, *two, "--save", other)
    paths = [folder / "plant.safetensors", other]
    result = run("compare", *paths, "--workers", 1, "--quiet")
    assert result.exit_code == 0, result.output
    fits = {str(path): dgp.load(path) for path in paths}
    expected = dgp.compare(fits, target="forecast", workers=1, progress=False)
    assert result.stdout == f"{expected}\n"
    assert run("compare", other).exit_code == 2
    assert "each saved fit once" in run("compare", other, other).stderr
    wrong = run("compare", *paths, "--horizon", 2, "--target", "new record")
    assert "--horizon: for --target forecast" in wrong.stderr


# Examples, tables, help


@pytest.mark.parametrize("name", ["gas_furnace", "vic_elec", "wh_process_noise"])
def test_an_example_is_the_record_that_its_command_reads(name, tmp_path):
    result = run("example", name, "--out", tmp_path / "data.csv")
    assert result.exit_code == 0, result.output
    data = datasets.load(name)
    records = [data.full] if data.full is not None else [data.train, data.test]
    commands = [line for line in result.stdout.splitlines() if "pyro-dynogp fit" in line]
    assert len(commands) == len(records)
    for command, record in zip(commands, records, strict=True):
        context = main.commands["fit"].make_context("fit", shlex.split(command)[2:])
        from pyro_dynogp.cli.data import training_and_test

        found = training_and_test(context.params["data"], context.params, None).train[0]
        assert found.input_names == record.input_names
        assert found.output_units == record.output_units
        np.testing.assert_array_equal(found.time, record.time)
        np.testing.assert_array_equal(found.inputs, record.inputs)
        np.testing.assert_array_equal(found.outputs, record.outputs)
        if record.timestamps is not None:
            assert (found.timestamps == record.timestamps).all()


def test_examples_are_the_shipped_ones(tmp_path):
    assert run("example", "nonsense").exit_code == 2
    assert "no folder" in run("example", "gas_furnace", "--out", tmp_path / "a" / "b.csv").stderr
    assert set(main.commands["example"].params[0].type.choices) == set(DATASETS)


def test_columns_of_tables_stay_apart():
    rows = [("name", "x"), ("a much longer name than any", "1.23e+12345"), ("b", "2")]
    lines = aligned(rows, left=1).splitlines()
    assert [re.split(r"\s{2,}", line) for line in lines] == [list(row) for row in rows]
    assert (
        len({line.rindex(row[1]) + len(row[1]) for line, row in zip(lines, rows, strict=True)}) == 1
    )
    name = "a quantity with a long name"
    test = dgp.Record([0.0, 1.0], outputs=[1.0, 2.0], output_names=name, output_units="kg/h")
    keys = ("rmse", "mae", "fit_percent", "crps", "coverage_95")
    values = dict.fromkeys(keys, -123456.789)
    line = score_table({"simulation": Result(None, values)}, test).splitlines()[1]
    cells = re.split(r"\s{2,}", line)
    assert cells[1] == f"{name} [kg/h]"
    assert len(cells) == 7


def test_module_is_the_command():
    code = [sys.executable, "-m", "pyro_dynogp", "--version"]
    done = subprocess.run(code, capture_output=True, text=True, check=True)
    assert dgp.__version__ in done.stdout


@pytest.mark.parametrize("command", ["forecast", "check", "compare", "example", "close-loop"])
def test_help_has_examples(command):
    result = run(command, "--help")
    assert result.exit_code == 0
    assert "Examples:\n    pyro-dynogp " in result.stdout
    assert max(map(len, result.stdout.splitlines())) <= 100
