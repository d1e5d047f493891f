"""Blind study of naming effects, on machines that are written apart from the search.

A machine of `tests.discrepancy.machines` is simulated in physical units, a model that lacks the
effects is fitted to the first half of its record, and the loop is closed on the whole of it with
defaults. Other tools look at the same residuals (`naming_peers`). The oracle is the same loop that
looks for the planted effects alone; what it finds more is the cost of search.

    python -m tests.benchmarks naming
    python -m tests.benchmarks naming --seeds 0-1 --kinds motor,tanks --strengths strong

The variables NAMING_SEEDS ("0-4"), NAMING_KINDS, NAMING_STRENGTHS, NAMING_GROUPS and
NAMING_WORKERS choose in the first form. Every case is a line of a file that is kept with the
project; cases that are there are not run again, and delete the file after a change of the search
or of the machines.
"""

from __future__ import annotations

import argparse
import os
import time
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import pyro_dynogp as dgp
from pyro_dynogp.support.parallel import parallel_map
from tests.benchmarks.circumstances import here
from tests.benchmarks.kept_rows import append_row, read_rows
from tests.benchmarks.naming_cases import KEY, Case, Choice, cases_of, choice_of, chosen_by
from tests.benchmarks.naming_peers import peers_of
from tests.benchmarks.naming_table import UNDECLARED, is_right, tables
from tests.discrepancy.machines import Machine, machine, outside, rows_of

KEPT = Path("docs/planted")
SCORES = ("rmse", "mae", "crps", "coverage_50", "coverage_95")
Row = dict[str, Any]


def made(case: Case, samples: int | None = None) -> Machine:
    """The machine of a case.

    Raises:
        ValueError: where it cannot be made with these effects.
    """
    if case.group == "outside":
        return outside(case.seed, strength=case.strength, split=case.split)
    options = {"strength": case.strength} if case.effects else {}
    return machine(
        case.kind, case.seed, effects=case.effects, samples=samples, split=case.split, **options
    )


def planted_alone(one: Machine) -> dict[str, Any]:
    """Options of a loop that looks for the planted effects alone."""
    names = {name for effect in one.effects for name in one.accepted[effect]}
    found = tuple(effect for effect in dgp.effects.CATALOGUE if effect.name in names)
    candidates = [one.channel] if UNDECLARED in one.effects and one.channel else None
    return {"effects": found, "candidates": candidates}


def study(case: Case, samples: int | None = None) -> Row:
    """Make, fit, close the loop, and compare with the truth: one row of the study.

    Failures of the fit or of the loop are results, and in the row; so is a machine that cannot be
    made with these effects.
    """
    try:
        one = made(case, samples)
    except ValueError as error:
        return case.fields | {"unmade": str(error)}
    row = case.fields | truth(one)
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", UserWarning)  # each goes into the row
            row |= _closed(case, one)
    except Exception as error:  # a case that fails is a result: it is counted
        traceback.print_exc()
        return row | {"error": f"{type(error).__name__}: {error}"}
    return row | {"warnings": sorted({str(w.message)[:60] for w in said})}


def oracle(case: Case, samples: int | None = None) -> Row:
    """The row of a case whose loop looks for the planted effects alone."""
    return study(replace(case, oracle=True), samples)


def truth(one: Machine) -> Row:
    """What is true of a machine, as JSON has it."""
    return {
        "planted": list(one.effects),
        "accepted": {effect: list(one.accepted.get(effect, ())) for effect in one.effects},
        "true_channel": one.channel,
        "samples": len(one.record),
        "what": one.kind,
        "model": "with functions" if one.model.has_function else "linear",
    }


def _closed(case: Case, one: Machine) -> Row:
    clocks = [_clocks()]
    fit = dgp.fit(one.model, one.record[: one.training], progress=False, workers=1)
    clocks.append(_clocks())
    options = planted_alone(one) if case.oracle else {}
    report = dgp.close_loop(fit, one.record, seed=0, workers=1, progress=False, **options)
    clocks.append(_clocks())
    row = collect(one, report)
    if not case.oracle:
        row["peers"] = peers_of(fit, one.record, one.training)
    clocks.append(_clocks())
    spent = np.diff(clocks, axis=0)
    stages = ("fit", "loop", "peers")
    row["seconds"] = {name: float(s[0]) for name, s in zip(stages, spent, strict=True)}
    row["cpu_seconds"] = {name: float(s[1]) for name, s in zip(stages, spent, strict=True)}
    return row


