"""What counts as named, and the tables of the study of naming, from its rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from pyro_dynogp.effects.base import OUTSIDE
from tests.benchmarks.circumstances import sentence
from tests.benchmarks.markdown import table
from tests.benchmarks.planted_table import interval, relied_on

Row = Mapping[str, Any]
UNDECLARED = "undeclared input"
STRENGTHS = ("weak", "middle", "strong", "none")
PLANTED_GROUPS = ("single", "two", "three")
# RMSE after over that before, on the last block, above which a loop did harm.
HARM = 1.05
PEERS = (
    "Bands ask for a noise model (counted as process noise), a plant model (unmodelled dynamics) "
    "or say feedback; indicators find steps (level shift) and outliers (heavy tails). They have no "
    "words for other effects: that they say anything is what to compare there. Indicators at "
    "1 / n keep one impulse of white noise by chance."
)


def names_of(row: Row) -> list[tuple[str, str | None]]:
    """Names with their channels, of the effects that a report ends with.

    What an early round reported and an added effect explains (a wrong clock looks like feedback) is
    none. Empty where the fit or the loop failed.
    """
    return list(zip(row.get("named", ()), row.get("channels", ()), strict=True))


def says(row: Row, effect: str, name: str, channel: str | None) -> bool:
    """Whether a name says a planted effect; of an undeclared input the channel has to be right."""
    if effect == UNDECLARED and (channel is None or channel != row["true_channel"]):
        return False
    return name in row["accepted"].get(effect, ())


def right(row: Row) -> list[str]:
    """Planted effects that were named. One name may say several of them: one block has both."""
    return [e for e in row["planted"] if any(says(row, e, *pair) for pair in names_of(row))]


def tied(row: Row) -> list[str]:
    """Planted effects that were not named, but that are among the ties of a name."""
    ties = {tie for several in row.get("ties", ()) for tie in several}
    named = right(row)
    return [e for e in row["planted"] if e not in named and ties & set(row["accepted"].get(e, ()))]


def superfluous(row: Row) -> list[str]:
    """Names that say no planted effect, and have none among their ties.

    A decoy is called so. A second name for the same effect (two missing pairs) is not superfluous.
    """
    accepted = {name for names in row["accepted"].values() for name in names}
    found = []
    for k, (name, channel) in enumerate(names_of(row)):
        ties = row["ties"][k] if k < len(row.get("ties", ())) else ()
        if any(says(row, effect, name, channel) for effect in row["planted"]):
            continue
        if not accepted & set(ties):
            found.append(f"{name} ({channel})" if channel else name)
    return found


def is_right(row: Row) -> bool:
    """Whether every planted effect was named, and nothing beside; of nothing, nothing named.

    Of what is outside the catalogue that structure is left, or that it is a tie of what was named.
    """
    if "error" in row:
        return False
    if row["group"] == "outside":
        return says_outside(row)
    return len(right(row)) == len(row["planted"]) and not superfluous(row)


def says_outside(row: Row) -> bool:
    """Whether a report leaves the cause open: nothing named, or a cause outside as a tie."""
    if row["named"]:
        return any(OUTSIDE in ties for ties in row["ties"])
    return "structure left" in row["outcome"]


def share(count: int, total: int) -> str:
    """Count, total and share."""
    return f"{count} of {total} ({100.0 * count / total:.0f} %)" if total else "-"


def tables(rows: Sequence[Row]) -> str:
    """All tables as one Markdown text."""
    made = [row for row in rows if "unmade" not in row]
    ours = [row for row in made if not row["oracle"]]
    done = [row for row in ours if "error" not in row]
    several = [row for row in ours if row["group"] in PLANTED_GROUPS]
    failed = sum("error" in row for row in made)
    parts = [
        f"{len(made)} cases, {failed} of them failed, which count as not named; "
        f"{len(rows) - len(made)} more could not be made. {sentence(made)}",
        "### Nothing planted", _gauge_table(ours),
        "### One effect: how often it is named", _potency_table(ours),
        "### All effects of a machine", _set_table(several),
        "### Errors on the last block, and time", _error_table(done),
        "### Outside the catalogue", _outside_table(done),
        "### Cost of search", _search_table(made),
        "### Other tools on the same residuals", PEERS, _peer_table(done),
        "### Superfluous names", _wrong_table(done),
    ]  # fmt: skip
    reasons = Counter(str(row["error"]) for row in made if "error" in row)
    reasons += Counter(f"not made: {row['unmade']}" for row in rows if "unmade" in row)
    if reasons:
        parts += ["### Failed", *(f"- {count} x {text}" for text, count in reasons.most_common())]
    return "\n\n".join(parts)


def _gauge_table(rows: Sequence[Row]) -> str:
    null = [row for row in rows if row["group"] == "null" and not row.get("planted")]
    lines = []
    for kind, own in [*_by(null, lambda row: row["kind"]), ("all", null)]:
        named = sum(bool(names_of(row)) for row in own)
        left = sum("structure left" in row.get("outcome", "") for row in own)
        low, high = interval(named, len(own))
        bounds = f"{100 * low:.1f} to {100 * high:.1f} %"
        lines.append([kind, share(named, len(own)), bounds, share(left, len(own))])
    return table(["machine", "anything named", "95 % interval", "structure left"], lines)


def _potency_table(rows: Sequence[Row]) -> str:
    single = [row for row in rows if row["group"] == "single"]
    head = ["effect", "strength", "cases", "named", "95 % interval", "named alone", "tie",
            "nothing named", "superfluous names", "after / floor", "90th percentile"]  # fmt: skip
    lines = []
    for effect, of_effect in [*_by(single, lambda row: row["effects"]), ("all", single)]:
        groups = [*_by(of_effect, lambda row: row["strength"], STRENGTHS), ("all", of_effect)]
        for strength, own in groups:
            count = sum(_named(row, effect) for row in own)
            low, high = interval(count, len(own))
            lines.append([
                effect, strength, str(len(own)), share(count, len(own)),
                f"{100 * low:.0f} to {100 * high:.0f} %", str(sum(map(is_right, own))),
                str(sum(bool(tied(row)) for row in own)),
                str(sum(not names_of(row) for row in own)),
                str(sum(len(superfluous(row)) for row in own)), *_over_floor(own),
            ])  # fmt: skip
    return table(head, lines)


def _named(row: Row, effect: str) -> bool:
    """Whether an effect was named; whichever was planted, where "all" are counted."""
    return (row["effects"] if effect == "all" else effect) in right(row)


def _set_table(rows: Sequence[Row]) -> str:
    head = ["planted", "strength", "cases", "all named, nothing beside",
            "one or more named, nothing beside", "named, of those planted", "tie",
            "superfluous names a case"]  # fmt: skip
    lines = []
    for group, of_group in _by(rows, lambda row: row["group"], PLANTED_GROUPS):
        groups = [*_by(of_group, lambda row: row["strength"], STRENGTHS), ("all", of_group)]
        for strength, own in groups:
            some = [row for row in own if right(row) and not superfluous(row)]
            beside = sum(len(superfluous(row)) for row in own)
            lines.append([
                group, strength, str(len(own)), share(sum(map(is_right, own)), len(own)),
                share(len(some), len(own)),
                share(sum(len(right(r)) for r in own), sum(len(r["planted"]) for r in own)),
                str(sum(len(tied(row)) for row in own)), f"{beside / len(own):.2f}",
            ])  # fmt: skip
    return table(head, lines)


def _over_floor(rows: Sequence[Row]) -> list[str]:
    """Median and 90th percentile of the RMSE of the fit to rely on over the floor."""
    return _quantiles([relied_on(r)["rmse"] / r["floor"] for r in rows if "error" not in r])


def _quantiles(values: Iterable[float], digits: int = 2) -> list[str]:
    found = list(values)
    if not found:
        return ["-", "-"]
    return [f"{np.median(found):.{digits}f}", f"{np.quantile(found, 0.9):.{digits}f}"]


def does_harm(row: Row) -> bool:
    """Whether the extended model does clearly worse on the last block than the one before."""
    return bool(row["after"]["rmse"] > HARM * row["before"]["rmse"])


def headline_names_harm(row: Row) -> bool:
    """Whether the headline says that effects do harm, which are left out."""
    return not all(row["kept"])


def _error_table(rows: Sequence[Row]) -> str:
    head = ["planted", "cases", "after > 1.05 before", "of those in the headline", "before / floor",
            "90th percentile", "after / floor", "90th percentile", "95 % bands hold, after",
            "fit [s]", "90th percentile", "loop [s]", "90th percentile"]  # fmt: skip
    lines = []
    for group, own in [*_by(rows, lambda row: row["group"]), ("all", rows)]:
        if not own:
            continue
        harm = [row for row in own if does_harm(row)]
        coverage = np.mean([relied_on(row)["coverage_95"] for row in own])
        lines.append([
            group, str(len(own)), str(len(harm)), str(sum(map(headline_names_harm, harm))),
            *_quantiles(row["before"]["rmse"] / row["floor"] for row in own), *_over_floor(own),
            f"{coverage:.1%}", *_quantiles((row["seconds"]["fit"] for row in own), 1),
            *_quantiles((row["seconds"]["loop"] for row in own), 1),
        ])  # fmt: skip
    return table(head, lines)


def _outside_table(rows: Sequence[Row]) -> str:
    own = [row for row in rows if row["group"] == "outside"]
    counts = Counter(
        (row["what"], row["strength"], row["outcome"], ", ".join(row["named"]) or "nothing",
         "yes" if says_outside(row) else "no")
        for row in own
    )  # fmt: skip
    lines = [[*key, str(count)] for key, count in sorted(counts.items())]
    return table(["machine", "strength", "outcome", "named", "cause left open", "cases"], lines)


def _search_table(rows: Sequence[Row]) -> str:
    """Potency of loops that look for the planted effects alone, less that of the search."""
    keys = ("group", "kind", "effects", "strength", "seed", "split")
    by_key: dict[Any, dict[bool, Row]] = {}
    for row in rows:
        by_key.setdefault(tuple(row[k] for k in keys), {})[row["oracle"]] = row
    pairs = [pair for pair in by_key.values() if len(pair) == 2]
    effects = sorted({effect for pair in pairs for effect in pair[True]["planted"]})
    lines = []
    for effect in [*effects, "all"]:
        counts = {False: 0, True: 0}
        total = 0
        for pair in pairs:
            chosen = [e for e in pair[True]["planted"] if effect in (e, "all")]
            total += len(chosen)
            for oracle, row in pair.items():
                counts[oracle] += sum(e in right(row) for e in chosen)
        if total:
            cost = 100.0 * (counts[True] - counts[False]) / total
            both = [share(counts[oracle], total) for oracle in (True, False)]
            lines.append([effect, *both, f"{cost:.0f}"])
    head = ["effect", "named by the oracle", "named by the search", "cost of search [points]"]
    return table(head, lines)


def _peer_table(rows: Sequence[Row]) -> str:
    """Ours and others, on the same cases."""
    both = [row for row in rows if "peers" in row]
    tools = list(dict.fromkeys(name for row in both for name in row["peers"]))
    views: dict[str, list[Row]] = {"closing the loop": both}
    for tool in tools:
        views[tool] = [as_said(row, row["peers"][tool]) for row in both if tool in row["peers"]]
    lines = []
    for tool, own in views.items():
        null = [row for row in own if row["group"] == "null" and not row["planted"]]
        single = [row for row in own if row["group"] == "single"]
        lines.append([
            tool, share(sum(bool(names_of(row)) for row in null), len(null)),
            share(sum(bool(names_of(row)) for row in single), len(single)),
            share(sum(bool(right(row)) for row in single), len(single)),
            share(sum(map(is_right, single)), len(single)),
        ])  # fmt: skip
    head = ["tool", "nothing planted: anything named", "one effect: anything named",
            "the effect named", "nothing beside"]  # fmt: skip
    return table(head, lines)


def as_said(row: Row, said: Mapping[str, Sequence[Any]]) -> Row:
    """A row as it would be if the names were those of another tool, which has no ties."""
    return {**row, **said, "ties": [[] for _ in said["named"]]}


def _wrong_table(rows: Sequence[Row]) -> str:
    lines = [
        [row["kind"], str(row["seed"]), row["strength"], row["effects"] or "nothing",
         ", ".join(superfluous(row)), ", ".join(right(row))]
        for row in rows
        if row["group"] != "outside" and superfluous(row)
    ]  # fmt: skip
    head = ["machine", "seed", "strength", "planted", "superfluous", "right"]
    return table(head, sorted(lines))


def _by(
    rows: Sequence[Row], key: Callable[[Row], str], order: Sequence[str] | None = None
) -> list[tuple[str, list[Row]]]:
    """Rows by a text, in the order given, or else of the alphabet."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(key(row), []).append(row)
    return [(name, found[name]) for name in (order or sorted(found)) if name in found]
