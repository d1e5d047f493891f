"""A recorded channel that acts, but that the model does not use."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from pyro_dynogp.data.channels import Channel, Delayed, Product, Recorded, Transformed
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import delayed, held
from pyro_dynogp.effects.base import Effect, centre_of, number_of
from pyro_dynogp.effects.delay_regression import resolved
from pyro_dynogp.models.variants import Model, with_channel
from pyro_dynogp.statistics.detecting import Search, lasting
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, against, evidence, unit
from pyro_dynogp.statistics.responses import responses, standardised
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import input_columns


def extra_input(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> list[Evidence]:
    """Test each recorded channel that the model does not use.

    The channel (linear), its square, its absolute value (both about its mean) and its products with
    used inputs go through a bank of filters, at delays up to a tenth of the record. What mean and
    responses of the used inputs explain is theirs. `where`: channel, form, delay [time unit].

    Returns:
        One piece of evidence for each candidate.
    """
    if not residuals.candidates:
        return []
    nuisance = input_columns(residuals)
    return [_extra(residuals, name, nuisance, settings, seed) for name in residuals.candidates]


def _forms(residuals: Residuals, name: str) -> dict[str, np.ndarray]:
    w = standardised(held(residuals.candidates[name])[:, None])[:, 0]
    u = standardised(residuals.inputs)
    forms = {"linear": w}
    if len(np.unique(w)) > 2:  # of a flag square and absolute value are the flag again
        forms |= {"square": w**2, "absolute": np.abs(w)}
    for j, used in enumerate(residuals.input_names):
        forms[f"product with {used}"] = w * u[:, j]
    return forms


def _extra(
    residuals: Residuals, name: str, nuisance: np.ndarray, settings: LoopSettings, seed: int
) -> Evidence:
    r = residuals

    def bank(form: np.ndarray, delay: float) -> np.ndarray:
        late = delayed(form, r.time, delay) if delay else form
        return responses(late, r.step, r.time, constants=4, lags=1)

    forms = _forms(r, name)
    longest = 0.1 * (r.time[-1] - r.time[0])
    coarse = np.concatenate([[0.0], np.geomspace(2.0 * r.step, longest, 4)])
    tried = [(f, d) for f in forms for d in (coarse[:1] if f.startswith("product") else coarse)]
    scan = lasting(r, [bank(forms[f], d) for f, d in tried], nuisance, settings, seed)
    form, delay = tried[scan.best]
    if scan.p_value < settings.noticed:
        search = Search(r, nuisance, settings)
        grid = np.concatenate([[0.0], np.geomspace(0.5 * r.step, longest, 24)])
        delay = search.located(lambda d: bank(forms[form], d), delay, grid)
        ways = [bank(forms[form], 0.0), bank(forms[form], delay)]
        alone = search.gains(ways, ways[1])
        # A filter's own lag is not a delay, and one that gains little is not worth a parameter.
        delay = delay if alone[1] - alone[0] > settings.preference and delay >= r.step else 0.0
    late = f", {delay:.3g}{unit(r.time_unit)} later" if delay else ""
    how = {"linear": "", "square": " by its square", "absolute": " by its absolute value"}
    return evidence(
        "extra input",
        scan,
        {"channel": name, "form": form, "delay": delay},
        f"Channel '{name}' acts on '{r.output_name}'{how.get(form, f' as {form}')}{late}, "
        f"{about(r, scan.size)}.",
        against(r, delayed(held(r.candidates[name]), r.time, delay), name, nuisance, scan.fitted),
    )


class ExtraInput(Effect):
    """A recorded channel that acts: through dynamics, alone, squared, or times an input."""

    name = "extra input"
    family = "paths"
    acts_on = "inputs"
    freedom = 2
    experiments: ClassVar = {"process noise": "a record in which the extra channel is moved"}
    test = staticmethod(extra_input)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The channel, or what is made from it, as an input; with its delay where there is one."""
        channel, form = str(evidence.where["channel"]), str(evidence.where["form"])
        delay = number_of(evidence, "delay")
        if form == "linear":
            plain = with_channel(model, Recorded(channel))
            if delay < 2.0 * record.sampling_time:
                return [plain]
            (later,) = resolved([delay], record)
            return [plain, with_channel(plain, Delayed(channel, later))]
        made: Channel
        if form in ("square", "absolute"):
            made = Transformed(channel, form, centre_of(record, channel))
        else:
            other = form.removeprefix("product with ")
            made = Product(channel, other, centre_of(record, channel), centre_of(record, other))
        alone = with_channel(model, made)
        return [alone, with_channel(alone, Recorded(channel))]

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """With the delay that refits have, if any: dynamics may stand for it."""
        channel, delay = str(evidence.where["channel"]), number_of(evidence, "delay")
        if not delay:
            return evidence.sentence
        start, _, rest = evidence.sentence.partition(f", {delay:.3g}")
        symbol, _, end = rest.partition(" later")
        for late in model.channels:
            if isinstance(late, Delayed) and late.channel == channel and late.delay is not None:
                return f"{start}, {late.delay:.3g}{symbol} later{end}"
        return start + end
