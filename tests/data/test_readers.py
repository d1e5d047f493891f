"""Readers: messy files give the right numbers or an error that says where."""

import gzip
import lzma
import re

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pyro_dynogp.data.record import Record


def refused(*parts):
    return pytest.raises(ValueError, match="(?s)" + ".*".join(map(re.escape, parts)))


@pytest.fixture
def write(tmp_path):
    def writer(text, name="data.csv", encoding="utf-8"):
        path = tmp_path / name
        path.write_bytes(text.encode(encoding))
        return path

    return writer


def columns(record):
    return {**{n: record.inputs[:, i].tolist() for i, n in enumerate(record.input_names)},
            **{n: record.outputs[:, i].tolist() for i, n in enumerate(record.output_names)},
            **{n: v.tolist() for n, v in record.extra.items()}}  # fmt: skip


class TestForms:
    @pytest.mark.parametrize(
        "text",
        [
            "t,u,y\n0,1.5,-3\n1,2.5,4e2\n",
            "t;u;y\n0;1.5;-3\n1;2.5;4e2\n",
            "t;u;y\n0;1,5;-3\n1;2,5;4e2\n",
            "t\tu\ty\n0\t1.5\t-3\n1\t2.5\t4e2\n",
            "t\tu\ty\n0\t1,5\t-3\n1\t2,5\t4e2\n",
            "  t   u  y\n  0 1.5\t -3\n  1   2.5 4e2   \n",
            "# made by a logger\n\n% and another\nt,u,y\n0,1.5,-3\n\n# mid\n1,2.5,4e2\n\n",
            '"t","u","y",\n0,1.5,-3,\n1,2.5,4e2,\n',
            "t , u , y\r\n0 , 1.5 , -3\r\n1 , 2.5 , 4e2\r\n",
            "t,u,y\n0,1.5,-3\n1,2.5,4e2\n,,\n,,\n",
            "\ufefft,u,y\n0,1.5,-3\n1,2.5,4e2",
        ],
    )
    def test_the_same_numbers(self, write, text):
        record = Record.from_csv(write(text), ["u"], output="y", time="t")
        assert record.time.tolist() == [0.0, 1.0]
        assert columns(record) == {"u": [1.5, 2.5], "y": [-3.0, 400.0]}

    def test_no_header(self, write):
        record = Record.from_csv(write("0 1.5 -3\n1 2.5 4\n"), ["1"], output="2", time="0")
        assert columns(record) == {"1": [1.5, 2.5], "2": [-3.0, 4.0]}

    def test_no_header_with_stamps(self, write):
        path = write("2024-01-01T00:00Z,1\n2024-01-01T00:01Z,2\n")
        assert Record.from_csv(path, ["1"], time="0").time.tolist() == [0.0, 60.0]

    def test_header_of_numbers_on_demand(self, write):
        path = write("10,20\n1,2\n")
        record = Record.from_csv(path, ["10"], header=True, sampling_time=1)
        assert columns(record) == {"10": [1.0], "20": [2.0]}

    def test_given_names(self, write):
        path = write("1,2\n3,4\n")
        record = Record.from_csv(path, ["a"], output="b", names=["a", "b"], sampling_time=1)
        assert columns(record) == {"a": [1.0, 3.0], "b": [2.0, 4.0]}
        path = write("x,x\n3,4\n")
        record = Record.from_csv(path, names=["a", "b"], header=True, sampling_time=1)
        assert columns(record) == {"a": [3.0], "b": [4.0]}

    def test_header_over_blocks(self, write):
        path = write('"r",,,"u",,"y","fs",\n1,2,3,4,5,6,78,\n7,8,9,10,11,12,,\n')
        record = Record.from_csv(path, ["u_1"], output="y", sampling_time=1)
        assert list(record.extra) == ["r_0", "r_1", "r_2", "u_0", "fs"]
        assert columns(record)["r_2"] == [3.0, 9.0]
        assert columns(record)["u_1"] == [5.0, 11.0]
        assert columns(record)["y"] == [6.0, 12.0]
        np.testing.assert_array_equal(record.extra["fs"], [78, np.nan])

    def test_index_column_without_a_name(self, write):
        record = Record.from_csv(write(",u\n0,3\n1,4\n"), ["u"], sampling_time=1)
        assert columns(record) == {"u": [3.0, 4.0], "unnamed_0": [0.0, 1.0]}

    def test_gaps_are_missing_outputs(self, write):
        path = write("u,y,z\n1,,5\n2,NA,6\n3,nan\n4,null,8\n5,9,N/A\n")
        record = Record.from_csv(path, ["u"], outputs=["y", "z"], sampling_time=1)
        assert record.missing[:, 0].tolist() == [True] * 4 + [False]
        assert record.missing[:, 1].tolist() == [False, False, True, False, True]

    def test_a_row_of_gaps_keeps_its_place_on_the_clock(self, write):
        record = Record.from_csv(write("y,z\n1,1\n,\n3,3\n"), outputs=["y", "z"], sampling_time=2)
        assert record.time.tolist() == [0.0, 2.0, 4.0]
        assert record.missing.sum() == 2

    def test_booleans(self, write):
        record = Record.from_csv(
            write("u,y\nTRUE,1\nFalse,2\n"), ["u"], output="y", sampling_time=1
        )
        assert columns(record)["u"] == [1.0, 0.0]

    @pytest.mark.parametrize(("name", "opener"), [("a.csv.gz", gzip.open), ("a.csv.xz", lzma.open)])
    def test_compressed(self, tmp_path, name, opener):
        with opener(tmp_path / name, "wt") as file:
            file.write("u,y\n1,2\n")
        record = Record.from_csv(tmp_path / name, ["u"], output="y", sampling_time=1)
        assert columns(record) == {"u": [1.0], "y": [2.0]}
        assert record.name == "a"

    def test_encoding(self, write):
        path = write("Dampfstärke\n1\n", encoding="latin-1")
        with refused("encoding", "utf-8", "latin-1"):
            Record.from_csv(path, sampling_time=1)
        assert "Dampfstärke" in Record.from_csv(path, sampling_time=1, encoding="latin-1").extra

    def test_delimiter_and_decimal_on_demand(self, write):
        path = write("u|y\n1,5|2\n")
        record = Record.from_csv(path, ["u"], delimiter="|", decimal=",", sampling_time=1)
        assert columns(record) == {"u": [1.5], "y": [2.0]}

    def test_units_and_step(self, write):
        record = Record.from_csv(
            write("u,y,e\n1,2,3\n4,5,6\n"), "u", output="y", sampling_time=0.25, time_unit="h",
            input_units=["V"], output_units="m", extra_units={"e": "K"}, name="run",
        )  # fmt: skip
        assert record.time.tolist() == [0.0, 0.25]
        assert (record.time_unit, record.input_units, record.output_units, record.name) == (
            "h", ("V",), ("m",), "run",
        )  # fmt: skip
        assert dict(record.extra_units) == {"e": "K"}

    def test_extra_choices(self, write):
        path = write("u,a,b,day\n1,2,3,Monday\n")
        assert list(Record.from_csv(path, ["u"], extra=["b"], sampling_time=1).extra) == ["b"]
        assert not Record.from_csv(path, ["u"], extra=None, sampling_time=1).extra
        with pytest.warns(UserWarning, match=r"'day' \(it has 'Monday' in line 2\)"):
            assert list(Record.from_csv(path, ["u"], sampling_time=1).extra) == ["a", "b"]
        with refused("column 'day'", "'Monday' in line 2"):
            Record.from_csv(path, ["u"], extra=["day"], sampling_time=1)

    @given(
        st.lists(
            st.tuples(
                st.floats(allow_nan=False, allow_infinity=False),
                st.floats(allow_infinity=False),
                st.booleans(),
            ),
            min_size=1,
            max_size=12,
        ),
        st.sampled_from([(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ",")]),
    )
    @settings(
        max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
    )
    def test_round_trip_to_the_bit(self, tmp_path, rows, form):
        delimiter, decimal = form
        lines = [delimiter.join(["u", "y", "b"])]
        for u, y, b in rows:
            cells = [repr(u), "" if np.isnan(y) else repr(y), str(b).upper()]
            lines.append(delimiter.join(c.replace(".", decimal) for c in cells))
        path = tmp_path / "round.csv"
        path.write_text("\n".join(lines) + "\n")
        record = Record.from_csv(
            path, ["u"], output="y", sampling_time=1.0, delimiter=delimiter, decimal=decimal
        )
        expected = np.array(rows, dtype=np.float64)
        np.testing.assert_array_equal(record.inputs[:, 0], expected[:, 0])
        np.testing.assert_array_equal(record.outputs[:, 0], expected[:, 1])
        np.testing.assert_array_equal(record.extra["b"], expected[:, 2])


