"""What a record cannot tell: poles slower than it is long, unstable plants, too many numbers."""

from __future__ import annotations

import numpy as np

from pyro_dynogp.inference.bayes_factor import counted
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.statistics.growth import least_stable_pole

# A plant is unstable where a pole multiplies its state by exp(GROWTH) within the record and lies
# SURE standard errors beyond the boundary of stability.
GROWTH, SURE = 3.0, 3.0
# A pole is slow where the record holds fewer of its time constants than this. The prior of decay
# rates (`LogDecayRate`) has its mode at twenty, and below three keeps it from going lower by nearly
# three nats for each factor e: only a record that pulls towards zero gets there.
FEWEST = 3.0
# A model with functions has too many numbers from this share of the measured outputs on (gas
# furnace, a function of a hidden signal: 133 for 148, and 95 % bands that held 9 %). Linear models
# have posteriors whose bands hold in short records, too.
CROWDED = 0.8


def warnings_of(fit: Fitted) -> tuple[str, ...]:
    """What is to be said of a fit: nothing where all is well."""
    return (*of_poles(fit), *of_numbers(fit))


def of_poles(fit: Fitted) -> tuple[str, ...]:
    """What is to be said of its poles."""
    return tuple(_unstable(fit) or _slow(fit))


def of_numbers(fit: Fitted) -> tuple[str, ...]:
    """Whether a model with functions has nearly as many numbers as there are outputs."""
    numbers, measured = counted(fit)
    if not fit.model.has_function or numbers < CROWDED * measured:
        return ()
    return (
        f"the model has {numbers} free numbers, and there are {measured} measured outputs. Bands "
        "are likely to be too narrow, and forecasts to be far off: check(fit) says how forecasts "
        "hold within the record. Take fewer pairs or inducing values, or a longer record.",
    )


def is_unstable(rate: float, error: float, duration: float) -> bool:
    """Whether a pole of a rate, known to a standard error, is unstable and matters."""
    return rate * duration > GROWTH and rate > SURE * error


def _slow(fit: Fitted) -> list[str]:
    """Of the slowest pole of each dynamic layer."""
    unit, duration = fit.scaling.time_unit, float(fit.scaling.duration)
    found, layers = [], fit.system_at(fit.mode).dynamic
    for (wire, layer), (_, made) in zip(layers, fit.model.dynamic, strict=True):
        if made.real and made.feedback:  # what comes back decides how fast its level settles
            continue
        pole = max(layer.modes.poles[: made.pairs].tolist(), key=lambda pole: pole.real)
        held = -pole.real * duration
        if held < FEWEST:
            kind, advice = (
                "is hardly different from an integrator",
                "set integrators=1 if the plant integrates, ",
            )
            if abs(pole.imag) > 2.0 * abs(pole.real):
                kind, advice = "oscillates on", "add a Sinusoid for what oscillates outside, "
            elif made.integrators:
                advice = ""
            found.append(
                f"layer {wire.name}: the pole with natural frequency {abs(pole):.4g} rad/{unit} "
                f"decays so slowly that the record holds only {held:.1f} of its time constants. "
                f"Within this record it {kind}, and forecasts with it are not to be trusted: "
                f"{advice}remove what drifts, take a longer record, or fewer pairs."
            )
    return found


def _unstable(fit: Fitted) -> list[str]:
    """Of outputs whose past says that they grow."""
    step, unit = float(fit.scaling.time_step), fit.scaling.time_unit
    records = [record for record in fit.records if len(record) > 1]
    if any(np.ptp(np.diff(r.time)) > 1e-6 * step or r.sampling_time > 1.5 * step for r in records):
        return []
    found = []
    for index, name in enumerate(fit.scaling.output_names):
        outputs = [record.outputs[:, index] for record in records]
        pole = least_stable_pole([record.inputs for record in records], outputs) or (0.0, 1.0)
        rate, error = (x / step for x in pole)
        if is_unstable(rate, error, float(fit.scaling.duration)):
            found.append(
                f"output {name!r}: the record is that of an unstable plant (an autoregression has "
                f"a pole at {rate:.3g} +- {error:.1g} 1/{unit}), and only stable systems can be "
                "identified. The closed loop is stable: take its reference as the input."
            )
    return found
