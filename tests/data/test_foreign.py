"""Records from tables of other libraries, MATLAB files, data sets of nonlinear_benchmarks."""

import datetime
import sys
import types

import numpy as np
import pandas as pd
import pytest
import scipy.io

from pyro_dynogp.data.record import Record


class TestTables:
    def test_polars(self):
        polars = pytest.importorskip("polars")
        begin = datetime.datetime(2024, 3, 31, tzinfo=datetime.UTC)
        stamps = [begin + datetime.timedelta(hours=k) for k in range(3)]
        table = polars.DataFrame({"t": stamps, "u": [1, 2, 3], "y": [1.0, None, 3.0],
                                  "state": ["a", "b", "c"]})  # fmt: skip
        table = table.with_columns(polars.col("t").dt.convert_time_zone("Europe/Vienna"))
        with pytest.warns(UserWarning, match="'state'"):
            record = Record.from_frame(table, "u", "y", time="t")
        assert record.time.tolist() == [0.0, 3600.0, 7200.0]
        assert record.timestamps[1] == pd.Timestamp("2024-03-31 03:00", tz="Europe/Vienna")
        np.testing.assert_array_equal(record.outputs[:, 0], [1.0, np.nan, 3.0])

    def test_what_is_no_table(self, monkeypatch):
        for value in (None, 3, "text", [1, 2]):
            with pytest.raises(ValueError, match="frame: expected a table"):
                Record.from_frame(value, "u")
        monkeypatch.setitem(sys.modules, "narwhals", None)
        with pytest.raises(ValueError, match="need the package narwhals"):
            Record.from_frame(3, "u")


class TestMatlab:
    @pytest.fixture
    def path(self, tmp_path):
        path = tmp_path / "run.mat"
        scipy.io.savemat(path, {
            "t": np.arange(4) * 0.5, "u": [[1.0], [2.0], [3.0], [4.0]],
            "Y": np.arange(8).reshape(4, 2),
            "fs": 2.0, "other": np.zeros(7), "note": "text", "data": {"y": [1.0, np.nan, 3.0, 4.0]},
        })  # fmt: skip
        return path

    def test_vectors_matrices_and_structures(self, path):
        record = Record.from_mat(path, "u", ["data.y", "Y_1"], time="t", output_units=["m", "V"])
        assert record.time.tolist() == [0.0, 0.5, 1.0, 1.5]
        assert record.inputs[:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]
        np.testing.assert_array_equal(record.outputs.T, [[1, np.nan, 3, 4], [1, 3, 5, 7]])
        assert (list(record.extra), record.name) == (["Y_0"], "run")

    def test_refusals(self, path, tmp_path):
        for error, arguments in {
            "inputs: .*'v'": {"inputs": "v", "outputs": "data.y", "sampling_time": 1},
            "one length": {"inputs": "u", "outputs": "other", "sampling_time": 1},
            "names among": {"sampling_time": 1},
            "sampling_time": {"outputs": "data.y"},
        }.items():
            with pytest.raises(ValueError, match=error):
                Record.from_mat(path, **arguments)
        other = tmp_path / "other.mat"
        for content in (b"no file of this kind" * 20, path.read_bytes()[:200], b""):
            other.write_bytes(content)
            with pytest.raises(ValueError, match=r"path: expected a (whole )?MATLAB file"):
                Record.from_mat(other, outputs="data.y", sampling_time=1)
        with pytest.raises(FileNotFoundError):
            Record.from_mat(tmp_path / "none.mat", outputs="y", sampling_time=1)

    def test_later_versions(self, path, monkeypatch):
        def later(*arguments, **options):
            raise NotImplementedError("Please use HDF reader for matlab v7.3 files")

        monkeypatch.setattr(scipy.io, "loadmat", later)
        with pytest.raises(ValueError, match=r"7\.2 or before.*-v7"):
            Record.from_mat(path, outputs="data.y", sampling_time=1)


class TestBenchmarks:
    def test_an_object_like_those(self):
        data = types.SimpleNamespace(
            u=np.arange(3.0), y=np.arange(6.0).reshape(3, 2), sampling_time=np.float32(0.5),
            name="run", state_initialization_window_length=1,
        )  # fmt: skip
        record = Record.from_benchmark(data)
        assert record.time.tolist() == [0.0, 0.5, 1.0]
        assert (record.n_inputs, record.n_outputs, record.name) == (1, 2, "run")
        assert Record.from_benchmark(data, sampling_time=2.0).time.tolist() == [0.0, 2.0, 4.0]

    def test_refusals(self):
        with pytest.raises(ValueError, match=r"data: .*without u"):
            Record.from_benchmark(3)
        data = types.SimpleNamespace(u=[1.0], y=[1.0])
        with pytest.raises(ValueError, match="sampling_time"):
            Record.from_benchmark(data)
        for step in (0, -1.0, True, "a"):
            with pytest.raises(ValueError, match="sampling_time: expected a positive number"):
                Record.from_benchmark(data, sampling_time=step)


class TestHolidays:
    def record(self, zone="Europe/Vienna"):
        stamps = pd.date_range("2023-12-31 12:00", periods=60, freq="6h", tz=zone)
        return Record(stamps, outputs=np.arange(60.0), extra={"e": np.zeros(60)})

    def test_local_dates(self):
        pytest.importorskip("holidays")
        record = self.record().with_holidays("AT")
        dates = pd.Series(record.timestamps.date.astype(str))
        # New Year's Day and Epiphany, and no other day from New Year's Eve to 15 January.
        expected = dates.isin(["2024-01-01", "2024-01-06"]).astype(float)
        assert record.extra["holiday"].tolist() == expected.tolist()
        assert list(record.extra) == ["e", "holiday"]
        assert record.with_extra_as_input("holiday").input_names == ("holiday",)
        bavaria = self.record().with_holidays("DE", "BY", name="free").extra["free"]
        assert bavaria.sum() > self.record().with_holidays("DE").extra["holiday"].sum() > 0

    def test_refusals(self, monkeypatch):
        with pytest.raises(ValueError, match="plain times"):
            Record([0.0, 1.0]).with_holidays("AT")
        for country in (None, 3):
            with pytest.raises(ValueError, match="country: expected"):
                self.record().with_holidays(country)
        monkeypatch.setitem(sys.modules, "holidays", None)
        with pytest.raises(ImportError, match="pip install holidays"):
            self.record().with_holidays("AT")

    def test_unknown_codes(self):
        pytest.importorskip("holidays")
        with pytest.raises(ValueError, match=r"country: .*'XX'"):
            self.record().with_holidays("XX")
        with pytest.raises(ValueError, match=r"subdivision: .*'XX'"):
            self.record().with_holidays("AT", "XX")
