"""Figures of static functions, of several models on one record, of the law of the errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from scipy.special import ndtri
from scipy.stats import beta

from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.isolation import isolated
from pyro_dynogp.plotting import style
from pyro_dynogp.plotting.layers import chosen_layer
from pyro_dynogp.prediction.prediction import Prediction
from pyro_dynogp.support.errors import instance, invalid

if TYPE_CHECKING:
    from pyro_dynogp.data.record import Record
    from pyro_dynogp.fitting import Fit


@isolated
def static_function(
    fit: Fit, record: Record, layer: str | None = None, *, channel: int = 0
) -> Figure:
    """A static layer's function with its 50 and 95 % band, and where a record has data for it.

    The band counts the parameters and the function itself, at each value by itself. Below is the
    density of the layer's input along the record: where there are no data the function is a guess.

    Args:
        fit: of a model with a static layer. record: with inputs and outputs.
        layer: name of the static layer; None for the only one.
        channel: which of its inputs varies, others at their mean.

    Raises:
        ValueError: no such layer, or several where none is named; no such channel; another record.
    """
    instance("fit", fit, Fitted, "dgp.fit(...) makes one.")
    dynamic = {wire.name for wire, _ in fit.system.dynamic}
    names = [wire.name for wire in fit.model.wires if wire.name not in dynamic]
    name = chosen_layer(names, layer, "static")
    band = fit.static_function(name, record, channel=channel)
    wire = next(wire for wire in fit.model.wires if wire.name == name)
    outputs = band.mean.shape[1]
    figure, axes = style.panels(
        outputs + 1, width=7.6, height=1.6 + 3.6 * outputs, ratios=[3.0] * outputs + [1.0],
        share_x=True,
    )  # fmt: skip
    for e in range(outputs):
        panel, mean, sd = axes[e, 0], band.mean[:, e], band.sd[:, e]
        for q, look, text in (
            (0.975, style.BAND_95, "95 % band"),
            (0.75, style.BAND_50, "50 % band"),
        ):
            reach = ndtri(q) * sd
            panel.fill_between(band.x, mean - reach, mean + reach, label=text, **look)
        panel.plot(band.x, mean, color=style.MODEL, linewidth=1.6, label="mean")
        label = name if outputs == 1 else f"{name} {e + 1}"
        style.label(panel, y=f"{label} [standard deviations]")
    below = axes[-1, 0]
    below.hist(band.inputs, bins=40, density=True, color=style.MUTED, label="data")
    seen = wire.sources[0] if wire.channels == 1 else f"channel {channel} of {name}"
    style.label(below, x=f"{seen} [standard deviations]", y="density")
    below.set_xlim(band.x[0], band.x[-1])
    figure.align_ylabels()
    style.title(figure, f"Static function {name}")
    style.legend(figure)
    return figure


@isolated
def compare(predictions: Mapping[str, Prediction], record: Record, *, skip: int = 0) -> Figure:
    """Predictions of several models on one record: means with 95 % bands, residuals below.

    Args:
        predictions: by name of the model, of the times of the record.
        record: with outputs.
        skip: number of first samples that the errors in the legend leave out.

    Raises:
        ValueError: no predictions, others than of this record, or too many samples skipped.
    """
    if not isinstance(predictions, Mapping) or not predictions:
        raise invalid("predictions", expected="predictions by name", got=type(predictions).__name__)
    for name, one in predictions.items():
        instance(f"predictions[{name!r}]", one, Prediction)
        one.check(record)
    if isinstance(skip, bool) or not isinstance(skip, int) or not 0 <= skip < len(record):
        raise invalid("skip", expected=f"0 to {len(record) - 1}", got=repr(skip))
    clock = style.TimeAxis(record)
    x = clock.positions(record.time)
    n_y = record.n_outputs
    figure, axes = style.panels(
        2 * n_y, height=1.2 + 4.6 * n_y, ratios=[3.0, 1.4] * n_y, share_x=True
    )
    for a, output in enumerate(record.output_names):
        above, below = axes[2 * a, 0], axes[2 * a + 1, 0]
        measured = record.outputs[:, a]
        style.draw_measured(above, x, measured, "measured", style.MEASURED)
        for k, (name, one) in enumerate(predictions.items()):
            color = style.PALETTE[k % len(style.PALETTE)]
            low, high = one.quantile([0.025, 0.975])[:, :, a]
            mean = one.mean[:, a]
            error = measured - mean
            rmse = np.sqrt(np.nanmean(error[skip:] ** 2))
            unit = record.output_units[a]
            text = f"{name}: RMSE {rmse:.3g}{' ' + unit if unit else ''}"
            above.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
            above.plot(x, mean, color=color, linewidth=1.4, label=text)
            below.plot(x, error, color=color, linewidth=1.0)
        below.axhline(0.0, color=style.MUTED, linewidth=0.9)
        style.label(above, y=style.named(output, record.output_units[a]))
        style.label(below, y=style.named("residual", record.output_units[a]))
    axes[0, 0].margins(x=0.01)
    clock.decorate(axes[-1, 0])
    figure.align_ylabels()
    kinds = {one.kind for one in predictions.values()}
    style.title(figure, f"Models compared: {', '.join(sorted(kinds))}, with 95 % bands")
    style.legend(figure)
    return figure


@isolated
def quantiles(fit: Fit, record: Record) -> Figure:
    """Quantiles of the standardised one-step errors against those of the normal distribution.

    Where the model is right the points lie on the diagonal; the band holds each ordered error with
    95 % probability, taken by itself: the k-th of n uniform numbers is Beta(k, n + 1 - k).
    Curved ends are tails heavier or lighter than normal, another slope is noise of another size.

    Args:
        fit: the fit. record: with outputs; the training record or another one.

    Raises:
        ValueError: fewer than ten errors of an output.
    """
    instance("fit", fit, Fitted, "dgp.fit(...) makes one.")
    errors = fit.innovations(record)
    n_y = errors.shape[1]
    figure, axes = style.panels(1, n_y, width=max(5.4, 4.6 * n_y), height=5.2)
    for a, name in enumerate(record.output_names):
        seen = np.sort(errors[np.isfinite(errors[:, a]), a])
        n = len(seen)
        if n < 10:
            raise invalid(
                "record", expected="ten measured samples or more of each output",
                got=f"{n} of {name!r}",
            )  # fmt: skip
        k = np.arange(1, n + 1)
        expected = ndtri((k - 0.5) / n)
        low, high = (ndtri(beta.ppf(q, k, n + 1 - k)) for q in (0.025, 0.975))
        panel = axes[0, a]
        panel.fill_between(expected, low, high, label="95 % of each, if the model is right",
                           **style.BAND_95)  # fmt: skip
        panel.plot(expected, expected, color=style.MODEL, linewidth=1.2)
        panel.plot(
            expected, seen, linestyle="none", marker="o", markersize=3.0, color=style.MEASURED,
            label="errors",
        )  # fmt: skip
        style.label(panel, x="standard normal quantile", y="error [standard deviations]")
        style.title(panel, name)
    style.title(figure, "Quantiles of the one-step errors")
    style.legend(figure)
    return figure
