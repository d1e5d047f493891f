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
from pyro_dynogp.statistics.bootstrap import replicates, sieve, spanning
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.shares_of_inputs import own
from pyro_dynogp.statistics.time_pictures import size_in_words
from pyro_dynogp.support.errors import invalid

# A period is at least this often in what is looked at; slower is drift. Grid of frequencies: so
# many for each 1 / duration.
CYCLES, OVERSAMPLING = 3.0, 4
# Shares of its resolution by which a period is moved to refine it, first and then.
NEARER = ((-0.1, -0.05, 0.05, 0.1), (-0.03, 0.03))


def periodic_disturbance(residuals: Residuals, *, seed: int = 0) -> Evidence:
    """A sine of any period in the residual, beside what the inputs explain; all samples.

    Lines need length: what was fitted to is looked at, too. A fit can take part of a line up, not
    make one.

    Frequencies from three cycles in what is looked at to half the sampling rate, four for each
    1 / duration; the best is refined between its neighbours. Periods that fit the harmonics 2 to 4
    of it are named in the sentence.

    Args:
        residuals: of one output (n,), steps equal or multiples of one step.
        seed: of the replicates.

    Returns:
        where: period [time unit].

    Raises:
        ValueError: where fewer than 30 samples are measured, or steps are irregular.

    Source: harmonic F test, Thomson, Proc. IEEE 70(9):1055 (1982), with one taper, in the whitened
    residual; the largest over frequencies as in Fisher, Proc. R. Soc. A 125:54 (1929).
    """
    r = residuals
    at = slots(r)
    n = int(at[-1]) + 1
    x = np.full(n, np.nan)
    x[at] = r.residual
    looked = np.flatnonzero(np.isfinite(x))
    span = int(looked[-1] - looked[0]) + 1 if len(looked) else 0
    if len(looked) < 30:
        raise invalid("residuals", expected="at least 30 measured samples", got=str(len(looked)))
    # Only what is looked at counts, so that the grid is no finer than it need be.
    x, kept = x[looked[0] : looked[-1] + 1], (at >= looked[0]) & (at <= looked[-1])
    beside = own(r)[kept]
    nuisance = np.zeros((span, beside.shape[1]))
    nuisance[at[kept] - looked[0]] = beside
    nuisance = spanning(nuisance)
    length = next_fast_len(OVERSAMPLING * span, real=True)
    bins = np.arange(int(np.ceil(CYCLES * length / span)), length // 2)
    prepare = lines(bins, length, nuisance, ~np.isfinite(x))
    deviations = np.zeros((len(r.deviations), span))
    deviations[:, at[kept] - looked[0]] = r.deviations[:, kept]
    found = sieve(
        x,
        prepare,
        np.full(len(bins), 2.0),
        deviations=deviations,
        joint=True,
        replicates=replicates(span, 2 * nuisance.shape[1]),
        seed=seed,
    )
    frequency = refined(found.whitener, x, nuisance, bins[found.best] / length, 1.0 / length)
    period = r.step / frequency
    effect, also = harmonics(found.whitener, x, nuisance, frequency)
    size = float(np.sqrt(np.mean(effect**2)))
    more = f", with harmonics {', '.join(map(str, also))}" if also else ""
    return Evidence(
        effect="periodic disturbance",
        statistic=found.statistic,
        p_value=found.p_value,
        gain=found.gain,
        size=size,
        where={"period": period, "output": r.output_name, "time_unit": r.time_unit},
        sentence=f"A disturbance of {r.output_name!r} with a period of {period:.4g} {r.time_unit}"
        f"{more}: {size_in_words(r, size)}.",
        curve=_folded(r, x, effect, period),
    )


def _folded(r: Residuals, x: np.ndarray, effect: np.ndarray, period: float) -> Curve:
    """Residual and effect over the phase, averaged in up to 24 bins."""
    phase = (np.arange(len(x)) * r.step) % period
    bins = np.minimum((phase / period * (B := int(np.clip(period / r.step, 4, 24)))), B - 1)
    bins = np.where(np.isfinite(x), bins, B).astype(int)
    count = np.bincount(bins, minlength=B + 1)[:B]
    shown, y = count > 0, np.nan_to_num(x - np.nanmean(x))

    def averaged(values: np.ndarray) -> np.ndarray:
        return (np.bincount(bins, values, minlength=B + 1)[:B] / np.maximum(count, 1))[shown]

    return Curve(
        x=averaged(phase),
        y=averaged(y),
        fitted=averaged(effect),
        x_label=f"time within the period [{r.time_unit}]",
        y_label=f"residual of {r.output_name} [{r.output_unit}]",
    )


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
