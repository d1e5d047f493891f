"""Kept machine code goes when any source of its package is newer."""

import os

from pyro_dynogp.support.compiled import drop_stale

FUTURE = 4e9


def package(tmp_path, source_time: float, kept_time: float):
    cache = tmp_path / "__pycache__"
    cache.mkdir()
    for path, time in (
        (tmp_path / "a.py", source_time),
        (tmp_path / "b.py", 1000.0),
        (cache / "b.run-1.py311.nbi", kept_time),
        (cache / "b.run-1.py311.1.nbc", kept_time + 5.0),
        (cache / "b.cpython-311.pyc", 900.0),
    ):
        path.write_bytes(b"x")
        # Later than the library's own sources, which count too.
        os.utime(path, (FUTURE + time, FUTURE + time))
    return cache


def test_code_older_than_a_source_goes_with_all_the_rest(tmp_path):
    cache = package(tmp_path, source_time=2003.0, kept_time=2000.0)
    assert len(drop_stale(tmp_path)) == 2
    assert [path.suffix for path in cache.iterdir()] == [".pyc"]


def test_code_newer_than_all_sources_stays(tmp_path):
    cache = package(tmp_path, source_time=1999.0, kept_time=2000.0)
    assert drop_stale(tmp_path) == []
    assert len(list(cache.iterdir())) == 3


def test_no_cache_is_no_error(tmp_path):
    assert drop_stale(tmp_path) == []
