"""Large files of plain numbers are read at once, to the same bits, or else line by line."""

import numpy as np
import pytest

from pyro_dynogp.data import plain_numbers, text_table
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.text_layout import Layout

ROWS = [f"{k * 0.1!r},{float(np.sin(k))!r},{1e-300 * k!r}" for k in range(60)]
BODY = "\n".join(ROWS) + "\n"
PLAIN = {
    "a header": f"t,u,y\n{BODY}",
    "none": BODY,
    "blank lines": f"\n\nt,u,y\n\n{BODY.replace('1.0,', chr(10) + '1.0,')}\n\n",
    "lines of Windows": f"t,u,y\n{BODY}".replace("\n", "\r\n"),
    "semicolons": f"t;u;y\n{BODY}".replace(",", ";"),
    "tabs": f"t\tu\ty\n{BODY}".replace(",", "\t"),
    "forms of numbers": f"t,u,y\n{BODY}6.0,+1E5,-.5\n6.1,5.,007\n",
    "empty names head a block": f"t,y,\n{BODY}",
    "no last end of line": f"t,u,y\n{BODY[:-1]}",
}
OTHER = {
    "a missing cell": f"t,u,y\n{BODY}6.0,,1\n",
    "a short line": f"t,u,y\n{BODY}6.0,1\n",
    "a short and a long line": f"t,u,y\n{BODY}6.0,1\n6.1,1,2,\n",
    "text": f"t,u,y\n{BODY}6.0,abc,1\n",
    "a word for missing": f"t,u,y\n{BODY}6.0,nan,1\n",
    "true": f"t,u,y\n{BODY}6.0,true,1\n",
    "quotes": f't,u,y\n{BODY}6.0,"1",1\n',
    "comments": f"# from the plant\nt,u,y\n{BODY}",
    "underscores": f"t,u,y\n{BODY}6.0,1_000,1\n",
    "decimal commas": f"t;u;y\n{BODY}".replace(",", ";").replace(".", ","),
    "letters beyond ASCII": f"t,ü,y\n{BODY}",
    "a long line": f"t,u,y\n{BODY}6.0,1,{'0' * 200_000}1\n",
    "too many cells": f"t,u,y\n{BODY}6.0,1,2,3\n",
    "white space": BODY.replace(",", "  "),
    "hexadecimal": f"t,u,y\n{BODY}6.0,0x10,1\n",
    "names that are twice there": f"t,u,u\n{BODY}",
    "infinite": f"t,u,y\n{BODY}6.0,inf,1\n",
}


def read(path, least, monkeypatch):
    monkeypatch.setattr(plain_numbers, "LEAST", least)
    try:
        table = text_table.read_table(path)
        return {name: table.numbers(name) for name in table.columns}, len(table.lines)
    except ValueError as error:
        return str(error)


@pytest.mark.parametrize("name", [*PLAIN, *OTHER])
def test_both_ways_read_the_same(name, tmp_path, monkeypatch):
    path = tmp_path / "file.csv"
    path.write_bytes({**PLAIN, **OTHER}[name].encode())
    fast, slow = (read(path, least, monkeypatch) for least in (0, 2**40))
    if isinstance(slow, str):
        assert fast == slow
        return
    assert fast[1] == slow[1]
    assert list(fast[0]) == list(slow[0])
    for column, values in slow[0].items():
        assert np.array_equal(fast[0][column], values, equal_nan=True)


@pytest.mark.parametrize("name", [*PLAIN, *OTHER])
def test_plain_files_are_read_at_once_and_no_others(name, tmp_path, monkeypatch):
    path = tmp_path / "file.csv"
    path.write_bytes({**PLAIN, **OTHER}[name].encode())
    monkeypatch.setattr(plain_numbers, "LEAST", 0)
    found = text_table._plain_table(path, Layout())
    assert (found is not None) == (name in PLAIN)


@pytest.mark.parametrize("options", [{"decimal": ","}, {"delimiter": "|"}, {"names": ["a", "b"]}])
def test_options_that_do_not_fit_are_left_to_the_other_reader(options, tmp_path, monkeypatch):
    path = tmp_path / "file.csv"
    path.write_text(PLAIN["a header"])
    monkeypatch.setattr(plain_numbers, "LEAST", 0)
    given = {"header": None, "names": None, "delimiter": None, "decimal": None, **options}
    assert text_table._plain_table(path, Layout(**given)) is None


def test_small_and_compressed_files_are_read_line_by_line(tmp_path):
    path = tmp_path / "file.csv"
    path.write_text(PLAIN["a header"])
    assert plain_numbers.whole_file(path) is None
    large = tmp_path / "file.csv.gz"
    large.write_bytes(b"1" * 2**20)
    assert text_table._plain_table(large, Layout()) is None


def test_a_record_of_a_large_file(tmp_path):
    """A hundred thousand rows, to the bits that were written."""
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((2, 100_000))
    lines = [
        f"{k},{a!r},{b!r}" for k, (a, b) in enumerate(zip(u.tolist(), y.tolist(), strict=True))
    ]
    path = tmp_path / "file.csv"
    path.write_text("time,u,y\n" + "\n".join(lines))
    assert plain_numbers.whole_file(path) is not None
    record = Record.from_csv(path, inputs=["u"], outputs=["y"], time="time")
    assert np.array_equal(record.inputs[:, 0], u)
    assert np.array_equal(record.outputs[:, 0], y)
    assert np.array_equal(record.time, np.arange(100_000.0))
