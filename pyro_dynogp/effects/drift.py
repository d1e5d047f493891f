"""A level, or a gain, that changes slowly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from pyro_dynogp.data.channels import Trend, TrendOfGain
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Effect, centre_of
from pyro_dynogp.models.variants import Model, with_channel, with_pairs, with_process_noise
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, evidence, over_time
from pyro_dynogp.statistics.prewhitening import free_columns, prewhitened, spanning
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import paths

# Cosines of a drift: the slowest runs once from one end to the other, the fastest four times.
SLOW = ((1,), (1, 2), (1, 2, 3, 4))
# Inputs beyond which a drift of gain is looked for in the mean as a whole only.
INPUTS = 4


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
    names, scaled = [""], [np.ones(len(r))]
    mean = r.mean - r.mean.mean()
    nuisance = mean[:, None]
    if mean.std() > 0:
        names, scaled = [*names, r.output_name], [*scaled, mean]
    if 2 <= len(r.input_names) <= INPUTS:
        shares = paths(r).shares
        nuisance = np.column_stack([nuisance, shares])
        names = [*names, *r.input_names]
        scaled = [*scaled, *(shares - shares.mean(0)).T]
    K = slow.shape[1]
    columns = np.concatenate([slow * s[:, None] for s in scaled], axis=1)
    places = [np.array(k) - 1 + K * j for j in range(len(scaled)) for k in SLOW]
    scan = prewhitened(
        r.residual,
        free_columns(columns, places),
        spanning(nuisance),
        r.deviations,
        settings,
        first=np.column_stack([columns, nuisance]),
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
        """A straight line in time, or a random path; or each input times a line.

        The random path is a pair of poles, as slow as suits it, that process noise drives. What is
        nearly straight so far need not go on so: held-out data say whether it does.
        """
        begin, end = float(record.time[0]), float(record.time[-1])
        if evidence.where["form"] == "additive":
            path = with_process_noise(with_pairs(model, 1))
            return [with_channel(model, Trend(begin, end)), path]
        extended = model
        prepared = model.check(record)[0]
        driving = prepared.n_inputs - model.direct
        for name in prepared.input_names[:driving]:
            extended = with_channel(
                extended, TrendOfGain(name, centre_of(prepared, name), begin, end)
            )
        return [extended]
