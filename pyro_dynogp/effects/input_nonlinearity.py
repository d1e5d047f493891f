"""A function of an input: an actuator that is not linear."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import hermite, hinges
from pyro_dynogp.effects.base import Effect, variants_of
from pyro_dynogp.models.variants import Model, with_input_function
from pyro_dynogp.statistics.detecting import lasting
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, against, evidence
from pyro_dynogp.statistics.regression import with_past
from pyro_dynogp.statistics.responses import responses
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import linear_responses, paths, several_valued
from pyro_dynogp.support.errors import invalid


def input_nonlinearity(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """Test for responses of even and odd functions of each used input, beyond those of itself.

    The functions (Hermite polynomials, piecewise linear ones) go through the model's own path from
    that input, and the polynomials through a bank of filters as well (after the cross-correlations
    with squared inputs of Billings and Voon, Int. J. Control 44:235, 1986). `where`: channel.
    Of an input of two values every function is a line: it is left out.

    Raises:
        ValueError: where too few samples are held out and measured, or all inputs are left out.
    """
    r = residuals
    path = paths(r)
    nuisance = linear_responses(r, path)
    tried: list[tuple[int, np.ndarray]] = []
    for j in several_valued(r):
        u = r.inputs[:, j]
        powers, bends = hermite(u), hinges(u, 3)
        through = path(j, np.column_stack([powers, bends]))
        banks = [responses(powers[:, i], r.step, r.time, constants=4, lags=1) for i in (0, 1)]
        ways = [through[:, :1], through[:, 1:2], through[:, :2], through[:, 2:]]
        tried += [(j, way) for way in [*map(with_past, ways), *banks]]
    if not tried:
        raise invalid("residuals", expected="an input of more than two values", got="none")
    scan = lasting(r, [columns for _, columns in tried], nuisance, settings, seed)
    j = tried[scan.best][0]
    name = r.input_names[j]
    return evidence(
        "input nonlinearity",
        scan,
        {"channel": name},
        f"Channel '{name}' acts on '{r.output_name}' through a nonlinear function of itself, "
        f"{about(r, scan.size)}.",
        against(r, r.inputs[:, j], name, nuisance, scan.fitted),
    )


class InputNonlinearity(Effect):
    """A function of an input: an actuator that is not linear."""

    name = "input nonlinearity"
    family = "shapes"
    acts_on = "inputs"
    freedom = 4
    test = staticmethod(input_nonlinearity)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A static layer at that end; nothing where there is one."""
        return variants_of(with_input_function(model))
