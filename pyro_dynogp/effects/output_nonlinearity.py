"""A function of the model's output: a sensor that is not linear."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import hermite, hinges
from pyro_dynogp.effects.base import Effect, variants_of
from pyro_dynogp.models.variants import Model, with_output_function
from pyro_dynogp.statistics.detecting import lasting
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, against, evidence, labelled
from pyro_dynogp.statistics.regression import with_past
from pyro_dynogp.statistics.settings import LoopSettings


def output_nonlinearity(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """Test for a function of the mean alone, beyond the mean itself.

    Variants: Hermite polynomials of the second and third degree, apart and together, and piecewise
    linear functions with one knot and with five (after Ramsey's RESET, J. R. Stat. Soc. B 31:350,
    1969). `where` is empty.
    """
    r = residuals
    powers, bends = hermite(r.mean), hinges(r.mean)
    variants = [powers[:, :1], powers[:, 1:], powers, bends, *bends.T]
    variants, nuisance = [with_past(v) for v in variants], with_past(r.mean)
    scan = lasting(r, variants, nuisance, settings, seed)
    label = labelled(f"simulated {r.output_name}", r.output_unit)
    return evidence(
        "output nonlinearity",
        scan,
        {},
        f"'{r.output_name}' is a nonlinear function of what the model says, {about(r, scan.size)}.",
        against(r, r.mean, label, nuisance, scan.fitted),
    )


class OutputNonlinearity(Effect):
    """A function of the model's output: a sensor that is not linear."""

    name = "output nonlinearity"
    family = "shapes"
    acts_on = "inputs"
    freedom = 4
    experiments: ClassVar = {
        "input nonlinearity": "the same slow sweep once more with fast steps on it: a nonlinear "
        "sensor follows the output, a nonlinear actuator the input, whatever the speed",
    }
    test = staticmethod(output_nonlinearity)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A static layer at that end; nothing where there is one."""
        return variants_of(with_output_function(model))