class TestRefusals:
    def test_unknown_columns(self, write):
        path = write("u,y\n1,2\n")
        for argument, options in {
            "inputs": {"inputs": ["v"]},
            "outputs": {"output": "v"},
            "extra": {"extra": ["v"]},
            "time": {"time": "v", "sampling_time": None},
        }.items():
            with refused(argument, "['u', 'y']", "'v'"):
                Record.from_csv(path, **{"sampling_time": 1, **options})

    def test_no_times(self, write):
        with refused("time", "sampling_time", "neither", "equal steps"):
            Record.from_csv(write("u\n1\n"), ["u"])

    def test_two_sources_of_times(self, write):
        with refused("sampling_time", "None where the data have times", "0.5"):
            Record.from_csv(write("t,u\n0,1\n"), ["u"], time="t", sampling_time=0.5)

    @pytest.mark.parametrize("step", [0, -1.0, np.nan, np.inf, "1", True])
    def test_sampling_time(self, write, step):
        with refused("sampling_time", "a positive number", repr(step)):
            Record.from_csv(write("u\n1\n"), ["u"], sampling_time=step)

    @pytest.mark.parametrize(
        ("cell", "advice"),
        [("x", "missing"), ("1_000", "missing"), ("1.2.3", "missing"), ("1,000", "thousands=','")],
    )
    def test_cells_that_are_no_numbers(self, write, cell, advice):
        path = write(f"# comment\nu;y\n1;2\n\n2;{cell}\n3.5;4\n")
        with refused("column 'y'", repr(cell), "line 5", advice):
            Record.from_csv(path, ["u"], output="y", sampling_time=1, decimal=".")

    def test_point_where_the_decimal_is_a_comma(self, write):
        with refused("column 'y'", "'2.5'", "line 3"):
            Record.from_csv(write("u;y\n1,5;2\n2;2.5\n"), ["u"], output="y", sampling_time=1)

    def test_gap_in_an_input(self, write):
        with refused("inputs", "nan in column 'u'", "1 rows: 1"):
            Record.from_csv(write("u,y\n1,1\n,2\n"), ["u"], output="y", sampling_time=1)

    def test_long_lines(self, write):
        with refused("path", "2 cells", "got 3 on line 3"):
            Record.from_csv(write("u,y\n1,2\n1,2,3\n"), ["u"], sampling_time=1)
        with refused("path", "2 cells", "got 3 on line 2"):
            Record.from_csv(write("1,2\n1,2,3\n"), ["0"], sampling_time=1)
        with refused("path", "1 cells", "got 2 on line 1"):
            Record.from_csv(write("1,2\n"), ["a"], names=["a"], sampling_time=1)

    def test_repeated_names(self, write):
        with refused("path", "unique column names", "['u', 'u']", "names="):
            Record.from_csv(write("u,u\n1,2\n"), ["u"], sampling_time=1)

    @pytest.mark.parametrize("text", ["", "# only\n", "u,y\n", "u,y\n,\n"])
    def test_no_data(self, write, text):
        with refused("path", "a line of data"):
            Record.from_csv(write(text), sampling_time=1)

    def test_quoted_lines(self, write):
        with refused("path", "one row on each line"):
            Record.from_csv(write('u,"y\nz,w"\n1,2\n'), sampling_time=1)

    def test_output_twice(self, write):
        with refused("output", "both"):
            Record.from_csv(write("u,y\n1,2\n"), outputs=["u"], output="y", sampling_time=1)

    def test_input_is_also_output(self, write):
        with refused("names", "'u' 2 times"):
            Record.from_csv(write("u,y\n1,2\n"), ["u"], output="u", sampling_time=1)

    def test_options(self, write):
        with refused("delimiter", "one character"):
            Record.from_csv(write("u\n1\n"), sampling_time=1, delimiter="::")
        with refused("decimal", '"." or ","'):
            Record.from_csv(write("u\n1\n"), sampling_time=1, decimal="'")

    def test_no_file(self, tmp_path):
        with pytest.raises(FileNotFoundError):
            Record.from_csv(tmp_path / "none.csv", sampling_time=1)


