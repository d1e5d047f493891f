"""A level that jumps at one instant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.channels import Step, StepInput
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Effect, changed, number_of
from pyro_dynogp.models.variants import Model, with_channel
from pyro_dynogp.models.wiring import StaticLayer
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import evidence, instant, over_time, unit
from pyro_dynogp.statistics.prewhitening import Projection, spanning
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.steps import beginning, instants, step_scan

# How far from the jump that fits best a disturbance may begin, as a share of the record.
NEARBY = 0.1
# How many samples its instant is moved at first, and then.
SAMPLES_AWAY = ((6, 3), (2, 1))


def level_shift(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """A step of the output's level at any instant, looked for in the whole record.

    Returns:
        where: time (of the first sample at the new level) [time unit], size [output], begin (of a
            disturbance to which the model's dynamics respond like this) [time unit].

    Source: largest F statistic over the instant, Andrews, Econometrica 61(4):821 (1993), in the
    whitened residual, as level shifts in Chen & Liu, JASA 88(421):284 (1993).
    """
    r = residuals
    # No slow responses of the inputs here: they would claim a step at almost any instant.
    nuisance = spanning(np.column_stack([r.mean, r.inputs]))
    scan, _, at = step_scan(r, np.ones((len(r), 1)), nuisance, settings, seed)
    size = float(scan.fitted[at] - scan.fitted[at - 1])
    begin = at
    if scan.p_value < settings.noticed and len(r.poles) > 0:
        under = Projection(scan.whitener, nuisance, ~np.isfinite(r.residual), settings)
        begin = _onset(r, under, at, settings)
    way = "up" if size > 0 else "down"
    return evidence(
        "level shift",
        scan,
        {"time": float(r.time[at]), "size": size, "begin": float(r.time[begin])},
        f"The level of {r.output_name!r} steps {way} by {abs(size):.3g}{unit(r.output_unit)} "
        f"at {instant(r, at)}.",
        over_time(r, scan.fitted),
    )


def _onset(r: Residuals, under: Projection, at: int, settings: LoopSettings) -> int:
    """The sample near a jump from which a step through the model's dynamics explains most.

    A slow response is not seen before it has grown, and by then looks like a smaller jump.
    """
    poles = np.unique(r.poles)

    def responses(places: np.ndarray) -> np.ndarray:
        """Of all poles to a step at each place, (n, M, K)."""
        past = np.maximum(r.time[:, None] - r.time[places], 0.0)
        made = np.stack([past if p == 0 else np.expm1(p * past) / p for p in poles], axis=2)
        columns = np.concatenate([made.real, made.imag], axis=2)
        size = np.abs(columns).max(axis=(0, 1))
        return columns[..., size > 0.0] / size[size > 0.0]

    places = instants(len(r), settings.step_margin)
    return beginning(r.residual, responses, under, places, at, int(NEARBY * len(r)))[0]


class LevelShift(Effect):
    """A level that jumps at one instant, or moves from it on as the dynamics respond to a step."""

    name = "level shift"
    family = "time"
    localised = True
    compared = "known"
    settled_by_evidence = True  # the response may lie in one block, held out
    test = staticmethod(level_shift)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A step of the output at the instant, or one of a disturbance of the dynamics.

        A sensor's zero jumps at once; what a leak or a load moves follows through the dynamics.
        Not behind a function of the inputs, which would have to be learnt at two values of the
        step.
        """
        at = number_of(evidence, "time")
        jump = with_channel(model, Step(at))
        if not model.dynamic or isinstance(model.layers[0], StaticLayer):
            return [jump]
        return [jump, with_channel(model, StepInput(number_of(evidence, "begin")))]

    def refine(self, model: Model, record: Record, times: int) -> Sequence[Model]:
        """Instants some samples away, of a disturbance: its response has no edge to see."""
        last = model.channels[-1]
        if not isinstance(last, StepInput):
            return []
        here = int(np.searchsorted(record.time, last.at))
        places = [here + sign * k for k in SAMPLES_AWAY[times] for sign in (-1, 1)]
        inside = [float(record.time[k]) for k in places if 0 < k < len(record)]
        return [changed(model, [last], at=time) for time in inside]

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """What it is where the step acts through the dynamics; how far is for its gain to say."""
        if not isinstance(model.channels[-1], StepInput):
            return evidence.sentence
        start, _, rest = evidence.sentence.rpartition(" by ")
        level, _, way = start.rpartition(" steps ")
        when = rest.partition(" at ")[2].rstrip(".")
        return (
            f"{level} moves {way} about {when}, as the dynamics respond to an earlier step of a "
            "disturbance."
        )
