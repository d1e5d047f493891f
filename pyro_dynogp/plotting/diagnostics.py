"""Figures that check a fit: residuals, the course of the optimisation, the starts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pyro_dynogp.plotting import style
from pyro_dynogp.support.errors import invalid

if TYPE_CHECKING:
    from pyro_dynogp.data.record import Record
    from pyro_dynogp.fitting import Fit


def residuals(fit: Fit, record: Record) -> Figure:
    """Check the standardised one-step prediction errors: white, standard normal, free of inputs.

    For each output: the errors over time; their histogram against the standard normal density;
    their autocorrelation; their cross-correlation with each input. Missing samples are left out,
    lags count samples.

    The bands are ±1.96/sqrt(number of pairs): where the errors are white (and, for the cross-
    correlation, independent of the input), 95 % of the correlations lie inside, each lag taken by
    itself. They are no bands for all lags at once: of 40 lags, two outside are expected. Before
    the cross-correlation the input is prewhitened by an autoregression fitted to it, since a
    slow input would make neighbouring lags rise and fall together. A correlation outside at a
    positive lag means that the input acts on the output in a way that the model lacks.

    Args:
        fit: the fit. record: with outputs; the training record or another one.

    Raises:
        ValueError: fewer than ten errors of an output.
    """
    errors = fit.innovations(record)
    n, n_y = errors.shape
    counts = np.isfinite(errors).sum(axis=0)
    if counts.min() < 10:
        raise invalid(
            "record",
            expected="ten measured samples or more of each output",
            got=f"{counts.min()} of {record.output_names[int(counts.argmin())]!r}",
        )
    lags = int(min(25, n // 4))
    with_inputs = record.n_inputs > 0
    figure, axes = style.panels(2 * n_y, 2, width=10.5, height=0.9 + 5.2 * n_y)
    clock = style.TimeAxis(record)
    x = clock.positions(record.time)
    for a, name in enumerate(record.output_names):
        over_time, shape, auto, cross = axes[2 * a : 2 * a + 2].ravel()
        e = errors[:, a]
        over_time.axhspan(-1.96, 1.96, color=style.MODEL, alpha=0.12, linewidth=0)
        over_time.plot(
            x, e, linestyle="none", marker="o", markersize=2.6 if n <= 2000 else 1.2,
            color=style.MEASURED,
        )  # fmt: skip
        over_time.margins(x=0.01)
        style.label(over_time, y="error [standard deviations]")
        style.title(over_time, f"{name}: one-step prediction errors, standardised")
        clock.decorate(over_time)
        _histogram(shape, e)
        correlation, pairs = cross_correlation(e, e, np.arange(1, lags + 1))
        _stems(auto, np.arange(1, lags + 1), correlation, style.MEASURED, None)
        _band(auto, np.arange(1, lags + 1), pairs)
        style.label(auto, x="lag [samples]", y="correlation [-]")
        style.title(auto, "autocorrelation of the errors")
        if not with_inputs:
            cross.set_axis_off()
            continue
        _cross_panel(cross, record, e, lags)
    style.title(figure, f"Residuals of {record.name}" if record.name else "Residuals")
    style.legend(figure)
    return figure


def _histogram(axes: Axes, e: np.ndarray) -> None:
    seen = e[np.isfinite(e)]
    edges = np.histogram_bin_edges(seen, bins="fd")
    if not 12 <= len(edges) <= 60:  # outliers stretch, few samples coarsen the automatic bins
        edges = np.linspace(seen.min(), seen.max(), int(np.clip(len(edges), 12, 60)))
    axes.hist(
        seen, bins=edges.tolist(), density=True, color="#BFBFBF", edgecolor="white", linewidth=0.4,
        label="errors",
    )  # fmt: skip
    reach = max(3.5, float(np.abs(seen).max()))
    grid = np.linspace(-reach, reach, 300)
    density = np.exp(-0.5 * grid**2) / np.sqrt(2.0 * np.pi)
    axes.plot(grid, density, color=style.MODEL, linewidth=1.8, label="standard normal")
    style.label(axes, x="error [standard deviations]", y="density [1/standard deviation]")
    style.title(axes, "distribution")


def _cross_panel(axes: Axes, record: Record, e: np.ndarray, lags: int) -> None:
    every = np.arange(-lags, lags + 1)
    constant = []
    pairs = None
    for b, name in enumerate(record.input_names):
        u = record.inputs[:, b]
        if u.std() <= 1e-12 * np.abs(u).max():
            constant.append(name)
            continue
        correlation, pairs = cross_correlation(prewhitened(u), e, every)
        shift = 0.6 * (b - 0.5 * (record.n_inputs - 1)) / record.n_inputs
        several = record.n_inputs > 1
        color = style.PALETTE[(b + 1) % len(style.PALETTE)] if several else style.INPUT
        _stems(axes, every + shift, correlation, color, f"input {name}" if several else None)
    if pairs is not None:
        _band(axes, every, pairs)
    text = "cross-correlation, input before error at positive lags"
    if constant:
        text = f"no cross-correlation with constant {', '.join(constant)}"
    style.label(axes, x="lag [samples]", y="correlation [-]")
    style.title(axes, text)


def _stems(axes: Axes, x: np.ndarray, height: np.ndarray, color: str, text: str | None) -> None:
    axes.vlines(x, 0.0, height, color=color, linewidth=1.4)
    axes.plot(x, height, linestyle="none", marker="o", markersize=3.4, color=color, label=text)
    axes.axhline(0.0, color=style.MUTED, linewidth=0.9)


def _band(axes: Axes, x: np.ndarray, pairs: np.ndarray) -> None:
    half = 1.96 / np.sqrt(np.maximum(pairs, 1))
    axes.fill_between(
        x, -half, half, color=style.MODEL, alpha=0.15, linewidth=0,
        label="95 % of each lag, if the errors are white",
    )  # fmt: skip
    reach = max(0.3, 1.15 * max(abs(limit) for limit in axes.dataLim.intervaly))
    axes.set_ylim(-reach, reach)


def cross_correlation(
    first: np.ndarray, second: np.ndarray, lags: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Correlation of first[t] with second[t + lag], pairs with a missing value left out.

    Args:
        first: (n,). second: (n,); NaN marks missing values. lags: (m,) whole numbers.

    Returns:
        Correlations (m,), and the number of pairs (m,) of each; NaN where there is none.
    """
    a, b = (values - np.nanmean(values) for values in (first, second))
    scale = np.nanstd(first) * np.nanstd(second)
    n = len(a)
    correlation, count = np.full(len(lags), np.nan), np.zeros(len(lags), dtype=int)
    for i, lag in enumerate(lags):
        early, late = max(0, -lag), max(0, lag)
        product = a[early : n - late] * b[late : n - early]
        there = np.isfinite(product)
        count[i] = there.sum()
        if count[i]:
            correlation[i] = product[there].mean() / scale
    return correlation, count