class TestStampsInFiles:
    def read(self, write, *stamps, **options):
        text = "t,y\n" + "".join(f'"{t}",{i}\n' for i, t in enumerate(stamps))
        return Record.from_csv(write(text), output="y", time="t", **options)

    def test_utc(self, write):
        record = self.read(write, "2011-12-31T13:00:00Z", "2011-12-31T13:30:00Z")
        assert record.time.tolist() == [0.0, 1800.0]
        assert record.timestamps[0] == pd.Timestamp("2011-12-31 13:00", tz="UTC")

    def test_utc_shown_in_a_zone(self, write):
        record = self.read(write, "2011-12-31T13:00Z", timezone="Australia/Melbourne")
        assert str(record.timestamps[0]) == "2012-01-01 00:00:00+11:00"

    def test_offsets_across_daylight_saving(self, write):
        record = self.read(write, "2024-10-27 02:30+02:00", "2024-10-27 02:30+01:00")
        assert record.time.tolist() == [0.0, 3600.0]
        assert str(record.timestamps.tz) == "UTC"

    def test_one_offset_is_kept(self, write):
        record = self.read(write, "2024-01-01 00:00:00,25+05:30", "2024-01-01 00:00:01,5+05:30")
        assert record.time.tolist() == [0.0, 1.25]
        assert record.start.utcoffset() == pd.Timedelta(hours=5.5)

    def test_local_times(self, write):
        record = self.read(write, "2024-03-31 01:30", "2024-03-31 03:30", timezone="Europe/Vienna")
        assert record.time.tolist() == [0.0, 3600.0]

    def test_local_times_without_a_zone(self, write):
        with refused("timezone", "None", 'timezone="UTC"'):
            self.read(write, "2024-01-01 00:00")

    @pytest.mark.parametrize("stamp", ["2024-10-27 02:30", "2024-03-31 02:30"])
    def test_local_times_that_daylight_saving_repeats_or_skips(self, write, stamp):
        with refused("exist once in Europe/Vienna", stamp, "row 1", "UTC", 'ambiguous="infer"'):
            self.read(write, "2024-01-01 00:00", stamp, timezone="Europe/Vienna")

    @pytest.mark.parametrize("zone", ["Europe/Atlantis", "nonsense"])
    def test_unknown_zone(self, write, zone):
        with refused("timezone", '"Europe/Vienna"', zone):
            self.read(write, "2024-01-01 00:00", timezone=zone)

    @pytest.mark.parametrize("second", ["01/02/2024", "2024-01-02 00:00Z", "", "7"])
    def test_mixed_forms(self, write, second):
        with refused("time", "ISO 8601", "line 3", "to_datetime"):
            self.read(write, "2024-01-01 00:00", second, timezone="UTC")

    def test_impossible_date(self, write):
        with refused("time", "ISO 8601"):
            self.read(write, "2024-13-01T00:00Z")

    def test_repeated_and_reversed(self, write):
        with refused("repeated time stamp at index 1", "2024-01-01 00:00:00+00:00"):
            self.read(write, "2024-01-01T00:00Z", "2024-01-01T00:00Z")
        with refused("a step back at index 1"):
            self.read(write, "2024-01-01T01:00Z", "2024-01-01T00:00Z")


