"""Kills at random moments, damaged files and pairs of processes: tests/reliability in length.

`python -m tests.benchmarks reliability` writes a table; it takes a quarter of an hour.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np

import pyro_dynogp as dgp
from tests.benchmarks.markdown import table
from tests.inference.cascades import same, wiener, wiener_record
from tests.reliability.damage import KINDS, damaged, foreign, outcome

ROOT = Path(__file__).parents[2]
OPTIONS = {"restarts": 2, "steps": 24, "particles": 1, "draws": 10, "workers": 1, "progress": False}
SCRIPT = """
import sys
sys.path.insert(0, {root!r})
import pyro_dynogp as dgp
from tests.benchmarks.reliability import OPTIONS
from tests.benchmarks.markdown import table
from tests.inference.cascades import wiener, wiener_record

dgp.fit(wiener(), wiener_record(), checkpoint={folder!r}, **OPTIONS)
"""


def started(folder):
    """A fit in a process of its own."""
    code = SCRIPT.format(root=str(ROOT), folder=str(folder))
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-c", code], stderr=subprocess.PIPE, env=environment, text=True
    )


def resumed(folder):
    """The fit of a folder, in this process."""
    return dgp.fit(wiener(), wiener_record(), checkpoint=folder, **OPTIONS)


def kills(count, whole, generator):
    """So many fits killed at a random time, and what resuming them gives.

    Those that are done before they can be killed do not count.
    """
    with tempfile.TemporaryDirectory() as folder, started(folder) as process:
        _until_it_works(folder, process)
        begin = time.perf_counter()
        process.communicate()
        seconds = time.perf_counter() - begin
    found = Counter()
    while sum(found.values()) < count:
        with tempfile.TemporaryDirectory() as folder, started(folder) as process:
            _until_it_works(folder, process)
            time.sleep(generator.uniform() * seconds)
            process.send_signal(signal.SIGKILL)
            process.communicate()
            if process.returncode != -signal.SIGKILL:
                continue
            pieces = len(list(Path(folder).glob("*.safetensors")))
            verdict = "same bits" if same(resumed(folder), whole) else "OTHER BITS"
            left = len(list(Path(folder).glob("*.part")))
            found[f"{'some' if pieces else 'no'} pieces: {verdict}, {left} parts left"] += 1
    return found


def _until_it_works(folder, process):
    """Wait for the note that a fit writes before any work: imports take longer than the rest."""
    while not (Path(folder) / "run.json").exists() and process.poll() is None:
        time.sleep(0.005)


def pairs(count, whole):
    """Two processes that make the same fit in one folder at once."""
    found = Counter()
    for _ in range(count):
        with tempfile.TemporaryDirectory() as folder:
            both = [started(folder), started(folder)]
            errors = [process.communicate()[1] for process in both]
            ended = all(process.returncode == 0 for process in both)
            verdict = "same bits" if same(resumed(folder), whole) else "OTHER BITS"
            found[f"{'both done' if ended else errors}: {verdict}"] += 1
    return found


def files(count, generator):
    """Damaged model files, and files that nobody wrote with a right digest."""
    short = wiener_record(n=40)
    linear = dgp.LinearDynamicGP(1, pairs=1)
    some = {**OPTIONS, "restarts": 1, "steps": 3}
    fits = {
        "map": dgp.fit(linear, short, restarts=1, workers=1, progress=False),
        "svi": dgp.fit(linear, short, method="svi", **some),
        "bent": dgp.fit(wiener(), short, **some),
        "trajectories": dgp.fit(wiener(), short, guide="gauss-markov", **some),
    }
    hurt, strange = Counter(), Counter()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path, other = Path(folder) / "fit.safetensors", Path(folder) / "other.safetensors"
        for fit in fits.values():
            fit.save(path)
            whole = path.read_bytes()
            for turn in range(count):
                other.write_bytes(damaged(whole, KINDS[turn % len(KINDS)], generator))
                hurt[outcome(other, fit).split(":")[0]] += 1
                foreign(path, generator, other)
                strange[outcome(other, fit).split(":")[0]] += 1
    return hurt, strange


def run(folder: Path) -> str:
    """What became of damaged files, of pairs of processes, and of fits that were killed."""
    del folder
    generator = np.random.default_rng(0)
    hurt, strange = files(300, generator)
    whole = dgp.fit(wiener(), wiener_record(), **OPTIONS)
    found = {
        "damaged files": hurt,
        "files that nobody wrote, with a right digest": strange,
        "two processes that make one fit in one folder": pairs(5, whole),
        "killed at a random moment and started again": kills(30, whole, generator),
    }
    lines = [[what, end, str(n)] for what, ends in found.items() for end, n in ends.items()]
    return table(["what", "how it ended", "times"], lines)
