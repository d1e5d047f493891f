"""Effects between inputs and output that are linear: a path, a delay, more dynamics."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from pyro_dynogp.data.channels import Channel, Delayed, Product, Recorded, Transformed
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import (
    AROUND,
    FINER,
    Effect,
    centre_of,
    changed,
    listed,
    number_of,
    set_last,
    unit_of,
)
from pyro_dynogp.effects.delay_regression import likely_delays
from pyro_dynogp.effects.path_effects import dead_time, extra_input, unmodelled_dynamics
from pyro_dynogp.models.variants import Model, with_channel, with_pairs, without_channel
from pyro_dynogp.statistics.evidence import Evidence, Residuals

# Delays that are tried whatever the data say.
COARSE = 5


class ExtraInput(Effect):
    """A recorded channel that acts: through dynamics, alone, squared, or times an input."""

    name = "extra input"
    family = "paths"
    freedom = 2
    test = staticmethod(extra_input)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The channel, or what is made from it, as an input; with its delay where there is one."""
        channel, form = str(evidence.where["channel"]), str(evidence.where["form"])
        delay = number_of(evidence, "delay")
        if form == "linear":
            plain = with_channel(model, Recorded(channel))
            if delay < 2.0 * record.sampling_time:
                return [plain]
            (later,) = _resolved([delay], record)
            return [plain, with_channel(plain, Delayed(channel, later))]
        made: Channel
        if form in ("square", "absolute"):
            made = Transformed(channel, form, centre_of(record, channel))
        else:
            other = form.removeprefix("product with ")
            made = Product(channel, other, centre_of(record, channel), centre_of(record, other))
        alone = with_channel(model, made)
        return [alone, with_channel(alone, Recorded(channel))]


class DeadTime(Effect):
    """An input that arrives later than the model has it."""

    name = "dead time"
    family = "paths"

    def detect(self, residuals: Residuals, seed: int = 0) -> Sequence[Evidence]:
        """One for each input."""
        found = listed(dead_time(residuals, seed=seed))
        return [replace(e, where={**e.where, "time_unit": residuals.time_unit}) for e in found]

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Each input, and all of them, delayed: by what regressions and the evidence say, and more.

        Poles make up for much of a delay, so that estimates of it are rough.
        """
        channel, more = str(evidence.where["channel"]), number_of(evidence, "delay")
        step, longest = record.sampling_time, len(record) // 10
        grid = {float(d) for d in step * np.geomspace(1.0, longest, COARSE)}
        around = {share * more for share in AROUND}
        prepared = model.check(record)[0]
        names = prepared.input_names[: prepared.n_inputs - model.direct]
        places: list[tuple[int, ...]] = [(k,) for k in range(len(names))]
        if len(names) > 1:
            places.append(tuple(range(len(names))))
        variants = []
        for place in places:
            chosen = tuple(names[k] for k in place)
            u, y = prepared.inputs[:, : len(names)], prepared.outputs[:, 0]
            found = {step * d for d in likely_delays(y, u, place, longest)}
            delays = grid | found | (around if channel in chosen else set())
            tried = (
                _later(model, chosen, delay, 0.2 * step) for delay in _resolved(delays, record)
            )
            variants += [one for one in tried if one is not None]
        return variants

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """The channels and their delay as refits have them."""
        found = set_last(model, Delayed, "delay")
        names = " and ".join(repr(one.channel) for one in found)
        start = f"Channel {names} acts" if len(found) == 1 else f"Channels {names} act"
        return f"{start} with a dead time of {found[0].delay:.3g}{unit_of(evidence)}."

    def refine(self, model: Model, record: Record, times: int) -> Sequence[Model]:
        """The delay a little shorter and longer, a sample or two at least."""
        found = set_last(model, Delayed, "delay")
        delay, step = found[0].delay, record.sampling_time
        near = {share * delay for share in FINER[times]}
        if record.is_regular:
            near |= {delay + k * step for k in (-2, -1, 1, 2)}
        return [
            changed(model, found, delay=later)
            for later in _resolved(near, record)
            if later != delay
        ]


def _resolved(delays: Iterable[float], record: Record) -> list[float]:
    """Delays that a record can tell apart: on an even clock whole samples, one at least.

    A held input that arrives within a sample is, at the samples, one that arrives with the next and
    acts with another numerator: x[k+1] = phi x[k] + g1 u[k] + g2 u[k+1] for every fraction of it
    (Franklin, Powell & Workman, Digital Control of Dynamic Systems, 3rd ed., section 4.3).
    """
    if not record.is_regular:
        return sorted(delays)
    step = record.sampling_time
    return [step * count for count in sorted({max(round(one / step), 1) for one in delays})]


def _later(model: Model, names: Sequence[str], more: float, least: float) -> Model | None:
    """The model with inputs delayed by more than they are; None for less than the least delay."""
    for name in names:
        source, known = name, 0.0
        for one in model.channels:
            if isinstance(one, Delayed) and name in one.names:  # correct the delay it has
                source, known = one.channel, one.delay
                model = without_channel(model, one)
        if known + more < least:
            return None
        model = with_channel(model, Delayed(source, known + more))
    return model


class UnmodelledDynamics(Effect):
    """More poles than the model has."""

    name = "unmodelled dynamics"
    family = "paths"
    freedom = 5
    test = staticmethod(unmodelled_dynamics)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """One pair of poles more, or two."""
        return [with_pairs(model, 1), with_pairs(model, 2)]
