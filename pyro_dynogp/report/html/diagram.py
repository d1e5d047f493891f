"""A model as boxes in a row with arrows between them, as inline SVG.

Drawn here, in 3 kB for three boxes: graphviz needs a program beside Python, and mermaid a script
that a page would have to load or carry, while a report is one file that opens offline.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from pyro_dynogp.models.description import Part
from pyro_dynogp.report.html.html import text

# Sizes in units of the drawing; a row holds as many boxes as fit into its width.
WIDTH, BOX, GAP, LINE, EDGE = 920, 158, 30, 16, 13
PER_ROW = (WIDTH + GAP) // (BOX + GAP)
CHARACTERS = 20
# Attributes rather than a style sheet: what makes a PDF of a page may not apply one to drawings.
_KEPT = 'fill="#f4f7fa" stroke="#4a4a4a" stroke-width="1.2"'
_ADDED = 'fill="#fff1d0" stroke="#9a5b00" stroke-width="3"'
_BOXES = {"new": _ADDED, "changed": _ADDED, "": _KEPT, "removed": f'{_KEPT} stroke-dasharray="5 4"'}
_TEXT = 'text-anchor="middle" font-family="Segoe UI, Roboto, Helvetica, Arial, sans-serif"'
_WORDS = {
    "heading": 'font-size="13" font-weight="600" fill="#1a1a1a"',
    "details": 'font-size="12" fill="#1a1a1a"',
    "flag": 'font-size="11.5" font-weight="600" fill="#ffffff"',
}


def marks(before: Sequence[Part], after: Sequence[Part]) -> list[str]:
    """What became of each part of `after`: "" (as before), "changed" or "new"."""
    left, found = list(before), [""] * len(after)
    others = []
    for k, part in enumerate(after):
        if part in left:
            left.remove(part)
        else:
            others.append(k)
    for k in others:
        alike = [part for part in left if part.kind == after[k].kind]
        found[k] = "changed" if alike else "new"
        if alike:
            left.remove(alike[0])
    return found


def diagram(model: Sequence[Part], marked: Sequence[str], name: str) -> str:
    """Boxes in the order of the parts, in rows that are read from left to right.

    Args:
        model: its parts. Those that join the others, as noise does, have a plus sign in place of
            an arrow.
        marked: a mark of each box, "" for none. name: of the drawing, for who cannot see it.
    """
    boxes = [_words(part) for part in model]
    said = " → ".join(
        f"{part} ({mark})" if mark else str(part) for part, mark in zip(model, marked, strict=True)
    )
    rows = [range(k, min(k + PER_ROW, len(boxes))) for k in range(0, len(boxes), PER_ROW)]
    parts: list[str] = []
    top, before = 14.0, None
    for row in rows:
        count = max(len(boxes[k][0]) + len(boxes[k][1]) for k in row)
        high = 2 * EDGE + LINE * count
        for place, k in enumerate(row):
            left = 2.0 + place * (BOX + GAP)
            middle = top + high / 2
            if place and model[k].joins:
                parts.append(_plus(left - GAP / 2, middle))
            elif place:
                parts.append(_arrow([(left - GAP, middle), (left, middle)]))
            elif before is not None:
                x, y = before
                bend = (y + top) / 2
                parts.append(
                    _arrow([(x, y), (x, bend), (left + BOX / 2, bend), (left + BOX / 2, top)])
                )
                if model[k].joins:
                    parts.append(_plus(left + BOX / 2 + 18, top - 10))
            parts.append(_box(left, top, high, boxes[k], marked[k]))
        before = (2.0 + (len(row) - 1) * (BOX + GAP) + BOX / 2, top + high)
        top += high + 34.0
    widest = max((len(row) for row in rows), default=0)
    wide, tall = widest * (BOX + GAP) - GAP + 4, top - 34.0 + 4.0
    return (
        f'<svg role="img" aria-label="{text(f"{name}: {said}")}" viewBox="0 0 {wide} {tall:g}" '
        f'width="{wide}" height="{tall:g}">{"".join(parts)}</svg>'
    )


def _words(part: Part) -> tuple[list[str], list[str]]:
    """Heading and details of a box, in lines that fit into it."""
    heading = textwrap.wrap(part.heading.strip(), CHARACTERS - 2)
    return heading, textwrap.wrap(part.details.strip(), CHARACTERS)


def _plus(x: float, y: float) -> str:
    """A plus sign instead of an arrow."""
    return (
        f'<path fill="none" stroke="#4a4a4a" stroke-width="2.4" '
        f'd="M{x - 7:g} {y:g}H{x + 7:g}M{x:g} {y - 7:g}V{y + 7:g}"/>'
    )


def _box(
    left: float, top: float, high: float, words: tuple[list[str], list[str]], mark: str
) -> str:
    heading, details = words
    parts = [
        f'<rect {_BOXES[mark]} x="{left:g}" y="{top:g}" width="{BOX}" height="{high:g}" rx="5"/>'
    ]
    y = top + (high - LINE * (len(heading) + len(details))) / 2 + 0.75 * LINE
    for kind, lines in (("heading", heading), ("details", details)):
        for line in lines:
            parts.append(_written(line, left + BOX / 2, y, kind))
            y += LINE
    if mark:
        wide = 12 + 7 * len(mark)
        parts.append(
            f'<rect fill="#9a5b00" x="{left + 8:g}" y="{top - 9:g}" width="{wide}" height="17" '
            f'rx="3"/>{_written(mark, left + 8 + wide / 2, top + 4, "flag")}'
        )
    return "".join(parts)


def _written(words: str, x: float, y: float, kind: str) -> str:
    return f'<text {_TEXT} {_WORDS[kind]} x="{x:g}" y="{y:g}">{text(words)}</text>'


def _arrow(points: Sequence[tuple[float, float]]) -> str:
    """A line through points with a head at the last."""
    x0, (x, y) = points[-2][0], points[-1]
    if x0 != x:
        head = f"{x:g},{y:g} {x - 8:g},{y - 4:g} {x - 8:g},{y + 4:g}"
        points = [*points[:-1], (x - 6, y)]
    else:
        head = f"{x:g},{y:g} {x - 4:g},{y - 8:g} {x + 4:g},{y - 8:g}"
        points = [*points[:-1], (x, y - 6)]
    path = " ".join(f"{a:g},{b:g}" for a, b in points)
    return (
        f'<polyline fill="none" stroke="#4a4a4a" stroke-width="1.6" points="{path}"/>'
        f'<polygon fill="#4a4a4a" points="{head}"/>'
    )
