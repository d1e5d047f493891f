"""An actuator that does nothing around the middle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from pyro_dynogp.data.channels import DeadZone
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import AROUND, FINER, Effect, changed, number_of
from pyro_dynogp.models.variants import Model, with_channel
from pyro_dynogp.statistics.detecting import Search, lasting, one_sided
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, against, evidence
from pyro_dynogp.statistics.regression import with_past
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import linear_responses, paths

# Quantiles of an input between which a dead zone may lie.
LEVELS = np.linspace(0.0, 1.0, 9)
# How lower and upper limit move together where a zone is refined.
MOVED = ((1, 0), (0, 1), (1, 1), (-1, 1))


def dead_zone(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """Test whether an input has no effect between two of its values.

    The column is the model's own path from that input, driven by dead zone less input. `where`:
    channel, low, high [input]; the smallest or largest value of the input where the zone reaches
    that far. An input with less than three values among its octiles is left out.

    Raises:
        ValueError: where too few samples are held out and measured, or all inputs are left
            out.
    """
    r = residuals
    path = paths(r)
    nuisance = linear_responses(r, path)

    def columns(j: int, limits: Sequence[tuple[float, float]]) -> np.ndarray:
        return path(j, np.column_stack([-np.clip(r.inputs[:, j], *at) for at in limits]))

    tried: list[tuple[int, float, float]] = []
    variants: list[np.ndarray] = []
    for j, u in enumerate(r.inputs.T):
        at = np.unique(np.quantile(u, LEVELS))
        inner = [(a, b) for i, a in enumerate(at) for b in at[i + 1 :] if (a, b) != (at[0], at[-1])]
        if not inner:
            continue
        tried += [(j, float(a), float(b)) for a, b in inner]
        variants += [with_past(c) for c in columns(j, inner).T]
    if not variants:
        raise ValueError(
            "residuals: expected an input of more than two values among its octiles, between which "
            f"a dead zone could lie; none of the {r.inputs.shape[1]} has them."
        )
    scan = one_sided(lasting(r, variants, nuisance, settings, seed), variants)
    j, low, high = tried[scan.best]
    if scan.p_value < settings.noticed:
        at = np.unique(np.quantile(r.inputs[:, j], np.linspace(0.0, 1.0, 21)))
        search = Search(r, nuisance, settings)
        low, high = search.located_limits(lambda a, b: columns(j, [(a, b)]), (low, high), at)
    name = r.input_names[j]
    return evidence(
        "dead zone",
        scan,
        {"channel": name, "low": low, "high": high},
        f"Channel '{name}' has no effect on '{r.output_name}' from {low:.3g} to {high:.3g}, "
        f"{about(r, scan.size)}.",
        against(r, r.inputs[:, j], name, nuisance, scan.fitted),
    )


class DeadZoneOfInput(Effect):
    """An actuator that does nothing around the middle."""

    name = "dead zone"
    family = "shapes"
    acts_on = "inputs"
    freedom = 2
    experiments: ClassVar = {
        "input nonlinearity": "slow ramps of the input through zero, smaller and larger than the "
        "suspected zone",
        "hysteresis": "a slow triangle of the input: play opens a loop, a dead zone does not",
    }
    test = staticmethod(dead_zone)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The input beyond limits around the estimate."""
        channel = str(evidence.where["channel"])
        low, high = number_of(evidence, "low"), number_of(evidence, "high")
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        return [
            with_channel(model, DeadZone(channel, middle - share * half, middle + share * half))
            for share in AROUND
        ]

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """The limits as refits have them."""
        zone = model.channels[-1]
        assert isinstance(zone, DeadZone)
        low, high = number_of(evidence, "low"), number_of(evidence, "high")
        refitted = f"from {zone.low:.3g} to {zone.high:.3g},"
        return evidence.sentence.replace(f"from {low:.3g} to {high:.3g},", refitted)

    def refine(self, model: Model, record: Record, times: int) -> Sequence[Model]:
        """Each limit a little lower and higher, the zone as a whole, and narrower and wider.

        A limit that is too low makes up for another one that is.
        """
        last = model.channels[-1]
        assert isinstance(last, DeadZone)
        moves = [(share - 1.0) * (last.high - last.low) for share in FINER[times]]
        return [
            changed(model, [last], low=last.low + a * move, high=last.high + b * move)
            for move in moves
            for a, b in MOVED
        ]
