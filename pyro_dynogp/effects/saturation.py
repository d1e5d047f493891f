"""A sensor that clips: an output that stops at a limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from scipy import stats

from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Effect, Parameters, number_of, variants_of
from pyro_dynogp.models.variants import Model, with_output_function
from pyro_dynogp.models.wiring import Static
from pyro_dynogp.statistics.autoregression import fitted_filter
from pyro_dynogp.statistics.bootstrap import noise_of, tail_probability
from pyro_dynogp.statistics.detecting import Search, lasting, one_sided
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, binned, evidence, labelled, unit
from pyro_dynogp.statistics.regression import solve, with_past
from pyro_dynogp.statistics.settings import LoopSettings

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit

# Quantiles of the mean above which it may flatten; below, their complements.
UPPER = np.array([0.5, 0.6, 0.7, 0.8, 0.9, 0.95])
# Values as near as this to each other, against the range, are the same number.
SAME = 1e-9


def saturation(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """Test whether the output stops at an upper or a lower limit.

    Two signs, of which either does: exact ties at the largest or smallest measured value (see
    `ties_at_the_top`), and an output that flattens where the mean goes on: to less than a share
    `flat` of its slope, or it is another nonlinearity. `where`: low, high [output], infinite where
    there is none.
    """
    r = residuals
    top = ties_at_the_top(r.output, r.mean, settings, seed=seed)
    bottom = ties_at_the_top(-r.output, -r.mean, settings, seed=seed)
    bottom = replace(bottom, limit=-bottom.limit)
    tied = min(1.0, 2.0 * min(top.p_value, bottom.p_value))
    knots = _knots(r.mean)
    variants = [with_past(np.clip(r.mean, *at) - r.mean) for at in knots]
    scan = one_sided(lasting(r, variants, with_past(r.mean), settings, seed), variants)
    # Two tests where values tie at all; two equal ones out of many may be chance.
    p = min(1.0, 2.0 * min(tied, scan.p_value)) if tied < 1.0 else scan.p_value
    statistic, gain, size = scan.statistic, scan.gain, scan.size
    if tied <= scan.p_value or tied < settings.tied:
        at_bottom, at_top = (end.p_value < settings.tied for end in (bottom, top))
        low = bottom.limit if at_bottom or bottom.p_value < top.p_value else -np.inf
        high = top.limit if at_top or top.p_value <= bottom.p_value else np.inf
        gain = -float(np.log(max(tied, 1e-300)))
        statistic, size = (2.0 * gain - 1.0) / np.sqrt(2.0), _cut(top, bottom, low, high)
        counts = [str(t.count) for t, at in ((bottom, low), (top, high)) if np.isfinite(at)]
        how = f" ({' and '.join(counts)} samples at exactly that value)"
    else:
        noticed = p < settings.noticed
        low, high, slope = _flat_limits(r, knots[scan.best], noticed, settings)
        p = 1.0 if (noticed and slope > settings.flat) or low >= high else p
        how = ""
    limits = [f"{at:.4g}{unit(r.output_unit)}" for at in (low, high) if np.isfinite(at)]
    label = labelled(r.output_name, r.output_unit)
    return evidence(
        "saturation",
        replace(scan, statistic=statistic, p_value=p, gains=np.array([gain]), best=0),
        {"low": low, "high": high},
        f"'{r.output_name}' stops at {' and '.join(limits)}{how}, {about(r, size)}.",
        binned(r, r.mean, r.output, np.clip(r.mean, low, high), (f"simulated {label}", label)),
        size,
    )


def _knots(mean: np.ndarray) -> list[tuple[float, float]]:
    """Limits in units of the mean that are tried: above, below, both."""
    high, low = np.quantile(mean, UPPER), np.quantile(mean, 1.0 - UPPER)
    above = [(-np.inf, float(c)) for c in high]
    below = [(float(c), np.inf) for c in low]
    both = [(float(a), float(b)) for a in low[1::2] for b in high[1::2]]
    return [*above, *below, *both]


def _flat_limits(
    r: Residuals, knot: tuple[float, float], finer: bool, settings: LoopSettings
) -> tuple[float, float, float]:
    """Output at the knots, and the slope beyond them as a share of that between them.

    The mean of a model that was fitted to a flattened output is too flat.

    With a finer look the knots are first moved to where they explain most.
    """
    m = r.mean
    low, high = knot
    if finer:
        grid = np.quantile(m, np.linspace(0.02, 0.98, 25))
        search = Search(r, m[:, None], settings)
        low, high = search.located_limits(lambda a, b: np.clip(m, a, b) - m, knot, grid)
    rows = r.held_out & np.isfinite(r.output)
    columns = np.column_stack([np.ones(len(r)), m, np.clip(m, low, high) - m])
    a, b, c = solve(columns[rows], r.output[rows])
    return float(a + b * low), float(a + b * high), float((b - c) / b) if b else 1.0


def _cut(top: Ties, bottom: Ties, low: float, high: float) -> float:
    """Root mean square of what limits cut off."""
    sizes = [t.size for t, at in ((bottom, low), (top, high)) if np.isfinite(at)]
    return float(np.sqrt(np.square(sizes).sum()))


@dataclass(frozen=True)
class Ties:
    """Samples at the largest value.

    Attributes:
        limit: that value [output]. count: of samples there.
        p_value: probability of as many were there no limit.
        size: root mean square of what is cut off, by the mean [output].
    """

    limit: float
    count: int
    p_value: float
    size: float


def ties_at_the_top(
    output: np.ndarray, mean: np.ndarray, settings: LoopSettings, *, seed: int = 0
) -> Ties:
    """Test whether more samples are at the largest value than the model has there.

    Under the null the record is mean plus residual (`Noise`), rounded to the record's own
    resolution: a slow record of few digits has ties at each of its peaks without any limit.

    Args:
        output: (n,) measured, NaN where missing [output]. mean: (n,) [output].
        settings: thresholds. seed: of the replicates.
    """
    measured = np.isfinite(output) & np.isfinite(mean)
    y = output[measured]
    top, spread = float(y.max(initial=-np.inf)), float(np.ptp(y)) if len(y) else 0.0
    count = int((y >= top - SAME * spread).sum())
    over = np.maximum(mean[measured] - top, 0.0)
    size = float(np.sqrt(np.mean(over**2)))
    if count < 3 or spread == 0:
        return Ties(top, count, 1.0, size)
    residual = np.where(measured, output - mean, np.nan)
    whiten, level = fitted_filter(residual, settings), residual[measured].mean()
    none = np.zeros((0, len(mean)))
    noise = noise_of(whiten.coefficients, whiten(residual), whiten.order + 1, ~measured, none)
    q, counts = _resolution(y, spread), []
    for series in noise.replicates(settings.replicates, seed):
        made = (mean + level + series)[:, measured]
        made = np.round((made - top) / q) if q > 0 else made
        counts.append((made >= made.max(1, keepdims=True)).sum(1))
    null = np.concatenate(counts).astype(float)
    # Most records have one sample at their maximum: a distribution of counts has a tail, too.
    p = float(stats.poisson.sf(count - 2, max(null.mean(), 1.0)))
    if null.std() > 0:
        p = max(p, tail_probability(null, count, settings))
    return Ties(top, count, p, size)


def _resolution(y: np.ndarray, spread: float) -> float:
    """Step to which values are rounded, zero where they are not."""
    distinct = np.unique(np.round(y / (SAME * spread)))
    gaps = np.diff(distinct) * SAME * spread
    if len(distinct) > 0.8 * len(y) or not len(gaps):
        return 0.0
    q = float(gaps.min())
    steps = gaps / q
    return q if np.abs(steps - np.round(steps)).max() < 0.05 else 0.0


class Saturation(Effect):
    """A sensor that clips."""

    name = "saturation"
    family = "shapes"
    acts_on = "inputs"
    special_of = "output nonlinearity"
    once = True
    experiments: ClassVar = {
        "output nonlinearity": "inputs that hold the output beyond the suspected limit",
    }
    test = staticmethod(saturation)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A static layer at the output whose prior mean stops at the limits."""
        low, high = (
            at if np.isfinite(at := number_of(evidence, end)) else None for end in ("low", "high")
        )
        # Which of several outputs the limits are of is not said, and what acts on the output
        # directly comes on top of the sensor.
        if model.outputs > 1 or model.direct:
            low = high = None
        limits = None if low is None and high is None else (low, high)
        return variants_of(with_output_function(model, limits))

    def parameters(self, fit: Fit, evidence: Evidence, record: Record) -> Parameters:
        """Limits of the sensor: its function where that is highest, or lowest.

        Posterior mean and standard deviation of the function [output] where it is best known of
        where it is at its limit to within a standard deviation; of the limits in the evidence.
        """
        if not isinstance(fit.model.output_wire.layer, Static):
            return {}
        band = fit.static_function(fit.model.output_wire.name, record)
        seen = (band.x >= band.inputs.min()) & (band.x <= band.inputs.max())
        mean, sd = band.mean[seen, 0], band.sd[seen, 0]
        scale, offset = fit.scaling.output_scale[0], fit.scaling.output_offset[0]
        limits: Parameters = {}
        for end, name, sign in (("low", "lower limit", -1.0), ("high", "upper limit", 1.0)):
            if np.isfinite(number_of(evidence, end)):
                top = int((sign * mean).argmax())
                flat = sign * mean >= sign * mean[top] - sd[top]
                at = int(np.where(flat, sd, np.inf).argmin())
                label = labelled(name, fit.scaling.output_units[0])
                limits[label] = float(offset + scale * mean[at]), float(scale * sd[at])
        return limits
