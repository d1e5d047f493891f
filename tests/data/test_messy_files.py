"""Text files as loggers and spreadsheets write them: read, or refused with advice that works."""

import re

import numpy as np
import pandas as pd
import pytest

from pyro_dynogp.data import text_cells, text_table
from pyro_dynogp.data.numerals import Numerals, decimal_mark
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.time_stamps import read_stamps

U = [0.5, 1.5, 2.5]
Y = [20.0, 20.327, 20.618]
GERMAN = (
    "Zeit;Öffnung Ventil [%];Temperatur °C\r\n"
    "25.11.2024 13:45:00;0,500;20,000\r\n"
    "25.11.2024 13:46:00;1,500;20,327\r\n"
    "25.11.2024 13:47:00;2,500;20,618\r\n"
)
CHANNELS = ("Öffnung Ventil [%]", "Temperatur °C")


@pytest.fixture
def write(tmp_path):
    def writer(text, encoding="utf-8"):
        path = tmp_path / "data.csv"
        path.write_bytes(text.encode(encoding))
        return path

    return writer


def advised(write, text, advice, *channels, encoding="utf-8", **options):
    """Refused at first; the record that is read when the advice is followed."""
    path = write(text, encoding)
    with pytest.raises(ValueError, match=re.escape(advice)):
        Record.from_csv(path, *channels, **options)
    name, _, value = advice.partition("=")
    return Record.from_csv(path, *channels, **options, **{name: eval(value)})


def plain(record):
    assert record.inputs[:, 0].tolist() == U
    np.testing.assert_array_equal(record.outputs[:, 0], Y)


class TestEncodings:
    @pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
    def test_told_from_the_first_bytes(self, write, encoding):
        for text in (GERMAN, GERMAN.replace(";", "\t")):
            record = Record.from_csv(write(text, encoding), *CHANNELS, time="Zeit", timezone="UTC")
            plain(record)
            assert record.timestamps[1] == pd.Timestamp("2024-11-25 13:46", tz="UTC")

    def test_windows(self, write):
        path = write(GERMAN, "cp1252")
        with pytest.raises(ValueError, match='encoding="cp1252"'):
            Record.from_csv(path, *CHANNELS, time="Zeit", timezone="UTC")
        options = {"time": "Zeit", "timezone": "UTC", "encoding": "cp1252"}
        plain(Record.from_csv(path, *CHANNELS, **options))

    def test_utf16_read_as_another_is_refused(self, write):
        with pytest.raises(ValueError, match=r'encoding: .*"utf-16"'):
            Record.from_csv(write(GERMAN, "utf-16"), encoding="latin-1", sampling_time=1)


def test_first_line_that_names_the_delimiter(write):
    text = "sep=;\nt;u;y\n0;0,5;20,0\n1;1,5;20,327\n2;2,5;20,618\n"
    plain(Record.from_csv(write(text), "u", "y", time="t"))
    plain(Record.from_csv(write(text.replace(";", "|")), "u", "y", time="t", decimal=","))


class TestPreambles:
    TABLE = "t,u,y\n0,0.5,20.0\n1,1.5,20.327\n2,2.5,20.618\n"

    @pytest.mark.parametrize(
        "preamble",
        [
            "Model,DS1000\nInterval,1.0E-03\n\n",
            "Model DS1000\n\n\n",
            "a,b,c,d\n1,2,3\n\n",
            "x\ny\nz\n",
        ],
    )
    def test_the_advice_works(self, write, preamble):
        advice = "skip_rows=3"
        plain(advised(write, preamble + self.TABLE, advice, "u", "y", time="t"))

    def test_more_rows_than_there_are(self, write):
        with pytest.raises(ValueError, match="a line of data"):
            Record.from_csv(write(self.TABLE), "u", skip_rows=4, sampling_time=1)