class TestFrames:
    def frame(self):
        index = pd.date_range("2024-10-27", periods=4, freq="1h", tz="Europe/Vienna")
        return pd.DataFrame(
            {"u": [1, 2, 3, 4], "on": [True, False, True, True], "y": [1.0, None, 3.0, 4.0]}, index
        )

    def test_channels(self):
        record = Record.from_frame(self.frame(), ["u"], output="y", output_units=["m"])
        assert record.missing[:, 0].tolist() == [False, True, False, False]
        assert record.extra["on"].tolist() == [1.0, 0.0, 1.0, 1.0]
        assert record.time.tolist() == [0.0, 3600.0, 7200.0, 10800.0]
        assert record.output_units == ("m",)

    def test_nullable_and_object_columns(self):
        frame = pd.DataFrame(
            {"a": pd.array([1, None], "Int64"), "b": pd.array([True, None], "boolean"),
             "c": pd.Series([1.5, None], dtype=object), "d": pd.Categorical([1, 2])}
        )  # fmt: skip
        record = Record.from_frame(frame, outputs=["a", "b", "c", "d"], sampling_time=1)
        np.testing.assert_array_equal(record.outputs, [[1, 1, 1.5, 1], [np.nan] * 3 + [2]])

    @pytest.mark.parametrize(
        "cells", [["1", "2"], [1.0, "x"], [1j, 2], pd.to_datetime(["2020"] * 2)]
    )
    def test_cells_that_are_no_numbers(self, cells):
        frame = pd.DataFrame({"u": cells}, index=[7, 8])
        with refused("column 'u'", "row ", "missing"):
            Record.from_frame(frame, ["u"], sampling_time=1)

    def test_time_column(self):
        frame = pd.DataFrame({"t": [0.0, 0.1], "u": [1, 2]})
        record = Record.from_frame(frame, ["u"], time="t", time_unit="min")
        assert (record.time.tolist(), record.time_unit) == ([0.0, 0.1], "min")
        assert not record.extra

    def test_column_of_local_stamps(self):
        frame = pd.DataFrame({"t": pd.to_datetime(["2024-03-31 01:00", "2024-03-31 03:00"])})
        with refused("timezone"):
            Record.from_frame(frame, time="t")
        record = Record.from_frame(frame, time="t", timezone="Europe/Vienna")
        assert record.time.tolist() == [0.0, 3600.0]

    def test_index_of_times(self):
        assert Record.from_frame(pd.DataFrame({"u": [1, 2]}, [0.5, 1.5])).time.tolist() == [
            0.5,
            1.5,
        ]
        frame = pd.DataFrame({"u": [1, 2]}, [5, 6])
        assert Record.from_frame(frame, time="index").time.tolist() == [5.0, 6.0]
        with refused("time", "neither", '"index"'):
            Record.from_frame(frame)

    def test_index_of_times_and_a_step(self):
        with refused("sampling_time", "reset_index"):
            Record.from_frame(self.frame(), sampling_time=1)

    def test_time_of_text(self):
        with refused("time", "real numbers"):
            Record.from_frame(pd.DataFrame({"t": ["noon"]}), time="t")

    def test_names_twice(self):
        frame = pd.DataFrame([[1, 2]], columns=["u", "u"])
        with refused("frame", "unique column names"):
            Record.from_frame(frame, ["u"], sampling_time=1)


