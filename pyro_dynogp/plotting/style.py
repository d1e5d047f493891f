"""What all figures share: colours, axes, legends, labels with units, time axes, bands."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib.dates as mdates
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

if TYPE_CHECKING:
    from pyro_dynogp.data.record import Record

# Colours of Okabe and Ito, which colour-blind readers can tell apart.
MEASURED = "#222222"
MODEL = "#0072B2"
INPUT = "#D55E00"
ACCENT = "#CC79A7"
MUTED = "#8A8A8A"
PALETTE = (MODEL, INPUT, "#009E73", ACCENT, "#E69F00", "#56B4E9")
TITLE_SIZE, LABEL_SIZE, TICK_SIZE = 12, 10.5, 9.5
BAND_95: dict[str, Any] = {"color": MODEL, "alpha": 0.17, "linewidth": 0}
BAND_50: dict[str, Any] = {"color": MODEL, "alpha": 0.36, "linewidth": 0}


class ShownFigure(Figure):
    """A Figure that a notebook shows without pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=110)
        return buffer.getvalue()


def panels(
    rows: int,
    columns: int = 1,
    *,
    width: float = 9.0,
    height: float = 5.0,
    ratios: Sequence[float] | None = None,
    share_x: bool = False,
) -> tuple[Figure, np.ndarray]:
    """Make a figure with a grid of plain axes (rows, columns)."""
    layout = ConstrainedLayoutEngine(w_pad=0.09, h_pad=0.07)
    figure = ShownFigure(figsize=(width, height), dpi=110, layout=layout, facecolor="white")
    axes = figure.subplots(
        rows, columns, squeeze=False, sharex=share_x, gridspec_kw={"height_ratios": ratios}
    )
    for one in axes.flat:
        plain(one)
    return figure, axes


def plain(axes: Axes) -> None:
    """Give axes a light grid and no frame at the top and right."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.tick_params(labelsize=TICK_SIZE, color=MUTED)
    axes.grid(True, color="#E6E6E6", linewidth=0.8)
    axes.set_axisbelow(True)


def label(axes: Axes, *, x: str | None = None, y: str | None = None) -> None:
    """Label the axes."""
    if x is not None:
        axes.set_xlabel(x, fontsize=LABEL_SIZE)
    if y is not None:
        axes.set_ylabel(y, fontsize=LABEL_SIZE)


def title(figure_or_axes: Any, text: str) -> None:
    """Title: centred above a figure, or at the left of one panel."""
    if isinstance(figure_or_axes, Figure):
        figure_or_axes.suptitle(text, fontsize=TITLE_SIZE, fontweight="bold")
    else:
        figure_or_axes.set_title(text, fontsize=LABEL_SIZE, loc="left")


def legend(figure: Figure, columns: int = 5) -> None:
    """One legend below all panels, where it hides no data; each label once."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(text, handle)
    if entries:
        figure.legend(
            list(entries.values()),
            list(entries),
            loc="outside lower center",
            ncols=min(columns, len(entries)),
            frameon=False,
            fontsize=TICK_SIZE,
        )


def named(name: str, unit: str) -> str:
    """Name with its unit, as axes are labelled; the name alone where no unit is stated."""
    return f"{name} [{unit}]" if unit else name


def per_input(output: tuple[str, str], given: tuple[str, str], time_unit: str) -> str:
    """Unit of an impulse response: output over input and time; each given as (name, unit)."""
    top, bottom = (unit or f"unit of {name}" for name, unit in (output, given))
    return f"({top})/({bottom} {time_unit})" if " " in top else f"{top}/({bottom} {time_unit})"


class TimeAxis:
    """Times as numbers in the time unit of a record, or as dates where it has time stamps.

    Args:
        reference: the record whose clock it is; None for plain numbers without a known unit.
    """

    def __init__(self, reference: Record | None) -> None:
        self.unit = "" if reference is None else reference.time_unit
        self.start = None if reference is None else reference.start

    def positions(self, time: np.ndarray, start: Any = None) -> np.ndarray:
        """Where to draw times (n,); `start` is the instant of their zero, if it is another."""
        if self.start is None:
            return np.asarray(time)
        origin = self.start if start is None else start
        zero = mdates.date2num(origin.tz_convert("UTC").tz_localize(None).to_datetime64())
        return zero + np.asarray(time) / 86400.0

    def decorate(self, axes: Axes) -> None:
        """Ticks and label of the time axis."""
        if self.start is None:
            label(axes, x=named("time", self.unit))
            return
        locator = mdates.AutoDateLocator(tz=self.start.tz)
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(mdates.ConciseDateFormatter(locator, tz=self.start.tz))
        label(axes, x=f"time [date, {self.start.tz}]")


def draw_measured(axes: Axes, x: np.ndarray, y: np.ndarray, text: str, color: str) -> None:
    """Measured samples: dots joined by a thin line; the line alone where there are many."""
    few = len(x) <= 600
    axes.plot(
        x,
        y,
        color=color,
        linewidth=0.5 if few else 0.8,
        marker="o" if few else None,
        markersize=2.6,
        label=text,
        zorder=3,
    )


def draw_bands(axes: Axes, x: np.ndarray, draws: np.ndarray) -> None:
    """Median and credible bands at each x of posterior draws (S, n); one line for S = 1."""
    if len(draws) == 1:
        axes.plot(
            x, draws[0], color=MODEL, linewidth=1.6, label="posterior mode (MAP fit: no band)"
        )
        return
    low, lower, middle, upper, high = np.quantile(draws, [0.025, 0.25, 0.5, 0.75, 0.975], axis=0)
    axes.fill_between(x, low, high, label="95 % credible band", **BAND_95)
    axes.fill_between(x, lower, upper, label="50 % credible band", **BAND_50)
    axes.plot(x, middle, color=MODEL, linewidth=1.6, label="posterior median")
