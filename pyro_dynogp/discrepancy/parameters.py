"""What a block has learnt: the posterior of its gains, delays, limits and instants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from pyro_dynogp.criticism.posterior_draws import draws_of
from pyro_dynogp.data.channels import (
    Channel,
    Delayed,
    Quantity,
    Step,
    StepOfGain,
    count_direct,
    prepared,
)
from pyro_dynogp.data.channels.base import unit_of
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Parameters
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.numbers import Number, number_posterior
from pyro_dynogp.inference.posteriors import Mixture
from pyro_dynogp.lti.views import steady_state_gain
from pyro_dynogp.models.arrival import DELAY
from pyro_dynogp.models.delays import where_inputs_are_known
from pyro_dynogp.models.model import Model

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit

DRAWS = 200
# Beyond how many times a delay, and how many steps more, others are not expected; and the share of
# a record that may be lost to comparing them.
DELAYS, STEPS, LOST = 1.5, 5, 0.25


def parameters_of(fit: Fit, channels: Sequence[Channel], record: Record) -> Parameters:
    """Posterior mean and standard deviation by name, unit included, of some channels of a model.

    The steady-state gain of a channel that acts through linear dynamics, what a direct one adds to
    the output for one unit of it, and the numbers that a channel is made with.

    Args:
        fit: to the record. channels: of its model. record: as measured, without the channels.
    """
    out: Parameters = {}
    present = [one for one in channels if one in fit.model.channels]
    single = fit.model.outputs == 1
    acting = [one for one in present if single and (one.direct or not one.replaces)]
    late = [(k, one) for k, one in enumerate(fit.model.late) if one in present]
    drawn = _drawn(fit) if acting or late else {}
    if acting:
        out |= _weights(fit, acting, drawn) | _gains(fit, acting, drawn)
    for k, one in late:
        label = _label(f"dead time of {one.channel}", record.time_unit)
        out[label] = _moments(drawn[DELAY][:, k].numpy())
    for group in _together(present):
        out |= _numbers(fit, group, record)
    return out


def _drawn(fit: Fit) -> Mapping[str, Tensor]:
    """Draws of all sites: those of the fit, or around its mode where it keeps sites there."""
    if not isinstance(fit.posterior, Mixture) or not fit.posterior.points:
        return fit.draws
    return draws_of(fit.at_mode(), count=DRAWS, seed=0, anneal=False).values


def _weights(fit: Fit, channels: Sequence[Channel], drawn: Mapping[str, Tensor]) -> Parameters:
    """Of direct channels, by column [output, for one unit of the column]."""
    if "direct" not in drawn:
        return {}
    first = fit.model.inputs - fit.model.direct
    offset = fit.model.direct - count_direct(fit.model.channels)
    names = fit.scaling.input_names[first:]
    weights = drawn["direct"][:, 0].numpy() * fit.scaling.output_scale[0]
    weights = weights / fit.scaling.input_scale[first:]
    own = {name for one in channels if one.direct for name in one.names}
    return {
        _label(name, fit.scaling.output_units[0]): _moments(weights[:, k])
        for k, name in enumerate(names)
        if k >= offset and name in own
    }


def _gains(fit: Fit, channels: Sequence[Channel], drawn: Mapping[str, Tensor]) -> Parameters:
    """Of channels that act through the dynamics of a linear model, for constant inputs."""
    own = {name for one in channels if not one.direct for name in one.names}
    if not own or not fit.model.is_linear:
        return {}
    modes = fit.system_at(drawn).physical(fit.scaling).modes
    if bool((modes.poles == 0).any()):  # an integrator has none
        return {}
    gains = steady_state_gain(modes)[..., 0, :].numpy()
    scaling = fit.scaling
    return {
        _label(f"steady-state gain of {name}", _ratio(scaling.output_units[0], unit)): _moments(
            gains[:, k]
        )
        for k, (name, unit) in enumerate(zip(scaling.input_names, scaling.input_units, strict=True))
        if name in own
    }


def _together(channels: Sequence[Channel]) -> list[list[Channel]]:
    """Channels with given numbers; those that share one dead time, or one instant, in one group."""
    groups: list[list[Channel]] = []
    late = [one for one in channels if isinstance(one, Delayed) and one.free]
    for one in channels:
        if not one.numbers or one in late:
            continue
        shared = next((g for g in groups if _shared(one) and _shared(one) == _shared(g[0])), None)
        if shared is not None:
            shared.append(one)
        else:
            groups.append([one])
    return groups


def _shared(channel: Channel) -> tuple[str, float] | None:
    """What a channel may share with others: a dead time, or an instant."""
    if isinstance(channel, Delayed) and channel.delay is not None:
        return ("delay", channel.delay)
    return ("at", channel.at) if isinstance(channel, Step | StepOfGain) else None


def _numbers(fit: Fit, group: Sequence[Channel], record: Record) -> Parameters:
    """Of the numbers that a channel, or a group with the same ones, is made with."""
    first = group[0]
    if isinstance(first, Delayed) and first.delay is not None:
        # All delays that are likely, on the same samples.
        reach = DELAYS * first.delay + STEPS * record.sampling_time
        record = where_inputs_are_known(record, min(reach, LOST * record.duration))
    whole = prepared(record, fit.model.channels)
    fields = list(first.numbers)
    numbers = [
        Number(
            getattr(first, field),
            _step(first, quantity, whole),
            max(quantity.low, float(whole.time[0])) if quantity.inside else quantity.low,
            float(whole.time[-1]) if quantity.inside else np.inf,
            cell=_cell(fit.model, first, whole),
            # A channel that changes at an instant is the same for all between two samples.
            instants=whole.time if quantity.inside else None,
        )
        for field, quantity in first.numbers.items()
    ]

    def potential(values: Sequence[float]) -> Potential:
        changed = {one: replace(one, **dict(zip(fields, values, strict=True))) for one in group}
        channels = tuple(changed.get(one, one) for one in fit.model.channels)
        names = {old: new for one in group for old, new in
                 zip(one.names, changed[one].names, strict=True)}  # fmt: skip
        scaling = replace(
            fit.scaling, input_names=tuple(names.get(n, n) for n in fit.scaling.input_names)
        )
        model = replace(fit.model, channels=channels, scaling=scaling).collapsed
        # Channels are made once here, not in every evaluation.
        return Potential(model, (model.prepare(record),), fit.mode)

    found = number_posterior(potential, numbers)
    whose = " and ".join(one.channel for one in group if hasattr(one, "channel"))
    return {
        _label(f"{quantity.name} of {whose}" if whose else quantity.name,
               _unit(first, quantity, whole)): pair
        for quantity, pair in zip(first.numbers.values(), found, strict=True)
    }  # fmt: skip


def _step(channel: Channel, quantity: Quantity, record: Record) -> float:
    """How far off a number may easily be: a sample, or a hundredth of the channel's spread."""
    if quantity.unit == "time":
        return float(record.sampling_time)
    return 0.01 * float(np.std(channel.columns(record)))


def _cell(model: Model, channel: Channel, record: Record) -> tuple[float, float] | None:
    """What times a whole number of samples stands for, of a dead time on an even clock.

    What arrives between two samples acts as what arrives with the second, through another numerator
    (Franklin, Powell & Workman, Digital Control of Dynamic Systems, 3rd ed., section 4.3): where
    the numerator has a direct term to spare, all that can be told is in which step it arrives.
    Without one, half a step to either side is what poles make up for.
    """
    if not (isinstance(channel, Delayed) and record.is_regular):
        return None
    step = record.sampling_time
    first = next((layer for _, layer in model.dynamic), None)
    at_once = first is None or first.feedthrough
    return (-step, 0.0) if at_once or channel.direct else (-0.5 * step, 0.5 * step)


def _unit(channel: Channel, quantity: Quantity, record: Record) -> str:
    if quantity.unit == "time":
        return record.time_unit
    return unit_of(record, str(getattr(channel, "channel", "")))


def _moments(values: np.ndarray) -> tuple[float, float]:
    return float(values.mean()), float(values.std())


def _label(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _ratio(output: str, unit: str) -> str:
    return f"{output or '1'}/{unit}" if unit else output
