"""Which path from an input to the output is missing: a channel, a delay, dynamics."""

from __future__ import annotations

import numpy as np
from scipy import signal as signals

from pyro_dynogp.data.signals import delayed, held, shifted
from pyro_dynogp.statistics.detecting import (
    NOTICED,
    binned,
    labelled,
    lasting,
    located,
    profiled,
    regained,
    unexplained,
    unit,
)
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.regression import with_past
from pyro_dynogp.statistics.responses import filtered, responses, standardised, time_constants
from pyro_dynogp.statistics.shares_of_inputs import check_inputs, looked_at, own, paths

# A delay is named only where it gains as much [nats]: a parameter more must pay for itself.
DELAY_GAIN = 3.0
# Damping ratio of the resonances that are tried: broad enough for a grid of twelve frequencies.
DAMPING, FREQUENCIES = 0.15, 12
# Damping ratios of which the best is named.
DAMPINGS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.7)


def extra_input(residuals: Residuals, *, seed: int = 0) -> list[Evidence]:
    """Test each recorded channel that the model does not use.

    The channel (linear), its square, its absolute value (both about its mean) and its products with
    used inputs go through a bank of filters, at delays up to a tenth of the record. What mean and
    responses of the used inputs explain is theirs. `where`: channel, form, delay [time unit].

    Returns:
        One piece of evidence for each candidate.

    Raises:
        ValueError: where fewer than 30 samples are held out and measured.
    """
    if not residuals.candidates:
        return []
    nuisance = own(residuals)
    return [_extra(residuals, name, nuisance, seed) for name in residuals.candidates]


def _forms(residuals: Residuals, name: str) -> dict[str, np.ndarray]:
    w = standardised(held(residuals.candidates[name])[:, None])[:, 0]
    u = standardised(residuals.inputs)
    forms = {"linear": w}
    if len(np.unique(w)) > 2:  # of a flag square and absolute value are the flag again
        forms |= {"square": w**2, "absolute": np.abs(w)}
    for j, used in enumerate(residuals.input_names):
        forms[f"product with {used}"] = w * u[:, j]
    return forms


def _extra(residuals: Residuals, name: str, nuisance: np.ndarray, seed: int) -> Evidence:
    r = residuals

    def bank(form: np.ndarray, delay: float) -> np.ndarray:
        late = delayed(form, r.time, delay) if delay else form
        return responses(late, r.step, r.time, constants=4, lags=1)

    forms = _forms(r, name)
    longest = 0.1 * (r.time[-1] - r.time[0])
    coarse = np.concatenate([[0.0], np.geomspace(2.0 * r.step, longest, 4)])
    tried = [(f, d) for f in forms for d in (coarse[:1] if f.startswith("product") else coarse)]
    found = lasting(r, [bank(forms[f], d) for f, d in tried], nuisance, seed)
    form, delay = tried[found.best]
    fitted = found.fitted
    if found.p_value < NOTICED:
        grid = np.concatenate([[0.0], np.geomspace(0.5 * r.step, longest, 24)])
        delay = located(r, lambda d: bank(forms[form], d), delay, grid, nuisance)
        ways = [bank(forms[form], 0.0), bank(forms[form], delay)]
        alone = profiled(r, ways, nuisance, ways[1])
        # A filter's own lag is not a delay, and one that gains little is not worth a parameter.
        delay = delay if alone[1] - alone[0] > DELAY_GAIN and delay >= r.step else 0.0
    late = f", {delay:.3g}{unit(r.time_unit)} later" if delay else ""
    how = {"linear": "", "square": " by its square", "absolute": " by its absolute value"}
    return Evidence(
        effect="extra input",
        statistic=found.statistic,
        p_value=found.p_value,
        gain=found.gain,
        size=found.size,
        where={"channel": name, "form": form, "delay": delay},
        sentence=f"Channel '{name}' acts on '{r.output_name}'{how.get(form, f' as {form}')}{late}, "
        f"about {found.size:.2g}{unit(r.output_unit)} (rms).",
        curve=binned(
            r,
            delayed(held(r.candidates[name]), r.time, delay),
            unexplained(r, nuisance, fitted),
            fitted,
            (name, labelled("residual", r.output_unit)),
        ),
    )