class TestUnits:
    def test_row_of_units(self, write):
        text = "t,u,y,z\nh,V,[degC],\n0,0.5,20.0,1\n1,1.5,20.327,2\n2,2.5,20.618,3\n"
        record = Record.from_csv(write(text), "u", "y", time="t")
        plain(record)
        assert (record.input_units, record.output_units) == (("V",), ("degC",))
        assert (record.time_unit, dict(record.extra_units)) == ("h", {"z": ""})
        given = Record.from_csv(write(text), "u", "y", time="t", input_units="mV", time_unit="s")
        assert (given.input_units, given.time_unit) == (("mV",), "s")

    def test_a_row_of_gaps_or_numbers_is_none(self, write):
        for row in ("NA,NA", "nan,", "1,2"):
            record = Record.from_csv(write(f"y,z\n{row}\n1,2\n"), outputs=["y"], sampling_time=1)
            assert len(record) == 2

    def test_a_column_of_text_is_no_row_of_units(self, write):
        path = write("y,state\n1,open\n2,closed\n")
        with pytest.warns(UserWarning, match="'state'"):
            assert len(Record.from_csv(path, outputs="y", sampling_time=1)) == 2

    def test_on_demand(self, write):
        path = write("y,z\n7,8\n1,2\n")
        record = Record.from_csv(path, outputs="y", units_row=True, sampling_time=1)
        assert (record.output_units, record.outputs.tolist()) == (("7",), [[1.0]])
        path = write("y,z\nm,s\n1,2\n")
        with pytest.raises(ValueError, match="'m' in line 2"):
            Record.from_csv(path, outputs="y", units_row=False, sampling_time=1)


class TestMissing:
    def test_values_that_mark_a_gap(self, write):
        path = write("u;y\n0,5;-9999\n1,5;bad\n2,5;20,618\n3,5;-9999,0\n")
        options = {"outputs": "y", "sampling_time": 1, "extra": None}
        record = Record.from_csv(path, missing=[-9999, "BAD"], **options)
        np.testing.assert_array_equal(record.outputs[:, 0], [np.nan, np.nan, 20.618, np.nan])
        record = Record.from_csv(write("y\n-1\n2\n"), missing="-1", outputs="y", sampling_time=1)
        assert record.missing[:, 0].tolist() == [True, False]

    @pytest.mark.parametrize(
        ("values", "noted"),
        [([20.0, 21.0, 20.5, -9999.0], True), ([20.0, 21.0, 20.5, 999.0, 999.0], True),
         ([9990.0, 9995.0, 9999.0], False), ([20.0, 21.0, -57.0], False),
         ([0.0, 5000.0, 9999.0], False), ([-9999.0, 1.0], False)],
    )  # fmt: skip
    def test_a_value_that_looks_like_one_is_told(self, write, values, noted, recwarn):
        text = "y\n" + "\n".join(map(str, values)) + "\n"
        record = Record.from_csv(write(text), outputs="y", sampling_time=1)
        assert record.outputs[:, 0].tolist() == values
        assert [w for w in recwarn if "missing=[" in str(w.message)] == list(recwarn)
        assert len(recwarn) == noted
        Record.from_frame(pd.DataFrame({"y": values}), outputs="y", sampling_time=1)
        assert len(recwarn) == 2 * noted


