"""Fits and loops whose processes are killed, in folders where nothing can be written, two at once.

`tests.benchmarks.reliability` does the same at more moments.
"""

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import pyro_dynogp as dgp
from tests.benchmarks.reliability import OPTIONS, ROOT, kills, pairs
from tests.discrepancy.test_loop import FEW, fitted, machine
from tests.inference.cascades import wiener, wiener_record


@pytest.fixture(scope="module")
def whole():
    return dgp.fit(wiener(), wiener_record(), **OPTIONS)


def test_kills_at_random_moments(whole):
    found = kills(2, whole, np.random.default_rng(1))
    assert sum(found.values()) == 2
    assert all("same bits, 0 parts left" in what for what in found), found


def test_two_processes_on_one_folder(whole):
    assert dict(pairs(1, whole)) == {"both done: same bits": 1}


def in_a_process(code, *arguments):
    """Standard error of a program that must end by itself."""
    command = [sys.executable, "-W", "ignore", "-c", code, str(ROOT), *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, env=environment).stderr


FIT = """
import os, resource, sys
import pyro_dynogp as dgp
from tests.benchmarks.reliability import OPTIONS
from tests.inference.cascades import wiener, wiener_record
"""


def test_a_fit_without_room_keeps_what_is_finished_and_goes_on_later(whole, tmp_path):
    """The largest file of a process is limited, as a disk that is full limits it."""
    limited = f"""{FIT}
resource.setrlimit(resource.RLIMIT_FSIZE, (1600, 1600))
dgp.fit(wiener(), wiener_record(), checkpoint=sys.argv[2], **OPTIONS)
"""
    said = in_a_process(limited, tmp_path)
    last = said.strip().splitlines()[-1]
    assert last.startswith("OSError: "), said
    assert f"checkpoint: {tmp_path} cannot be written to" in last
    kept = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.safetensors")}
    assert kept
    assert not list(tmp_path.glob("*.part"))
    resumed = dgp.fit(wiener(), wiener_record(), checkpoint=tmp_path, **OPTIONS)
    assert np.array_equal(resumed.history, whole.history)
    assert all(np.array_equal(resumed.draws[k], whole.draws[k]) for k in whole.draws)
    assert all((tmp_path / name).stat().st_mtime_ns == at for name, at in kept.items())


def test_a_save_without_room_leaves_what_was_there(tmp_path):
    code = f"""{FIT}
fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), wiener_record(n=60), method="map", restarts=1,
              workers=1, progress=False)
fit.save(sys.argv[2])
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
fit.save(sys.argv[2])
"""
    path = tmp_path / "fit.safetensors"
    last = in_a_process(code, path).strip().splitlines()[-1]
    assert last.startswith("ValueError: path: expected a file in an existing folder"), last
    assert "File too large" in last
    assert "The fit is as it was, and so is a file that was there." in last
    assert dgp.load(path).method == "map"
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


NOBODY = """
if os.getuid() == 0:  # root may write anywhere
    os.setuid(65534)
"""


@pytest.mark.skipif(not hasattr(os, "setuid"), reason="users and modes of POSIX")
def test_folders_that_are_read_only_are_told_before_any_work():
    code = f"""{FIT}
os.umask(0)
fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), wiener_record(n=60), method="map", restarts=1,
              workers=1, progress=False)
{NOBODY}
try:
    fit.save(sys.argv[2] + "/fit.safetensors")
except ValueError as error:
    print(error, file=sys.stderr)
dgp.Trajectories.__call__ = None  # nothing need be fitted
dgp.fit(wiener(), wiener_record(), checkpoint=sys.argv[2] + "/kept", **OPTIONS)
"""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o555)
        lines = in_a_process(code, folder).strip().splitlines()
        Path(folder).chmod(0o755)
    (first,) = [line for line in lines if line.startswith("path: expected a file in an existing")]
    assert "Permission denied" in first
    assert lines[-1].startswith(f"PermissionError: [Errno 13] checkpoint: {folder}/kept cannot be")


def children():
    """Processes that loky started for this one, busiest first."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            command = (entry / "cmdline").read_bytes()
        except OSError:  # it has ended
            continue
        if int(fields[1]) == os.getpid() and b"loky.backend.popen_loky" in command:
            found.append((int(fields[11]), int(entry.name)))  # clock ticks in user mode
    return sorted(found, reverse=True)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_a_loop_whose_worker_is_killed_reports_the_same():
    record = machine(weight=0.3)
    fit = fitted(record)

    def report(workers):
        return dgp.close_loop(
            fit, record, effects=FEW, max_rounds=1, progress=False, workers=workers
        )

    killed = []

    def kill():
        until = time.monotonic() + 120.0
        before = {pid: ticks for ticks, pid in children()}  # those of earlier tests work on
        while not killed and time.monotonic() < until:
            busy = [pid for ticks, pid in children() if ticks > before.get(pid, 0) + 50]
            if busy:
                os.kill(busy[0], signal.SIGKILL)
                killed.append(busy[0])
            time.sleep(0.05)

    watch = threading.Thread(target=kill, daemon=True)
    watch.start()
    two = report(2)
    killed_during = list(killed)
    killed.append(0)
    watch.join()
    assert killed_during
    one = report(1)
    for a, b in zip(one.attempts, two.attempts, strict=True):
        assert (a.name, a.decision, a.gain) == (b.name, b.decision, b.gain) or (
            a.decision == b.decision == "not tried"
        )
    assert [e.name for e in one.effects] == [e.name for e in two.effects]
    assert dict(one.after) == dict(two.after)
