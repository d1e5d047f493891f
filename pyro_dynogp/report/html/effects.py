"""What was found to be missing, and what was tried and not kept."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pyro_dynogp.report.html.html import (
    Cell,
    duration,
    listed,
    measure,
    number,
    paragraph,
    picture,
    plus_minus,
    probability,
    table,
    text,
)
from pyro_dynogp.report.html.scores import LEVEL, output_unit

if TYPE_CHECKING:
    from pyro_dynogp.discrepancy.result import Attempt, FoundEffect, LoopResult
    from pyro_dynogp.statistics.evidence import Curve

_NOTHING_ADDED = "Nothing was added: the model is the one that was given."
_ORDER = {
    name: place
    for place, name in enumerate(
        ("accepted", "tie", "reported", "undecided", "nearly", "rejected", "not tried")
    )
}


def effects(report: LoopResult) -> str:
    """One article for each effect that was added."""
    if not report.effects:
        return paragraph(_NOTHING_ADDED)
    return "".join(_effect(report, k, one) for k, one in enumerate(report.effects, 1))


def _effect(report: LoopResult, k: int, effect: FoundEffect) -> str:
    size, said = _size(report, effect), report.said_of_last_block(effect)
    facts = [
        ("Size (root mean square)", measure(size, output_unit(report))) if size else None,
        ("Probability of as much without the effect (p-value)", probability(effect.p_value)),
        ("False discovery rate (q-value)", probability(effect.q_value)),
        (
            "Gain in elpd of held-out data, block standard error",
            plus_minus(effect.gain, effect.gain_error, "nats"),
        ),
        ("Block of the model", effect.block) if effect.block else None,
        ("With this effect and those before", said) if said else None,
    ]
    facts += [(name, plus_minus(*pair)) for name, pair in effect.parameters.items()]
    rows = "".join(
        f"<div><dt>{text(one[0])}</dt><dd>{text(one[1])}</dd></div>" for one in facts if one
    )
    return (
        f"<article><h3>{k}. {text(_capital(effect.name))}</h3>{paragraph(effect.sentence, 'lead')}"
        f'<dl class="facts">{rows}</dl>{_ties(effect)}{_evidence(effect)}</article>'
    )


def _size(report: LoopResult, effect: FoundEffect) -> float | None:
    """Size of the effect that the accepted test of the same name and p-value gave."""
    for one in report.attempts:
        same = one.name == effect.name and one.evidence.p_value == effect.p_value
        if one.decision == "accepted" and same and np.isfinite(one.evidence.size):
            return one.evidence.size
    return None


def _ties(effect: FoundEffect) -> str:
    if not effect.ties:
        return ""
    others = listed([f"“{name}”" for name in effect.ties])
    words = f"These data cannot tell this effect from {others}."
    if effect.experiment:
        words += f" To distinguish them: {effect.experiment.rstrip('.')}."
    return f'<aside class="tie"><strong>Tie. </strong>{text(words)}</aside>'


def _evidence(effect: FoundEffect) -> str:
    from pyro_dynogp.report.figures import evidence

    curve = effect.curve
    if curve is None or not (np.isfinite(curve.x) & np.isfinite(curve.y)).any():
        return paragraph("There is no picture of this evidence.")
    return picture(
        evidence(effect),
        f"Evidence for {effect.name}: {_said(curve)}",
        f"{_capital(curve.y_label)} against {curve.x_label}.",
    )


def _said(curve: Curve) -> str:
    """A curve in words."""
    there = np.isfinite(curve.x) & np.isfinite(curve.y)
    x, y = curve.x[there], curve.y[there]
    words = (
        f"{curve.y_label} against {curve.x_label}, {len(x)} points from {number(x.min())} to "
        f"{number(x.max())}, largest {number(y.max())} at {number(x[np.argmax(y)])}, "
        f"smallest {number(y.min())} at {number(x[np.argmin(y)])}"
    )
    fitted = np.isfinite(curve.fitted[there])
    return f"{words}, and the fitted effect as a line." if fitted.any() else f"{words}."


def attempts(report: LoopResult) -> str:
    """Tables of what was refitted, and of what was not worth it."""
    tried = [one for one in report.attempts if one.decision != "not tried"]
    untried = [one for one in report.attempts if one.decision == "not tried"]
    parts = []
    if tried:
        head = ["Effect, and what its test says", "Round", "p and q", "elpd gain [nats]",
                "Decision", "Time"]  # fmt: skip
        rows = [_tried(one) for one in _sorted(tried)]
        parts.append(table("Effects that a test pointed at", head, rows, "tnnntn"))
    if untried:
        head = ["Effect", "Round", "p", "q", "Reason"]
        rows = [
            [_named(one), str(one.round), probability(one.evidence.p_value),
             probability(one.q_value), one.reason or "the data do not call for it"]
            for one in _sorted(untried)
        ]  # fmt: skip
        parts.append(table("Effects that were tested, but not refitted", head, rows, "tnnnt"))
    return "".join(parts) or paragraph("No effect was considered.")


def _sorted(attempts: Sequence[Attempt]) -> list[Attempt]:
    def key(one: Attempt) -> tuple[int, int, float]:
        p = one.evidence.p_value
        return one.round, _ORDER.get(one.decision, 9), p if np.isfinite(p) else 1.0

    return sorted(attempts, key=key)


def _tried(one: Attempt) -> list[str | Cell]:
    p, q = probability(one.evidence.p_value), probability(one.q_value)
    return [
        Cell((_titled(one), one.evidence.sentence)),
        str(one.round),
        Cell((f"p {p}", f"q {q}"), plain=True),
        plus_minus(one.gain, one.gain_error),
        Cell((one.decision, one.reason)),
        duration(one.seconds) if one.seconds else "–",
    ]


def _named(one: Attempt) -> Cell:
    """Name of an effect, and what its test says where it says anything."""
    return Cell((_titled(one), one.evidence.sentence if one.q_value <= LEVEL else ""))


def _titled(one: Attempt) -> str:
    """Name of an effect with its channel."""
    return _capital(f"{one.name}, {one.channel}" if one.channel else one.name)


def all_tests(report: LoopResult) -> str:
    """Table of every test of every round, whatever came of it."""
    if not report.tests:
        return paragraph("No residual was tested.")
    head = ["Test for", "Output", "Channel or place", "Round", "p", "q", "What became of it"]
    rows = [
        [_capital(one.effect), one.output, one.place or "–", str(one.round),
         probability(one.p_value), probability(one.q_value), one.decision]
        for one in report.tests
    ]  # fmt: skip
    words = (
        f"{len(rows)} test{'s' if len(rows) > 1 else ''} of the residuals in all. Where nothing is "
        f"missing about one in twenty has a p-value below {LEVEL}; q-values allow for that."
    )
    return paragraph(words) + table("Tests of the residuals", head, rows, "tttnnnt")


def _capital(words: str) -> str:
    return words[:1].upper() + words[1:]
