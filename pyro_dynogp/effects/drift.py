"""A level, or a gain, that changes slowly."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from pyro_dynogp.data.channels import Ramp, RampOfGain, Trend, TrendOfGain
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Effect, centre_of, driving_names
from pyro_dynogp.models.variants import (
    Model,
    with_channel,
    with_channels,
    with_pairs,
    with_process_noise,
)
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, evidence, over_time
from pyro_dynogp.statistics.prewhitening import free_columns, prewhitened, spanning
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import contributions

# Cosines of a drift: the slowest runs once from one end to the other, the fastest four times.
SLOW = ((1,), (1, 2), (1, 2, 3, 4))
# Ramps of a path of gain, and the share of the record at which the last one ends: the path begins
# in what a search trains on, two thirds of what it knows, and is held from there.
RAMPS, LAST = 4, 2 / 3


def drift(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """A slow change over the whole record, of the level or of a gain.

    The level changes by cosines of k half periods over the record, k = 1 to 4; a gain by the same
    cosines times the mean's deviation from its average, or times the share of one input.

    Returns:
        where: form "additive" or "gain", channel (input or output whose gain drifts, "" for the
        level), time_scale (half a period of what dominates) [time unit].

    Source: slow cosines as in Müller & Watson, Econometrica 76(5):979 (2008); the null by
    `prewhitened`.
    """
    r = residuals
    t = (r.time - r.time[0]) / (r.time[-1] - r.time[0])
    slow = np.cos(np.pi * t[:, None] * np.arange(1, SLOW[-1][-1] + 1))
    gains, signals = contributions(r)
    names, scaled = ["", *gains], [np.ones(len(r)), *signals.T]
    K = slow.shape[1]
    columns = np.concatenate([slow * s[:, None] for s in scaled], axis=1)
    places = [np.array(k) - 1 + K * j for j in range(len(scaled)) for k in SLOW]
    scan = prewhitened(
        r.residual,
        free_columns(columns, places),
        spanning(signals),
        r.deviations,
        settings,
        first=np.column_stack([columns, signals]),
        seed=seed,
    )
    j, order = divmod(scan.best, len(SLOW))
    # What the fitted effect is as a function of time alone, and the cosine that dominates there.
    basis = slow[:, [k - 1 for k in SLOW[order]]] * scaled[j][:, None]
    joined = np.column_stack([basis, np.ones(len(r))])
    weights = np.linalg.lstsq(joined, scan.fitted, rcond=None)[0][:-1]
    k = float(np.square(weights) @ np.array(SLOW[order]) / max(np.square(weights).sum(), 1e-300))
    scale = float(r.time[-1] - r.time[0]) / max(k, 1.0)
    form = "gain" if names[j] else "additive"
    what = f"The gain of {names[j]!r}" if names[j] else f"The level of {r.output_name!r}"
    return evidence(
        "drift",
        scan,
        {"form": form, "channel": names[j], "time_scale": scale},
        f"{what} drifts over about {scale:.3g} {r.time_unit}: {about(r, scan.size)}.",
        over_time(r, scan.fitted),
    )


class Drift(Effect):
    """A level, or a gain, that changes slowly."""

    name = "drift"
    family = "time"
    compared = "rehearsed"
    experiments: ClassVar = {
        "level shift": "a longer record at rest",
        "process noise": "a longer record at constant inputs",
    }
    test = staticmethod(drift)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A straight line in time, or a random path; or each input times a line, or times ramps.

        The random path is a pair of poles, as slow as suits it, that process noise drives. Ramps
        make a path of gain that is held where the last one ends. A gain that drifts moves the level
        as well, unless the input is at its zero on average: there are variants with and without.
        What is nearly straight so far need not go on so: held-out data say whether it does.
        """
        begin, end = float(record.time[0]), float(record.time[-1])
        if evidence.where["form"] == "additive":
            path = with_process_noise(with_pairs(model, 1))
            return [with_channel(model, Trend(begin, end)), path]
        drifting = [one for one in model.channels if isinstance(one, TrendOfGain)]
        made = {name for one in drifting for name in one.names}
        prepared = model.check(record)[0]
        driving = driving_names(model, prepared)
        centres = {name: centre_of(prepared, name) for name in driving if name not in made}
        last = begin + LAST * (end - begin)
        ramps = list(itertools.pairwise(np.linspace(begin, last, RAMPS + 1).tolist()))
        lines = [TrendOfGain(name, at, begin, end) for name, at in centres.items()]
        paths = [RampOfGain(name, at, *ends) for name, at in centres.items() for ends in ramps]
        variants = (
            lines,
            [*lines, Trend(begin, end)],
            paths,
            [*paths, *(Ramp(*ends) for ends in ramps)],
        )
        # A gain that drifts already has what it has not had.
        kinds = {type(one) for one in model.channels}
        return [
            with_channels(model, channels)
            for channels in variants
            if not kinds & {type(one) for one in channels}
        ]
