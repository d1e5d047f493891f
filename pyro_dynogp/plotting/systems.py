"""Figures of an identified system: impulse response, Bode diagram, poles."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.isolation import isolated
from pyro_dynogp.lti import views
from pyro_dynogp.plotting import style
from pyro_dynogp.plotting.layers import Shown, frequency_grid, shown_layer
from pyro_dynogp.support.errors import instance, invalid
from pyro_dynogp.support.tensors import Numbers

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit

DAMPING_LINES = (0.05, 0.1, 0.2, 0.4, 0.7)


@isolated
def impulse_response(fit: Fit, time: Numbers | None = None, *, layer: str | None = None) -> Figure:
    """Response of each output to a unit impulse of each input, with credible bands.

    The bands hold 50 and 95 % of the posterior draws at each time by itself. The impulse that the
    direct path passes on at time 0 cannot be drawn; its weight is written into the panel.

    Args:
        fit: a fit with inputs. A "map" fit has one line and no band.
        time: times since the impulse (m,) [time unit of the record]; by default until the median
            response has died down, at most the length of the training record.
        layer: of a cascade, the dynamic layer, whose signals are in standard deviations; None for
            the only one.

    Raises:
        ValueError: the layer has no inputs, or there is no such one; `time` is not a row of finite
            numbers.
    """
    shown = _with_inputs(fit, layer)
    grid = _settling_grid(shown, fit) if time is None else _row("time", time)
    draws = _draws(views.impulse_response, shown, grid)
    direct = _unbatched(shown.draws.D, shown).reshape(-1, *draws.shape[2:])
    scaling = fit.scaling
    n_y, n_u = draws.shape[2:]
    figure, axes = style.panels(
        n_y, n_u, width=9.0 if n_u == 1 else 5.0 * n_u, height=1.0 + 3.4 * n_y, share_x=True
    )
    for a, output in enumerate(shown.outputs):
        for b, given in enumerate(shown.inputs):
            panel = axes[a, b]
            panel.axhline(0.0, color=style.MUTED, linewidth=0.9)
            style.draw_bands(panel, grid, draws[:, :, a, b])
            unit = style.per_input(output, given, scaling.time_unit)
            style.label(panel, y=f"response [{unit}]")
            style.title(panel, f"from {given[0]} to {output[0]}")
            weight = direct[:, a, b]
            if np.any(weight):
                varies = np.ptp(weight) > 1e-12 * np.abs(weight).max()
                spread = f" ± {weight.std():.2g}" if varies else ""
                panel.annotate(
                    f"and an impulse of weight {weight.mean():.2g}{spread} at time 0",
                    (0.985, 0.96),
                    xycoords="axes fraction",
                    ha="right",
                    va="top",
                    fontsize=style.TICK_SIZE,
                    color="#555555",
                )
            panel.set_xlim(grid[0], grid[-1])
    for panel in axes[-1]:
        style.label(panel, x=style.named("time since the impulse", scaling.time_unit))
    style.title(figure, f"Impulse response{shown.title}")
    style.legend(figure)
    return figure


@isolated
def bode(fit: Fit, omega: Numbers | None = None, *, layer: str | None = None) -> Figure:
    """Magnitude and phase of the transfer function from each input to each output, with bands.

    The bands hold 50 and 95 % of the posterior draws at each frequency by itself. The phase is
    unwrapped along the frequency; draws are shifted by whole turns to where they agree best.

    Args:
        fit: a fit with inputs. A "map" fit has one line and no band.
        omega: increasing positive angular frequencies (m,) [rad/time unit]; by default from one
            period in twice the training record to a little above the Nyquist frequency, beyond
            which the samples say nothing, closer around resonances, whose peaks it meets.
        layer: of a cascade, the dynamic layer, whose signals are in standard deviations; None for
            the only one.

    Raises:
        ValueError: the layer has no inputs, or there is no such one; `omega` is not increasing and
            positive.
    """
    shown = _with_inputs(fit, layer)
    scaling = fit.scaling
    nyquist = np.pi / scaling.time_step
    if omega is None:
        grid = frequency_grid(shown, np.pi / scaling.duration, 1.6 * nyquist)
    else:
        grid = _row("omega", omega)
        if grid[0] <= 0 or (np.diff(grid) <= 0).any():
            raise invalid("omega", expected="increasing positive frequencies", got=f"{grid[:5]}...")
    response = _draws(views.frequency_response, shown, grid)
    n_y, n_u = response.shape[2:]
    figure, axes = style.panels(
        2 * n_y,
        n_u,
        width=9.0 if n_u == 1 else 5.0 * n_u,
        height=1.0 + 4.9 * n_y,
        ratios=[1.35, 1.0] * n_y,
        share_x=True,
    )
    for a, output in enumerate(shown.outputs):
        for b, given in enumerate(shown.inputs):
            magnitude, phase = axes[2 * a, b], axes[2 * a + 1, b]
            G = response[:, :, a, b]
            style.draw_bands(magnitude, grid, 20.0 * np.log10(np.abs(G)))
            style.draw_bands(phase, grid, _unwrapped(G))
            # Ticks at parts or multiples of right angles, in which a phase is read.
            low, high = phase.dataLim.intervaly
            ticks = next((step for step in (15, 30, 45, 90, 180) if high - low < 7 * step), 360)
            phase.yaxis.set_major_locator(MultipleLocator(ticks))
            style.label(magnitude, y="magnitude [dB]")
            style.label(phase, y="phase [degrees]")
            style.title(
                magnitude,
                f"from {style.named(*given)} to {style.named(*output)}",
            )
    for panel in axes.flat:
        panel.set_xscale("log")
        panel.set_xlim(grid[0], grid[-1])
        if grid[0] < nyquist < grid[-1]:
            panel.axvline(
                nyquist,
                color=style.INPUT,
                linewidth=1.2,
                linestyle=(0, (4, 3)),
                label="Nyquist frequency",
            )
    for panel in axes[-1]:
        style.label(panel, x=f"angular frequency [rad/{scaling.time_unit}]")
    figure.align_ylabels()
    style.title(figure, f"Bode diagram{shown.title}")
    style.legend(figure)
    return figure


@isolated
def pole_map(fit: Fit, *, layer: str | None = None) -> Figure:
    """Poles in the upper left half of the complex plane, with lines of constant damping.

    Each pole stands for a conjugate pair. Every posterior draw is a faint point; a cross marks
    the best optimum found. The axes end where 1 % of the draws lie beyond; how many of them are
    not shown is written below.

    Args:
        fit: any fit; a "map" fit has crosses alone.
        layer: of a cascade, the dynamic layer; None for the only one.

    Raises:
        ValueError: there is no such layer, or several where none is named.
    """
    instance("fit", fit, Fitted, "dgp.fit(...) makes one.")
    unit = fit.scaling.time_unit
    shown = shown_layer(fit, layer)
    draws, best = np.asarray(shown.draws.poles).ravel(), shown.best
    figure, axes = style.panels(1, width=7.6, height=6.2)
    panel = axes[0, 0]
    sampled = fit.method != "map"
    decay = [-best.real.min() * 1.12, np.quantile(-draws.real, 0.99) if sampled else 0.0]
    height = [best.imag.max() * 1.12, np.quantile(draws.imag, 0.99) if sampled else 0.0]
    left, top = max(decay), max(height)
    _damping_lines(panel, left, top)
    beyond = 0
    if sampled:
        panel.plot(
            draws.real,
            draws.imag,
            linestyle="none",
            marker=".",
            markersize=5,
            markeredgewidth=0,
            alpha=max(0.15, min(0.6, 350.0 / len(draws))),
            color=style.MODEL,
            label="posterior draws",
        )
        beyond = int(((-draws.real > left) | (draws.imag > top)).sum())
    panel.plot(
        best.real,
        best.imag,
        linestyle="none",
        marker="x",
        markersize=9,
        markeredgewidth=2.2,
        color=style.INPUT if sampled else style.MODEL,
        label="best optimum" if sampled else "posterior mode (MAP fit: no draws)",
    )
    panel.axvline(0.0, color=style.MEASURED, linewidth=1.0)
    panel.set_xlim(-left, 0.02 * left)
    panel.set_ylim(0.0, top)
    panel.grid(False)
    across = f"real part [1/{unit}]"
    if beyond:
        across += f"      ({beyond} of {len(draws)} draws lie outside)"
    style.label(panel, x=across, y=f"imaginary part [rad/{unit}]")
    style.title(figure, f"Poles{shown.title}, one of each conjugate pair")
    style.legend(figure)
    return figure


def _damping_lines(axes: Axes, left: float, top: float) -> None:
    for index, ratio in enumerate(DAMPING_LINES):
        slope = np.sqrt(1.0 - ratio**2) / ratio
        end = min(left, top / slope)
        axes.plot(
            [0.0, -end],
            [0.0, slope * end],
            color="#CFCFCF",
            linewidth=1.0,
            zorder=0,
            label=None if index else "constant damping ratio",
        )
        axes.annotate(
            f"{ratio:g}",
            (-0.93 * end, 0.93 * slope * end),
            ha="center",
            va="center",
            fontsize=style.TICK_SIZE - 0.5,
            color="#777777",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.2},
        )


def _with_inputs(fit: Fit, layer: str | None) -> Shown:
    instance("fit", fit, Fitted, "dgp.fit(...) makes one.")
    shown = shown_layer(fit, layer) if fit.model.inputs else None
    if shown is None or not shown.draws.inputs:
        raise invalid(
            "fit",
            expected="a model with inputs, which has a transfer function",
            got="one without inputs",
        )
    return shown


def _row(argument: str, values: Numbers) -> np.ndarray:
    row = np.asarray(values, dtype=np.float64)
    if row.ndim != 1 or len(row) < 2 or not np.isfinite(row).all():
        raise invalid(
            argument, expected="shape (m,), two finite numbers or more", got=f"shape {row.shape}"
        )
    return row


def _unbatched(values: Any, shown: Shown) -> np.ndarray:
    """Values with a first dimension of draws, which those of a "map" fit lack."""
    array = np.asarray(values)
    return array if shown.draws.batch_shape else array[None]


def _draws(function: Any, shown: Shown, grid: np.ndarray) -> np.ndarray:
    """A response (S, m, n_y, n_u) of every draw, in blocks of the grid that bound the memory."""
    modes = shown.draws
    each = modes.batch_shape.numel() * modes.outputs * modes.pairs
    block = max(1, 2_000_000 // each)
    parts = [
        _unbatched(function(modes, grid[i : i + block]), shown) for i in range(0, len(grid), block)
    ]
    return np.concatenate(parts, axis=1)


def _settling_grid(shown: Shown, fit: Fit) -> np.ndarray:
    """Times until every median response has fallen below 1 % of its largest value for good."""
    scaling = fit.scaling
    trial = np.concatenate([[0.0], np.geomspace(0.02 * scaling.time_step, scaling.duration, 300)])
    size = np.median(np.abs(_draws(views.impulse_response, shown, trial)), axis=0)
    largest = size.max(axis=0)
    audible = (size > 0.01 * np.where(largest > 0, largest, 1.0)).any(axis=(1, 2))
    last = int(np.flatnonzero(audible)[-1]) if audible.any() else len(trial) - 1
    return np.linspace(0.0, trial[min(last + 2, len(trial) - 1)], 500)


def _unwrapped(G: np.ndarray) -> np.ndarray:
    """Phase (S, m) [degrees] of responses, continuous along the frequency, draws together."""
    phase = np.unwrap(np.angle(G), axis=1)
    direction = np.exp(1j * phase).mean(axis=0)
    agreed = int(np.argmax(np.abs(direction)))
    turn = 2.0 * np.pi
    phase -= turn * np.round((phase[:, [agreed]] - np.angle(direction[agreed])) / turn)
    phase -= turn * np.round(np.median(phase[:, 0]) / turn)
    return np.degrees(phase)
