"""How well the model predicts before and after, in words and tables."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pyro_dynogp.report.html.html import (
    Cell,
    listed,
    measure,
    paragraph,
    picture,
    plus_minus,
    probability,
    share,
    table,
)

if TYPE_CHECKING:
    from pyro_dynogp.discrepancy.result import LoopResult

# A test fails below this p-value.
LEVEL = 0.05
# Relative changes of an error, and changes of a share, that are not worth a word.
SAME, SAME_SHARE = 0.005, 0.01
# Samples of a record of which a part is drawn as well, and of that part.
LONG, CLOSE = 3000, 400
_ERRORS = {
    "rmse": "Root mean square error (RMSE)",
    "mae": "Mean absolute error (MAE)",
    "nrmse": "RMSE over the standard deviation of the output (NRMSE)",
    "crps": "Continuous ranked probability score (CRPS)",
}
_SHARES = {
    "coverage_50": ("Samples inside the 50 % band", 0.50),
    "coverage_95": ("Samples inside the 95 % band", 0.95),
}


def output_unit(report: LoopResult) -> str:
    """Unit of the outputs where all have the same, else ""."""
    units = set(report.sealed.output_units)
    return units.pop() if len(units) == 1 else ""


def change_of_error(before: float, after: float) -> Cell:
    """Words for an error that is better where it is smaller."""
    if not (np.isfinite(before) and np.isfinite(after)):
        return Cell(("not computed",))
    if before <= 0 or abs(after / before - 1.0) < SAME:
        return Cell(("about the same",) if abs(after - before) <= SAME * before else ("worse",))
    size = f"{100 * abs(after / before - 1.0):.3g} %"
    if after < before:
        return Cell((f"better: {size} smaller",), "better")
    return Cell((f"worse: {size} larger",), "worse")


def change_of_share(before: float, after: float, wanted: float) -> Cell:
    """Words for a share that is best where it is what it should be."""
    if not (np.isfinite(before) and np.isfinite(after)):
        return Cell(("not computed",))
    nearer = abs(before - wanted) - abs(after - wanted)
    if abs(nearer) < SAME_SHARE:
        return Cell(("about the same",))
    if nearer > 0:
        return Cell((f"better: nearer to {100 * wanted:.0f} %",), "better")
    return Cell((f"worse: further from {100 * wanted:.0f} %",), "worse")


def change_of_elpd(gain: float, error: float) -> Cell:
    """Words for a difference in elpd, beside its standard error."""
    if not (np.isfinite(gain) and np.isfinite(error)):
        return Cell(("not computed",))
    if abs(gain) <= 2.0 * error:
        return Cell(("no clear difference: within two standard errors",))
    kind = "better" if gain > 0 else "worse"
    return Cell((f"{kind}: more than two standard errors",), kind)


def scores(report: LoopResult) -> str:
    """Table of scores on the sealed block, and both figures."""
    from pyro_dynogp.report.figures import before_after, residuals_before_after

    n, added = len(report.sealed), bool(report.effects)
    thinned = " Of each short stretch the extremes are drawn." if n > 600 else ""
    which = "by the model before and after" if added else "by the model given"
    outputs = listed(list(report.sealed.output_names))
    return "".join(
        [
            _table(report),
            picture(
                before_after(report),
                f"Measured {outputs} over time, with the forecast {which}: mean, 50 % and 95 % "
                f"bands. {_rmse_in_words(report)}",
                "Forecast of the sealed data from their inputs and what came before. About half of "
                f"the measured samples should lie in the dark band, 95 % in the wide one.{thinned}",
            ),
            _closer(report, f"Measured {outputs} over time, with the forecast {which}"),
            picture(
                residuals_before_after(report),
                f"Residuals of {outputs} over time, {which}, on one scale. "
                f"{_rmse_in_words(report)}",
                "Measured less predicted mean. What is left should look like noise: without slow "
                f"waves, steps or a pattern that repeats.{thinned}",
            ),
        ]
    )


def _closer(report: LoopResult, alt: str) -> str:
    """A stretch in the middle of a record that is too long to see one sample after another."""
    from pyro_dynogp.report.figures import before_after

    n = len(report.sealed)
    if n <= LONG:
        return ""
    begin = n // 2 - CLOSE // 2
    words = f"{CLOSE} of the {n} samples, from the middle"
    figure = before_after(report, slice(begin, begin + CLOSE))
    return picture(figure, f"{alt}: {words}.", f"The same forecast closer: {words}.")


def _table(report: LoopResult) -> str:
    unit, added = output_unit(report), bool(report.effects)
    rows: list[list[str | Cell]] = []
    for name, words in (*_ERRORS.items(), *((k, v[0]) for k, v in _SHARES.items())):
        before, after = (scored.get(name, np.nan) for scored in (report.before, report.after))
        if name in _ERRORS:
            of_output = unit if name != "nrmse" else ""
            shown = [measure(x, of_output, 4) for x in (before, after)]
            change = change_of_error(before, after)
        else:
            shown = [share(x) for x in (before, after)]
            change = change_of_share(before, after, _SHARES[name][1])
        rows.append([words, *shown, change] if added else [words, shown[0]])
    caption = f"Forecast of the {len(report.sealed)} samples that no step had used before"
    if report.sealed.n_outputs > 1:
        caption += ", mean over the outputs"
    if not added:
        return table(caption, ["Score", "The model given"], rows, "tn")
    gain, error = report.elpd_gain, report.elpd_gain_error
    elpd = "Log predictive density (elpd), after less before"
    rows.append([elpd, "", plus_minus(gain, error, "nats"), change_of_elpd(gain, error)])
    return table(caption, ["Score", "Before", "After", "In words"], rows, "tnnt")


def _rmse_in_words(report: LoopResult) -> str:
    before, after = report.before.get("rmse", np.nan), report.after.get("rmse", np.nan)
    unit = output_unit(report)
    if not report.effects:
        return f"Root mean square error {measure(before, unit)}."
    return f"Root mean square error {measure(before, unit)} before, {measure(after, unit)} after."


def last_block_tests(report: LoopResult) -> str:
    """Table of the tests on the sealed block, those that changed first."""
    if not report.last_block_tests:
        return paragraph("No test was repeated on the sealed data.")
    ranked = sorted(report.last_block_tests.items(), key=lambda one: _rank(*one[1]))
    failed = [
        sum(p < LEVEL for p in column)
        for column in zip(*report.last_block_tests.values(), strict=True)
    ]
    caption = "Tests repeated on the sealed data"
    rows: list[list[str | Cell]] = []
    if report.effects:
        for name, (p, q) in ranked:
            rows.append([name, probability(p), probability(q), _verdict(p, q)])
        shown = table(caption, ["Test for", "p before", "p after", "In words"], rows, "tnnt")
        found = f"{failed[0]} failed before and {failed[1]} after"
    else:
        rows = [[name, probability(p), _alone(p)] for name, (p, _) in ranked]
        shown = table(caption, ["Test for", "p", "In words"], rows, "tnt")
        found = f"{failed[0]} failed"
    words = (
        f"Of {len(ranked)} test{'s' if len(ranked) > 1 else ''}, {found}. A test fails where its "
        f"p-value is below {LEVEL}; about one in twenty does so by chance."
    )
    return paragraph(words) + shown


def _rank(before: float, after: float) -> int:
    fails = (before < LEVEL, after < LEVEL)
    return [(True, False), (False, True), (True, True), (False, False)].index(fails)


def _alone(p: float) -> Cell:
    if not np.isfinite(p):
        return Cell(("not computed",))
    return Cell(("fails",), "worse") if p < LEVEL else Cell(("passes",))


def _verdict(before: float, after: float) -> Cell:
    if not (np.isfinite(before) and np.isfinite(after)):
        return Cell(("not computed",))
    return (
        Cell(("failed, now passes",), "better"),
        Cell(("passed, now fails",), "worse"),
        Cell(("fails as before",), "worse"),
        Cell(("passes as before",)),
    )[_rank(before, after)]
