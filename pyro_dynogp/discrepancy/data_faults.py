"""Faults of the data that no model explains: gaps, stuck sensors, duplicates, spikes. Counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pyro_dynogp.discrepancy.evidence import Residuals

# A run of equal values is suspect where chance makes as long a one in one record of a thousand,
# and it is so many times as long as nearly all others.
CHANCE, TIMES, SHORT = 1e-3, 5.0, 10
# So many samples in a row that occur twice are a copy; with as many different values among them.
COPY, DIFFERENT = 10, 6
# A spike leaves its neighbours by as many robust standard deviations of such differences.
SPIKE = 8.0


@dataclass(frozen=True, eq=False)
class Fault:
    """What is wrong with a channel, and where.

    Attributes:
        kind: "gap", "stuck", "duplicate" or "spike". channel: its name.
        samples: (k,) numbers of the samples concerned.
        sentence: in words.
    """

    kind: str
    channel: str
    samples: np.ndarray
    sentence: str


def data_faults(residuals: Residuals) -> list[str]:
    """What is wrong with the data, a sentence for each kind and channel; none: nothing found."""
    return [fault.sentence for fault in faults(residuals)]


def faults(residuals: Residuals) -> list[Fault]:
    """Gaps, stuck values, copies and spikes of the output; stuck values of the candidates.

    Inputs rest where they are set to rest, so theirs are not looked at. Runs at a channel's largest
    or smallest value that come back are a limit, not a fault.

    Args:
        residuals: of one output (n,).
    """
    r = residuals
    found = [_gaps(r), _skipped(r), _copies(r), _spikes(r)]
    for name, x in [(r.output_name, r.output), *r.candidates.items()]:
        found.append(_stuck(r, name, x))
    return [fault for fault in found if fault is not None]


def _runs(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Beginnings and lengths of runs of equal values; NaN equals nothing."""
    starts = np.flatnonzero(np.concatenate([[True], ~(x[1:] == x[:-1])]))
    return starts, np.diff(np.append(starts, len(x)))


def _stuck(r: Residuals, name: str, x: np.ndarray) -> Fault | None:
    starts, lengths = _runs(x)
    known = np.isfinite(x[starts])
    starts, lengths = starts[known], lengths[known]
    if len(starts) < 10:
        return None
    # How often neighbours are equal at ordinary times: coarse steps of a sensor, or held values.
    short = lengths < SHORT
    ordinary = lengths[short] if lengths[short].sum() > lengths.sum() / 2 else lengths
    equal = 1.0 - len(ordinary) / ordinary.sum()
    chance = 1.0 + np.log(CHANCE / len(x)) / np.log(max(equal, 1e-6))
    limit = max(chance, TIMES * float(np.quantile(lengths, 0.98)), 5.0)
    extreme = (x[starts] == np.nanmax(x)) | (x[starts] == np.nanmin(x))
    again = np.array([(x[starts] == v).sum() > 1 for v in x[starts[lengths >= limit]]], dtype=bool)
    which = np.flatnonzero(lengths >= limit)
    which = which[~(extreme[which] & again)]
    if not len(which):
        return None
    samples = np.concatenate([np.arange(starts[k], starts[k] + lengths[k]) for k in which])
    longest = which[int(np.argmax(lengths[which]))]
    text = (
        f"{name!r} is stuck {_times(len(which))}, {len(samples)} samples in all, longest for "
        f"{lengths[longest] * r.step:.4g} {r.time_unit} from {r.time[starts[longest]]:.5g} "
        f"{r.time_unit} at {x[starts[longest]]:.5g}."
    )
    return Fault("stuck", name, samples, text)


def _gaps(r: Residuals) -> Fault | None:
    missing = ~np.isfinite(r.output)
    if not missing.any():
        return None
    starts, lengths = _runs(missing.astype(float))
    longest = int(lengths[missing[starts]].max())
    text = (
        f"{r.output_name!r} lacks {int(missing.sum())} of {len(r)} samples in "
        f"{int(missing[starts].sum())} gaps, the longest of {longest * r.step:.4g} {r.time_unit}."
    )
    return Fault("gap", r.output_name, np.flatnonzero(missing), text)


def _skipped(r: Residuals) -> Fault | None:
    """Rows that are not there: steps in time that are longer than the others."""
    steps = np.diff(r.time)
    wide = np.flatnonzero(steps > 1.5 * np.median(steps))
    # Where many steps differ the record is irregular, which is no fault.
    if not len(wide) or len(wide) > 0.05 * len(steps):
        return None
    text = f"The record skips time {_times(len(wide))}, at most {steps.max():.4g} {r.time_unit}."
    return Fault("gap", r.output_name, wide + 1, text)


def _copies(r: Residuals) -> Fault | None:
    """Stretches of the output that occur earlier in the record, value by value."""
    if len(r) < 3 * COPY:
        return None
    windows = np.lib.stride_tricks.sliding_window_view(r.output, COPY)
    changes = np.diff(np.sort(windows, axis=1), axis=1) > 0
    rich = np.flatnonzero(np.isfinite(windows).all(1) & (changes.sum(1) + 1 >= DIFFERENT))
    if not len(rich):
        return None
    _, first, which = np.unique(windows[rich], axis=0, return_index=True, return_inverse=True)
    # A window that overlaps the one it equals is part of a short period, not a copy.
    later = rich[rich - rich[first[which.ravel()]] >= COPY]
    if not len(later):
        return None
    samples = np.unique(later[:, None] + np.arange(COPY))
    text = (
        f"{r.output_name!r} repeats {len(samples)} earlier samples value by value, first at "
        f"{r.time[samples[0]]:.5g} {r.time_unit}: a copy?"
    )
    return Fault("duplicate", r.output_name, samples, text)


def _spikes(r: Residuals) -> Fault | None:
    """Single samples that leave both neighbours while those agree."""
    x = r.residual
    off = x[1:-1] - 0.5 * (x[2:] + x[:-2])
    apart = np.abs(x[2:] - x[:-2])
    known = np.isfinite(off)
    if known.sum() < 30:
        return None
    sd = 1.4826 * float(np.median(np.abs(off[known])))
    if sd <= 0:
        return None
    with np.errstate(invalid="ignore"):
        spikes = np.flatnonzero((np.abs(off) > SPIKE * sd) & (apart < 0.5 * np.abs(off))) + 1
    if not len(spikes):
        return None
    largest = spikes[int(np.argmax(np.abs(off[spikes - 1])))]
    text = (
        f"{r.output_name!r} has {len(spikes)} spikes of one sample, the largest of "
        f"{off[largest - 1]:.3g} {r.output_unit} at {r.time[largest]:.5g} {r.time_unit}."
    )
    return Fault("spike", r.output_name, spikes, text)


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
