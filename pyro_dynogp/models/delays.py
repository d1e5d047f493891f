"""Where a model knows its inputs: after the longest of its delays.

What acted before the record is not in it. For as long as a delayed input comes from there, outputs
are no evidence of the model, and the few samples that a held first value makes wrong by many
standard deviations would move every parameter.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.models.variants import Model


def longest_delay(*models: Model) -> float:
    """Longest given delay of an input in any of the models [time unit], zero where there is none.

    `fit` leaves out what it has to where the delay is a parameter.
    """
    late = [c for model in models for c in model.delayed]
    return max([0.0, *(c.delay for c in late if c.delay is not None)])


def unknown_beginning(record: Record, delay: float) -> int:
    """Number of samples before the first input of the record has arrived."""
    if delay <= 0.0:
        return 0
    tolerance = 1e-6 * record.sampling_time
    return int(np.searchsorted(record.time, record.time[0] + delay - tolerance))


def where_inputs_are_known(record: Record, delay: float) -> Record:
    """The record with outputs missing from its beginning until the first input has arrived."""
    count = unknown_beginning(record, delay)
    if not count:
        return record
    outputs = record.outputs.copy()
    outputs[:count] = np.nan
    return record.with_outputs(outputs)


def comparable(record: Record, models: Sequence[Model], reach: float = 1.0) -> Record:
    """The record as all of several models can be compared on it: on the same samples.

    Args:
        record: training record. models: whose delays may differ.
        reach: times the longest of them, where variants of them are to come.
    """
    delays = {longest_delay(model) for model in models}
    if len(delays) < 2:
        return record
    return where_inputs_are_known(record, reach * max(delays))
