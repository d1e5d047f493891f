"""Pieces of a page: escaped text, numbers as people write them, tables, figures.

No template engine: of the 940 lines of these modules most choose numbers and words, which jinja2
would not shorten, and each function from values to escaped text is tested by itself.
"""

from __future__ import annotations

import base64
import html
import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.figure import Figure

ABSENT = "–"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def text(x: object) -> str:
    """Text that a browser shows as it is, whatever characters it has."""
    return html.escape(str(x), quote=True)


def number(x: float | None, digits: int = 3) -> str:
    """A number with so many significant digits; a dash where there is none."""
    if x is None or not np.isfinite(x):
        return ABSENT
    if x == 0:
        return "0"
    if not 1e-4 <= abs(x) < 1e6:
        mantissa, exponent = f"{x:.{digits - 1}e}".split("e")
        power = str(int(exponent)).translate(_SUPERSCRIPTS)
        return f"{mantissa} × 10{power}".replace("-", "−")
    # Digits before the decimal point stay: 1234 is no 1230 to whoever reads a meter.
    decimals = max(digits - 1 - int(np.floor(np.log10(abs(x)))), 0)
    return f"{x:.{decimals}f}".replace("-", "−")


def measure(x: float | None, unit: str = "", digits: int = 3) -> str:
    """A number with its unit."""
    shown = number(x, digits)
    return f"{shown} {unit}" if unit and shown != ABSENT else shown


def plus_minus(x: float, error: float, unit: str = "", digits: int = 3) -> str:
    """A number with its standard error, and their unit; as many decimals in both."""
    if not np.isfinite(x):
        return ABSENT
    after = f" {unit}" if unit else ""
    if not np.isfinite(error):
        return f"{number(x, digits)}{after}"
    largest = max(abs(x), abs(error))
    if largest == 0 or 1e-3 <= largest < 1e6:
        places = digits - 1 - int(np.floor(np.log10(largest))) if largest else 0
        decimals = max(places, 0)
        return f"{x:.{decimals}f} ± {error:.{decimals}f}{after}".replace("-", "−")
    return f"{number(x, digits)} ± {number(error, 2)}{after}"


def probability(p: float | None) -> str:
    """A p or q value."""
    if p is None or not np.isfinite(p):
        return ABSENT
    return "below 0.0001" if p < 1e-4 else number(p, 2)


def share(x: float | None) -> str:
    """A share as per cent."""
    return ABSENT if x is None or not np.isfinite(x) else f"{100 * x:.1f} %"


def duration(seconds: float) -> str:
    """Time that something took."""
    return f"{number(seconds / 60)} min" if seconds >= 120 else measure(seconds, "s")


def listed(names: Sequence[str], last: str = "and") -> str:
    """Words in a row: a, b and c."""
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} {last} {names[-1]}"


@dataclass(frozen=True)
class Cell:
    """Content of a cell of a table.

    Attributes:
        lines: of text; the first is bold where there are several.
        kind: class for the style sheet: "better", "worse" or nothing.
        plain: whether nothing is bold.
    """

    lines: tuple[str, ...]
    kind: str = ""
    plain: bool = False

    def __str__(self) -> str:
        shown = [text(line) for line in self.lines if line]
        if len(shown) > 1 and not self.plain:
            shown[0] = f"<strong>{shown[0]}</strong>"
        return "<br>".join(shown)


def table(
    caption: str, head: Sequence[str], rows: Sequence[Sequence[str | Cell]], numeric: str = ""
) -> str:
    """A table; the first cell of a row names it.

    Args:
        caption: above it. head: names of the columns. rows: cells, as plain text.
        numeric: an "n" for each column of numbers, set flush right, another letter for the rest.
    """

    def styled(k: int, cell: str | Cell) -> str:
        kinds = ["n"] if numeric[k : k + 1] == "n" else []
        kinds += [cell.kind] if isinstance(cell, Cell) and cell.kind else []
        return f' class="{" ".join(kinds)}"' if kinds else ""

    def content(cell: str | Cell) -> str:
        return str(cell) if isinstance(cell, Cell) else text(cell)

    heads = "".join(
        f'<th scope="col"{styled(k, name)}>{text(name)}</th>' for k, name in enumerate(head)
    )
    body = []
    for row in rows:
        cells = "".join(
            f"<td{styled(k, cell)}>{content(cell)}</td>" for k, cell in enumerate(row) if k
        )
        body.append(f'<tr><th scope="row"{styled(0, row[0])}>{content(row[0])}</th>{cells}</tr>')
    return (
        f'<div class="wide"><table><caption>{text(caption)}</caption>'
        f"<thead><tr>{heads}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"
    )


def paragraph(words: str, kind: str = "") -> str:
    """A paragraph of plain text."""
    styled = f' class="{kind}"' if kind else ""
    return f"<p{styled}>{text(words)}</p>"


def items(lines: Sequence[str]) -> str:
    """A list of plain sentences."""
    return f"<ul>{''.join(f'<li>{text(line)}</li>' for line in lines)}</ul>"


def picture(figure: Figure, alt: str, caption: str) -> str:
    """A figure as an image inside the page: vectors, so that it prints sharply.

    As a data URI, since identifiers of several SVG inside one page would clash.
    """
    buffer = io.BytesIO()
    nothing = {"Creator": None, "Date": None, "Format": None, "Type": None}
    with (
        matplotlib.rc_context({"svg.fonttype": "path", "svg.hashsalt": "pyro_dynogp"}),
        warnings.catch_warnings(),
    ):
        # A name in letters that the font lacks is drawn as boxes; the caption has it right.
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        figure.savefig(buffer, format="svg", metadata=nothing)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    wide, high = (round(96 * x) for x in figure.get_size_inches())
    return (
        f'<figure><img src="data:image/svg+xml;base64,{data}" alt="{text(alt)}" '
        f'width="{wide}" height="{high}"><figcaption>{text(caption)}</figcaption></figure>'
    )
