"""Run the benchmarks and write one results page: ``make benchmark``, or with names of parts.

Options after the name of a part that has some are its own: `naming --seeds 0-1 --kinds motor`.
"""

from __future__ import annotations

import platform
import sys
import time
from pathlib import Path

import joblib
import numba
import torch

from tests.benchmarks import (
    brute_force,
    calibration,
    calibration_tests,
    cascade_cost,
    cascade_loo,
    coverage,
    criticism,
    electricity,
    example2,
    feedback_plants,
    filter,
    first_use,
    fits,
    forward_fits,
    guides,
    leaderboard,
    loop_cost,
    measured,
    naming,
    package,
    planted,
    reference,
    reliability,
    selection,
    slow_pages,
    speed,
    textbook,
    thresholds,
    wiener,
)
from tests.benchmarks.paper import growth
from tests.benchmarks.paper import run as paper

PARTS = {
    "speed": speed.run,
    "first_use": first_use.run,
    "fits": fits.run,
    "forward_fits": forward_fits.run,
    "example2": example2.run,
    "wiener": wiener.run,
    "feedback": feedback_plants.run,
    "filter": filter.run,
    "leaderboard": leaderboard.run,
    "cascade_cost": cascade_cost.run,
    "guides": guides.run,
    "electricity": electricity.run,
    "reference": reference.run,
    "calibration": calibration.run,
    "criticism": criticism.run,
    "calibration_tests": calibration_tests.run,
    "coverage": coverage.run,
    "selection": selection.run,
    "brute_force": brute_force.run,
    "cascade_loo": cascade_loo.run,
    "planted": planted.run,
    "naming": naming.run,
    "textbook": textbook.run,
    "thresholds": thresholds.run,
    "measured": measured.run,
    "loop_cost": loop_cost.run,
    "paper": paper.run,
    "growth": growth.run,
    "reliability": reliability.run,
    "slow_pages": slow_pages.run,
    "package": package.run,
}

# Parts that read options of their own.
WITH_OPTIONS = {"naming": naming.main}


def main(names: list[str]) -> int:
    if len(names) > 1 and names[0] in WITH_OPTIONS and names[1].startswith("-"):
        return WITH_OPTIONS[names[0]](names[1:])
    unknown = set(names) - set(PARTS)
    if unknown:
        print(f"Unknown parts {sorted(unknown)}; there are {', '.join(PARTS)}.", file=sys.stderr)
        return 2
    folder = Path("benchmark_output")
    folder.mkdir(exist_ok=True)
    for name in names or PARTS:
        begin = time.perf_counter()
        text = PARTS[name](folder)
        minutes = (time.perf_counter() - begin) / 60
        head = (
            f"Python {platform.python_version()}, torch {torch.__version__}, "
            f"numba {numba.__version__}, {joblib.cpu_count()} processors; "
            f"this part took {minutes:.1f} minutes.\n\n"
        )
        (folder / f"{name}.md").write_text(f"## {name}\n\n{head}{text}\n")
        print((folder / f"{name}.md").read_text())
    page = "\n".join((folder / f"{n}.md").read_text() for n in PARTS if
                     (folder / f"{n}.md").exists())  # fmt: skip
    (folder / "results.md").write_text(f"# Benchmark results\n\n{page}")
    print(f"Written: {folder / 'results.md'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
