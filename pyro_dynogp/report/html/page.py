"""A report as one page for whoever runs the plant: self-contained HTML, figures inside."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pyro_dynogp.discrepancy.result import WITHOUT_NOISE
from pyro_dynogp.report.html.diagram import diagram, marks
from pyro_dynogp.report.html.effects import all_tests, attempts, effects
from pyro_dynogp.report.html.html import (
    duration,
    items,
    listed,
    measure,
    paragraph,
    table,
    text,
)
from pyro_dynogp.report.html.scores import SAME, last_block_tests, output_unit, scores
from pyro_dynogp.report.html.style import STYLE

if TYPE_CHECKING:
    from pyro_dynogp.data.record import Record
    from pyro_dynogp.discrepancy.result import LoopResult

_NUMBERS = ("No", "One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine")
_HOW_TO_READ = (
    "A part with an arrow before it acts on what comes before, one with a plus sign joins it."
)
_TERMS = (
    ("p-value", "how often a test would find as much where the effect is absent."),
    ("q-value", "share of false alarms to expect among all effects that look as convincing."),
    (
        "elpd",
        "expected log predictive density: how probable the model makes data that it has not seen. "
        "One nat more means e = 2.7 times as probable.",
    ),
    (
        "block standard error",
        "what the elpd gain would vary by in other data like these, neighbouring samples counted "
        "together.",
    ),
    ("RMSE, MAE", "root of the mean squared error, and mean absolute error, of the forecast."),
    ("CRPS", "error of the whole predictive distribution; of a single number it is the MAE."),
    ("50 % and 95 % band", "between which a measured sample should lie as often as that."),
    ("sealed data", "the last part of the record, opened once, when the model was settled."),
)


def page(report: LoopResult) -> str:
    """One HTML page without scripts or anything from outside.

    Args:
        report: what `close_loop` returned.
    """
    about = f"{listed(list(report.sealed.output_names)) or 'no output'}"
    name = report.sealed.name or report.known.name
    subject = f"{about} of record “{name}”" if name else about
    sections = [
        ("What was missing", effects(report)),
        *([("What is left", items(report.left))] if report.left else []),
        ("The model", _models(report)),
        ("How well it predicts", scores(report)),
        ("Tests on the sealed data", last_block_tests(report)),
        ("What was tried", attempts(report)),
        ("Every test of the search", all_tests(report)),
        ("Which data were for what", _data(report)),
        ("Where the time went", _times(report)),
        ("Terms", _terms()),
    ]
    body = "".join(
        f"<section><h2>{text(title)}</h2>{content}</section>" for title, content in sections
    )
    headline = text(_headline(report))
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>Closing the loop: {text(subject)}</title>\n<style>{STYLE}</style>\n</head>\n"
        f'<body>\n<header><p class="kicker">Closing the loop: {text(subject)}</p>'
        f"<h1>{headline}</h1>{_key(report)}</header>\n"
        f"<main>{_warnings(report)}{body}</main>\n</body>\n</html>\n"
    )


def _headline(report: LoopResult) -> str:
    """The outcome in one sentence."""
    kept = [one for one in report.effects if one.kept or report.model_kept]
    count, left = len(kept), "structure left" in report.outcome
    if count:
        how_many = _NUMBERS[count] if count < len(_NUMBERS) else str(count)
        verb = "effect was" if count == 1 else "effects were"
        names = listed([one.name for one in kept])
        if report.model_kept:
            added = "it" if count == 1 else "them"
            return (
                f"{how_many} {verb} named, but the model is kept as it was, as it does worse with "
                f"{added} on the sealed data: {names}."
            )
        words = f"{how_many} {verb} missing from the model and added: {names}"
        if report.left_out and not report.model_kept:
            words += (
                f"; {listed(list(report.left_out))} named too, but left out, as the model does "
                "worse with that on the sealed data"
            )
        if "ended early" in report.outcome:
            return f"{words}; the search ended early."
        return f"{words}; structure of unknown cause is left." if left else f"{words}."
    more = f"; {WITHOUT_NOISE}." if report.noise_dropped else "."
    if report.outcome == "nothing missing":
        return f"No effect was found that the model lacks{more}"
    if left:
        said = "The model leaves structure in the data that no effect in the catalogue explains"
        return said + more
    return f"{report.outcome[:1].upper()}{report.outcome[1:]}."


def _key(report: LoopResult) -> str:
    """The one number that most readers want."""
    before, after = report.before.get("rmse", np.nan), report.after.get("rmse", np.nan)
    unit, n = output_unit(report), len(report.sealed)
    where = f"On the {n} samples that no step had used before, the root mean square error"
    if not np.isfinite(before):
        return ""
    if not (report.effects or report.noise_dropped) or not np.isfinite(after):
        return paragraph(f"{where} of the forecast is {measure(before, unit)}.", "lead")
    words = f"{where} of the forecast goes from {measure(before, unit)} to {measure(after, unit)}"
    if before > 0 and abs(after / before - 1.0) >= SAME:
        way = "smaller" if after < before else "larger"
        words += f": {100 * abs(after / before - 1.0):.3g} % {way}"
    if report.model_kept:
        words += ". Rely on the model before, not on the extended one"
    return paragraph(f"{words}.", "lead")


def _warnings(report: LoopResult) -> str:
    if not report.warnings:
        return ""
    return f'<aside class="warning"><h2>Warnings</h2>{items(report.warnings)}</aside>'


def _models(report: LoopResult) -> str:
    before, after = report.model_before, report.model_after
    if tuple(before) == tuple(after):
        drawn = diagram(before, [""] * len(before), "Model")
        said = f"The model is as it was given. {_HOW_TO_READ}"
        return f"<figure>{drawn}<figcaption>{said}</figcaption></figure>"
    gone = ["removed" if mark == "new" else mark for mark in marks(after, before)]
    return (
        f"<h3>Before</h3><figure>{diagram(before, gone, 'Model before')}</figure>"
        f"<h3>After</h3><figure>{diagram(after, marks(before, after), 'Model after')}"
        f"<figcaption>{_HOW_TO_READ} New and changed ones have a thick border and are marked."
        "</figcaption></figure>"
    )


def _data(report: LoopResult) -> str:
    known, sealed = report.known, report.sealed
    rows = [
        ["Known: fitted to, and searched", str(len(known)), *_ends(known)],
        ["Sealed: reported on", str(len(sealed)), *_ends(sealed)],
    ]
    channels = [
        (what, listed([f"{n} [{u}]" if u else n for n, u in zip(names, units, strict=True)]))
        for what, names, units in (
            ("Outputs", known.output_names, known.output_units),
            ("Inputs", known.input_names, known.input_units),
            (
                "Other recorded channels",
                tuple(known.extra),
                tuple(known.extra_units[name] for name in known.extra),
            ),
        )
    ]
    return (
        paragraph(report.data)
        + table("Parts of the record", ["Part", "Samples", "From", "To"], rows, "tnnn")
        + items([f"{what}: {names or 'none'}." for what, names in channels])
    )


def _ends(record: Record) -> tuple[str, str]:
    """First and last time of a record."""
    stamps = record.timestamps
    if stamps is not None:
        first, last = stamps[0], stamps[-1]
        return tuple(one.isoformat(sep=" ", timespec="seconds") for one in (first, last))  # type: ignore[return-value]
    first_time, last_time = float(record.time[0]), float(record.time[-1])
    first_shown, last_shown = (f"{x:.9g} {record.time_unit}" for x in (first_time, last_time))
    return first_shown.strip(), last_shown.strip()


def _times(report: LoopResult) -> str:
    if not report.seconds:
        return paragraph("No times were taken.")
    rows = [[name, duration(value)] for name, value in report.seconds.items()]
    return table("Time for each stage", ["Stage", "Time"], rows, "tn")


def _terms() -> str:
    inside = "".join(f"<div><dt>{text(a)}</dt><dd>{text(b)}</dd></div>" for a, b in _TERMS)
    return f'<dl class="terms">{inside}</dl>'
