"""A pole at zero that the model lacks: a level, a position, a charge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import held
from pyro_dynogp.effects.base import Effect, Parameters, variants_of
from pyro_dynogp.models.variants import Model, with_integrator
from pyro_dynogp.statistics.detecting import lasting
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, evidence, labelled, over_time
from pyro_dynogp.statistics.regression import with_past
from pyro_dynogp.statistics.responses import standardised
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import check_inputs

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit


def integrator(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """Test for the integral of each used input, beside the mean and a straight line of time.

    The line is what the integral of a constant makes: the input at which the output rests need not
    be its mean, and a level that drifts by itself is no integral of an input. `where`: channel.
    """
    check_inputs(residuals)
    r = residuals
    steps = np.append(0.0, np.diff(r.time))
    inputs = np.column_stack([held(u) for u in r.inputs.T])
    before = np.concatenate([inputs[:1], inputs[:-1]]) - inputs.mean(0)
    integrals = standardised(np.cumsum(before * steps[:, None], axis=0))
    nuisance = np.column_stack([with_past(r.mean), standardised(r.time[:, None])])
    scan = lasting(r, [with_past(column) for column in integrals.T], nuisance, settings, seed)
    name = r.input_names[scan.best]
    return evidence(
        "integrator",
        scan,
        {"channel": name},
        f"'{r.output_name}' integrates channel '{name}', {about(r, scan.size)}.",
        over_time(r, scan.fitted),
    )


class Integrator(Effect):
    """A pole at zero that the model lacks."""

    name = "integrator"
    family = "paths"
    acts_on = "inputs"
    freedom = 2
    once = True
    imitated = True  # of seven motors their angle's integrator had p-values from 0.08 to 1
    experiments: ClassVar = {
        "unmodelled dynamics": "a step of the input, left alone for several times the slowest time "
        "constant: an integrator continues at the same rate, a slow pole comes to rest",
        "drift": "the same record with an input of the opposite sign: what an integrator makes of "
        "it changes sign, a drift does not",
    }
    test = staticmethod(integrator)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A pole at zero in the last dynamic layer; nothing where there is one."""
        return variants_of(with_integrator(model))

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """Without the size of what the residual shows of it, which poles hide."""
        return f"{evidence.sentence.partition(', about ')[0].rstrip('.')}."

    def parameters(self, fit: Fit, evidence: Evidence, record: Record) -> Parameters:
        """Rate of the output for one unit of each input [output / (input time)].

        Posterior mean and standard deviation. None for several outputs and for models that are not
        linear, where the output of the layer has no unit.
        """
        model, scaling = fit.model, fit.scaling
        if not model.is_linear or model.outputs > 1:
            return {}
        modes = fit.system_at(fit.draws).physical(scaling).modes
        at = (modes.poles == 0).nonzero()[:, -1]
        if modes.input_gain is None or modes.output_gain is None or not len(at):
            return {}
        k = int(at[0])
        # A pole at zero is one of no pair: y' = c B u, its gains are real.
        rates = 2.0 * (modes.output_gain[..., k, None] * modes.input_gain[..., k, :]).real.numpy()
        rates = rates.reshape(-1, rates.shape[-1])
        found: Parameters = {}
        for j in range(model.inputs - model.direct):
            per = f"{scaling.input_units[j] or '1'} {scaling.time_unit}".strip()
            unit = f"{scaling.output_units[0] or '1'}/({per})"
            label = labelled(f"rate per unit of {scaling.input_names[j]}", unit)
            found[label] = float(rates[:, j].mean()), float(rates[:, j].std())
        return found
