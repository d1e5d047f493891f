"""Files that are there whole or not at all."""

import os

import pytest

from pyro_dynogp.support.writing import write_result, write_text, write_whole


def broken(path):
    path.write_text("half")
    raise OSError(28, "No space left on device")


def test_what_was_there_is_there_where_writing_fails(tmp_path):
    path = tmp_path / "page.html"
    write_text(path, "first", "The report")
    with pytest.raises(ValueError, match=r"path: expected .* got .*page.html \(No space left"):
        write_result(path, broken, "The report")
    assert path.read_text() == "first"
    assert os.listdir(tmp_path) == ["page.html"]
    write_text(path, "zweite Fassung: ü", "The report")
    assert path.read_text(encoding="utf-8") == "zweite Fassung: ü"


def test_a_link_stays_one(tmp_path):
    (tmp_path / "there").mkdir()
    target, link = tmp_path / "there" / "fit", tmp_path / "link"
    link.symlink_to(target)
    write_text(link, "one", "The fit")
    assert link.is_symlink()
    assert target.read_text() == "one"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes of POSIX")
def test_a_pipe_stays_one(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    write_text(path, "one", "The table")
    assert os.read(reader, 10) == b"one"
    os.close(reader)
    assert path.is_fifo()


def test_a_name_as_long_as_names_may_be(tmp_path):
    path = tmp_path / ("x" * 250 + ".html")
    write_text(path, "one", "The report")
    assert path.read_text() == "one"


def test_the_mode_is_what_the_mask_says(tmp_path):
    mask = os.umask(0o027)
    try:
        write_whole(tmp_path / "fit", lambda part: part.write_text("one"))
    finally:
        os.umask(mask)
    assert (tmp_path / "fit").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("where", ["absent/fit", ".", "file/fit"])
def test_where_nothing_can_be_written(tmp_path, where):
    (tmp_path / "file").write_text("one")
    with pytest.raises(ValueError, match="path: expected a file in an existing folder"):
        write_text(tmp_path / where, "one", "The fit")
