"""Effects that a model may lack: how each is found, and which blocks add it to the model.

An effect is one class in one file: a test, blocks, words, and experiments that tell it from others.
`Effect` lists its parts. One of your own is given to `close_loop` among `effects`; for example
`close_loop(fit, record, effects=(*CATALOGUE, Ageing()))` with this file:

    '''An effect of one's own: an actuator that ages.'''

    from dataclasses import dataclass
    from typing import ClassVar

    import numpy as np

    from pyro_dynogp.data.channels.base import Quantity, signal_of
    from pyro_dynogp.data.channels.signal import Replacement
    from pyro_dynogp.effects.base import AROUND, Effect, finer, number_of, unit_of
    from pyro_dynogp.models.variants import with_channel
    from pyro_dynogp.statistics.detecting import evidence, lasting
    from pyro_dynogp.statistics.regression import with_past
    from pyro_dynogp.statistics.shares_of_inputs import paths


    @dataclass(frozen=True)
    class Aged(Replacement):
        '''The block: an input times exp(-(t - begin) / time_constant); times in [time unit].'''

        label: ClassVar[str] = "aged"
        numbers: ClassVar = {"time_constant": Quantity("time constant of ageing", "time", low=1e-3)}
        begin: float
        time_constant: float

        def _columns(self, record):
            age = record.time - self.begin
            return signal_of(record, self.channel) * np.exp(-age / self.time_constant)


    class Ageing(Effect):
        '''The gain of one input decays exponentially.'''

        name = "ageing"
        family = "paths"
        acts_on = "inputs"
        experiments: ClassVar = {"drift": "the same record once more with a new actuator"}

        def detect(self, residuals, seed=0):
            shares, age = paths(residuals).shares, residuals.time - residuals.time[0]
            scales = age[-1] * np.array([0.1, 0.2, 0.5, 1.0, 2.0])
            grid = [(j, tau) for j in range(shares.shape[1]) for tau in scales]
            variants = [with_past(shares[:, j] * np.exp(-age / tau)) for j, tau in grid]
            scan = lasting(residuals, variants, with_past(shares), seed)
            j, tau = grid[scan.best]
            name, unit = residuals.input_names[j], residuals.time_unit
            where = {"channel": name, "time_constant": tau, "time_unit": unit}
            return [evidence(self.name, scan, where, f"The gain of {name!r} decays.", None)]

        def extend(self, model, evidence, record):
            channel, tau = str(evidence.where["channel"]), number_of(evidence, "time_constant")
            start = float(record.time[0])
            return [with_channel(model, Aged(channel, start, share * tau)) for share in AROUND]

        def refine(self, model, record, times):
            return finer(model, "time_constant", times)

        def sentence(self, evidence, model):
            aged, unit = model.channels[-1], unit_of(evidence)
            return f"The gain of {aged.channel!r} decays to 1/e in {aged.time_constant:.3g}{unit}."
"""

from pyro_dynogp.effects.base import Effect
from pyro_dynogp.effects.calendar import CalendarEffect
from pyro_dynogp.effects.clock_shift import ClockShift
from pyro_dynogp.effects.dead_time import DeadTime
from pyro_dynogp.effects.dead_zone import DeadZoneOfInput
from pyro_dynogp.effects.drift import Drift
from pyro_dynogp.effects.dynamics import UnmodelledDynamics
from pyro_dynogp.effects.extra_input import ExtraInput
from pyro_dynogp.effects.feedback import Feedback
from pyro_dynogp.effects.heavy_tails import HeavyTails
from pyro_dynogp.effects.heteroscedastic import HeteroscedasticNoise
from pyro_dynogp.effects.hysteresis import Hysteresis
from pyro_dynogp.effects.input_nonlinearity import InputNonlinearity
from pyro_dynogp.effects.level_shift import LevelShift
from pyro_dynogp.effects.output_nonlinearity import OutputNonlinearity
from pyro_dynogp.effects.periodic import PeriodicDisturbance
from pyro_dynogp.effects.process_noise import ProcessNoise
from pyro_dynogp.effects.saturation import Saturation

__all__ = ["CATALOGUE", "Effect"]

CATALOGUE: tuple[Effect, ...] = (
    ExtraInput(), DeadTime(), UnmodelledDynamics(), OutputNonlinearity(), InputNonlinearity(),
    Saturation(), DeadZoneOfInput(), Hysteresis(), Drift(), LevelShift(), PeriodicDisturbance(),
    CalendarEffect(), ClockShift(), HeavyTails(), HeteroscedasticNoise(), ProcessNoise(),
    Feedback(),
)  # fmt: skip
