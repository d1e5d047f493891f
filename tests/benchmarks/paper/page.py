"""Tables and figures of the comparison, from the rows that jobs have left."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import pyro_dynogp as dgp
from tests.benchmarks.circumstances import USUAL, sentence
from tests.benchmarks.markdown import table
from tests.benchmarks.paper.bound import System, clean_error_bound
from tests.benchmarks.paper.experiments import EXPERIMENTS, Experiment
from tests.benchmarks.paper.figures import (
    complete_seeds,
    experiment_figure,
    predictions_file,
    study_figure,
)
from tests.benchmarks.paper.prediction import OURS

Row = Mapping[str, Any]
# Column -> score, and whether it carries the output's unit.
COLUMNS = {"RMSE": "rmse", "MAE": "mae", "CRPS": "crps", "coverage 95 %": "coverage_95",
           "log density": "log_density"}  # fmt: skip
STUDY_COLUMNS = {"RMSE / floor": "rmse_over_floor", "clean RMSE / floor": "clean_over_floor",
                 "CRPS / floor": "crps_over_floor", "coverage 95 %": "coverage_95",
                 "MAE, first 150": "first_over_floor",
                 "MAE, after": "after_over_floor"}  # fmt: skip
PUBLISHED = ("dynoGP, published", "dynoNet, published", "GP-NARX, published")


def page(rows: Sequence[Row], folder: Path, pictures: Path) -> str:
    """One section for each experiment that has rows.

    Args:
        rows: of finished jobs. folder: of what they predicted. pictures: folder for figures; that
            of an experiment is drawn again where the predictions of all of its jobs are there.
    """
    parts = [
        "Peers may learn for an experiment's budget of wall time (longer by as much as the "
        f"machine is slower than one that does ten million additions in {USUAL} s), and stop "
        "before where they gain no more; pyro_dynogp runs with its default settings, whatever time "
        "they take. Some settings of the peers were chosen with a look at test scores of the "
        "second drives and of two simulated systems, which is in their favour. Tests are free "
        "runs: no test output is seen. A cell is the median over seeds, with the range in "
        "brackets; the CRPS of a point prediction is its MAE."
    ]
    for key, experiment in EXPERIMENTS.items():
        own = [row for row in rows if row["experiment"] == key]
        if own:
            parts += _section(experiment, own, folder / key, pictures / f"{key}.png")
    return "\n\n".join(parts)


def _section(experiment: Experiment, rows: Sequence[Row], folder: Path, picture: Path) -> list[str]:
    unit = f" Unit: {experiment.unit}." if experiment.unit else ""
    parts = [
        f"### {experiment.name}",
        f"{experiment.note}{unit} Budget {experiment.seconds / 60:.3g} minutes, "
        f"{len(experiment.seeds)} seed(s).".strip(),
    ]
    done = [row for row in rows if "failed" not in row]
    names = list(dict.fromkeys(name for row in done for name in row["scores"]))
    for name in names:
        if len(names) > 1:
            parts.append(f"Test record: {name}.")
        parts.append(_table(experiment, done, name, published=name == names[0]))
    parts += [_costs(done), sentence(done)] if done else []
    parts += _targets(experiment, done)
    if experiment.system is not None:
        parts += _against_peers(done, experiment.system)
    parts += _notes(rows)
    if experiment.simulated:
        if done and all(predictions_file(folder, row).exists() for row in done):
            study_figure(experiment, done, folder, picture)
    elif complete_seeds(done, folder):
        experiment_figure(experiment, done, folder, picture)
    if picture.exists():
        parts.append(f"![{experiment.name}]({picture.parent.name}/{picture.name})")
    return parts


def values_of(rows: Sequence[Row], method: str, test: str, score: str) -> np.ndarray:
    """A score of one method over its seeds."""
    return np.array([_score(row["scores"][test], score) for row in rows if row["method"] == method])


def _score(found: Mapping[str, float], score: str) -> float:
    """A score; in units of the noise floor where its name says so."""
    floor = found.get("floor", math.nan)
    derived = {
        "clean_over_floor": ("rmse_clean", floor),
        "first_over_floor": ("mae_first_150", floor * math.sqrt(2.0 / math.pi)),
        "after_over_floor": ("mae_after", floor * math.sqrt(2.0 / math.pi)),
        "crps_over_floor": ("crps", floor / math.sqrt(math.pi)),
    }
    if score in derived:
        name, scale = derived[score]
        return found.get(name, math.nan) / scale
    return found.get(score, math.nan)


def _methods(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row["method"] for row in rows))


def _table(experiment: Experiment, rows: Sequence[Row], test: str, published: bool) -> str:
    columns = STUDY_COLUMNS if experiment.simulated else COLUMNS
    lines = [["method", *columns]]
    for method in _methods(rows):
        cells = [spread(values_of(rows, method, test, score)) for score in columns.values()]
        lines.append([method, *cells])
    if published and experiment.paper:
        for place, name in enumerate(PUBLISHED):
            cells = [
                number(experiment.paper[score][place]) if score in experiment.paper else ""
                for score in columns.values()
            ]
            lines.append([name, *cells])
    return table(lines[0], lines[1:])


def _costs(rows: Sequence[Row]) -> str:
    lines = [["method", "learning [s]", "iterations", "one pass over the record [s]",
              "per 1000 samples [s]", "peak memory [GB]"]]  # fmt: skip
    for method in _methods(rows):
        own = [row for row in rows if row["method"] == method]
        passes = np.array([row["step_seconds"] for row in own], dtype=float)
        length = np.array([_length(row["experiment"]) for row in own], dtype=float)
        lines.append([
            method,
            spread(np.array([row["seconds"] for row in own])),
            spread(np.array([row["steps"] or math.nan for row in own], dtype=float)),
            spread(passes),
            spread(1000.0 * passes / length),
            spread(np.array([row["memory_gb"] for row in own])),
        ])  # fmt: skip
    return table(lines[0], lines[1:])


LENGTHS: dict[str, int] = {}


def _length(experiment: str) -> int:
    if experiment not in LENGTHS:
        one = EXPERIMENTS[experiment]
        train = one.load(one.seeds[0])[0]
        records = (train,) if isinstance(train, dgp.Record) else train
        LENGTHS[experiment] = sum(len(record) for record in records)
    return LENGTHS[experiment]


def _targets(experiment: Experiment, rows: Sequence[Row]) -> list[str]:
    """What the project set out to reach, and what it came to, in a line each."""
    own = [row for row in rows if row["method"] == OURS]
    if not own or not experiment.targets:
        return []
    tests = list(own[0]["scores"])
    lines = []
    for target, limit in experiment.targets.items():
        score, _, test = target.partition(" ")
        found = float(np.median(values_of(own, OURS, test or tests[0], score)))
        verdict = "reached" if found <= limit else f"not reached, {found / limit - 1.0:.1%} above"
        where = f" ({test})" if test else ""
        name = _name(score) if experiment.simulated else score.upper()
        lines.append(f"- {name}{where}: {found:.4g}, target {number(limit)}: {verdict}.")
    return ["Targets, from default settings:", "\n".join(lines)]


def _name(score: str) -> str:
    """As the study's table has it."""
    return next(name for name, own in STUDY_COLUMNS.items() if own == score)


