"""How well a model runs by itself: from the filter's state through blocks of a record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.optimise.optimum import Optimum
from pyro_dynogp.inference.starts.poles import grown
from pyro_dynogp.lti.arithmetic import SEGMENT
from pyro_dynogp.models.assembly import assemble
from pyro_dynogp.models.late_systems import arrive
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.moments import filtering
from pyro_dynogp.moments.stepping import step_through

# Blocks of a record at most, and segments of the filter in one at least.
BLOCKS, LEAST = 8, 2
# What is left of noise gains that are switched off, and the share of the error that noise has to
# take away to pay, with feedback.
SILENT, WORTH = 1e-3, 0.01


def free_run_error(
    model: Model, values: Mapping[str, Tensor], records: Sequence[PreparedRecord]
) -> float:
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
            seen = arrive(here, record)
            assembly = assemble(seen.system, record.grid, seen.scaled)
            problem = assembly.with_outputs(record.scaled_outputs)
            (numbers,), _ = problem.elements()
            means = filtering.run(problem.layout, numbers)[1].means
            length = SEGMENT * max(LEAST, -(-len(means) // BLOCKS))
            for first in range(0, len(problem.layout.step), length):
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
    total = float(np.sqrt(squares / max(count, 1)))
    return total if np.isfinite(total) else np.inf


def noise_sites(model: Model) -> tuple[str, ...]:
    """Sites of the process noise of layers that something drives, as far as a model has any."""
    return tuple(
        f"{wire.name}_{part}"
        for wire, layer in model.dynamic
        if layer.process_noise and wire.channels + wire.fed
        for part in ("noise_gain_local_scale", "noise_gain_unit")
        + ("integrator_noise",) * layer.integrators
    )


def silenced(
    model: Model,
    records: Sequence[PreparedRecord],
    optimum: Optimum,
    start: Mapping[str, Tensor],
) -> Optimum:
    """An optimum found without process noise as a point of the model that has some: next to none.

    Args:
        model: with process noise, collapsed. records: of it. optimum: without.
        start: values of all sites of the model.
    """
    off = [site for site in noise_sites(model) if not site.endswith("_local_scale")]
    values = grown(optimum.values, dict(start))
    values = {k: SILENT * v if k in off else v for k, v in values.items()}
    potential = Potential(model, (records,), values)
    (energy,) = potential.energies_at([values])
    return replace(optimum, energy=float(energy), values=values)


def noise_pays(
    model: Model, records: Sequence[PreparedRecord], noisy: Optimum, quiet: Optimum, line: float
) -> bool:
    """Whether free runs over blocks are good enough with process noise, beside those without.

    With feedback better by a hundredth. In forward cascades no worse than without, or than those of
    the linear model, whose error is `line`: free runs of a fit without noise are the closest to the
    training record that there are, also where the plant has noise.
    """
    with_noise, without = (free_run_error(model, one.values, records) for one in (noisy, quiet))
    if model.has_feedback:
        return with_noise < (1.0 - WORTH) * without
    return with_noise <= max(without, line)
