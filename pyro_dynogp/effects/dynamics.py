"""More poles than the model has."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import signal as signals

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import held
from pyro_dynogp.effects.base import Effect
from pyro_dynogp.models.variants import Model, with_pairs
from pyro_dynogp.statistics.detecting import Search, lasting, looked, regained
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, evidence, labelled, unit
from pyro_dynogp.statistics.responses import filtered, responses, standardised, time_constants
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import check_inputs, looked_at

# Damping ratio of the resonances that are tried: broad enough for a grid of twelve frequencies.
DAMPING, FREQUENCIES = 0.15, 12
# Damping ratios of which the best is named.
DAMPINGS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.7)


def unmodelled_dynamics(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """Test for linear responses of the used inputs beyond what the mean already is.

    Variants are the bank of first-order responses of each input, of all inputs together, and a
    resonance at each of a grid of frequencies. `where`: frequency [rad / time unit] and
    time_constant [time unit] of the resonance where that is the best variant (its time constant of
    decay); else the frequency of the largest coherence between the residual and the input that
    explains most, and the time constant of the first-order response of it that does.
    """
    check_inputs(residuals)
    r = regained(residuals, settings)
    n_u = r.inputs.shape[1]
    banks = [responses(r.inputs[:, [j]], r.step, r.time) for j in range(n_u)]
    longest = 0.2 * (r.time[-1] - r.time[0])
    grid = np.geomspace(2.0 * np.pi / longest, 0.8 * np.pi / r.step, FREQUENCIES)
    # Bank of each input, a resonance of each, all banks together: what, of which input, where.
    tried: list[tuple[int, float]] = [(j, np.nan) for j in range(n_u)]
    tried += [(j, float(w)) for j in range(n_u) for w in grid]
    variants = banks + [_resonance(r, j, w, DAMPING) for j in range(n_u) for w in grid]
    if n_u > 1 and 8 * n_u * banks[0].shape[1] <= looked_at(r):
        tried.append((-1, np.nan))
        variants.append(np.column_stack(banks))
    nuisance = r.mean[:, None]
    scan, search = lasting(r, variants, nuisance, settings, seed), Search(r, nuisance, settings)
    j, at = tried[scan.best]
    j = j if j >= 0 else int(np.argmax(scan.gains[:n_u]))
    frequencies, coherence = _coherence(r, r.inputs[:, j])
    if np.isfinite(at):
        peak = at
        if scan.p_value < settings.noticed:
            peak = search.located(lambda w: _resonance(r, j, w, DAMPING), at, grid)
        damped = [_resonance(r, j, peak, z) for z in DAMPINGS]
        gains = search.gains(damped, _resonance(r, j, peak, DAMPING))
        constant = 1.0 / (DAMPINGS[int(np.argmax(gains))] * peak)
    else:
        peak = float(frequencies[np.argmax(coherence)])
        constants = time_constants(r.step, r.time, 24)
        single = filtered(r.inputs[:, [j]], r.step, r.time, -1.0 / constants, 0)[:, 0, 1:]
        singles = list(standardised(single).T)
        gains = search.gains(singles, banks[j])
        constant = float(constants[np.argmax(gains)])
    blank = np.full(len(frequencies), np.nan)
    label = labelled("frequency", f"rad/{r.time_unit}" if r.time_unit else "")
    return evidence(
        "unmodelled dynamics",
        scan,
        {"frequency": peak, "time_constant": constant},
        f"'{r.output_name}' responds to channel '{r.input_names[j]}' by dynamics that the "
        f"model lacks (time constant about {constant:.2g}{unit(r.time_unit)}, frequency "
        f"{peak:.2g} rad{'/' + r.time_unit if r.time_unit else ''}), "
        f"{about(r, scan.size)}.",
        Curve(frequencies, coherence, blank, label, f"coherence with {r.input_names[j]}"),
    )


def _resonance(residuals: Residuals, j: int, frequency: float, damping: float) -> np.ndarray:
    """Both quadratures of a damped oscillator driven by input j, and the input one step before."""
    rate = frequency * (-damping + 1j * np.sqrt(1.0 - damping**2))
    r = residuals
    both = filtered(r.inputs[:, [j]], r.step, r.time, np.array([rate]), 1)
    return standardised(both[:, 0, 1:])


def _coherence(residuals: Residuals, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies [rad / time unit] and coherence of residual and input, by Welch's method.

    Irregular samples are read at equal steps; missing ones count as zero, which lowers coherence.
    """
    r = residuals
    e = looked(r)
    e = np.nan_to_num(e - np.nanmean(e))
    at = np.arange(r.time[0], r.time[-1] + 0.5 * r.step, r.step)
    nearest = np.clip(np.searchsorted(r.time, at + 1e-6 * r.step, side="right") - 1, 0, len(e) - 1)
    u = held(u)
    length = max(16, int(r.held_out.sum()) // 8)
    f, c = signals.coherence(
        e[nearest], (u - u.mean())[nearest], fs=1.0 / r.step, nperseg=min(length, len(at))
    )
    return 2.0 * np.pi * f[1:], np.nan_to_num(c[1:])


class UnmodelledDynamics(Effect):
    """More poles than the model has."""

    name = "unmodelled dynamics"
    family = "paths"
    acts_on = "inputs"
    freedom = 5
    test = staticmethod(unmodelled_dynamics)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """One pair of poles more, or two."""
        return [with_pairs(model, 1), with_pairs(model, 2)]
