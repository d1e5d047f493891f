"""Which of several variants of an effect is the most probable, on samples that all of them have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pyro_dynogp.data.record import Record
from pyro_dynogp.fitting import Fit
from pyro_dynogp.inference.refit import race
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.delays import comparable, longest_delay, where_inputs_are_known
from pyro_dynogp.models.variants import Model

# Variants that are compared again.
NEAREST = 3


def leading(
    base: Fit,
    models: Sequence[Model],
    finer: Sequence[Model],
    training: Record,
    reach: float,
    run: Run,
) -> tuple[Fit, Record, float]:
    """The most probable variant, the record on which it was, and the longest delay to try there.

    Outputs count from where the longest of all delays has passed. One that is far too long takes
    samples away: of 533 samples of a sensor a delay of 80 left 429, on which 27 samples were more
    probable than 9 by 32 nats; on the 498 that 27 leaves, 9 by 81. So the leading variants are
    compared again on what those of them leave.

    Args:
        base: fit that they extend. models: variants. finer: those that are to come. training: the
            record. reach: times the longest delay that finer ones may come to. run: as of `race`.

    Raises:
        ValueError: where none of them can be fitted.
    """
    every = [*models, *finer]
    longest, same = longest_delay(*every), comparable(training, every, reach)
    found, problems = race(base, models, same, run)
    if not found:
        raise problems[0]
    nearest = [unscaled(one) for one in found[:NEAREST]]
    shorter = longest_delay(*nearest)
    if 0.0 < shorter < longest:
        longest, same = shorter, where_inputs_are_known(training, reach * shorter)
        found, _ = race(base, nearest, same, run)
    return found[0], same, reach * longest


def unscaled(fit: Fit) -> Model:
    """Its model, which gets the units of the next record."""
    model: Model = replace(fit.model, scaling=None)
    return model
