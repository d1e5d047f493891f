"""Which part of the data is for what: A to fit, B to search, C to be opened once."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.data_faults import Fault, faults, without_stuck
from pyro_dynogp.prediction.records import gap_between, joined
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.support.errors import invalid

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit


@dataclass(frozen=True, eq=False)
class Blocks:
    """A record in three parts.

    Attributes:
        known: A and B in one piece. held_out: (n,) True in B.
        sealed: C, which nothing looks at before the end.
        refit: whether A is not what the fit was trained on.
        sentence: what is what.
        faults: of the data. What a stuck sensor reports is missing from all three parts.
    """

    known: Record
    held_out: np.ndarray
    sealed: Record
    refit: bool
    sentence: str
    faults: tuple[Fault, ...]


def blocks_of(
    fit: Fit, record: Record, candidates: Record | None, settings: LoopSettings
) -> Blocks:
    """Cut the data in time.

    Where the record goes on after the training record, A is the training record and what follows
    is halved. Where it is the training record, or part of it, it is cut anew: half of it to fit,
    a quarter to search, a quarter to report on. What a stuck sensor reports counts as missing.

    Raises:
        ValueError: where the fit has several training records, the record has other outputs or a
            clock that does not compare, or too few samples are left or were measured.
    """
    fewest = settings.block_samples
    if len(fit.records) != 1:
        raise invalid(
            "fit", expected="one training record", got=f"{len(fit.records)}",
            advice="Fit to the longest of them, and close the loop on it.",
        )  # fmt: skip
    record = with_candidates(record, candidates)
    training = fit.records[0]
    if record.output_names != training.output_names:
        raise invalid(
            "record", expected=f"the outputs {list(training.output_names)} that were fitted",
            got=f"{list(record.output_names)}", advice="Record.select chooses and orders channels.",
        )  # fmt: skip
    shift = _shift(training, record)
    tolerance = 1e-6 * training.sampling_time
    begin, end = training.time[0] + shift, training.time[-1] + shift
    after = int(np.searchsorted(record.time, end + tolerance))
    first = int(np.searchsorted(record.time, begin - tolerance))
    if first > 0 and after > 0:
        raise invalid(
            "record",
            expected="the training record, its continuation, or both",
            got="samples before the training record",
            advice="Cut them off: record[k:].",
        )
    if len(record) - after >= 2 * fewest:
        if after == 0:  # later data alone: the training record comes before them
            record = _joined(with_candidates(training, None), record, shift)
            after = len(training)
        cut, refit = after, not _same(training, record[:after])
        second = cut + (len(record) - cut) // 2
    elif len(record) - after == 0 or after > 0:
        record = record[:after] if after else record
        cut, refit = int(settings.fit_share * len(record)), True
        second = cut + int(settings.search_share * len(record))
    else:
        cut = second = 0
        refit = False
    if min(cut, second - cut, len(record) - second) < fewest:
        raise invalid(
            "record", expected=f"at least {2 * fewest} samples after the training record, or "
            f"{4 * fewest} of it", got=f"{len(record)} samples, {after} of them for training",
        )  # fmt: skip
    found = faults(record, list(record.extra))
    cleared = without_stuck(record, found)
    for part, name in ((cleared[cut:second], "searched"), (cleared[second:], "reported on")):
        measured = int((~part.missing).sum(0).min())
        if measured < settings.measured_samples:
            raise invalid(
                "record", expected=f"{settings.measured_samples} samples or more of each output "
                f"that were measured in the part to be {name}", got=f"{measured} of {len(part)}",
                advice="Give a longer record.",
            )  # fmt: skip
    refit = refit or not _same(cleared[:cut], record[:cut])
    held_out = np.zeros(second, dtype=bool)
    held_out[cut:] = True
    sentence = (
        f"Fitted to {cut} samples, searched on the {second - cut} after them, reported on the last "
        f"{len(record) - second}, which no step has used."
    )
    return Blocks(cleared[:second], held_out, cleared[second:], refit, sentence, tuple(found))


def with_candidates(record: Record, candidates: Record | None) -> Record:
    """The record with the channels of another one on the same times as extra channels.

    Raises:
        ValueError: where the times differ, or a name is taken.
    """
    if candidates is None:
        return record
    if len(candidates) != len(record) or not np.array_equal(candidates.time, record.time):
        raise invalid(
            "candidates", expected=f"the {len(record)} times of the record",
            got=f"{len(candidates)} samples, or other times",
        )  # fmt: skip
    found = {name: candidates.inputs[:, i] for i, name in enumerate(candidates.input_names)}
    found |= {name: candidates.outputs[:, i] for i, name in enumerate(candidates.output_names)}
    units = dict(zip(candidates.input_names, candidates.input_units, strict=True))
    units |= dict(zip(candidates.output_names, candidates.output_units, strict=True))
    return dataclasses.replace(
        record,
        extra={**record.extra, **candidates.extra, **found},
        extra_units={**record.extra_units, **candidates.extra_units, **units},
    )


def _shift(training: Record, record: Record) -> float:
    """What to add to the training record's times to have them on the record's clock."""
    if training.start == record.start:
        return 0.0
    if training.start is None or record.start is None:
        raise invalid(
            "record", expected="the same kind of clock as the training record",
            got="stamps and plain times",
        )  # fmt: skip
    return float((training.start - record.start).total_seconds())


def _same(training: Record, part: Record) -> bool:
    """Whether the outputs are those that the fit has seen."""
    return np.array_equal(training.outputs, part.outputs, equal_nan=True)


def _joined(training: Record, later: Record, shift: float) -> Record:
    """The training record and what follows it, as one record on the clock of the first."""
    gap_between(training, later)
    inputs = [*training.input_names, *training.extra]
    lost = [name for name in later.input_names if name not in inputs]
    if lost:
        raise invalid("record", expected=f"inputs among {inputs}", got=f"{lost}")
    before = training.select(inputs=later.input_names)
    return joined(before, later, shift)
