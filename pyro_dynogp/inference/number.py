"""Posterior of numbers that a model is made with rather than samples: a delay, a limit, a period.

Such a number moves an input along the time axis or bends it, and the density is not smooth in it.
At each of several values the sample sites climb to their mode again, in coordinates that are round
at the fitted number, and

    p(number | y) = exp(-E(number)) / integral over the number,

E the negative log joint density at that mode. This is Laplace's approximation of the integral over
the sites (Tierney & Kadane, J. Am. Stat. Assoc. 81:82, 1986) with one curvature for all values of
the number, whose prior is flat within its bounds.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import PchipInterpolator

from pyro_dynogp.inference.descent import bounded_root, piece
from pyro_dynogp.inference.potential import WALL, Potential

# Nats below the top at which the density counts as zero; how often a range is doubled or halved to
# find that depth; points of the grid for each of two numbers.
DEPTH, DOUBLINGS, POINTS = 9.0, 20, 9
# Points for one number: for each step of the first scan, of all of it at least and at most, and in
# all.
SCANNED, SCAN, MOST = 8, (17, 33), 80
# Peaks are looked for up to so many nats below the top, and a point goes where it promises so many;
# so much of the mass is too much between two points.
RISE, NEWS, SHARE = 60.0, 0.3, 0.1
# Most steps of the sites to their mode.
ITERATIONS = 30
# Gradient, in coordinates that are round at the fitted number, at which they are there.
FLAT = 0.05
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

    if len(numbers) == 1:
        return [_alone(lambda value: energy([value]), numbers[0])]
    ranges = [_range(energy, centre, k, one) for k, one in enumerate(numbers)]
    grid = [np.linspace(low, high, POINTS) for low, high in ranges]
    heights = np.array([energy(values) for values in itertools.product(*grid)])
    density = np.exp(heights.min() - heights).reshape([POINTS] * len(grid))
    found = []
    for axis, one in enumerate(grid):
        share = density.sum(tuple(other for other in range(density.ndim) if other != axis))
        found.append(_moments(one, share / share.sum()))
    return found


def _alone(energy: Callable[[float], float], number: Number) -> tuple[float, float]:
    """Posterior mean and standard deviation of one number, whose density may have many peaks.

    Points go where peaks may be, half a step apart or more, then where mass is. A dead time is an
    example: neighbouring numbers of samples explain a record nearly as well, and times between them
    do not.
    """
    low, high = (_end(energy, number, side) for side in (-1.0, 1.0))
    count = int(np.clip(SCANNED * (high - low) / number.step, *SCAN))
    at = np.unique(np.append(np.linspace(low, high, count), number.at))
    known = {float(x): energy(float(x)) for x in sorted(at, key=lambda x: abs(x - number.at))}
    while True:
        x = np.array(sorted(known))
        E = _capped(np.array([known[float(one)] for one in x]))
        new = _peak(x, E)
        if new is None:
            new = _midpoint(x, E)
        if new is None or len(known) >= MOST:
            break
        known[new] = energy(new)
    fine = np.unique(np.concatenate([np.linspace(a, b, 20) for a, b in itertools.pairwise(x)]))
    density = np.exp(E.min() - PchipInterpolator(x, E)(fine))
    share = density * np.gradient(fine)
    return _moments(fine, share / share.sum())


def _capped(E: np.ndarray) -> np.ndarray:
    """Energies, where they are high or infinite as high as peaks are looked for."""
    return np.asarray(np.minimum(E, E.min() + RISE))


def _peak(x: np.ndarray, E: np.ndarray) -> float | None:
    """Where a parabola through a low point and its neighbours says that a peak with mass is."""
    for i in 1 + np.flatnonzero((E[1:-1] <= E[:-2]) & (E[1:-1] <= E[2:])):
        left, right = x[i] - x[i - 1], x[i + 1] - x[i]
        up, down = (E[i + 1] - E[i]) / right, (E[i - 1] - E[i]) / left
        curvature = (up + down) / (left + right)
        if curvature <= 0.0:
            continue
        slope = (up * left - down * right) / (left + right)
        lower = slope**2 / (4.0 * curvature)  # than the point
        place = x[i] - slope / (2.0 * curvature)
        if lower > NEWS and E[i] - lower < E.min() + DEPTH:
            return float(place)
    return None


def _midpoint(x: np.ndarray, E: np.ndarray) -> float | None:
    """Middle of the interval that may hold most, where that is much."""
    density = np.exp(E.min() - E)
    wide = np.diff(x)
    most = wide * np.maximum(density[1:], density[:-1])
    total = float((0.5 * wide * (density[1:] + density[:-1])).sum())
    i = int(most.argmax())
    return float(0.5 * (x[i] + x[i + 1])) if most[i] > SHARE * total else None


def _end(energy: Callable[[float], float], number: Number, side: float) -> float:
    """A value on one side beyond which the density is zero, a step away at least."""
    bound = number.low if side < 0.0 else number.high
    lowest, width = energy(number.at), number.step
    for _ in range(DOUBLINGS):
        value = _within(number.at + side * width, bound, side)
        here = energy(value)
        lowest = min(lowest, here)
        if value == bound or here > lowest + DEPTH:
            break
        width *= 2.0
    return value


def _moments(x: np.ndarray, share: np.ndarray) -> tuple[float, float]:
    mean = float(share @ x)
    return mean, float(np.sqrt(share @ (x - mean) ** 2))


def _lowest(potential: Potential, z: np.ndarray, root: np.ndarray) -> tuple[float, np.ndarray]:
    """Lowest energy from a point on, to a few hundredths of a nat, and where it is."""
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
        lowest, width = at(number.at), number.step
        for _ in range(DOUBLINGS):  # not deep in the tails to begin with
            if at(_within(number.at + side * width, bound, side)) < lowest + DEPTH:
                break
            width *= 0.5
        ends.append(_end(at, replace(number, step=width), side))
    return ends[0], ends[1]


def _within(value: float, bound: float, side: float) -> float:
    return max(value, bound) if side < 0.0 else min(value, bound)
