"""How much the thresholds of the loop decide: stored refits judged again with other values.

`record` closes the loop on development plants and keeps, of the first round, what every refit
gained, sample by sample; which effect is added with a wider and a narrower circle of relatives;
how much a cause outside the catalogue explains; and what tests name with other preferences.
`judge_again` needs no refit. Run `python -m tests.benchmarks thresholds`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import pyro_dynogp as dgp
from pyro_dynogp import LoopSettings
from pyro_dynogp.discrepancy import context, decision, search, state
from pyro_dynogp.discrepancy import refits as refitting
from pyro_dynogp.discrepancy.held_out import certain
from pyro_dynogp.discrepancy.judged import loss_of
from tests.benchmarks.markdown import table
from tests.benchmarks.planted import Case, study

KEPT = Path("docs/planted/refits.development.npz")
PLANTS = tuple(
    Case(effect, strength, 1)
    for effect in ("extra input", "dead time", "output nonlinearity", "saturation", "drift",
                   "level shift", "heavy tails", "heteroscedastic noise", "outside catalogue",
                   "clock shift", "calendar")
    for strength in ("weak", "middle")
)  # fmt: skip
LEVEL = 0.05
VARIED = {
    "gain": (2.0, 8.0),
    "standard_errors": (1.0, 3.0),
    "cap": (5.0, 20.0),
    "harm": (0.025, 0.1),
    "special": (0.025, 0.1),
}
RELATIVE, OUTSIDE, PREFERENCE = (0.6, 0.15, 0.3), (1.0, 2.0, 4.0), (3.0, 1.5, 6.0)
PREFERRING = ("extra input", "calendar", "clock shift")
Rows = list[dict[str, Any]]


@dataclass(frozen=True, eq=False)
class Study:
    """What was recorded, row by row.

    Attributes:
        refits: plant, effect, special_of, gains (N,) of held-out samples [nats], losses (M,) of
            forecasts, empty where structure was added [nats].
        winners: plant, round, relative: its value; name: of the effect added, "" for none;
            candidates: count.
        doubts: plant, effect: that was added; gain: of its test; beyond: that of a cause outside
            the catalogue [nats]; replaces: whether that cause does what the effect does.
        evidence: plant, output, effect, piece: which; preference: its value; p_value; where.
    """

    refits: Rows = field(default_factory=list)
    winners: Rows = field(default_factory=list)
    doubts: Rows = field(default_factory=list)
    evidence: Rows = field(default_factory=list)


def record(plants: tuple[Case, ...] = PLANTS) -> Study:
    """The first round of the loop on each plant."""
    kept = Study()
    quiet = partial(dgp.close_loop, workers=1, progress=False)
    for number, case in enumerate(plants):
        with ExitStack() as patches:
            patches.enter_context(mock.patch.object(dgp, "close_loop", quiet))
            for owner, name, put in _recorders(kept, number):
                patches.enter_context(mock.patch.object(owner, name, put))
            study(case)
    return kept


def _recorders(kept: Study, number: int) -> Iterator[tuple[Any, str, Any]]:
    """Functions of the loop, each with one that does the same and keeps what it came to."""
    Context, Refits = context.SearchContext, refitting.Refits
    judge, run, confirm = refitting.judge, Refits.run, Context.confirm
    doubtful, look = Context.doubtful, Context.look
    judged, done = set[str](), dict[Any, Any]()
    given: list[Any] = []

    def judging(found: Any, kind: Any, tried: Any, base: Any, *rest: Any) -> Any:
        row = {"plant": number, "effect": found.effect.name, "special_of": found.effect.special_of}
        key = f"{row}{found.evidence.where}{kind}"
        if not (tried.failure or base.failure or key in judged):
            losses = loss_of(tried.errors, base.errors) if len(tried.errors) else np.zeros(0)
            kept.refits.append(row | {"gains": tried.densities - base.densities, "losses": losses})
            judged.add(key)
        return judge(found, kind, tried, base, *rest)

    def running(self: Any, tasks: dict[Any, Any], label: str) -> dict[Any, Any]:
        keys = {k: (repr(t.models), t.score, len(t.folds), t.compared) for k, t in tasks.items()}
        new = run(self, {k: t for k, t in tasks.items() if keys[k] not in done}, label)
        done.update({keys[k]: result for k, result in new.items()})
        return {k: done[keys[k]] for k in tasks}

    def choosing(*args: Any) -> Any:
        given[:] = args
        return search.candidates_of(*args[:-1], replace(args[-1], relative=max(RELATIVE)))

    def confirming(self: Any, chosen: Any, current: Any, round_: int, weighed: bool) -> Any:
        for value in RELATIVE:  # the default comes last, and goes on
            chosen = search.candidates_of(*given[:-1], replace(self.settings, relative=value))
            result = confirm(self, chosen, current, round_, weighed) if chosen else None
            name = result.winner.effect.name if result is not None and result.winner else ""
            kept.winners.append(
                {"plant": number, "round": round_, "relative": value, "name": name,
                 "candidates": len(chosen)}
            )  # fmt: skip
        none = decision.Confirmed((), None, replace(current.model, scaling=None), *[None] * 3, ())
        return none if result is None else result

    def doubting(self: Any, winner: Any, residuals: Any, beyond: Any) -> Any:
        settings, self.settings = self.settings, replace(self.settings, outside=1e-9)
        replaces = doubtful(self, winner, residuals, beyond)
        self.settings = settings
        kept.doubts.append(
            {"plant": number, "effect": winner.effect.name, "gain": winner.evidence.gain,
             "beyond": max(one.gain for one in beyond), "replaces": bool(replaces)}
        )  # fmt: skip
        return doubtful(self, winner, residuals, beyond)

    def looking(self: Any, *args: Any) -> Any:
        looked = look(self, *args)
        if not any(row["plant"] == number for row in kept.evidence):
            kept.evidence.extend(_named(self, looked, number))
        return looked

    yield refitting, "judge", judging
    yield Refits, "run", running
    yield state, "candidates_of", choosing
    yield Context, "confirm", confirming
    yield Context, "doubtful", doubting
    yield Context, "look", looking


def _named(rounds: Any, looked: Any, number: int) -> Iterator[dict[str, Any]]:
    """What tests name with each preference."""
    for effect in (e for e in rounds.effects if e.name in PREFERRING):
        for residuals in looked.whole if effect.acts_on == "inputs" else looked.residuals:
            for value in PREFERENCE:
                settings = replace(rounds.settings, preference=value)
                try:
                    pieces = effect.detect(residuals, settings, seed=rounds.seed)
                except ValueError:  # there is nothing to test
                    continue
                for k, one in enumerate(pieces):
                    where = json.dumps(one.where, default=str, sort_keys=True)
                    yield {"plant": number, "output": residuals.output_name, "effect": effect.name,
                           "piece": k, "preference": value, "p_value": one.p_value,
                           "where": where}  # fmt: skip


def save(kept: Study, path: Path = KEPT) -> None:
    """Write a study to a file, gains in single precision."""
    arrays: dict[str, Any] = {}
    for name, rows in vars(kept).items():
        for column in rows[0] if rows else ():
            if column in ("gains", "losses"):
                for k, row in enumerate(rows):
                    arrays[f"{column}/{k}"] = row[column].astype(np.float32)
            else:
                arrays[f"{name}.{column}"] = np.array([row[column] for row in rows])
    np.savez_compressed(path, **arrays)


def load(path: Path = KEPT) -> Study:
    """A study from a file."""
    kept = Study()
    with np.load(path, allow_pickle=False) as file:
        for name, rows in vars(kept).items():
            columns = {
                k.partition(".")[2]: file[k].tolist() for k in file if k.startswith(f"{name}.")
            }
            rows += [
                dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)
            ]
        for k, row in enumerate(kept.refits):
            row.update({of: file[f"{of}/{k}"].astype(float) for of in ("gains", "losses")})
    return kept


def helps(refit: dict[str, Any], settings: LoopSettings) -> bool:
    """Whether a candidate counts as a help."""
    gains, losses = refit["gains"], refit["losses"]
    enough = certain(gains, settings) or certain(np.minimum(gains, settings.cap), settings)
    harms = len(losses) and certain(losses, settings)
    return bool(enough and not (harms and losses.mean() > settings.harm))


def special_ties(refits: Rows, settings: LoopSettings) -> int:
    """Special cases that count as equal to the general effect beside them."""
    pairs = [
        (one["gains"].sum(), other["gains"].sum())
        for one in refits
        for other in refits
        if (one["plant"], one["special_of"]) == (other["plant"], other["effect"])
    ]
    return sum(bool(b - a <= max(settings.gain, settings.special * b)) for a, b in pairs)


def judge_again(kept: Study) -> list[tuple[str, float, int, int]]:
    """For each value of each threshold: how often another one decides otherwise, of how many."""
    refits, default = kept.refits, LoopSettings()
    rows = []
    for name, values in VARIED.items():
        for value in values:
            settings = replace(default, **{name: value})
            changed = sum(helps(one, settings) != helps(one, default) for one in refits)
            if name == "special":
                changed = abs(special_ties(refits, settings) - special_ties(refits, default))
            rows.append((name, value, changed, len(refits)))
    for value in RELATIVE[:-1]:
        pairs = _beside(kept.winners, ("plant", "round"), "relative", value, RELATIVE[-1])
        changed = sum(one["name"] != other["name"] for one, other in pairs)
        rows.append(("relative", value, changed, len(pairs)))
    for value in (OUTSIDE[0], OUTSIDE[2]):
        doubt = [_doubts(kept.doubts, at) for at in (value, OUTSIDE[1])]
        rows.append(("outside", value, len(doubt[0] ^ doubt[1]), len(kept.doubts)))
    certain = [row for row in kept.evidence if row["p_value"] <= LEVEL]
    for value in PREFERENCE[1:]:
        same = ("plant", "output", "effect", "piece")
        pairs = _beside(certain, same, "preference", value, PREFERENCE[0])
        changed = sum(one["where"] != other["where"] for one, other in pairs)
        rows.append(("preference", value, changed, len(pairs)))
    return rows


def _beside(rows: Rows, same: tuple[str, ...], name: str, value: float, usual: float) -> list[Any]:
    """Pairs of rows that differ in one threshold."""
    of = {
        at: {tuple(r[k] for k in same): r for r in rows if r[name] == at} for at in (value, usual)
    }
    return [(of[value][key], row) for key, row in of[usual].items() if key in of[value]]


def _doubts(doubts: Rows, outside: float) -> set[int]:
    """Which effects that were added are doubted."""
    return {
        k for k, row in enumerate(doubts)
        if row["beyond"] > outside * row["gain"] and row["replaces"]
    }  # fmt: skip


def run(folder: Path) -> str:
    """Record what is missing, and tabulate."""
    del folder  # it has no picture
    if not KEPT.exists():
        save(record())
    kept, default = load(), LoopSettings()
    rows = [
        [name, f"{getattr(default, name):g}", f"{value:g}", str(changed), str(count)]
        for name, value, changed, count in judge_again(kept)
    ]
    plants = len({row["plant"] for row in kept.refits})
    head = ["threshold", "default", "instead", "decided otherwise", "of"]
    return f"{len(kept.refits)} refits on {plants} plants.\n\n" + table(head, rows)
