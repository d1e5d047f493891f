"""A sine of unknown period in the residual: a disturbance that no input explains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.fft import next_fast_len

from pyro_dynogp.data.channels import Sinusoid
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Effect, changed, number_of, unit_of
from pyro_dynogp.effects.periodic_lines import harmonics, lines, refined, slots
from pyro_dynogp.models.variants import Model, with_channel
from pyro_dynogp.statistics.autoregression import check_samples
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, averages, evidence, residual_axis
from pyro_dynogp.statistics.prewhitening import Projection, prewhitened, spanning
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import input_columns

# Grid of frequencies: so many for each 1 / duration.
OVERSAMPLING = 4
# Shares of its resolution by which a period is moved to refine it, first and then.
NEARER = ((-0.1, -0.05, 0.05, 0.1), (-0.03, 0.03))


def periodic_disturbance(
    residuals: Residuals, settings: LoopSettings, *, seed: int = 0
) -> Evidence:
    """A sine of any period in the residual, beside what the inputs explain; all samples.

    Lines need length: what was fitted to is looked at, too. A fit can take part of a line up, not
    make one.

    Frequencies from `cycles` periods in what is looked at to half the sampling rate, four for each
    1 / duration; the best is refined between its neighbours. Periods that fit the harmonics 2 to 4
    of it are named in the sentence.

    Args:
        residuals: of one output (n,), steps equal or multiples of one step.
        settings: thresholds. seed: of the replicates.

    Returns:
        where: period [time unit].

    Raises:
        ValueError: where too few samples are measured, or steps are irregular.

    Source: harmonic F test, Thomson, Proc. IEEE 70(9):1055 (1982), with one taper, in the whitened
    residual; the largest over frequencies as in Fisher, Proc. R. Soc. A 125:54 (1929).
    """
    r = residuals
    at = slots(r)
    n = int(at[-1]) + 1
    x = np.full(n, np.nan)
    x[at] = r.residual
    looked = np.flatnonzero(np.isfinite(x))
    check_samples(len(looked), settings, "measured samples")
    span = int(looked[-1] - looked[0]) + 1
    # Only what is looked at counts, so that the grid is no finer than it need be.
    x, kept = x[looked[0] : looked[-1] + 1], (at >= looked[0]) & (at <= looked[-1])
    beside = input_columns(r)[kept]
    nuisance = np.zeros((span, beside.shape[1]))
    nuisance[at[kept] - looked[0]] = beside
    nuisance = spanning(nuisance)
    length = next_fast_len(OVERSAMPLING * span, real=True)
    bins = np.arange(int(np.ceil(settings.cycles * length / span)), length // 2)
    deviations = np.zeros((len(r.deviations), span))
    deviations[:, at[kept] - looked[0]] = r.deviations[:, kept]
    missing = ~np.isfinite(x)
    variants = lines(bins, length, nuisance, missing, settings)
    scan = prewhitened(x, variants, nuisance, deviations, settings, seed=seed)
    under = Projection(scan.whitener, nuisance, missing, settings)
    frequency = refined(under, x, bins[scan.best] / length, 1.0 / length)
    period = r.step / frequency
    effect, also = harmonics(under, x, frequency, settings.harmonic)
    size = float(np.sqrt(np.mean(effect**2)))
    more = f", with harmonics {', '.join(map(str, also))}" if also else ""
    return evidence(
        "periodic disturbance",
        scan,
        {"period": period, "output": r.output_name, "time_unit": r.time_unit},
        f"A disturbance of {r.output_name!r} with a period of {period:.4g} {r.time_unit}"
        f"{more}: {about(r, size)}.",
        _folded(r, x, effect, period),
        size,
    )


def _folded(r: Residuals, x: np.ndarray, effect: np.ndarray, period: float) -> Curve:
    """Residual and effect over the phase, averaged in up to 24 bins."""
    phase, rows = (np.arange(len(x)) * r.step) % period, np.isfinite(x)
    count = int(np.clip(period / r.step, 4, 24))
    bins = np.minimum(phase / period * count, count - 1).astype(int)[rows]
    at, y, fitted = averages(bins, count, phase[rows], x[rows] - x[rows].mean(), effect[rows])
    return Curve(at, y, fitted, f"time within the period [{r.time_unit}]", residual_axis(r))


class PeriodicDisturbance(Effect):
    """A line that no input explains."""

    name = "periodic disturbance"
    family = "time"
    freedom = 4  # its period is free, where the calendar's are known
    test = staticmethod(periodic_disturbance)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A sinusoid of the period, and of periods within its resolution.

        Or of two and three times the period: process noise may have taken the fundamental, and the
        residual has a harmonic only.
        """
        period = number_of(evidence, "period")
        width = period**2 / record.duration
        waves = [Sinusoid(period + share * width, 1) for share in (-0.2, -0.1, 0.0, 0.1, 0.2)]
        waves.append(Sinusoid(period, 3))
        # What does not come twice in a record is a drift.
        waves += [Sinusoid(k * period, k) for k in (2, 3) if 2 * k * period <= record.duration]
        return [with_channel(model, wave) for wave in waves]

    def refine(self, model: Model, record: Record, times: int) -> Sequence[Model]:
        """The period a little shorter and longer, in shares of its resolution."""
        wave = model.channels[-1]
        assert isinstance(wave, Sinusoid)
        width = wave.period**2 / record.duration
        return [
            changed(model, [wave], period=wave.period + share * width) for share in NEARER[times]
        ]

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """The period as refits have it."""
        wave = model.channels[-1]
        assert isinstance(wave, Sinusoid)
        several = f" and {wave.harmonics} harmonics" if wave.harmonics > 1 else ""
        return (
            f"A disturbance of {evidence.where['output']!r} with a period of "
            f"{wave.period:.4g}{unit_of(evidence)}{several}."
        )
