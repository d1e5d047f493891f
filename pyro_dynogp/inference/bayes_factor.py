"""How far data speak for one posterior mode against another, by Laplace's approximation."""

from __future__ import annotations

import math

import numpy as np

from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.laplace import log_evidence

# Log Bayes factor from which on evidence is very strong (Kass & Raftery, JASA 90:773, 1995) [nats].
VERY_STRONG = 5.0


def energy(fit: Fitted) -> float:
    """-log p(y, values) at the mode [nats]."""
    return float(fit.start_energies[0])


def counted(fit: Fitted) -> tuple[int, int]:
    """Free numbers of a fit, and measured outputs that it was fitted to."""
    numbers = sum(value.numel() for value in fit.mode.values())
    return numbers, sum(int((~record.missing).sum()) for record in fit.records)


def log_evidence_of(fit: Fitted) -> float:
    """Log p(y) of the data that a mode is fitted to, as far as its neighbourhood goes [nats].

    Schwarz's criterion would pay for every inducing value of a function as for a parameter of its
    own, which most of them are not. Minus infinity where predictions next to the mode are not
    finite.
    """
    model = fit.model.collapsed
    potential = Potential(model, (model.prepare(fit.records),), fit.mode)
    try:
        found = log_evidence(potential, fit.mode)
    except np.linalg.LinAlgError:  # of a curvature that is not finite
        return -math.inf
    return found if math.isfinite(found) else -math.inf


def log_bayes_factor(one: Fitted, other: Fitted) -> float:
    """Of one fit against another of the same data [nats]: how far these speak for it.

    Not a number where neither has finite predictions next to it.
    """
    return log_evidence_of(one) - log_evidence_of(other)
