"""Noise whose size depends on an input, on the output or on time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import held
from pyro_dynogp.effects.base import Effect
from pyro_dynogp.layers.noise import Driver, Heteroscedastic
from pyro_dynogp.models.variants import Model, with_likelihood
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import binned, evidence, labelled
from pyro_dynogp.statistics.prewhitening import free_columns, prewhitened, spanning
from pyro_dynogp.statistics.responses import filtered
from pyro_dynogp.statistics.serial import held_out_innovations, one_step_sd
from pyro_dynogp.statistics.settings import LoopSettings

# Slow responses that may drive the size of the noise [steps].
MEMORY = (4.0, 16.0)


def heteroscedastic_noise(
    residuals: Residuals, settings: LoopSettings, *, seed: int = 0
) -> Evidence:
    """Noise whose size depends on an input, on the mean or on time.

    The size of the held-out one-step errors is regressed on each driver d: d and |d - median|,
    as they are or through a first-order response; on time by slow cosines. The absolute value
    stands for the size: under normal noise it has 88 % of the efficiency of the square, the
    logarithm of the square 40 %, and outliers do not carry it. Sizes that only cluster in time, as
    in autoregressive conditional heteroscedasticity, are the colour of the size, and no driver.

    Returns:
        where: driver (an input's name, "mean" or "time"). size: standard deviation over the record
        of the one-step error's standard deviation [output].

    Source: Glejser, JASA 64(325):316 (1969); efficiencies: Davidian & Carroll, JASA 82(400):1079
    (1987). The null: `prewhitened`.
    """
    r = residuals
    v = held_out_innovations(r, settings)
    y = np.abs(v - np.nanmean(v))
    names, variants = list[str](), list[np.ndarray]()
    for name, driver in [*zip(r.input_names, r.inputs.T, strict=True), ("mean", r.mean)]:
        d = held(driver)
        if not np.std(d) > 0:
            continue
        both = np.column_stack([d, np.abs(d - np.median(d))])
        slow = filtered(both, r.step, r.time, -1.0 / (r.step * np.array(MEMORY)), lags=0)
        variants += list(np.moveaxis(slow, 2, 0))
        names += [name] * slow.shape[2]
    t = (r.time - r.time[0]) / (r.time[-1] - r.time[0])
    cosines = np.cos(np.pi * t[:, None] * np.arange(1, 5))
    variants += [cosines[:, :1], cosines[:, :2], cosines]
    names += ["time"] * 3
    columns = np.column_stack(variants)
    columns = columns - columns.mean(0)
    ends = np.cumsum([v.shape[1] for v in variants])
    places = [np.arange(b - v.shape[1], b) for v, b in zip(variants, ends, strict=True)]
    scan = prewhitened(
        y,
        free_columns(columns, places),
        spanning(columns[:, :0]),
        r.deviations[:0],
        settings,
        first=columns if columns.shape[1] < np.isfinite(y).sum() // 5 else cosines,
        seed=seed,
    )
    name = names[scan.best]
    average = float(np.nanmean(y))
    level = np.maximum(average + scan.fitted, 0.05 * average)
    low, high = np.quantile(level[np.isfinite(y)], [0.05, 0.95])
    unit = one_step_sd(r, settings) / average
    shown = r.time if name == "time" else variants[scan.best][:, 0]
    axes = (
        name if name == "time" else f"{name}, as it acts",
        labelled(f"standard deviation of the noise of {r.output_name}", r.output_unit),
    )
    what = "the mean" if name == "mean" else name if name == "time" else repr(name)
    return evidence(
        "heteroscedastic noise",
        scan,
        {"driver": name},
        f"The noise of {r.output_name!r} depends on {what}: its standard deviation varies "
        f"by a factor of {high / low:.3g} (5 to 95 % of the samples).",
        binned(r, shown, unit * y, unit * level, axes, bins=20),
        unit * scan.size,
    )


class HeteroscedasticNoise(Effect):
    """Noise whose size depends on an input or on the output."""

    name = "heteroscedastic noise"
    once = True
    score = "one step"
    family = "noise"
    acts_on = "noise"
    freedom = 3
    test = staticmethod(heteroscedastic_noise)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Log standard deviation of the noise as a Gaussian process of what it follows."""
        if model.inputs == model.direct:
            return []
        of: Driver = "output" if evidence.where["driver"] == "mean" else "inputs"
        noise = Heteroscedastic(of=of)
        if noise.follows_output and model.has_feedback:  # which such noise is not defined for
            return []
        return [with_likelihood(model, noise)]
