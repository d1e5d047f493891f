"""A disk that is full: a small one, mounted for one process alone."""

import json
import os
import shutil
import subprocess
import sys

import pytest

from tests.benchmarks.reliability import ROOT

# Mounted in a name space of its own, which ends with the process, and the disk with it.
MOUNTED = 'mount -t tmpfs -o size="$0" tmpfs "$1" && shift && exec "$@"'


def allowed(folder):
    """Why no disk can be mounted here; nothing where it can."""
    if shutil.which("unshare") is None:
        return "there is no unshare(1)"
    command = ["unshare", "--map-root-user", "--mount", "sh", "-c", MOUNTED, "512k", str(folder)]
    done = subprocess.run([*command, "true"], capture_output=True, text=True)
    return "" if done.returncode == 0 else done.stderr.strip() or "unshare is not permitted"


def on_a_disk(size, folder, code):
    """What a program prints, as JSON, that has a disk of a size at `folder`."""
    why = allowed(folder)
    if why:
        pytest.skip(f"a small disk cannot be mounted here: {why}")
    command = ["unshare", "--map-root-user", "--mount", "sh", "-c", MOUNTED, size, str(folder)]
    command += [sys.executable, "-W", "ignore", "-c", BEGIN + code, str(folder)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


BEGIN = """
import json, os, sys, tempfile
from pathlib import Path

import numpy as np

import pyro_dynogp as dgp
from tests.benchmarks.reliability import OPTIONS
from tests.discrepancy import reports
from tests.inference.cascades import wiener, wiener_record

disk, said = Path(sys.argv[1]), {}


def fill(left):
    "Leave so many bytes of the disk."
    filler = disk / "filler"
    filler.unlink(missing_ok=True)
    room = os.statvfs(disk)
    filler.write_bytes(bytes(room.f_bavail * room.f_frsize - left))


def attempt(name, call):
    try:
        call()
    except (ValueError, OSError) as error:
        said[name] = f"{type(error).__name__}: {error}"


def files():
    return sorted(path.name for path in disk.rglob("*") if path.name != "filler")
"""


def test_a_fit_that_there_is_no_room_for_is_not_lost_nor_what_was_there(tmp_path):
    found = on_a_disk("512k", tmp_path, """
options = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
first, second = (dgp.fit(dgp.LinearDynamicGP(1, pairs=p), wiener_record(n=60), **options)
                 for p in (1, 2))
path = disk / "fit.safetensors"
first.save(path)
fill(4096)
attempt("over a file", lambda: second.save(path))
attempt("new", lambda: second.save(disk / "new.safetensors"))
said["files"] = files()
said["kept"] = len(dgp.load(path).modes.poles)
elsewhere = Path(tempfile.mkdtemp()) / "fit.safetensors"
second.save(elsewhere)
said["elsewhere"] = len(dgp.load(elsewhere).modes.poles)
print(json.dumps(said))
""")  # fmt: skip
    for name, path in (("over a file", "fit"), ("new", "new")):
        assert found[name].startswith("ValueError: path: expected a file in an existing folder")
        assert f"{tmp_path}/{path}.safetensors" in found[name]
        assert "No space left on device" in found[name]
        assert "The fit is as it was, and so is a file that was there." in found[name]
    assert found["files"] == ["fit.safetensors"]
    assert (found["kept"], found["elsewhere"]) == (1, 2)


def test_a_checkpointed_fit_goes_on_once_there_is_room(tmp_path):
    found = on_a_disk("512k", tmp_path, """
def run(**where):
    return dgp.fit(wiener(), wiener_record(), **where, **OPTIONS)


whole, kept = run(), disk / "kept"
fill(24 * 1024)
attempt("full", lambda: run(checkpoint=kept))
before = {path.name: path.stat().st_mtime_ns for path in kept.glob("*.safetensors")}
said["before"], said["files"] = len(before), files()
(disk / "filler").unlink()
resumed = run(checkpoint=kept)
said["same"] = bool(np.array_equal(resumed.history, whole.history)) and all(
    np.array_equal(resumed.draws[name], draws) for name, draws in whole.draws.items())
said["used"] = all((kept / name).stat().st_mtime_ns == at for name, at in before.items())
print(json.dumps(said))
""")  # fmt: skip
    assert found["full"].startswith("OSError: "), found
    assert f"checkpoint: {tmp_path}/kept cannot be written to (No space left" in found["full"]
    assert found["before"] > 0
    assert not [name for name in found["files"] if name.endswith(".part")]
    assert found["same"]
    assert found["used"]


def test_a_report_that_there_is_no_room_for_leaves_the_one_before(tmp_path):
    found = on_a_disk("8m", tmp_path, """
report = reports.report()
page, numbers = disk / "report.html", disk / "report.json"
report.to_html(page)
report.to_json(numbers)
before = page.read_bytes(), numbers.read_bytes()
fill(0)
attempt("page", lambda: report.to_html(page))
attempt("numbers", lambda: report.to_json(numbers))
said["kept"] = (page.read_bytes(), numbers.read_bytes()) == before
said["files"] = files()
print(json.dumps(said))
""")  # fmt: skip
    for name, path in (("page", "report.html"), ("numbers", "report.json")):
        assert found[name].startswith("ValueError: path: expected a file in an existing folder")
        assert f"{tmp_path}/{path} (No space left on device)" in found[name]
        assert "The report is as it was, and so is a file that was there." in found[name]
    assert found["kept"]
    assert found["files"] == ["report.html", "report.json"]