# Score, the peer it is set against, and the most that the median of the ratios should be.
RIVALS = (("clean_over_floor", "dynoNet", 0.7), ("first_over_floor", "dynoNet", 1.0),
          ("crps_over_floor", "GP-NARX", 1.0))  # fmt: skip


def _against_peers(rows: Sequence[Row], system: Callable[[int], System]) -> list[str]:
    """Seed by seed beside a peer, and beside what can be known at all."""
    found = {(row["method"], row["seed"]): row["scores"]["test"] for row in rows if row["scores"]}
    seeds = sorted(seed for method, seed in found if method == OURS)
    lines = []
    for score, peer, limit in RIVALS:
        common = [seed for seed in seeds if (peer, seed) in found]
        ratios = [
            _score(found[OURS, seed], score) / _score(found[peer, seed], score) for seed in common
        ]
        if ratios:
            lines.append(
                f"- {_name(score)} over that of {peer}, {len(common)} seeds: "
                f"{spread(np.array(ratios))}, target {number(limit)}."
            )
    if seeds:
        bounds = np.array([clean_error_bound(system(seed)) for seed in seeds])
        own = np.array([_score(found[OURS, seed], "clean_over_floor") for seed in seeds])
        lines.append(
            f"- Cramer-Rao bound of the clean RMSE / floor, if all except the response to "
            f"the inputs were given: {spread(bounds)}, which is an RMSE / floor of "
            f"{number(float(np.median(np.sqrt(1.0 + bounds**2))))} in the median; the clean RMSE "
            f"is {spread(own / bounds)} times the bound."
        )
    return ["\n".join(lines)] if lines else []


def _notes(rows: Sequence[Row]) -> list[str]:
    """Of each method what its first run notes, in how many runs it was otherwise, and failures."""
    notes: dict[str, list[str]] = {}
    found = []
    for row in rows:
        if row.get("note"):
            notes.setdefault(row["method"], []).append(row["note"])
        if "failed" in row:
            found.append(f"- {row['method']}, seed {row['seed']}: failed, {row['failed']}")
    for method, own in notes.items():
        others = sum(note != own[0] for note in own)
        more = f" (other runs: {others} of {len(own)} otherwise)" if others else ""
        found.append(f"- {method}: {own[0]}{more}")
    return ["\n".join(found)] if found else []


def number(value: float) -> str:
    """Three significant digits; nothing for what is not there."""
    if not math.isfinite(value):
        return ""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def spread(values: np.ndarray) -> str:
    """Median, and the range where there are several; nothing where there are none."""
    values = values[np.isfinite(values)]
    if not len(values):
        return ""
    middle = number(float(np.median(values)))
    if len(values) == 1:
        return middle
    return f"{middle} ({number(float(values.min()))} to {number(float(values.max()))})"
