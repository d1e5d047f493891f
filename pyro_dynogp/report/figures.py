"""Figures of what a model lacked: the evidence, and predictions before and after."""

from __future__ import annotations

import dataclasses
import itertools
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pyro_dynogp.plotting import style
from pyro_dynogp.support.errors import invalid

if TYPE_CHECKING:
    from pyro_dynogp.data.record import Record
    from pyro_dynogp.discrepancy.result import FoundEffect, LoopResult
    from pyro_dynogp.prediction.prediction import Prediction
    from pyro_dynogp.statistics.evidence import Evidence

# Bins of a long record in all panels of a figure together, which bound the size of a file.
BINS = 600


def evidence(effect: FoundEffect | Evidence) -> Figure:
    """Draw what the data say about an effect, and the effect that was fitted to it.

    Args:
        effect: with a curve: one of `Report.effects`, or what a test returned.

    Raises:
        ValueError: it has no curve, or one without a finite point.
    """
    name = str(getattr(effect, "name", "") or getattr(effect, "effect", ""))
    curve = effect.curve
    if curve is None or not (there := np.isfinite(curve.x) & np.isfinite(curve.y)).any():
        raise invalid("effect", expected="one with a curve", got=f"{name!r} without points")
    order = np.argsort(curve.x[there], kind="stable")
    x, y, fitted = (v[there][order] for v in (curve.x, curve.y, curve.fitted))
    keep = _kept([y, fitted], BINS)
    x, y, fitted = x[keep], y[keep], fitted[keep]
    figure, axes = style.panels(1, width=6.6, height=3.3)
    panel = axes[0, 0]
    shown = np.isfinite(fitted)
    panel.plot(
        x,
        y,
        color=style.MEASURED,
        linestyle="none" if shown.any() else "-",
        linewidth=1.0,
        marker="o",
        markersize=4 if len(x) <= 100 else 2,
        label="data",
        zorder=3,
    )
    if shown.any():
        panel.plot(
            x[shown], fitted[shown], color=style.MODEL, linewidth=2.0, label="fitted effect",
            zorder=4,
        )  # fmt: skip
    style.label(panel, x=_wrapped(curve.x_label, 70), y=_wrapped(curve.y_label, 34))
    style.title(figure, f"Evidence for {_wrapped(name, 60)}")
    if shown.any():
        style.legend(figure)
    return figure


