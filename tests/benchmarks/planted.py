"""Blind study of closing the loop: which planted effect is named, and what the error comes to.

A plant of `tests.discrepancy.plants` is made, a model that lacks the effect is fitted to the first
half of its record, and the loop is closed on the whole of it; the search sees the record only.
Every case is a line of a file that is kept with the project, so that a study of many hours can be
made in parts; a line says with which commit.
"""

from __future__ import annotations

import itertools
import re
import time
import traceback
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

import pyro_dynogp as dgp
from pyro_dynogp.support.parallel import parallel_map
from tests.benchmarks.circumstances import here
from tests.benchmarks.kept_rows import append_row, read_rows
from tests.benchmarks.planted_table import NOTHING, confusion_picture, is_right, tables
from tests.discrepancy.plants import EFFECTS, STRENGTHS, Plant, Strength, plant

# One round: what is named first, and what adding it brings.
SAMPLES, INDUCING, ROUNDS = 1200, 16, 1
KEPT = Path("docs/planted")
KEY = ("effect", "strength", "replicate", "split")
SCORES = ("rmse", "mae", "crps", "coverage_95")


@dataclass(frozen=True)
class Case:
    """One plant of the study; strength "none" where nothing is planted."""

    effect: str | None
    strength: str
    replicate: int
    split: str = "development"

    @property
    def key(self) -> tuple[str, str, int, str]:
        """What tells it from the others."""
        return (self.effect or NOTHING, self.strength, self.replicate, self.split)


def cases_of(
    replicates: int,
    effects: Sequence[str | None] | None = None,
    split: str = "development",
    strengths: Sequence[Strength] = STRENGTHS,
    kind: str | None = None,
) -> list[Case]:
    """Every effect at every strength, and as many null plants as an effect has plants.

    Sorted by replicate: what there is of an interrupted study is balanced. With a kind ("linear",
    "wiener") replicates are the first plants whose model to start from is of that kind.
    """
    chosen = (None, *EFFECTS) if effects is None else effects
    count = len(strengths)
    found = []
    for effect in chosen:
        many = count * replicates if effect is None else replicates
        levels = ("none",) if effect is None else strengths
        for level in levels:
            plants = range(20 * many) if kind else range(many)
            suited = (n for n in plants if kind is None or _kind(effect, level, n, split) == kind)
            numbers = itertools.islice(suited, many)
            order = [k // count if effect is None else k for k in range(many)]
            found += [
                (k, Case(effect, level, n, split)) for k, n in zip(order, numbers, strict=False)
            ]
    return [case for _, case in sorted(found, key=lambda one: one[0])]


def _kind(effect: str | None, level: str, number: int, split: str) -> str:
    strength = cast(Strength, "middle" if effect is None else level)
    return str(plant(effect, strength, number, samples=SAMPLES, split=split).base["kind"])


def base_model(base: Mapping[str, Any], inputs: int) -> Any:
    """The model to start from, not yet fitted."""
    options = {"pairs": base["pairs"], "process_noise": base["process_noise"]}
    if base["kind"] == "wiener":
        return dgp.Wiener(inputs, inducing=INDUCING, **options)
    return dgp.LinearDynamicGP(inputs, **options)


def study(case: Case, samples: int = SAMPLES) -> dict[str, Any]:
    """Fit, close the loop, and compare with the truth: one row of the study."""
    strength = cast(Strength, "middle" if case.effect is None else case.strength)
    made = plant(case.effect, strength, case.replicate, samples=samples, split=case.split)
    begin = time.perf_counter()
    train = made.record[: samples // 2]
    model = base_model(made.base, made.record.n_inputs)
    fit = dgp.fit(model, train, restarts=3, progress=False, workers=1)
    fitted = time.perf_counter() - begin
    report = dgp.close_loop(fit, made.record, seed=0, max_rounds=ROUNDS)
    seconds = {"fit": fitted, "loop": time.perf_counter() - begin - fitted}
    return collect(case, made, report) | {"seconds": seconds}


def collect(case: Case, made: Plant, report: Any) -> dict[str, Any]:
    """What a report says, beside what is true, as JSON has it.

    Effects that are only reported (a loop cannot be mended by a block) are kept apart.
    """
    sealed = getattr(report, "sealed", None)
    if sealed is None:
        sealed = made.record[3 * len(made.record) // 4 :]
    attempts = [a for a in getattr(report, "attempts", ()) if a.decision == "reported"]
    scored = {}
    for name in ("before", "after"):
        found = getattr(report, name)
        scored[name] = {k: float(found[k]) for k in SCORES if k in found}
    return {
        **asdict(case),
        "effect": case.effect or NOTHING,
        "base": made.base["kind"],
        "named": [one.name for one in report.effects],
        "p_values": [float(one.p_value) for one in report.effects],
        "sentences": [one.sentence for one in report.effects],
        "channels": [channel_of(one, made.record.extra) for one in report.effects],
        "ties": sorted({tie for one in report.effects for tie in getattr(one, "ties", ())}),
        "reported": list(dict.fromkeys(a.name for a in attempts)),
        "true_channel": made.truth.get("channel"),
        "outcome": str(report.outcome),
        "floor": made.floor(sealed),
        **scored,
    }


def channel_of(effect: Any, names: Iterable[str]) -> str | None:
    """The extra channel that an effect speaks of, or None."""
    text = f"{effect.sentence} {getattr(effect, 'block', '')}"
    return next((n for n in names if re.search(rf"(?<!\w){re.escape(n)}(?!\w)", text)), None)


def _work(task: tuple[Case, Path]) -> dict[str, Any]:
    case, path = task
    try:
        row = study(case) | here()
    except Exception as error:  # a case that fails is a result: it is counted, and tried again
        traceback.print_exc()
        row = {**asdict(case), "effect": case.effect or NOTHING}
        row["error"] = f"{type(error).__name__}: {error}"
    append_row(path, row)
    return row


def _news(rows: Sequence[Mapping[str, Any]]) -> str:
    done = [row for row in rows if "error" not in row]
    right = np.mean([is_right(row) for row in done]) if done else 0.0
    return f"right {right:.0%}, failed {len(rows) - len(done)}"


def run(
    folder: Path,
    replicates: int = 5,
    effects: Sequence[str | None] | None = None,
    workers: int | None = None,
    split: str = "development",
    strengths: Sequence[Strength] = STRENGTHS,
    kind: str | None = None,
    kept: Path = KEPT,
) -> str:
    """Run what is missing of the study and tabulate all of it.

    Args:
        folder: for `confusion.png`.
        replicates: plants of each effect and strength, and of each strength as many null plants.
        effects: names, None among them for null plants; by default all.
        workers: processes, None for all processors.
        split: "development", or "final" for the plants that nothing was tuned on.
        strengths: that are planted. kind: of the models to start from, "linear" or "wiener".
        kept: folder of `planted.<split>.jsonl`, a line for each case; delete it after a change of
            the search or of the plants.
    """
    path = kept / f"planted.{split}.jsonl"
    wanted = cases_of(replicates, effects, split, strengths, kind)
    rows: dict[Any, dict[str, Any]] = {
        key: row for key, row in read_rows(path, KEY).items() if "error" not in row
    }
    missing = [(case, path) for case in wanted if case.key not in rows]
    if missing:
        new = parallel_map(
            _work, missing, workers=workers, progress=True, description="plants", news=_news
        )
        rows |= {case.key: row for (case, _), row in zip(missing, new, strict=True)}
    chosen = [rows[case.key] for case in wanted]
    confusion_picture(chosen, folder / "confusion.png")
    return tables(chosen)