class TestDecimals:
    def test_thousands(self, write):
        text = "t;u;y\n0;0,500;1.000,5\n1;1,500;1.001,5\n2;2,500;-12.345.678\n"
        record = advised(write, text, "thousands='.'", "u", "y", time="t")
        assert record.outputs[:, 0].tolist() == [1000.5, 1001.5, -12345678.0]
        text = 't,u,y\n0,0.5,"1,000.5"\n1,1.5,"1,001.5"\n2,2.5,7\n'
        record = advised(write, text, "thousands=','", "u", "y", time="t")
        assert record.outputs[:, 0].tolist() == [1000.5, 1001.5, 7.0]
        record = advised(write, "u;y\n1;1'000.5\n2;2'000\n", "thousands=\"'\"", "u", "y",
                         sampling_time=1)  # fmt: skip
        assert record.outputs[:, 0].tolist() == [1000.5, 2000.0]

    @pytest.mark.parametrize("cell", ["1.00,5", "1.0000", "1.000.00", ".000", "1..000", "1,000.5"])
    def test_groups_that_are_none(self, write, cell):
        with pytest.raises(ValueError, match="column 'y'"):
            Record.from_csv(write(f"u;y\n1;{cell}\n"), outputs="y", thousands=".", sampling_time=1)

    @pytest.mark.parametrize("mark", [",", "."])
    def test_groups_of_three_alone_are_ambiguous(self, write, mark):
        text = "u;y\n1;1,500\n2;2,250\n".replace(",", mark)
        for advice, first in ((f'decimal="{mark}"', 1.5), (f'thousands="{mark}"', 1500.0)):
            record = advised(write, text, advice, "u", "y", sampling_time=1)
            assert record.outputs[0, 0] == first

    @pytest.mark.parametrize("mark", [",", "."])
    @pytest.mark.parametrize("other", ["0,500", "1,5", "-12,5000", ",250", "1,500e2"])
    @pytest.mark.parametrize("row", [1, 70])
    def test_any_number_of_another_form_tells(self, write, mark, other, row):
        rows = ["1;1,500"] * 80
        rows[row] = f"2;{other}"
        text = ("u;y\n" + "\n".join(rows) + "\n").replace(",", mark)
        assert Record.from_csv(write(text), "u", "y", sampling_time=1).outputs[0, 0] == 1.5

    def test_a_point_between_commas_and_tabs_is_a_decimal_mark(self):
        for delimiter in (",", "\t", " "):
            assert decimal_mark(["1.500"], (), delimiter, "file") == "."
        assert decimal_mark(["1", "a"], (), ";", "file") == "."

    def test_values_at_once_are_those_one_by_one(self):
        cells = ["1", "-2.5", "", "1e3", "0.1", " 7 ", "-9999"]
        for form in (Numerals(), Numerals(missing=(-9999.0,))):
            expected = [form.value(cell) for cell in cells]
            np.testing.assert_array_equal(form.values(cells), np.array(expected, float))
        form = Numerals(",")
        assert form.values(["1,5", "2.5"]) is None
        assert form.values(["1,5", "2"]).tolist() == [1.5, 2.0]
        assert Numerals().values(["1", "x"]) is None
        assert Numerals().values(["1_0"]) is None


