r"""Gauss-Newton climbs of a model's posterior.

Each iteration has the energy's local shape from differences of one-step predictions (see
`innovation_energy`) and tries several dampings of the step together, straight and bent along the
valleys that systems with spare pairs have: half the second derivative of errors and log variances
along the step, projected back (geodesic acceleration: Transtrum & Sethna 2012, arXiv:1201.5885).
Climbs from several starts go side by side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from pyro_dynogp.inference.optimise.innovation_energy import Evaluated, Innovations
from pyro_dynogp.inference.optimise.lockstep import in_lockstep

# Dampings that are tried, as multiples of the last that was best; largest change of an entry.
DAMPINGS = np.array([1e-4, 1e-2, 0.1, 1.0, 10.0, 1e3])
LONGEST = 2.0
# Largest bend, in steps.
BENT = 0.75
# Least curvature, and least damping.
LEAST = 1e-3
# A climb ends where so many nats are left to gain by the quadratic form and by the last iteration,
# or were gained in so many iterations.
FLAT, PATIENCE = 0.01, 8
# With functions there are long ridges: each iteration gains some hundredths of a nat, and forecasts
# do not change. A climb ends where it gained so few nats in so many iterations. (Hidden signals: a
# third of all iterations had gained 1 nat of 1000, and errors were no smaller.)
RIDGE, FEW = 0.5, 4
# What a climb says that ended there.
DONE = "nothing left to gain"
# End, energy after each iteration, why it ended.
Climbed = tuple[np.ndarray, list[float], str]


def climb(innovations: Innovations, z: np.ndarray, steps: int, *, ridge: float = RIDGE) -> Climbed:
    """Lowest point from z (d,) on, the energy after each iteration, and why it ended.

    Args:
        innovations: of the model. steps: most iterations. ridge: nats, see `RIDGE`.
    """
    history: list[float] = []
    damping = 1.0
    while len(history) < steps:
        here = innovations.local(z)
        if here is None:
            return z, history, "no derivative"
        curvature, own = here.axes
        curvature = np.maximum(np.abs(curvature), LEAST)
        slope = own.T @ here.gradient
        axes = np.zeros((len(z), len(own)))  # with nothing along what does not vary
        axes[innovations.free] = own
        tried = damping * DAMPINGS
        inverse = 1.0 / (curvature + tried[:, None])  # of each damping, along the axes
        moves = _shortened(-(slope * inverse) @ axes.T)
        bends = -0.5 * ((innovations.bends(here, z, moves) @ own) * inverse) @ axes.T
        length, bent = (np.linalg.norm(x, axis=1, keepdims=True) for x in (moves, bends))
        bends *= np.minimum(1.0, BENT * length / np.maximum(bent, 1e-300))
        moves = np.concatenate([moves, moves + bends])
        energies = innovations.energies(z + moves)
        best = int(energies.argmin())
        gain = here.energy - float(energies[best])
        left = 0.5 * float((slope**2 / curvature).sum())
        history.append(here.energy - max(gain, 0.0))
        if gain > 0.0:
            z, damping = z + moves[best], max(float(tried[best % len(tried)]), LEAST)
        else:
            damping *= 1e4
        if gain < FLAT and (left < FLAT or _lately(history, PATIENCE) < FLAT):
            return z, history, DONE
        if innovations.has_functions and _lately(history, FEW) < ridge:
            return z, history, DONE
        if damping > 1e4 * curvature.max():
            return z, history, "no step gains anything"
    return z, history, "all steps used"


def climb_together(
    innovations: Innovations, starts: Sequence[np.ndarray], steps: int
) -> list[Climbed]:
    """What `climb` returns from each start; their points go through the filter together.

    A model is assembled once for all: on short records that takes longer than the filter.
    """

    def run(z: np.ndarray) -> Callable[[Callable[[np.ndarray], Evaluated]], Climbed]:
        return lambda evaluate: climb(innovations.asking(evaluate), z, steps)

    return in_lockstep(innovations.evaluate, [run(z) for z in starts])


def _lately(history: list[float], iterations: int) -> float:
    """What so many last iterations gained; infinite before so many are made."""
    return history[-iterations - 1] - history[-1] if len(history) > iterations else math.inf


def _shortened(moves: np.ndarray) -> np.ndarray:
    """Moves (k, d) of which no entry is longer than `LONGEST`."""
    longest = np.maximum(np.abs(moves).max(1, keepdims=True), LONGEST)
    return np.asarray(moves * (LONGEST / longest))
