"""A level that jumps at one instant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.channels import Step
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Effect, number_of
from pyro_dynogp.models.variants import Model, with_channel
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import evidence, instant, over_time
from pyro_dynogp.statistics.prewhitening import spanning
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.steps import step_scan


def level_shift(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """A step of the output's level at any instant, looked for in the whole record.

    Returns:
        where: time (of the first sample at the new level) [time unit], size [output].

    Source: largest F statistic over the instant, Andrews, Econometrica 61(4):821 (1993), in the
    whitened residual, as level shifts in Chen & Liu, JASA 88(421):284 (1993).
    """
    r = residuals
    # No slow responses of the inputs here: they would claim a step at almost any instant.
    nuisance = spanning(np.column_stack([r.mean, r.inputs]))
    scan, _, at = step_scan(r, np.ones((len(r), 1)), nuisance, settings, seed)
    size = float(scan.fitted[at] - scan.fitted[at - 1])
    way = "up" if size > 0 else "down"
    return evidence(
        "level shift",
        scan,
        {"time": float(r.time[at]), "size": size},
        f"The level of {r.output_name!r} steps {way} by {abs(size):.3g} {r.output_unit} "
        f"at {instant(r, at)}.",
        over_time(r, scan.fitted),
    )


class LevelShift(Effect):
    """A level that jumps at one instant."""

    name = "level shift"
    family = "time"
    localised = True
    test = staticmethod(level_shift)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A step at the instant."""
        return [with_channel(model, Step(number_of(evidence, "time")))]
