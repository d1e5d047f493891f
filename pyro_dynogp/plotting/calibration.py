"""Figures of the criticism of predictions: calibration, and statistics beside replicated ones."""

from __future__ import annotations

import math
import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pyro_dynogp.criticism.calibration import Calibration
from pyro_dynogp.criticism.predictive_checks import PredictiveChecks
from pyro_dynogp.plotting import style
from pyro_dynogp.support.errors import invalid

OUTSIDE: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "markersize": 4,
    "color": style.INPUT,
    "label": "outside the band",
}


def calibration(result: Calibration) -> Figure:
    """Draw the distribution of the probability integral transform (PIT), one row per output.

    For each output: the histogram of the PIT, flat where the prediction is calibrated; its
    empirical distribution function (ECDF) less that of the uniform distribution; the coverage of
    central intervals, less their probability. The bands come from joint samples of the prediction
    and hold for the whole curve: of a calibrated prediction `level` of all records stay inside,
    those of ECDF and coverage taken together.

    How to read it: bars high at both ends, a curve above the band at the left and below it at the
    right, coverage below its band: too narrow; the reverse: too wide. A curve above the band
    throughout: the prediction lies too high; below it throughout: too low.

    Args:
        result: what `pyro_dynogp.criticism.calibration.calibration` returned.

    Raises:
        ValueError: the result is no Calibration.
    """
    if not isinstance(result, Calibration):
        raise invalid("result", expected="a Calibration", got=type(result).__name__)
    rows = len(result.output_names)
    figure, axes = style.panels(rows, 3, width=11.5, height=1.1 + 3.2 * rows)
    band = f"{100 * result.level:.3g} % of calibrated records stay inside"
    for a, name in enumerate(result.output_names):
        histogram, ecdf, coverage = axes[a]
        _bars(histogram, result, a, band)
        style.title(histogram, f"{name}: distribution of the PIT")
        _curve(
            ecdf, result.levels, result.ecdf[:, a], result.low[:, a], result.high[:, a], band
        )  # fmt: skip
        style.label(ecdf, x="probability [-]", y="ECDF - probability [-]")
        style.title(ecdf, f"ECDF of the PIT (with coverage: p = {result.p_value[a]:.2g})")
        _curve(
            coverage, result.nominal, result.coverage[:, a],
            result.coverage_low[:, a], result.coverage_high[:, a], band,
        )  # fmt: skip
        style.label(
            coverage, x="probability of central interval [-]", y="share inside - probability [-]"
        )
        style.title(coverage, "coverage of central intervals")
    # Whoever sees the figure alone has to know, too.
    caveat = " (bands are too narrow: see the note of the result)" if result.note else ""
    style.title(figure, f"Calibration of a {result.kind}{caveat}")
    style.legend(figure)
    return figure


def _bars(axes: Axes, result: Calibration, a: int, band: str) -> None:
    height, low, high = (
        values[:, a] for values in (result.density, result.density_low, result.density_high)
    )
    edges = result.edges
    axes.fill_between(
        edges, np.append(low, low[-1]), np.append(high, high[-1]), step="post", label=band,
        **style.BAND_95,
    )  # fmt: skip
    axes.axhline(1.0, color=style.MODEL, linewidth=1.6, label="calibrated")
    axes.stairs(height, edges, color=style.MEASURED, linewidth=1.6, baseline=None)
    outside = (height < low) | (height > high)
    if outside.any():
        middle = 0.5 * (edges[1:] + edges[:-1])
        axes.plot(middle[outside], height[outside], **OUTSIDE)
    axes.set_xlim(0, 1)
    axes.set_ylim(bottom=0)
    style.label(axes, x="PIT [-]", y="density [-]")


def _curve(
    axes: Axes, at: np.ndarray, values: np.ndarray, low: np.ndarray, high: np.ndarray, band: str
) -> None:
    """Difference from the diagonal; it is zero by definition at both ends."""

    def closed(curve: np.ndarray) -> np.ndarray:
        return np.concatenate([[0.0], curve - at, [0.0]])

    x = np.concatenate([[0.0], at, [1.0]])
    axes.fill_between(x, closed(low), closed(high), label=band, **style.BAND_95)
    axes.axhline(0.0, color=style.MODEL, linewidth=1.6, label="calibrated")
    axes.plot(x, closed(values), color=style.MEASURED, linewidth=1.6, label="measured")
    outside = (values > high) | (values < low)
    if outside.any():
        axes.plot(at[outside], (values - at)[outside], **OUTSIDE)
    axes.set_xlim(0, 1)


def predictive_checks(result: PredictiveChecks) -> Figure:
    """Draw each statistic of the joint samples as a histogram, and the measured one as a line.

    A line at the edge of its histogram or beyond it: the prediction does not produce records like
    the measured one. Each panel gives the two-sided p-value of its statistic by itself; the line
    is orange where the statistic stands out among all of them.

    Args:
        result: what `pyro_dynogp.criticism.predictive_checks.predictive_checks` returned.

    Raises:
        ValueError: the result is no PredictiveChecks.
    """
    if not isinstance(result, PredictiveChecks):
        raise invalid("result", expected="a PredictiveChecks", got=type(result).__name__)
    count = len(result.statistics)
    columns = min(4, count)
    rows = math.ceil(count / columns)
    figure, axes = style.panels(
        rows, columns, width=max(4.5, 2.9 * columns), height=1.2 + 2.25 * rows
    )
    several = len(set(result.outputs)) > 1
    for j, panel in enumerate(axes.flat):
        if j >= count:
            panel.set_axis_off()
            continue
        _replicates(panel, result, j)
        name = f"{result.outputs[j]}: {result.statistics[j]}" if several else result.statistics[j]
        style.label(panel, x=_wrapped(name, result.units[j]))
        if j % columns == 0:
            style.label(panel, y="joint samples [-]")
        style.title(panel, f"p = {result.p_value[j]:.2g}")
    output = "" if several else f" of {result.outputs[0]}"
    style.title(figure, f"Measured and replicated statistics{output}: {result.kind}")
    style.legend(figure)
    return figure


def _wrapped(name: str, unit: str) -> str:
    """Label of a narrow panel in several lines, its unit and its lag never torn apart."""
    text = style.named(name, unit.replace(" ", "\u00a0")).replace("lag ", "lag\u00a0")
    return textwrap.fill(text, 30, break_long_words=False)


def _replicates(axes: Axes, result: PredictiveChecks, j: int) -> None:
    values = result.replicated[:, j]
    whole = np.ptp(values) <= 20 and np.array_equal(values, np.round(values))
    # Counts get a bar for each number, since other bins would make teeth.
    bins = np.arange(values.min() - 0.5, values.max() + 1.0).tolist() if whole else 15
    axes.hist(
        values, bins=bins, histtype="stepfilled", color="#BFBFBF",
        label="joint samples of the prediction",
    )  # fmt: skip
    out = bool(result.stands_out[j])
    axes.axvline(
        result.observed[j],
        color=style.INPUT if out else style.MEASURED,
        linewidth=2.2,
        label="measured, stands out among all statistics" if out else "measured",
    )
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
