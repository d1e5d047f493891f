"""An input that arrives later than the model has it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from pyro_dynogp.data.channels import Delayed
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import shifted
from pyro_dynogp.effects.base import (
    AROUND,
    FINER,
    Effect,
    changed,
    driving_names,
    number_of,
    set_last,
    unit_of,
)
from pyro_dynogp.effects.delay_regression import likely_delays, resolved
from pyro_dynogp.models.variants import Model, with_channel, without_channel
from pyro_dynogp.statistics.detecting import Search, lasting, regained
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, evidence, labelled, unit
from pyro_dynogp.statistics.regression import with_past
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import paths

# Delays that are tried whatever the data say.
COARSE = 5


def dead_time(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """Test whether the output follows an input later (or earlier) than the model says.

    The column is mean_j(t - d) - mean_j(t), where mean_j is what input j contributes to the mean:
    all of it with one input, the share by `paths` with several. The delay is that at which the
    column fits with a weight of one. `where`: channel, delay (additional, > 0 for later)
    [time unit].
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
    scan = lasting(regained(r, settings), variants, mean, settings, seed)
    j, delay = tried[scan.best]
    # Without a column for no delay, small ones of either sign look the same but for their weight.
    grid = np.unique(np.concatenate([coarse, np.linspace(-1.0, 1.0, 9) * r.step]))
    search = Search(r, mean, settings, weight=1.0)
    if scan.p_value < settings.noticed:
        delay = search.located(lambda d: late(j, d), delay, grid)
    profile = search.gains([late(j, d) for d in grid], late(j, delay))
    size = float(late(j, delay).std())
    word = "later" if delay > 0 else "earlier"
    label = labelled("additional delay", r.time_unit)
    return evidence(
        "dead time",
        scan,
        {"channel": names[j], "delay": delay, "time_unit": r.time_unit},
        f"'{r.output_name}' follows channel '{names[j]}' {abs(delay):.3g}"
        f"{unit(r.time_unit)} {word} than the model says, {about(r, size)}.",
        Curve(grid, profile, np.full(len(grid), np.nan), label, "gain [nats]"),
        size,
    )


class DeadTime(Effect):
    """An input that arrives later than the model has it."""

    name = "dead time"
    family = "paths"
    acts_on = "inputs"
    experiments: ClassVar = {
        "unmodelled dynamics": "a step of the input, sampled several times faster: after a dead "
        "time nothing moves at first, more dynamics begin at once",
    }

    test = staticmethod(dead_time)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Each input, and all of them, delayed: by what regressions and the evidence say, and more.

        Poles make up for much of a delay, so that estimates of it are rough.
        """
        channel, more = str(evidence.where["channel"]), number_of(evidence, "delay")
        step, longest = record.sampling_time, len(record) // 10
        grid = {float(d) for d in step * np.geomspace(1.0, longest, COARSE)}
        around = {share * more for share in AROUND}
        prepared = model.check(record)[0]
        names = driving_names(model, prepared)
        places: list[tuple[int, ...]] = [(k,) for k in range(len(names))]
        if len(names) > 1:
            places.append(tuple(range(len(names))))
        variants = []
        for place in places:
            chosen = tuple(names[k] for k in place)
            u, y = prepared.inputs[:, : len(names)], prepared.outputs[:, 0]
            likely = {step * d for d in likely_delays(y, u, place, longest)}
            delays = grid | likely | (around if channel in chosen else set())
            tried = (_later(model, chosen, delay, 0.2 * step) for delay in resolved(delays, record))
            variants += [later for later in tried if later is not None]
        return variants

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """The channels and their delay as refits have them."""
        late = set_last(model, Delayed, "delay")
        names = " and ".join(repr(channel.channel) for channel in late)
        start = f"Channel {names} acts" if len(late) == 1 else f"Channels {names} act"
        assert late[0].delay is not None
        return f"{start} with a dead time of {late[0].delay:.3g}{unit_of(evidence)}."

    def refine(self, model: Model, record: Record, times: int) -> Sequence[Model]:
        """The delay a little shorter and longer, a sample or two at least."""
        late = set_last(model, Delayed, "delay")
        delay, step = late[0].delay, record.sampling_time
        assert delay is not None
        near = {share * delay for share in FINER[times]}
        if record.is_regular:
            near |= {delay + k * step for k in (-2, -1, 1, 2)}
        return [
            changed(model, late, delay=later) for later in resolved(near, record) if later != delay
        ]


def _later(model: Model, names: Sequence[str], more: float, least: float) -> Model | None:
    """The model with inputs delayed by more than they are.

    None for less than the least delay, and where the delay of one is a parameter already.
    """
    for name in names:
        source, known = name, 0.0
        for channel in model.channels:
            if isinstance(channel, Delayed) and name in channel.names:  # correct the delay it has
                if channel.delay is None:
                    return None
                source, known = channel.channel, channel.delay
                model = without_channel(model, channel)
        if known + more < least:
            return None
        model = with_channel(model, Delayed(source, known + more))
    return model