class TestStamps:
    def read(self, *cells, form=None):
        return read_stamps(cells, range(2, 2 + len(cells)), "t", form)

    @pytest.mark.parametrize(
        ("cells", "expected"),
        [(["25.11.2024 13:45:00", "26.11.2024 01:00:00"], "2024-11-25 13:45"),
         (["01.02.2024 13:45"], "2024-02-01 13:45"),
         (["11/25/2024 01:45:00 PM", "11/25/2024 02:45:00 PM"], "2024-11-25 13:45"),
         (["1/25/2024 1:45 pm"], "2024-01-25 13:45"),
         (["25/11/2024 13:45:00.250"], "2024-11-25 13:45:00.25"),
         (["12/11/2024 00:00", "13/11/2024 00:00"], "2024-11-12"),
         (["2024/11/02 13:45"], "2024-11-02 13:45"),
         (["25-Nov-2024 13:45"], "2024-11-25 13:45"),
         (["11.11.2024"], "2024-11-11"),
         (["11/11/2024 10:00"], "2024-11-11 10:00")],
    )  # fmt: skip
    def test_one_order_reads_them(self, cells, expected):
        assert self.read(*cells)[0] == pd.Timestamp(expected)

    @pytest.mark.parametrize("cell", ["01/02/2024 10:00", "01.02.03 10:00", "05-06-2024"])
    def test_day_and_month_that_cannot_be_told_apart(self, cell):
        with pytest.raises(ValueError, match="day and month can be told apart") as caught:
            self.read(cell)
        forms = re.findall(r'"(%[^"]*)"', str(caught.value))
        assert len(forms) >= 2
        assert len({self.read(cell, form=form)[0] for form in forms}) >= 2

    def test_a_form_that_is_given(self):
        assert self.read("01/02/2024", form="%m/%d/%Y")[0] == pd.Timestamp("2024-01-02")
        assert self.read("20240102 101112", form="%Y%m%d %H%M%S")[0].second == 12
        with pytest.raises(ValueError, match=r"time_format: .*'31/02/2024' in line 3 .1 rows"):
            self.read("01/02/2024", "31/02/2024", form="%d/%m/%Y")
        with pytest.raises(ValueError, match="time_format"):
            self.read("01/02/2024", form="%Q")

    @pytest.mark.parametrize("form", ["%d.%m.%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S"])
    def test_two_ways_of_parsing_agree(self, form):
        stamps = pd.date_range("2023-12-30 22:58:59", periods=200, freq="17h61s")
        cells = list(stamps.strftime(form))
        assert self.read(*cells, form=form).equals(pd.DatetimeIndex(stamps))
        short = [cell.replace("/0", "/").replace(".0", ".") for cell in cells]
        assert self.read(*short, form=form).equals(pd.DatetimeIndex(stamps))
        with pytest.raises(ValueError, match="line 3"):
            self.read(cells[0], cells[0].replace(form[2], "-"), form=form)
        with pytest.raises(ValueError, match="line 3"):
            self.read(cells[0], cells[0].replace("12", "32").replace("30", "32"), form=form)

    def test_forms_that_change(self):
        with pytest.raises(ValueError, match="'2024-11-25 10:00' in column 't', line 3"):
            self.read("25.11.2024 10:00", "2024-11-25 10:00")

    def test_a_row_without_a_header_is_data(self, write):
        path = write("25.11.2024 13:45;1,5\n25.11.2024 13:46;2,5\n")
        record = Record.from_csv(path, outputs="1", time="0", timezone="UTC")
        assert record.outputs[:, 0].tolist() == [1.5, 2.5]


# Quotation marks -> whether each pair of them has one whole cell in it.
QUOTED = {
    '"7","7.5"': True,
    '7,"7.5"': True,
    '"","7.5"': True,
    '"a b","Grüße"': True,
    '"7", 7.5': True,
    '7, "7.5"': False,
    '"7" ,7.5': False,
    '"7,7",7.5': False,
    '","': False,
    '",",","': False,
    '"say ""7""",7.5': False,
    '"7"7,7.5': False,
    '7"7",7.5': False,
    '"""",7.5': False,
    '"7,"7.5"': False,
    '7,"': False,
    '"7\r",7.5': False,
}


@pytest.mark.parametrize("cells", QUOTED)
def test_ways_of_splitting_agree(cells, write, monkeypatch):
    """Lines all alike are split at once, also without their quotation marks, or as csv does."""
    text = '"u","y"\n' + "".join(f'{i},"{i}.5"\n' for i in range(60)) + cells + "\n"
    assert (text_cells.unquoted(text, ",") is not None) == QUOTED[cells]

    def read():
        try:
            table = text_table.read_table(write(text))
            return {name: list(column) for name, column in table.columns.items()}
        except ValueError as error:
            return str(error)

    at_once = read()
    monkeypatch.setattr(text_cells, "unquoted", lambda whole, mark: None)
    assert read() == at_once


def test_short_lines_and_long_ones_agree_with_csv(write):
    text = "u,y\n" + "".join(f"{i}, {i}.5 \n" for i in range(60))
    at_once, filled = (text_table.read_table(write(t)) for t in (text, text + "60\n"))
    assert {name: list(column)[:60] for name, column in filled.columns.items()} == {
        name: list(column) for name, column in at_once.columns.items()
    }
