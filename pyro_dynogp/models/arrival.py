"""Dead times that are parameters of a model: their site, and inputs as they arrive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pyro_dynogp.data.channels import Channel, Delayed
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.distributions.dead_time import DeadTime
from pyro_dynogp.layers.sites import Site
from pyro_dynogp.lti.delay import delayed
from pyro_dynogp.models.prepared import PreparedRecord, scaled_inputs
from pyro_dynogp.support.errors import invalid

# Name of the site, and of its dimension.
DELAY, LATE = "delay", "delayed input"


@dataclass(frozen=True, eq=False)
class Delays:
    """Dead times of some inputs of a model.

    Attributes:
        columns: (K,) of the inputs. values: (*b, K) [time unit].
    """

    columns: tuple[int, ...]
    values: Tensor


def free_delays(channels: Sequence[Channel]) -> tuple[Delayed, ...]:
    """The channels whose dead time is a parameter.

    Raises:
        ValueError: where another channel is made from one of them, which is known only with the
            parameters, or two are of one input.
    """
    late = tuple(c for c in channels if isinstance(c, Delayed) and c.free)
    inputs = [channel.channel for channel in late]
    if len(set(inputs)) < len(inputs):
        raise invalid("channels", expected="one dead time for each input", got=f"{inputs}")
    names = {name for channel in late for name in channel.names}
    for channel in channels:
        used = {getattr(channel, field, None) for field in ("channel", "first", "second")}
        if names & used:
            raise invalid(
                "channels",
                expected="no channel that is made from one with a free dead time",
                got=f"{channel!r}",
                advice="Make it from the input as recorded and delay what comes of it, or give "
                "the delay as a number.",
            )
    return late


def columns_of(late: Sequence[Delayed], scaling: Scaling) -> tuple[int, ...]:
    """Columns of the inputs that they are."""
    return tuple(scaling.input_names.index(channel.names[0]) for channel in late)


def prompt_columns(late: Sequence[Delayed], scaling: Scaling, count: int) -> list[int]:
    """Columns, of the first ones so many, of inputs that do not come late: they may act at once."""
    columns = columns_of(late, scaling)
    return [column for column in range(count) if column not in columns]


def medians(late: Sequence[Delayed], scaling: Scaling) -> list[float]:
    """Prior medians (K,) of the dead times [time unit]."""
    usual = math.sqrt(float(scaling.time_step) * float(scaling.duration) / math.pi)
    return [usual if channel.median is None else channel.median for channel in late]


def delay_site(late: Sequence[Delayed], scaling: Scaling) -> Site:
    """Dead times (K,) [time unit], half-Cauchy; see `Delayed`."""
    scale = torch.tensor(medians(late, scaling), dtype=torch.float64)
    step = torch.tensor(float(scaling.time_step), dtype=torch.float64)
    return Site(DELAY, DeadTime(scale, step).to_event(1), (LATE,))


def arriving(record: PreparedRecord, delays: Delays | None) -> tuple[Tensor, Tensor]:
    """Inputs (*b, n, n_u) of a record as they arrive [input], and the same scaled.

    Args:
        record: with inputs as recorded. delays: of some of them; None for none.
    """
    if delays is None:
        return record.inputs, record.scaled_inputs
    time, inputs, first = record.surroundings
    own = slice(first, first + len(record))
    batch = delays.values.shape[:-1]
    columns = [u.expand((*batch, len(record))) for u in inputs[own].unbind(-1)]
    for place, delay in zip(delays.columns, delays.values.unbind(-1), strict=True):
        columns[place] = delayed(inputs[:, place], time, delay)[..., own]
    found = torch.stack(columns, -1)
    return found, scaled_inputs(found, record.scaling)


def arrived(record: PreparedRecord, columns: Sequence[int], values: Tensor) -> PreparedRecord:
    """The record with inputs delayed by given numbers (K,) [time unit]."""
    inputs, scaled = arriving(record, Delays(tuple(columns), values))
    return replace(record, inputs=inputs, scaled_inputs=scaled, around=None)
