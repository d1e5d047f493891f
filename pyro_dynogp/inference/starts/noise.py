"""The noise that climbs begin with."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.starts.dynamic import Values
from pyro_dynogp.layers.noise import TYPICAL
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import Records

# Measurement noise, in sds of the outputs, from which starts without process noise climb at least.
UNEXPLAINED = 0.5
# Process noise at which climbs from optima without any begin, as a share of that of a linear fit,
# which has it explain what the functions should.
FAINT = 0.03


def louder(values: Values) -> Values:
    """A start whose measurement noise can stand for what dynamics and functions lack as yet.

    Linear fits leave that to process noise. Without any, noise of their size makes the density so
    steep that the climb ends on its slopes.
    """
    least = {"noise_sd": UNEXPLAINED, "log_noise_constant": math.log(UNEXPLAINED / TYPICAL)}
    return {
        name: value.clamp_min(least[name]) if name in least else value
        for name, value in values.items()
    }


def faint(values: Values) -> Values:
    """A start whose process noise is `FAINT`."""
    scales = ("_noise_gain_local_scale", "_integrator_noise")
    return {
        name: FAINT * value if name.endswith(scales) else value for name, value in values.items()
    }


def most_probable(model: Model, records: Records, points: Sequence[Values]) -> Values:
    """The most probable of several starts."""
    potential = Potential(model, (records,), points[0])
    return points[int(potential.energies_at(points).argmin())]


def with_likely_noise(model: Model, records: Records, values: Values) -> Values:
    """What was learnt elsewhere, louder where that is more probable: free runs may be far off."""
    return most_probable(model, records, [values, louder(values)])
