"""When, with which commit, and on how fast a machine a row of a study was made."""

from __future__ import annotations

import shutil
import statistics
import subprocess
import time
from collections.abc import Mapping, Sequence
from datetime import date
from functools import cache
from typing import Any

ADDITIONS = 10_000_000
# What rows depend on; the files that they are kept in change with every row.
CODE = ("pyro_dynogp", "tests", "constraints.txt")
# Seconds of the additions on the machine that budgets of time are meant for.
USUAL = 0.6


@cache
def here() -> dict[str, str | float]:
    """Day, commit, and seconds of a fixed calculation, which tells machines apart.

    The commit is "unknown" outside a repository.
    """
    commit = "unknown"
    if shutil.which("git"):
        commit = _git("describe", "--always") or commit
        if _git("status", "--porcelain", "--", *CODE):
            commit += "-dirty"
    return {"date": f"{date.today()}", "commit": commit, "reference_seconds": reference_seconds()}


@cache
def reference_seconds() -> float:
    """Seconds of ten million additions, the median of three times."""
    return statistics.median(_additions() for _ in range(3))


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], capture_output=True, text=True, check=False)
    return done.stdout.strip()


def budget(seconds: float) -> float:
    """A budget of time on this machine: longer where it is slower than the usual one."""
    return seconds * max(1.0, reference_seconds() / USUAL)


def _additions() -> float:
    begin = time.perf_counter()
    total = 0
    for k in range(ADDITIONS):
        total += k
    return time.perf_counter() - begin


def sentence(rows: Sequence[Mapping[str, Any]]) -> str:
    """Where the rows come from; one that does not say is of an unknown run."""
    runs: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        key = (row.get("date", "unknown day"), row.get("commit", "unknown"))
        runs.setdefault(key, []).append(row.get("reference_seconds", float("nan")))
    found = [
        f"{count} on {day} with commit {commit} (ten million additions took {low:.2g} to "
        f"{high:.2g} s)"
        for (day, commit), seconds in sorted(runs.items())
        for count, low, high in [(len(seconds), min(seconds), max(seconds))]
    ]
    return f"Runs: {'; '.join(found)}."
