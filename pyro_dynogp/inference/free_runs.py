"""How well a model runs by itself: from the filter's state through blocks of a record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.lti.arithmetic import SEGMENT
from pyro_dynogp.lti.grid import time_grid
from pyro_dynogp.models.assembly import assemble
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.system import scaled_inputs, scaled_outputs
from pyro_dynogp.moments import filtering
from pyro_dynogp.moments.stepping import step_through

# Blocks of a record at most, and segments of the filter in one at least.
BLOCKS, LEAST = 8, 2


def free_run_error(model: Model, values: Mapping[str, Tensor], records: Sequence[Record]) -> float:
    """Root mean square error of runs through blocks of records, in scaled outputs.

    Each block begins at the mean of the filter's state; functions are at their mean and there is no
    process noise from there on. Infinite where a run diverges.

    Args:
        model: with its scaling, trajectories integrated out. values: of all its sites.
        records: prepared, that the values are of.
    """
    assert model.scaling is not None
    squares, count = 0.0, 0
    with torch.no_grad():
        system = model.system(values, model.scaling)
        for index, record in enumerate(records):
            suffix = "" if len(records) == 1 else f"_{index}"
            here = model.begin(system, model.states_of(values, suffix))
            inputs = scaled_inputs(model.scaling, record)
            problem = assemble(here, time_grid(record.time), inputs).with_outputs(
                scaled_outputs(model.scaling, record)
            )
            (numbers,), _ = problem.elements()
            means = filtering.run(problem.layout, numbers)[1]
            length = SEGMENT * max(LEAST, -(-len(means) // BLOCKS))
            for first in range(0, len(record), length):
                part = slice(first, first + length)
                step = problem.layout.step[part].copy()
                step[0] = -1
                own = numbers._replace(offset=numbers.offset[part])
                nothing = np.zeros((0, means.shape[1]))
                found = step_through(
                    problem.layout._replace(step=step), own, means[first // SEGMENT], nothing,
                    np.zeros((0, 0, 0)), numbers.H,
                )  # fmt: skip
                error = numbers.y[part] - numbers.y_offset[part] - found
                there = ~np.isnan(numbers.y[part])
                squares += float((error[there] ** 2).sum())
                count += int(there.sum())
    error_ = float(np.sqrt(squares / max(count, 1)))
    return error_ if np.isfinite(error_) else np.inf


def silenced(model: Model, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Values with next to no process noise in any layer that inputs drive."""
    quiet = {f"{w.name}_noise_gain_unit" for w, _ in model.dynamic if w.channels + w.fed}
    return {k: v * 1e-3 if k in quiet else v for k, v in values.items()}
