"""Mechanical play of an actuator or of a sensor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.channels import Play
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import play
from pyro_dynogp.effects.base import AROUND, Effect, finer, number_of
from pyro_dynogp.models.variants import Model, with_channel
from pyro_dynogp.statistics.detecting import Search, lasting, one_sided
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, evidence, labelled, unit
from pyro_dynogp.statistics.regression import with_past
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import linear_responses, paths, several_valued

# Widths of play that are tried, against the range of the signal.
WIDTHS = np.geomspace(0.02, 0.8, 10)


def hysteresis(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """Test for play (backlash) at an input or at the output.

    Columns: the model's own path driven by play(u_j, width) - u_j, and play(mean, width) - mean.
    A phase lag, which differs from play in that it depends on frequency, is left to the responses
    of the inputs. `where`: channel (the output's name for play there), width (full, of that
    channel's unit). Play makes nothing but another gain and level of an input of two values, which
    is left out.
    """
    r = residuals
    path = paths(r)
    nuisance = linear_responses(r, path)
    used = several_valued(r)
    signals = [*(r.inputs[:, j] for j in used), r.mean]
    names = [*(r.input_names[j] for j in used), r.output_name]

    def columns(j: int, widths: np.ndarray) -> np.ndarray:
        s = signals[j]
        lost = np.column_stack([play(s, w) - s for w in widths])
        return path(used[j], lost) if j < len(used) else lost

    ranges = [float(np.ptp(np.quantile(s, [0.01, 0.99]))) for s in signals]
    tried = [(j, k) for j in range(len(signals)) for k in range(len(WIDTHS))]
    variants = [with_past(c) for j in range(len(signals)) for c in columns(j, WIDTHS * ranges[j]).T]
    scan = one_sided(lasting(r, variants, nuisance, settings, seed), variants)
    j, k = tried[scan.best]
    width = float(WIDTHS[k] * ranges[j])
    if scan.p_value < settings.noticed:
        search = Search(r, nuisance, settings)
        width = search.located(lambda w: columns(j, np.array([w])), width, WIDTHS * ranges[j])
    gains = scan.gains[[i for i, t in enumerate(tried) if t[0] == j]]
    of = unit(r.output_unit) if j == len(signals) - 1 else ""
    label = labelled(f"width of the play of {names[j]}", of.strip())
    return evidence(
        "hysteresis",
        scan,
        {"channel": names[j], "width": width},
        f"'{r.output_name}' follows channel '{names[j]}' with play, {width:.3g}{of} wide, "
        f"{about(r, scan.size)}."
        if j < len(signals) - 1
        else f"'{r.output_name}' has play, {width:.3g}{of} wide, {about(r, scan.size)}.",
        Curve(WIDTHS * ranges[j], gains, np.full(len(WIDTHS), np.nan), label, "gain [nats]"),
    )


class Hysteresis(Effect):
    """Mechanical play of an actuator."""

    name = "hysteresis"
    family = "shapes"
    acts_on = "inputs"
    freedom = 2
    test = staticmethod(hysteresis)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The input behind play of widths around the estimate; play of a sensor is reported."""
        channel, width = str(evidence.where["channel"]), number_of(evidence, "width")
        if channel in record.output_names:
            return []
        return [with_channel(model, Play(channel, share * width)) for share in AROUND]

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """The width as refits have it."""
        behind = model.channels[-1]
        assert isinstance(behind, Play)
        width = number_of(evidence, "width")
        return evidence.sentence.replace(f"play, {width:.3g}", f"play, {behind.width:.3g}")

    def refine(self, model: Model, record: Record, times: int) -> Sequence[Model]:
        """The play a little narrower and wider."""
        return finer(model, "width", times)