def prewhitened(u: np.ndarray) -> np.ndarray:
    """What of an input (n,) its own past does not predict; NaN for the first samples.

    The autoregression is fitted by least squares, its order chosen by Akaike's criterion among 0
    to 10 log10(n), at most a quarter of the samples.
    """
    v = u - u.mean()
    n = len(v)
    most = int(min(10 * np.log10(n), n // 4))
    past = np.column_stack([np.ones(n - most), *(v[most - k : n - k] for k in range(1, most + 1))])
    target = v[most:]
    best, kept = np.inf, target
    for order in range(most + 1):
        columns = past[:, : order + 1]
        error = target - columns @ np.linalg.lstsq(columns, target, rcond=None)[0]
        power = float(np.mean(error**2))
        if power <= 1e-20 * float(np.mean(v**2)):
            break  # a periodic input predicts itself; nothing would be left to correlate
        criterion = len(target) * np.log(power) + 2 * order
        if criterion < best:
            best, kept = criterion, error
    return np.concatenate([np.full(most, np.nan), kept])


def history(fit: Fit) -> Figure:
    """Objective after each iteration, with a mean over 50 where it is a noisy estimate (SVI).

    The first tenth of the iterations may lie far off and leave the axis, so that the rest can be
    read; where they do, the title says from where the objective came.

    Args:
        fit: the fit.

    Raises:
        ValueError: the fit holds no history.
    """
    values = np.asarray(fit.history, dtype=np.float64)
    if not len(values):
        raise invalid("fit", expected="a history of the objective", got="none")
    figure, axes = style.panels(1, width=8.0, height=4.2)
    panel = axes[0, 0]
    iteration = np.arange(1, len(values) + 1)
    noisy = fit.method == "svi"
    panel.plot(
        iteration, values, color=style.MODEL, linewidth=0.7 if noisy else 1.6,
        marker="o" if len(values) == 1 else None,
        alpha=0.5 if noisy else 1.0, label="estimate" if noisy else None,
    )  # fmt: skip
    if noisy and len(values) >= 50:
        mean = np.convolve(values, np.full(50, 1 / 50), mode="valid")
        panel.plot(
            iteration[49:], mean, color=style.INPUT, linewidth=1.8, label="mean of the last 50"
        )
    later = values[len(values) // 10 :]
    low, high = np.quantile(later, [0.02, 1.0]) if noisy else (later.min(), later.max())
    margin = 0.06 * (high - low) or 1.0
    if values.min() < low - margin or values.max() > high + margin:
        panel.set_ylim(low - margin, high + margin)
        style.title(panel, f"begins at {values[0]:.4g}, off the axis")
    name = "evidence lower bound" if noisy else "-log p(outputs, parameters)"
    style.label(panel, x="iteration [-]", y=f"{name} [nats]")
    style.title(figure, "SearchState of the optimisation")
    style.legend(figure)
    return figure


def starts(fit: Fit) -> Figure:
    """What each start came to, best first, as the distance to the best.

    Several starts at zero: the optimum was found again, and there is reason to trust it. The best
    one alone: more starts may find a better one.

    Args:
        fit: the fit.
    """
    energies = np.asarray(fit.start_energies, dtype=np.float64)
    above = energies - energies.min()
    figure, axes = style.panels(1, width=7.0, height=3.9)
    panel = axes[0, 0]
    rank = np.arange(1, len(above) + 1)
    panel.vlines(rank, 0.0, above, color="#CFCFCF", linewidth=2.0)
    panel.plot(rank, above, linestyle="none", marker="o", markersize=7, color=style.MODEL)
    # Starts closer than one nat count as the same, farther than a hundred as lost.
    panel.set_yscale("symlog", linthresh=1.0)
    panel.set_ylim(bottom=-0.3)
    panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.label(
        panel, x="start, best first [-]", y="-log p(outputs, parameters)\nabove the best [nats]"
    )
    style.title(figure, f"Optima of {len(above)} starts; the best: {energies.min():.1f} nats")
    return figure