class TestRoundTrips:
    @pytest.mark.parametrize(
        "clock", [[0.0, 0.1, 0.35], pd.date_range("2024-10-27", periods=3, tz="Europe/Vienna")]
    )
    @pytest.mark.parametrize("first", [0, 1])
    def test_frame_and_xarray(self, clock, first):
        record = Record(
            clock, [1, 2, 3], [[1, 2], [np.nan, 4], [5, 6]], extra={"e": [0, np.nan, 1]},
            input_units=["V"], output_units=["m", "m/s"], extra_units={"e": "K"}, name="run",
        )[first:]  # fmt: skip
        for again in (
            Record.from_frame(record.to_frame(), ["u"], ["y1", "y2"]),
            Record.from_xarray(record.to_xarray(), ["u"], ["y1", "y2"]),
        ):
            assert again == record
            assert again.name == "run"
            if record.start is not None:
                assert str(again.timestamps.tz) == "Europe/Vienna"

    def test_other_time_units_survive(self):
        record = Record([0, 1], [1, 2], time_unit="h")
        assert Record.from_frame(record.to_frame(), ["u"]).time_unit == "h"
        assert Record.from_xarray(record.to_xarray(), ["u"]).time_unit == "h"

    def test_given_units_win(self):
        frame = Record([0, 1], [1, 2], input_units=["V"]).to_frame()
        assert Record.from_frame(frame, ["u"], input_units=["mV"]).input_units == ("mV",)

    def test_xarray_has_utc_stamps(self):
        record = Record(pd.date_range("2024-01-01", periods=2, tz="Europe/Vienna"))
        stamp = record.to_xarray()["timestamp"].values[0]
        assert stamp == np.datetime64("2023-12-31T23:00")


class TestXarray:
    def dataset(self):
        return xr.Dataset(
            {"u": ("t", [1, 2], {"units": "V"}), "y": ("t", [1.0, np.nan]), "n": ((), 3),
             "grid": (("t", "x"), np.zeros((2, 2)))},
            {"t": ("t", np.array(["2024-01-01", "2024-01-02"], "M8[ns]"))},
        )  # fmt: skip

    def test_datetime_coordinate(self):
        record = Record.from_xarray(self.dataset(), "u", output="y", time="t", timezone="UTC")
        assert record.time.tolist() == [0.0, 86400.0]
        assert (record.input_units, dict(record.extra)) == (("V",), {})
        with refused("timezone"):
            Record.from_xarray(self.dataset(), "u", output="y", time="t")

    def test_no_time_coordinate(self):
        with refused("time", "['t']", "'time'", "assign_coords"):
            Record.from_xarray(self.dataset(), "u")

    def test_variable_over_other_dimensions(self):
        with refused("inputs", "['u', 'y']", "'grid'"):
            Record.from_xarray(self.dataset(), "grid", time="t", timezone="UTC")