def before_after(report: LoopResult, part: slice | None = None) -> Figure:
    """Forecasts of the sealed block by the model given and by the extended one.

    Predictive mean with 50 and 95 % bands for measured outputs, and what was measured; one scale
    for both. Where nothing was added there is one panel for each output. Of a long record the
    extremes in each of many bins are drawn.

    Args:
        report: what `close_loop` returned. part: samples of the sealed block to draw; None for all.

    Raises:
        ValueError: the forecasts are not of the sealed block, or the part is empty.
    """
    forecasts = _forecasts(report)
    record = report.sealed
    samples = np.arange(len(record))[slice(None) if part is None else part]
    if not len(samples):
        raise invalid("part", expected="a slice that holds a sample", got=f"{part}, empty")
    figure, axes, clock = _panels(report, forecasts)
    bins = max(BINS // axes.size, 60)
    for (a, name), (k, (word, made)) in itertools.product(
        enumerate(record.output_names), enumerate(forecasts)
    ):
        panel = axes[a * len(forecasts) + k, 0]
        measured = record.outputs[samples, a]
        keep = _kept([measured, made.mean[samples, a], made.variance[samples, a]], bins)
        drawn = _part(made, samples[keep], a)
        x = clock.positions(drawn.time)
        low, lower, upper, high = drawn.quantile([0.025, 0.25, 0.75, 0.975])[:, :, 0]
        panel.fill_between(x, low, high, label="95 % band", **style.BAND_95)
        panel.fill_between(x, lower, upper, label="50 % band", **style.BAND_50)
        panel.plot(x, drawn.mean[:, 0], color=style.MODEL, linewidth=1.3, label="predictive mean")
        _draw(panel, x, measured, keep, "measured")
        scores = report.after if k else report.before
        style.title(panel, f"{word}{_scored(scores, record) if part is None else ''}")
        style.label(panel, y=_wrapped(style.named(name, record.output_units[a]), 24))
    which = "the sealed data" if part is None else "part of the sealed data"
    return _finished(figure, axes, clock, f"Forecast of {which}")


def residuals_before_after(report: LoopResult) -> Figure:
    """What the forecasts of the sealed block leave of the measured outputs, on one scale.

    Args:
        report: what `close_loop` returned.

    Raises:
        ValueError: the forecasts are not of the sealed block.
    """
    forecasts = _forecasts(report)
    record = report.sealed
    figure, axes, clock = _panels(report, forecasts)
    for (a, name), (k, (word, made)) in itertools.product(
        enumerate(record.output_names), enumerate(forecasts)
    ):
        panel = axes[a * len(forecasts) + k, 0]
        residual = record.outputs[:, a] - made.mean[:, a]
        keep = _kept([residual], max(2 * BINS // axes.size, 120))
        unit = record.output_units[a]
        _draw(panel, clock.positions(made.time[keep]), residual, keep, "measured less mean")
        panel.axhline(0.0, color=style.MODEL, linewidth=1.2, zorder=4)
        there = residual[np.isfinite(residual)]
        if len(there):
            size = np.sqrt(np.mean(there**2))
            for sign in (-1.0, 1.0):
                panel.axhline(
                    sign * size, color=style.INPUT, linewidth=1.2, linestyle=(0, (4, 3)),
                    label="root mean square", zorder=4,
                )  # fmt: skip
            style.title(
                panel, _safe(f"{word}: root mean square {size:.3g} {_clipped(unit, 20)}".rstrip())
            )
        style.label(panel, y=_wrapped(style.named(f"residual of {name}", unit), 24))
    return _finished(figure, axes, clock, "Residuals of the forecast of the sealed data")


def _forecasts(report: LoopResult) -> list[tuple[str, Prediction]]:
    """Forecasts to draw, each with a word; one where nothing was added."""
    before, after = report.forecast_before, report.forecast_after
    for name, made in (("forecast_before", before), ("forecast_after", after)):
        if not np.array_equal(made.time, report.sealed.time):
            raise invalid(
                f"report.{name}", expected="a forecast of the sealed block",
                got=f"{len(made)} times that are not its {len(report.sealed)}",
            )  # fmt: skip
    if not report.effects:
        return [("The model given", before)]
    return [("Before", before), ("After", after)]


def _panels(
    report: LoopResult, forecasts: Sequence[object]
) -> tuple[Figure, np.ndarray, style.TimeAxis]:
    """One panel for each output and forecast; those of one output share their scale."""
    count = report.sealed.n_outputs * len(forecasts)
    figure, axes = style.panels(count, height=1.2 + 2.2 * count, share_x=True)
    for k, panel in enumerate(axes[:, 0]):
        first = axes[k - k % len(forecasts), 0]
        if panel is not first:
            panel.sharey(first)
    return figure, axes, style.TimeAxis(report.sealed)


def _finished(figure: Figure, axes: np.ndarray, clock: style.TimeAxis, text: str) -> Figure:
    axes[0, 0].margins(x=0.01)
    clock.decorate(axes[-1, 0])
    figure.align_ylabels()
    style.title(figure, text)
    style.legend(figure)
    return figure


def _scored(scores: Mapping[str, float], record: Record) -> str:
    """Scores for the title of a panel, where there is one output."""
    rmse, inside = (scores.get(key, np.nan) for key in ("rmse", "coverage_95"))
    parts = []
    if record.n_outputs == 1 and np.isfinite(rmse):
        parts.append(f"RMSE {rmse:.3g} {_safe(_clipped(record.output_units[0], 20))}".rstrip())
    if record.n_outputs == 1 and np.isfinite(inside):
        parts.append(f"95 % band holds {100 * inside:.0f} %")
    return f": {', '.join(parts)}" if parts else ""


def _draw(axes: Axes, x: np.ndarray, y: np.ndarray, keep: np.ndarray, text: str) -> None:
    """Samples `keep` of y at x: dots where they are all there are, a line through extremes."""
    if len(keep) == len(y):
        style.draw_measured(axes, x, y, text, style.MEASURED)
    else:
        axes.plot(x, y[keep], color=style.MEASURED, linewidth=0.7, label=text, zorder=3)


def _kept(signals: Sequence[np.ndarray], bins: int) -> np.ndarray:
    """Samples to draw: where each signal (n,) is smallest and largest in each bin; all of a few."""
    n = len(signals[0])
    if n <= 2 * len(signals) * bins:
        return np.arange(n)
    kept = {0, n - 1}
    for a, b in itertools.pairwise(np.linspace(0, n, bins + 1).astype(int)):
        for signal in signals:
            part = signal[a:b]
            if np.isfinite(part).any():
                kept |= {a + int(np.nanargmin(part)), a + int(np.nanargmax(part))}
            else:
                kept.add(a)  # so that a gap stays one
    return np.array(sorted(kept))


def _part(made: Prediction, keep: np.ndarray, output: int) -> Prediction:
    """One output of a prediction at some of its times: quantiles of all would take long."""
    one = slice(output, output + 1)
    noise = made.noise_variance
    return dataclasses.replace(
        made,
        time=made.time[keep],
        output_names=made.output_names[one],
        component_mean=made.component_mean[:, keep, one],
        component_variance=made.component_variance[:, keep, one],
        noise_variance=noise[:, keep, one] if noise.ndim == 3 else noise[:, one],
        parts={},
    )


def _safe(text: str) -> str:
    """Text as it is: matplotlib takes dollar signs for formulas."""
    return text.replace("$", r"\$")


def _clipped(text: str, most: int) -> str:
    """Text without its middle where it is longer; the page has it whole."""
    if len(text) <= most:
        return text
    return f"{text[: most - most // 3]}…{text[len(text) - most // 3 + 1 :]}"


def _wrapped(text: str, width: int) -> str:
    """A label in three lines at most, its unit in one."""
    name, bracket, unit = text.partition(" [")
    unit = _clipped(unit.replace(" ", "\u00a0"), width - 4)
    whole = _clipped(name, 2 * width - 4) + bracket + unit
    return _safe(textwrap.fill(whole, width, break_on_hyphens=False))


__all__: Sequence[str] = ["before_after", "evidence", "residuals_before_after"]