def _clocks() -> tuple[float, float]:
    """Wall and CPU seconds."""
    return time.perf_counter(), time.process_time()


def collect(one: Machine, report: Any) -> Row:
    """What a report says, as JSON has it.

    Attempts that were accepted are in the order of the effects that were added; what is only
    reported comes after those, and acts on no channel.
    """
    sealed = report.sealed
    if sealed is None:
        sealed = one.record[3 * len(one.record) // 4 :]
    channels = [a.channel or None for a in report.attempts if a.decision == "accepted"]
    channels += [None] * (len(report.effects) - len(channels))
    scored = {
        when: {k: float(getattr(report, when)[k]) for k in SCORES} for when in ("before", "after")
    }
    return {
        "named": [effect.name for effect in report.effects],
        "channels": channels,
        "p_values": [float(effect.p_value) for effect in report.effects],
        "ties": [list(effect.ties) for effect in report.effects],
        "kept": [bool(effect.kept) for effect in report.effects],
        "outcome": str(report.outcome),
        "headline": str(report.headline),
        "floor": floor_of(one, sealed),
        **scored,
    }


def floor_of(one: Machine, part: dgp.Record) -> float:
    """Error of the noise-free outputs on a part of the record, as reports have it [output].

    Of several outputs it is the mean of their root mean square errors, where `Machine.floor` is
    the root of the mean over all of them.
    """
    squares = np.nanmean((part.outputs - one.noise_free[rows_of(one.record, part)]) ** 2, axis=0)
    return float(np.sqrt(squares).mean())


def _work(task: tuple[Case, Path, float]) -> Row | None:
    """A row, also in the file; None after the time is up."""
    case, path, end = task
    if time.time() > end:
        return None
    row = study(case) | here()
    append_row(path, row)
    return row


def _news(rows: Sequence[Row | None]) -> str:
    done = [row for row in rows if row and "unmade" not in row]
    return f"right {sum(map(is_right, done))} of {len(done)}"


def run(
    folder: Path,
    choice: Choice | None = None,
    workers: int | None = None,
    seconds: float = np.inf,
    kept: Path = KEPT,
    again: bool = False,
) -> str:
    """Run what is missing of the study and tabulate all of it that is there.

    Args:
        folder: of results; tables are the result.
        choice: of cases; None for that of the environment.
        workers: processes; None for NAMING_WORKERS, or all processors.
        seconds: after which no case is begun.
        kept: folder of `naming.<split>.jsonl`, a line for each case.
        again: whether cases that failed are run again.
    """
    choice = chosen_by(os.environ) if choice is None else choice
    workers = int(os.environ.get("NAMING_WORKERS", 0)) or None if workers is None else workers
    path = kept / f"naming.{choice.split}.jsonl"
    wanted, rows = cases_of(choice), read_rows(path, KEY)
    end = time.time() + seconds
    missing = [
        (case, path, end)
        for case in wanted
        if case.key not in rows or (again and "error" in rows[case.key])
    ]
    if missing:
        parallel_map(
            _work, missing, workers=workers, progress=True, description="machines", news=_news
        )
        rows = read_rows(path, KEY)
    both = [replace(case, oracle=of) for case in wanted for of in (False, True)]
    there = sum(case.key in rows for case in wanted)
    found = tables([rows[case.key] for case in both if case.key in rows])
    return f"{there} of the {len(wanted)} cases asked for are there.\n\n{found}"


def main(arguments: Sequence[str]) -> int:
    """Run a part of the study and print the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks naming")
    names = ("seeds", "kinds", "effects", "strengths", "groups")
    for name in names:
        parser.add_argument(f"--{name}")
    parser.add_argument("--split", default="development", choices=("development", "final"))
    parser.add_argument("--oracle", action="store_true")
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--workers", type=int)
    parser.add_argument("--seconds", type=float, default=np.inf)
    parser.add_argument("--kept", type=Path, default=KEPT)
    given = parser.parse_args(arguments)
    words = {name: getattr(given, name) for name in names if getattr(given, name)}
    choice = choice_of(words, given.split, given.oracle)
    print(run(given.kept, choice, given.workers, given.seconds, given.kept, given.again))
    return 0
