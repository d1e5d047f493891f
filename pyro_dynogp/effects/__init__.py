"""Effects that a model may lack: how each is found, and which blocks add it to the model.

An effect is a class with a name, a test and a way to extend a model. To add one of your own, write
such a class and give it to `close_loop` among `effects`:

    class Ageing(Effect):
        name = "ageing"

        def detect(self, residuals, seed=0):
            found = lasting(residuals, [with_past(my_column(residuals))], None, seed)
            return [evidence(self.name, found, {}, "The gain falls with age.", None)]

        def extend(self, model, evidence, record):
            return [with_channel(model, MyChannel(...))]
"""

from pyro_dynogp.effects.base import Effect
from pyro_dynogp.effects.noise import (
    Feedback,
    HeavyTails,
    HeteroscedasticNoise,
    ProcessNoise,
)
from pyro_dynogp.effects.paths import DeadTime, ExtraInput, UnmodelledDynamics
from pyro_dynogp.effects.shapes import (
    DeadZoneOfInput,
    Hysteresis,
    InputNonlinearity,
    OutputNonlinearity,
    Saturation,
)
from pyro_dynogp.effects.times import (
    CalendarEffect,
    ClockShift,
    Drift,
    LevelShift,
    PeriodicDisturbance,
)

__all__ = ["CATALOGUE", "Effect"]

CATALOGUE: tuple[Effect, ...] = (
    ExtraInput(), DeadTime(), UnmodelledDynamics(), OutputNonlinearity(), InputNonlinearity(),
    Saturation(), DeadZoneOfInput(), Hysteresis(), Drift(), LevelShift(), PeriodicDisturbance(),
    CalendarEffect(), ClockShift(), HeavyTails(), HeteroscedasticNoise(), ProcessNoise(),
    Feedback(),
)  # fmt: skip
