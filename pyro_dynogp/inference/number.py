"""Posterior of numbers that a model is made with rather than samples: a delay, a limit, a period.

Such a number moves an input along the time axis or bends it, and the density is not smooth in it.
At each value of a grid the sample sites climb to their mode again, in coordinates that are round at
the fitted number, and

    p(number | y) = exp(-E(number)) / sum over the grid,

E the negative log joint density at that mode. This is Laplace's approximation of the integral over
the sites (Tierney & Kadane, J. Am. Stat. Assoc. 81:82, 1986) with one curvature for all values of
the number, whose prior is flat within its bounds.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pyro_dynogp.inference.descent import bounded_root, piece
from pyro_dynogp.inference.potential import WALL, Potential

# Nats below the top at which the density counts as zero; points of the grid for one number and for
# each of two; how often a range is doubled or halved to find that depth.
DEPTH, POINTS, DOUBLINGS = 9.0, (21, 9), 20
# How often a grid that is too coarse is drawn again.
CLOSER = 4
# Most steps of the sites to their mode.
ITERATIONS = 60
# Gradient, in coordinates that are round at the fitted number, at which they are there.
FLAT = 0.03
# Standard deviation of an unconstrained site in whose direction the density is flat.
WIDEST = 3.0


@dataclass(frozen=True)
class Number:
    """One number of a model.

    Attributes:
        at: its value in the fit. step: how far off it may easily be, to begin with.
        low, high: its bounds.
    """

    at: float
    step: float
    low: float = -np.inf
    high: float = np.inf


def number_posterior(
    potential: Callable[[Sequence[float]], Potential], numbers: Sequence[Number]
) -> list[tuple[float, float]]:
    """Posterior mean and standard deviation of one number, or of two that go together.

    Args:
        potential: of the model with other numbers; its `at` is the fit's mode.
        numbers: as the fit has them.

    Raises:
        ValueError: where the fitted numbers themselves make no model.
    """
    centre = tuple(one.at for one in numbers)
    steps = np.array([one.step for one in numbers])
    first = potential(centre)
    z = first.pack(first.at).numpy()
    root = bounded_root(first.hessian(z), widest=WIDEST)
    known: dict[tuple[float, ...], tuple[float, np.ndarray]] = {}

    def energy(values: Sequence[float]) -> float:
        """-log density up to a constant; infinite where it cannot be evaluated."""
        key = tuple(values)
        if key not in known:
            near = min(known, key=lambda one: float(np.sum(((key - np.array(one)) / steps) ** 2)),
                       default=None)  # fmt: skip
            start = z if near is None else known[near][1]
            try:
                known[key] = _lowest(potential(key), start, root)
            except ValueError:  # numbers that make no model, as limits that cross: no density
                known[key] = np.inf, start
        return known[key][0]

    ranges = [_range(energy, centre, k, one) for k, one in enumerate(numbers)]
    points = POINTS[len(numbers) - 1]
    for _ in range(CLOSER if len(numbers) == 1 else 1):
        grid = [np.linspace(low, high, points) for low, high in ranges]
        heights = np.array([energy(values) for values in itertools.product(*grid)])
        density = np.exp(heights.min() - heights).reshape([points] * len(grid))
        closer = [_where(density, axis, one) for axis, one in enumerate(grid)]
        # A grid that is too coarse for the top, as where the first range had none of it.
        if all(b - a > 0.5 * (d - c) for (a, b), (c, d) in zip(closer, ranges, strict=True)):
            break
        ranges = closer
    found = []
    for axis, one in enumerate(grid):
        share = _along(density, axis)
        share = share / share.sum()
        mean = float(share @ one)
        found.append((mean, float(np.sqrt(share @ (one - mean) ** 2))))
    return found


def _lowest(potential: Potential, z: np.ndarray, root: np.ndarray) -> tuple[float, np.ndarray]:
    """Lowest energy from a point on, to a hundredth of a nat, and where it is."""
    z, energy, _ = piece(potential.with_jacobian, z, root, ITERATIONS, [], flat=FLAT)
    return (energy if energy < WALL else np.inf), z


def _range(
    energy: Callable[[Sequence[float]], float], centre: Sequence[float], k: int, number: Number
) -> tuple[float, float]:
    """Between which values of a number the density is not zero, others held where they are."""

    def at(value: float) -> float:
        return energy([value if j == k else v for j, v in enumerate(centre)])

    ends = []
    for side in (-1.0, 1.0):
        bound = number.low if side < 0.0 else number.high
        lowest, width, value = at(number.at), number.step, number.at
        for _ in range(DOUBLINGS):  # not deep in the tails to begin with
            if at(_within(number.at + side * width, bound, side)) < lowest + DEPTH:
                break
            width *= 0.5
        for _ in range(DOUBLINGS):
            value = _within(number.at + side * width, bound, side)
            here = at(value)
            lowest = min(lowest, here)
            if value == bound or here > lowest + DEPTH:
                break
            width *= 2.0
        ends.append(value)
    return ends[0], ends[1]


def _within(value: float, bound: float, side: float) -> float:
    return max(value, bound) if side < 0.0 else min(value, bound)


def _along(density: np.ndarray, axis: int) -> np.ndarray:
    """Density of one number, the other summed out."""
    others = tuple(a for a in range(density.ndim) if a != axis)
    return np.asarray(density.sum(others))


def _where(density: np.ndarray, axis: int, grid: np.ndarray) -> tuple[float, float]:
    """Range of a grid on which the density is not zero, with a point on either side."""
    there = np.flatnonzero(_along(density, axis) > np.exp(-DEPTH))
    return float(grid[max(there[0] - 1, 0)]), float(grid[min(there[-1] + 1, len(grid) - 1)])
