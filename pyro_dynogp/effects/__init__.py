"""Effects that a model may lack: how each is found, and which blocks add it to the model.

An effect is one class in one file: a test, blocks, words, and experiments that tell it from others.
`Effect` lists its parts. One of your own is given to `close_loop` among `effects`, as in
`close_loop(fit, record, effects=(*CATALOGUE, Ageing()))`; docs/effects.md has all of `Ageing`, an
actuator that ages, in one file of 60 lines.

Examples:
    >>> [effect.name for effect in dgp.effects.CATALOGUE][:3]
    ['extra input', 'dead time', 'unmodelled dynamics']
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
from pyro_dynogp.effects.gain_shift import GainShift
from pyro_dynogp.effects.heavy_tails import HeavyTails
from pyro_dynogp.effects.heteroscedastic import HeteroscedasticNoise
from pyro_dynogp.effects.hysteresis import Hysteresis
from pyro_dynogp.effects.input_nonlinearity import InputNonlinearity
from pyro_dynogp.effects.integrator import Integrator
from pyro_dynogp.effects.level_shift import LevelShift
from pyro_dynogp.effects.nonlinear_feedback import NonlinearFeedbackOfOutput
from pyro_dynogp.effects.output_nonlinearity import OutputNonlinearity
from pyro_dynogp.effects.periodic import PeriodicDisturbance
from pyro_dynogp.effects.process_noise import ProcessNoise
from pyro_dynogp.effects.saturation import Saturation

__all__ = ["CATALOGUE", "Effect"]

CATALOGUE: tuple[Effect, ...] = (
    ExtraInput(), DeadTime(), UnmodelledDynamics(), Integrator(), OutputNonlinearity(),
    InputNonlinearity(), NonlinearFeedbackOfOutput(), Saturation(), DeadZoneOfInput(),
    Hysteresis(), Drift(), LevelShift(), GainShift(), PeriodicDisturbance(), CalendarEffect(),
    ClockShift(), HeavyTails(), HeteroscedasticNoise(), ProcessNoise(), Feedback(),
)  # fmt: skip