def dead_time(residuals: Residuals, *, seed: int = 0) -> Evidence:
    """Test whether the output follows an input later (or earlier) than the model says.

    The column is mean_j(t - d) - mean_j(t), where mean_j is what input j contributes to the mean:
    all of it with one input, the share by `paths` with several. The delay is that at which the
    column fits with a weight of one. `where`: channel, delay (additional, > 0 for later)
    [time unit].

    Raises:
        ValueError: where fewer than 30 samples are held out and measured.
    """
    r = residuals
    names, shares = r.input_names, paths(r).shares
    longest = 0.1 * (r.time[-1] - r.time[0])

    def late(j: int, delay: float) -> np.ndarray:
        return shifted(shares[:, j], r.time, delay) - shares[:, j]

    sizes = np.geomspace(0.25 * r.step, longest, 12)
    coarse = np.concatenate([-sizes[::-1], sizes])
    tried = [(j, float(d)) for j in range(len(names)) for d in coarse]
    variants = [with_past(late(j, d)) for j, d in tried]
    mean = r.mean[:, None]
    found = lasting(regained(r), variants, mean, seed)
    j, nearest = tried[found.best]
    # Without a column for no delay, small ones of either sign look the same but for their weight.
    grid = np.unique(np.concatenate([coarse, np.linspace(-1.0, 1.0, 9) * r.step]))
    delay = nearest
    if found.p_value < NOTICED:
        delay = located(r, lambda d: late(j, d), nearest, grid, mean, weight=1.0)
    profile = profiled(r, [late(j, d) for d in grid], mean, late(j, delay), weight=1.0)
    column = late(j, delay)
    word = "later" if delay > 0 else "earlier"
    label = labelled("additional delay", r.time_unit)
    return Evidence(
        effect="dead time",
        statistic=found.statistic,
        p_value=found.p_value,
        gain=found.gain,
        size=float(column.std()),
        where={"channel": names[j], "delay": delay},
        sentence=f"'{r.output_name}' follows channel '{names[j]}' {abs(delay):.3g}"
        f"{unit(r.time_unit)} {word} than the model says, "
        f"about {column.std():.2g}{unit(r.output_unit)} (rms).",
        curve=Curve(grid, profile, np.full(len(grid), np.nan), label, "gain [nats]"),
    )


def unmodelled_dynamics(residuals: Residuals, *, seed: int = 0) -> Evidence:
    """Test for linear responses of the used inputs beyond what the mean already is.

    Variants are the bank of first-order responses of each input, of all inputs together, and a
    resonance at each of a grid of frequencies. `where`: frequency [rad / time unit] and
    time_constant [time unit] of the resonance where that is the best variant (its time constant of
    decay); else the frequency of the largest coherence between the residual and the input that
    explains most, and the time constant of the first-order response of it that does.

    Raises:
        ValueError: where fewer than 30 samples are held out and measured.
    """
    check_inputs(residuals)
    r = regained(residuals)
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
    found = lasting(r, variants, nuisance, seed)
    j, at = tried[found.best]
    j = j if j >= 0 else int(np.argmax(found.gains[:n_u]))
    frequencies, coherence = _coherence(r, r.inputs[:, j])
    if np.isfinite(at):
        peak = at
        if found.p_value < NOTICED:
            peak = located(r, lambda w: _resonance(r, j, w, DAMPING), at, grid, nuisance)
        damped = [_resonance(r, j, peak, z) for z in DAMPINGS]
        gains = profiled(r, damped, nuisance, _resonance(r, j, peak, DAMPING))
        constant = 1.0 / (DAMPINGS[int(np.argmax(gains))] * peak)
    else:
        peak = float(frequencies[np.argmax(coherence)])
        constants = time_constants(r.step, r.time, 24)
        single = filtered(r.inputs[:, [j]], r.step, r.time, -1.0 / constants, 0)[:, 0, 1:]
        singles = list(standardised(single).T)
        gains = profiled(r, singles, nuisance, banks[j])
        constant = float(constants[np.argmax(gains)])
    blank = np.full(len(frequencies), np.nan)
    label = labelled("frequency", f"rad/{r.time_unit}" if r.time_unit else "")
    return Evidence(
        effect="unmodelled dynamics",
        statistic=found.statistic,
        p_value=found.p_value,
        gain=found.gain,
        size=found.size,
        where={"frequency": peak, "time_constant": constant},
        sentence=f"'{r.output_name}' responds to channel '{r.input_names[j]}' by dynamics that the "
        f"model lacks (time constant about {constant:.2g}{unit(r.time_unit)}, frequency "
        f"{peak:.2g} rad{'/' + r.time_unit if r.time_unit else ''}), "
        f"about {found.size:.2g}{unit(r.output_unit)} (rms).",
        curve=Curve(frequencies, coherence, blank, label, f"coherence with {r.input_names[j]}"),
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
    e = np.where(r.held_out, r.residual, np.nan)
    e = np.nan_to_num(e - np.nanmean(e))
    at = np.arange(r.time[0], r.time[-1] + 0.5 * r.step, r.step)
    nearest = np.clip(np.searchsorted(r.time, at + 1e-6 * r.step, side="right") - 1, 0, len(e) - 1)
    u = held(u)
    length = max(16, int(r.held_out.sum()) // 8)
    f, c = signals.coherence(
        e[nearest], (u - u.mean())[nearest], fs=1.0 / r.step, nperseg=min(length, len(at))
    )
    return 2.0 * np.pi * f[1:], np.nan_to_num(c[1:])
