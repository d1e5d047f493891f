"""Tables and a picture of the study of planted effects, from its rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from pyro_dynogp.discrepancy.result import KEPT
from tests.benchmarks.circumstances import sentence
from tests.benchmarks.markdown import table
from tests.discrepancy.plants import CATALOGUE, OUTSIDE, STRENGTHS

Row = Mapping[str, Any]
NOTHING, UNKNOWN, EXTRA = "nothing", "cause unknown", "extra input"
COLUMNS = (*CATALOGUE, UNKNOWN, NOTHING)
# An effect of which another is a special case: named so, it is not wrong, but less than there is.
WIDER = {
    "saturation": {"output nonlinearity"},
    "dead zone": {"input nonlinearity"},
    "calendar": {"periodic disturbance"},
}


def top_name(row: Row) -> str:
    """The effect that was named first: accepted, or else reported.

    Without any, "cause unknown" where the outcome says that structure is left, else "nothing". An
    extra input counts as such only where it is the true channel; other channels are decoys.
    """
    if row["named"]:
        return _named(row)[0]
    if row.get("reported"):
        return str(row["reported"][0])
    return UNKNOWN if "structure left" in row["outcome"] else NOTHING


def _named(row: Row) -> list[str]:
    """Accepted effects; a decoy that was taken for an input is called so."""
    return [
        "decoy" if name == EXTRA and (channel is None or channel != row["true_channel"]) else name
        for name, channel in zip(row["named"], row["channels"], strict=True)
    ]


def is_right(row: Row) -> bool:
    """Whether the planted effect was named first.

    Of what is outside the catalogue, that no cause is known, or that several explain it.
    """
    if row["effect"] == OUTSIDE and row.get("ties"):
        return True
    return top_name(row) == _right_name(row["effect"])


def _right_name(effect: str) -> str:
    return UNKNOWN if effect == OUTSIDE else effect


def relied_on(row: Row) -> Mapping[str, float]:
    """Scores of the fit that a report says to rely on: where effects do harm, the model before."""
    scores: Mapping[str, float] = row["before" if row["outcome"] == KEPT else "after"]
    return scores


def is_found(row: Row) -> bool:
    """Whether it is among all that was named, reported, or given as a tie."""
    others = {*_named(row), *row.get("reported", ()), *row.get("ties", ())}
    return is_right(row) or row["effect"] in others


def is_wider(row: Row) -> bool:
    """Whether an effect was named first of which the planted one is a special case."""
    return top_name(row) in WIDER.get(row["effect"], ())


def interval(count: int, total: int) -> tuple[float, float]:
    """95 % interval of a share by Clopper and Pearson; (0, 1) of nothing."""
    if not total:
        return 0.0, 1.0
    found = stats.binomtest(count, total).proportion_ci(method="exact")
    return float(found.low), float(found.high)


def confusion(rows: Sequence[Row]) -> dict[str, Counter[str]]:
    """Planted effect -> how often each name came first."""
    found: dict[str, Counter[str]] = {}
    for row in _done(rows):
        found.setdefault(row["effect"], Counter())[top_name(row)] += 1
    order = [*CATALOGUE, OUTSIDE, NOTHING]
    return {effect: found[effect] for effect in order if effect in found}


def tables(rows: Sequence[Row]) -> str:
    """All tables as one Markdown text."""
    done = _done(rows)
    parts = [
        f"{len(rows)} plants, {len(rows) - len(done)} of them failed. {sentence(done)}",
        _null_sentences(done),
        "### Named first, by planted effect",
        _confusion_table(done),
        "![confusion](confusion.png)",
        "### By strength",
        _strength_table(done),
        "### Outside the catalogue, and null plants: what the reports said",
        _outcome_table(done),
    ]
    failed = Counter(str(row["error"]) for row in rows if "error" in row)
    if failed:
        parts += ["### Failed", *(f"- {count} x {text}" for text, count in failed.most_common())]
    return "\n\n".join(parts)


def _done(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if "error" not in row]


def _null_sentences(rows: Sequence[Row]) -> str:
    null = [row for row in rows if row["effect"] == NOTHING]
    accepted = sum(bool(row["named"]) for row in null)
    named = sum(bool(row["named"] or row.get("reported")) for row in null)
    decoys = sum("decoy" in _named(row) for row in rows)
    share = [row for row in rows if row["effect"] not in (NOTHING, OUTSIDE)]
    right = sum(is_right(row) for row in share)
    kept = sum(row["outcome"] == KEPT for row in rows)
    harm = (  # rows of before there was such an outcome say nothing of it
        f"The model before was kept in {_share(kept, len(rows))}, as the extended one did worse on "
        "the sealed block. "
        if kept else ""
    )  # fmt: skip
    return (
        f"Null plants: an effect accepted in {_share(accepted, len(null))}, accepted or reported "
        f"in {_share(named, len(null))}. A decoy channel accepted in {_share(decoys, len(rows))} "
        f"of all plants. The planted effect named first in {_share(right, len(share))}. {harm}"
        "Intervals are 95 %, by Clopper and Pearson."
    )


def _share(count: int, total: int) -> str:
    low, high = interval(count, total)
    text = f"{100 * count / total:.1f} %" if total else "no"
    return f"{text} ({count} of {total}; {100 * low:.1f} to {100 * high:.1f} %)"


def _names(found: Mapping[str, Counter[str]]) -> list[str]:
    """Columns of the confusion matrix: all names, and what else came up."""
    others = {name for row in found.values() for name in row} - set(COLUMNS)
    return [*COLUMNS, *sorted(others)]


def _confusion_table(rows: Sequence[Row]) -> str:
    found = confusion(rows)
    names = _names(found)
    lines = []
    for effect, counts in found.items():
        cells = {name: str(counts[name] or "") for name in names}
        right = _right_name(effect)
        cells[right] = f"**{counts[right]}**"
        lines.append([effect, *cells.values()])
    return table(["planted", *names], lines)


def _strength_table(rows: Sequence[Row]) -> str:
    """Shares that are right, and errors over the floor before and after, in the median.

    Errors after are those of the fit to rely on.
    """
    head = ["effect", "strength", "plants", "right", "found", "wider", "rmse before / floor",
            "after / floor", "after, where right", "coverage 95 % after"]  # fmt: skip
    lines = []
    for effect in confusion(rows):
        for strength in (*STRENGTHS, "none"):
            own = [r for r in rows if r["effect"] == effect and r["strength"] == strength]
            if not own:
                continue
            right = [row for row in own if is_right(row)]
            lines.append(
                [effect, strength, str(len(own)), *(
                    f"{np.mean([what(row) for row in own]):.2f}"
                    for what in (is_right, is_found, is_wider)
                ), _over_floor(own, "before"), _over_floor(own, "after"),
                 _over_floor(right, "after"),
                 _median(own, lambda row: relied_on(row)["coverage_95"])]
            )  # fmt: skip
    return table(head, lines)


def _over_floor(rows: Sequence[Row], when: str) -> str:
    def scores(row: Row) -> Mapping[str, float]:
        return relied_on(row) if when == "after" else row[when]  # type: ignore[no-any-return]

    return _median(rows, lambda row: scores(row)["rmse"] / row["floor"])


def _median(rows: Sequence[Row], value: Callable[[Row], float]) -> str:
    return f"{np.median([value(row) for row in rows]):.3f}" if rows else "-"


def _outcome_table(rows: Sequence[Row]) -> str:
    counts = Counter(
        (row["effect"], row["strength"], row["outcome"], ", ".join(_named(row)) or NOTHING)
        for row in rows
        if row["effect"] in (OUTSIDE, NOTHING)
    )
    lines = [[*key, str(count)] for key, count in sorted(counts.items())]
    return table(["planted", "strength", "outcome", "accepted", "plants"], lines)


def confusion_picture(rows: Sequence[Row], path: Path) -> None:
    """Confusion matrix, each row as shares of its plants, counts in the cells."""
    found = confusion(rows)
    names = _names(found)
    counts = np.array([[row[name] for name in names] for row in found.values()], dtype=float)
    counts = counts.reshape(len(found), len(names))
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
    figure = Figure(figsize=(2.5 + 0.42 * len(names), 2.5 + 0.34 * len(found)))
    figure.set_layout_engine("constrained")
    axes = figure.subplots()
    image = axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(len(names)), names, rotation=55, ha="right", fontsize=8)
    axes.set_yticks(range(len(found)), list(found), fontsize=8)
    axes.set_xlabel("named first")
    axes.set_ylabel("planted")
    for i, j in np.argwhere(counts > 0):
        colour = "white" if shares[i, j] > 0.6 else "black"
        axes.text(j, i, f"{counts[i, j]:.0f}", ha="center", va="center", color=colour, fontsize=7)
    figure.colorbar(image, ax=axes, label="share of the plants with this effect")
    figure.savefig(path, dpi=130)
