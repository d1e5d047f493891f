"""Effects on noise, and feedback."""

from __future__ import annotations

from collections.abc import Sequence

from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Effect, number_of
from pyro_dynogp.effects.noise_effects import (
    feedback,
    heavy_tails,
    heteroscedastic_noise,
    process_noise,
)
from pyro_dynogp.layers.noise import Driver, Heteroscedastic, StudentT
from pyro_dynogp.models.variants import (
    Model,
    has_process_noise,
    with_likelihood,
    with_pairs,
    with_process_noise,
)
from pyro_dynogp.statistics.evidence import Evidence


class HeavyTails(Effect):
    """Measurement noise with outliers."""

    name = "heavy tails"
    once = True
    score = "one step"
    family = "noise"
    test = staticmethod(heavy_tails)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Student-t measurement noise."""
        nu = min(max(number_of(evidence, "degrees_of_freedom"), 2.2), 30.0)
        return [with_likelihood(model, StudentT(nu))]


class HeteroscedasticNoise(Effect):
    """Noise whose size depends on an input or on the output."""

    name = "heteroscedastic noise"
    once = True
    score = "one step"
    family = "noise"
    freedom = 3
    test = staticmethod(heteroscedastic_noise)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Log standard deviation of the noise as a Gaussian process of what it follows."""
        if model.inputs == model.direct:
            return []
        of: Driver = "output" if evidence.where["driver"] == "mean" else "inputs"
        return [with_likelihood(model, Heteroscedastic(of=of))]


class ProcessNoise(Effect):
    """Disturbances that pass through dynamics."""

    name = "process noise"
    score = "one step"
    family = "paths"
    freedom = 6
    once = True
    test = staticmethod(process_noise)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Process noise in every dynamic layer; where it is there, more poles are for dynamics."""
        if has_process_noise(model):
            return []
        noisy = with_process_noise(model)
        return [noisy, with_pairs(noisy, 1)]


class Feedback(Effect):
    """Inputs that follow the output: the record comes from a closed loop."""

    name = "feedback"
    family = "feedback"
    added = False
    test = staticmethod(feedback)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Nothing: it is reported."""
        return []
