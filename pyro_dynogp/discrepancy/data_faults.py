"""Faults of the data that no model explains: gaps, stuck sensors, duplicates, spikes. Counts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.pictures import unit
from pyro_dynogp.statistics.settings import LoopSettings

# A run of equal values is suspect where chance makes as long a one in one record of a thousand,
# and it is so many times as long as nearly all others.
CHANCE, TIMES, SHORT = 1e-3, 5.0, 10
# A sensor that falls to the end of its range changes by so many times as much as nearly always; a
# signal that reaches a limit comes by ordinary steps.
SUDDEN = 3.0
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


def faults(record: Record, candidates: Sequence[str] = ()) -> list[Fault]:
    """Gaps, stuck values and copies of the outputs; stuck values of the candidates.

    Inputs rest where they are set to rest, so theirs are not looked at, and outputs may rest while
    they do. A run of equal values at an end of a channel's range is a limit, not a fault, unless
    the channel falls there all at once.

    Args:
        record: in one piece.
        candidates: names of extra channels that may act.
    """
    found = []
    for a, name in enumerate(record.output_names):
        y = record.outputs[:, a]
        found += [_gaps(record, name, y), _copies(record, name, y), _stuck(record, name, y, True)]
    found += [_stuck(record, name, record.extra[name], False) for name in candidates]
    return [fault for fault in (_skipped(record), *found) if fault is not None]


def without_stuck(record: Record, found: Iterable[Fault]) -> Record:
    """The record whose stuck outputs count as missing: what they report was not measured."""
    outputs = record.outputs.copy()
    for fault in found:
        if fault.kind == "stuck" and fault.channel in record.output_names:
            outputs[fault.samples, record.output_names.index(fault.channel)] = np.nan
    return record.with_outputs(outputs)


def data_spikes(residuals: Residuals, settings: LoopSettings) -> Fault | None:
    """Single samples that leave both neighbours while those agree."""
    r = residuals
    x = r.residual
    off = x[1:-1] - 0.5 * (x[2:] + x[:-2])
    apart = np.abs(x[2:] - x[:-2])
    known = np.isfinite(off)
    if known.sum() < settings.measured_samples:
        return None
    sd = 1.4826 * float(np.median(np.abs(off[known])))
    if sd <= 0:
        return None
    with np.errstate(invalid="ignore"):
        spiking = np.flatnonzero((np.abs(off) > SPIKE * sd) & (apart < 0.5 * np.abs(off))) + 1
    if not len(spiking):
        return None
    largest = spiking[int(np.argmax(np.abs(off[spiking - 1])))]
    text = (
        f"{r.output_name!r} has {len(spiking)} spike{'s' if len(spiking) > 1 else ''} of one "
        f"sample, the largest of {off[largest - 1]:.3g}{unit(r.output_unit)} at "
        f"{r.time[largest]:.5g}{unit(r.time_unit)}."
    )
    return Fault("spike", r.output_name, spiking, text)


def _runs(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Beginnings and lengths of runs of equal values; NaN equals nothing."""
    starts = np.flatnonzero(np.concatenate([[True], ~(x[1:] == x[:-1])]))
    return starts, np.diff(np.append(starts, len(x)))


def _stuck(record: Record, name: str, x: np.ndarray, is_output: bool) -> Fault | None:
    """Runs of equal values that are far too long; of an output while the inputs change."""
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
    long = [(a, a + m) for a, m in zip(starts, lengths, strict=True) if m >= limit]
    runs = [
        run for run in long if not (_at_a_limit(x, run[0]) or (is_output and _rests(record, *run)))
    ]
    if not runs:
        return None
    samples = np.concatenate([np.arange(a, b) for a, b in runs])
    a, b = max(runs, key=lambda run: run[1] - run[0])
    text = (
        f"{name!r} is stuck {_times(len(runs))}, {len(samples)} samples in all, longest for "
        f"{(b - a) * record.sampling_time:.4g} {record.time_unit} from {record.time[a]:.5g} "
        f"{record.time_unit} at {x[a]:.5g}."
    )
    if is_output:  # see `without_stuck`
        text += " These samples count as missing."
    return Fault("stuck", name, samples, text)


def _at_a_limit(x: np.ndarray, begin: int) -> bool:
    """Whether a run is at the largest or smallest value, and not come there all at once."""
    if np.nanmin(x) < x[begin] < np.nanmax(x):
        return False
    steps = np.abs(np.diff(x))
    changes = steps[steps > 0]  # NaN is not
    sudden = SUDDEN * float(np.quantile(changes, 0.98)) if len(changes) else np.inf
    return not (begin > 0 and steps[begin - 1] > sudden)


def _rests(record: Record, begin: int, end: int) -> bool:
    """Whether no input changes meanwhile, so that the output may rest."""
    u = record.inputs[begin:end]
    return record.n_inputs > 0 and bool((u == u[0]).all())


def _gaps(record: Record, name: str, x: np.ndarray) -> Fault | None:
    missing = ~np.isfinite(x)
    if not missing.any():
        return None
    starts, lengths = _runs(missing.astype(float))
    longest = int(lengths[missing[starts]].max())
    text = (
        f"{name!r} lacks {int(missing.sum())} of {len(x)} samples in "
        f"{int(missing[starts].sum())} gaps, the longest of "
        f"{longest * record.sampling_time:.4g} {record.time_unit}."
    )
    return Fault("gap", name, np.flatnonzero(missing), text)


def _skipped(record: Record) -> Fault | None:
    """Rows that are not there: steps in time that are longer than the others."""
    steps = np.diff(record.time)
    wide = np.flatnonzero(steps > 1.5 * np.median(steps))
    # Where many steps differ the record is irregular, which is no fault.
    if not len(wide) or len(wide) > 0.05 * len(steps):
        return None
    text = f"The record skips time {_times(len(wide))}, at most {steps.max():.4g}"
    return Fault("gap", "", wide + 1, f"{text} {record.time_unit}.")


def _copies(record: Record, name: str, x: np.ndarray) -> Fault | None:
    """Stretches of the output that occur earlier in the record, value by value."""
    if len(x) < 3 * COPY:
        return None
    windows = np.lib.stride_tricks.sliding_window_view(x, COPY)
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
        f"{name!r} repeats {len(samples)} earlier samples value by value, first at "
        f"{record.time[samples[0]]:.5g} {record.time_unit}: a copy?"
    )
    return Fault("duplicate", name, samples, text)


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def spikes_of(residuals: Sequence[Residuals], record: Record, settings: LoopSettings) -> list[str]:
    """Spikes of the outputs, in words, also in samples that tests leave out."""
    whole = [replace(one, output=record.outputs[:, a]) for a, one in enumerate(residuals)]
    faults = [data_spikes(one, settings) for one in whole]
    return [fault.sentence for fault in faults if fault is not None]
