"""Run all methods on all experiments, what is missing of it, and write the page.

What finished jobs found is kept with the project, so that a study of many hours can be made in
parts; every row says on which day, with which commit, and on how fast a machine.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tests.benchmarks.circumstances import budget
from tests.benchmarks.kept_rows import append_row, read_rows
from tests.benchmarks.paper.experiments import EXPERIMENTS
from tests.benchmarks.paper.job import METHODS
from tests.benchmarks.paper.ours import STACK
from tests.benchmarks.paper.page import page
from tests.benchmarks.paper.prediction import OURS, folder_name

# Rows of finished jobs, a line each, beside the page that they make; a job whose line is deleted is
# run again.
PICTURES = Path("docs/paper")
KEPT = PICTURES / "rows.jsonl"
KEY = ("experiment", "method", "seed")
# A method is given this many times its budget before it is stopped; it should stop by itself.
GRACE = 4.0


def jobs(
    experiments: Iterable[str] | None = None, methods: Iterable[str] | None = None
) -> list[tuple[str, str, int]]:
    """(experiment, method, seed), all seeds of one method together."""
    return [
        (experiment, method, seed)
        for experiment in (experiments or EXPERIMENTS)
        for method in (methods or METHODS)
        for seed in EXPERIMENTS[experiment].seeds
        if (experiment, method) not in LEFT_OUT
        and EXPERIMENTS[experiment].needs in (None, *os.environ)
    ]


# The second study is for the methods that its criteria name, several records are for those that
# take them; stacking is for short records.
LEFT_OUT = {
    *(("wiener_own", m) for m in METHODS if m not in (OURS, "dynoNet", "GP-NARX")),
    *(("circuit_ten", m) for m in METHODS if m != OURS),
    *((e, STACK) for e in EXPERIMENTS if not e.startswith("drives")),
}


def run(
    folder: Path,
    experiments: Sequence[str] | None = None,
    methods: Sequence[str] | None = None,
) -> str:
    """Do what is missing, one job at a time on the whole machine; tables and figures of all.

    Args:
        folder: for what is predicted and drawn, in ``paper/``.
        experiments, methods: names, all by default.
    """
    base = folder / "paper"
    rows = kept_rows(KEPT)
    missing = [job for job in jobs(experiments, methods) if job not in rows]
    bar = tqdm(missing, desc="paper", disable=not missing)
    for job in bar:
        bar.set_postfix_str(f"{job[1]}, {job[0]}, seed {job[2]}")
        _one(base, job)
        keep(KEPT, json.loads(file_of(base, job).read_text()))
    return page(list(kept_rows(KEPT).values()), base, PICTURES)


def kept_rows(path: Path) -> dict[Any, dict[str, Any]]:
    """What finished jobs have found, in the order of `jobs`."""
    order = {job: place for place, job in enumerate(jobs())}
    rows: dict[Any, dict[str, Any]] = dict(read_rows(path, KEY))
    return dict(sorted(rows.items(), key=lambda one: order.get(one[0], len(order))))


def keep(path: Path, row: dict[str, Any]) -> None:
    """Add the row of a job, figures to six digits."""
    append_row(
        path,
        json.loads(json.dumps(row), parse_float=lambda text: float(f"{float(text):.6g}")),
    )


def file_of(base: Path, job: tuple[str, str, int]) -> Path:
    """Where the result of a job is kept."""
    experiment, method, seed = job
    return base / experiment / folder_name(method) / f"{seed}.json"


def _one(base: Path, job: tuple[str, str, int]) -> None:
    experiment, method, seed = job
    file = file_of(base, job)
    command = [sys.executable, "-m", "tests.benchmarks.paper.job", experiment, method, str(seed)]
    limit = budget(GRACE * EXPERIMENTS[experiment].seconds + 600.0)
    problem: str | None = None
    try:
        done = subprocess.run(
            [*command, str(file)], capture_output=True, text=True, timeout=limit, check=False
        )
        if done.returncode:
            problem = done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "killed"
    except subprocess.TimeoutExpired:
        problem = f"stopped after {limit:.0f} s"
    if problem is not None:
        failed: dict[str, Any] = {"experiment": experiment, "method": method, "seed": seed}
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({**failed, "failed": problem}, indent=1))
