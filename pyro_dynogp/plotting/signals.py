"""Figures over time: a record, and a prediction beside what was measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pyro_dynogp.plotting import style
from pyro_dynogp.support.errors import invalid, whole

if TYPE_CHECKING:
    from pyro_dynogp.data.record import Record
    from pyro_dynogp.prediction.prediction import Prediction


def record(record: Record) -> Figure:
    """Outputs and inputs over time, one panel each; inputs as the steps that models take them for.

    Missing output samples leave gaps and are marked at the bottom of their panel.

    Args:
        record: what to show; dates on the time axis where it has time stamps.

    Raises:
        ValueError: the record has neither inputs nor outputs.
    """
    count = record.n_outputs + record.n_inputs
    if not count:
        raise invalid("record", expected="inputs or outputs to draw", got="neither")
    figure, axes = style.panels(count, height=0.9 + 1.75 * count, share_x=True)
    clock = style.TimeAxis(record)
    x = clock.positions(record.time)
    for a, name in enumerate(record.output_names):
        panel = axes[a, 0]
        style.draw_measured(panel, x, record.outputs[:, a], "output", style.MEASURED)
        missing = x[record.missing[:, a]]
        if len(missing):
            panel.plot(
                missing,
                np.full(len(missing), 0.03),
                transform=panel.get_xaxis_transform(),
                linestyle="none",
                marker="|",
                markersize=9,
                markeredgewidth=1.2,
                color=style.ACCENT,
                label="missing output sample",
            )
        style.label(panel, y=style.named(name, record.output_units[a]))
    for b, name in enumerate(record.input_names):
        panel = axes[record.n_outputs + b, 0]
        panel.plot(
            x,
            record.inputs[:, b],
            drawstyle="steps-post",
            color=style.INPUT,
            linewidth=1.2 if len(x) <= 2000 else 0.8,
            label="input, constant between samples",
        )
        style.label(panel, y=style.named(name, record.input_units[b]))
    axes[0, 0].margins(x=0.01)
    clock.decorate(axes[-1, 0])
    style.title(figure, record.name or "record")
    style.legend(figure)
    return figure


def prediction(
    prediction: Prediction,
    record: Record | None = None,
    skip: int = 0,
    past: Record | None = None,
) -> Figure:
    """Predictive mean with 50 and 95 % bands, what was measured, and the residual below.

    The bands are quantiles of measured outputs, so that 95 % of the samples should lie in the wide
    one. Around the residual lies the wide band less the mean.

    Args:
        prediction: what to show.
        record: measured outputs at the same times; without it (or `past`) units and time stamps
            are not known, and there is no residual.
        skip: number of first samples that are not scored; they are shaded.
        past: measured outputs before the prediction, on the same clock.

    Raises:
        ValueError: other times or outputs in `record` than in the prediction; `skip` out of
            range; other outputs or another kind of clock in `past`.
    """
    _check(prediction, record, skip, past)
    reference = past if record is None else record
    clock = style.TimeAxis(reference)
    x = clock.positions(prediction.time)
    low, lower, upper, high = prediction.quantile([0.025, 0.25, 0.75, 0.975])
    n_y = prediction.mean.shape[1]
    has_residual = record is not None and record.n_outputs > 0
    step = 2 if has_residual else 1
    figure, axes = style.panels(
        n_y * step,
        height=1.1 + n_y * (4.6 if has_residual else 3.4),
        ratios=[3.0, 1.2] * n_y if has_residual else None,
        share_x=True,
    )
    for a, name in enumerate(prediction.output_names):
        panel = axes[a * step, 0]
        mean = prediction.mean[:, a]
        unit = "" if reference is None or not reference.n_outputs else reference.output_units[a]
        if past is not None:
            before = clock.positions(past.time, past.start)
            style.draw_measured(panel, before, past.outputs[:, a], "measured before", style.MUTED)
            for one in axes[a * step : (a + 1) * step, 0]:
                one.axvline(x[0], color=style.MUTED, linewidth=1.0, linestyle=(0, (4, 3)))
        panel.fill_between(x, low[:, a], high[:, a], label="95 % band", **style.BAND_95)
        panel.fill_between(x, lower[:, a], upper[:, a], label="50 % band", **style.BAND_50)
        panel.plot(x, mean, color=style.MODEL, linewidth=1.5, label="predictive mean")
        style.label(panel, y=style.named(name, unit))
        if record is None or not has_residual:
            continue
        measured = record.outputs[:, a]
        style.draw_measured(panel, x, measured, "measured", style.MEASURED)
        below = axes[a * step + 1, 0]
        below.fill_between(x, low[:, a] - mean, high[:, a] - mean, **style.BAND_95)
        below.axhline(0.0, color=style.MODEL, linewidth=1.0)
        style.draw_measured(below, x, measured - mean, "measured", style.MEASURED)
        style.label(below, y=style.named("residual", unit))
        for one, shift in ((panel, np.zeros_like(mean)), (below, mean)):
            if skip:
                drawn = np.stack([low[:, a] - shift, high[:, a] - shift, measured - shift])
                _leave_out(one, x, drawn, skip)
    axes[0, 0].margins(x=0.01)
    clock.decorate(axes[-1, 0])
    figure.align_ylabels()
    style.title(figure, prediction.kind[:1].upper() + prediction.kind[1:])
    style.legend(figure, columns=6)
    return figure


def _leave_out(axes: Axes, x: np.ndarray, drawn: np.ndarray, skip: int) -> None:
    """Shade the samples that are not scored; their bands, often very wide, set no limits."""
    # Up to the middle between the last sample left out and the first that counts.
    axes.axvspan(x[0], 0.5 * (x[skip - 1] + x[skip]), color="#E9E4D4", zorder=0, label="not scored")
    low, high = np.nanmin(drawn[:, skip:]), np.nanmax(drawn[:, skip:])
    margin = 0.06 * (high - low)
    axes.set_ylim(low - margin, high + margin)


def _check(prediction: Prediction, record: Record | None, skip: int, past: Record | None) -> None:
    names = prediction.output_names
    if record is not None:
        prediction.check(record, outputs=record.n_outputs > 0)
    whole(0, len(prediction) - 1).check("skip", skip)
    if past is None:
        return
    if past.output_names != names:
        raise invalid("past", expected=f"outputs {list(names)}", got=f"{list(past.output_names)}")
    if record is not None and (past.start is None) != (record.start is None):
        raise invalid(
            "past",
            expected="the same kind of clock as the record",
            got="time stamps in one and plain times in the other",
        )
