"""A gain that jumps at one instant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from pyro_dynogp.data.channels import Channel, Ramp, RampOfGain, Step, StepOfGain
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Effect, centre_of, driving_names, number_of, unit_of
from pyro_dynogp.models.variants import Model, with_channels
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, evidence, instant, over_time
from pyro_dynogp.statistics.prewhitening import Projection, spanning
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import contributions, paths
from pyro_dynogp.statistics.steps import beginning, instants, step_scan
from pyro_dynogp.support.errors import invalid

# Signals that are filtered at once.
AT_ONCE = 8
# How long a gain may take to change, as shares of the record.
WIDTHS = (0.1, 0.25, 0.5)
# Channels that make a gain change.
SHIFTS = (StepOfGain, RampOfGain)


def gain_shift(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """A step of a gain at any instant, looked for in the whole record.

    From the instant on the output has a share of what the model says about its average, or of what
    one input contributes to it.

    Returns:
        where: time (of the first sample with the new gain) [time unit], channel (the input whose
            gain steps, or the output where that of all does), ratio (of the new gain to the old).

    Raises:
        ValueError: where the model's mean is constant.

    Source: largest F statistic over the instant, Andrews, Econometrica 61(4):821 (1993), of a
    coefficient that changes once, Chow, Econometrica 28(3):591 (1960); the null by `prewhitened`.
    """
    r = residuals
    names, signals = contributions(r)
    if not names:
        raise invalid("residuals", expected="a mean that moves", got="a constant one")
    nuisance = spanning(signals)
    scan, k, at = step_scan(r, signals, nuisance, settings, seed)
    of = range(r.inputs.shape[1]) if k == 0 else [r.input_names.index(names[k])]
    under = Projection(scan.whitener, nuisance, ~np.isfinite(r.residual), settings)
    within = len(r) // 10 if scan.p_value < settings.noticed else 0
    at, share, fitted = _nearby(r, of, under, instants(len(r), settings.step_margin), at, within)
    way = "up" if share > 0 else "down"
    return evidence(
        "gain shift",
        scan,
        {
            "time": float(r.time[at]),
            "channel": names[k],
            "ratio": 1.0 + share,
            "time_unit": r.time_unit,
        },
        f"The gain of {names[k]!r} steps {way} to {1.0 + share:.3g} times what it was "
        f"at {instant(r, at)}: {about(r, scan.size)}.",
        over_time(r, fitted),
    )


def _nearby(
    residuals: Residuals,
    of: Sequence[int],
    under: Projection,
    places: np.ndarray,
    at: int,
    within: int,
) -> tuple[int, float, np.ndarray]:
    """The instant near one at which a step fits best that goes through the model's own dynamics.

    A product with the mean begins at once where the response to the input begins slowly: by about
    a time constant the instant is wrong. The level may step as well, for whatever input does
    nothing.

    Args:
        of: inputs whose gain steps. under: the filter, and what the step may not claim.
        places: samples where it may be. at: where the scan found it. within: how far it may be.

    Returns:
        The sample, by which share the gain changes, and what the step explains (n,) [output].
    """
    r, path = residuals, paths(residuals)
    signals = [(j, r.inputs[:, j] - r.inputs[:, j].mean()) for j in of]
    levels = [(j, np.full(len(r), x.std())) for j, x in signals]
    row = np.arange(len(r))

    def responses(signals: Sequence[tuple[int, np.ndarray]], places: np.ndarray) -> np.ndarray:
        """Of signals that begin at each place, through the paths of their inputs, (n, M)."""
        parts = np.array_split(places, np.arange(AT_ONCE, len(places), AT_ONCE))
        begun = [row[:, None] >= part for part in parts]
        return np.sum([
            np.concatenate([path(j, np.where(some, x[:, None], 0.0)) for some in begun], axis=1)
            for j, x in signals
        ], axis=0)  # fmt: skip

    def columns(places: np.ndarray) -> np.ndarray:
        return np.stack([responses(signals, places), responses(levels, places)], axis=2)

    at, weights, fitted = beginning(r.residual, columns, under, places, at, within)
    return at, float(weights[0]), fitted


class GainShift(Effect):
    """A gain that steps at one instant, or changes about it."""

    name = "gain shift"
    family = "time"
    localised = True
    compared = "held out"
    experiments: ClassVar = {
        "drift": "the same input once more",
        "level shift": "a record at two sizes of the input",
    }
    test = staticmethod(gain_shift)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The input, or each of them, from the instant on as another input; its level as well.

        A gain that steps moves the level by as much as the input is away from where it does
        nothing. That is its zero, or else there is a variant with a step of the level. Others take
        a while, about the instant. Variants beyond the first have to be certainly better.
        """
        at, channel = number_of(evidence, "time"), evidence.where["channel"]
        prepared = model.check(record)[0]
        driving = driving_names(model, prepared)
        made = {n for one in model.channels if isinstance(one, SHIFTS) for n in one.names}
        of = [name for name in driving if name == channel] or [
            name for name in driving if name not in made
        ]
        centres = {name: centre_of(prepared, name) for name in of}
        first, last = float(record.time[0]), float(record.time[-1])
        variants: list[list[Channel]] = [
            [StepOfGain(name, 0.0, at) for name in of],
            [*(StepOfGain(name, centre, at) for name, centre in centres.items()), Step(at)],
        ]
        for share in WIDTHS:
            half = 0.5 * share * (last - first)
            ends = (max(at - half, first), min(at + half, last))
            ramps = [RampOfGain(name, centre, *ends) for name, centre in centres.items()]
            variants.append([*ramps, Ramp(*ends)])
        return [with_channels(model, channels) for channels in variants]

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """How long it takes, where it is no step."""
        last = [one for one in model.channels if isinstance(one, SHIFTS)][-1]
        if isinstance(last, StepOfGain):
            return evidence.sentence
        took = f"{last.end - last.begin:.3g}{unit_of(evidence)}"
        return f"{evidence.sentence.replace(' steps ', ' changes ', 1)} It takes {took} about then."
