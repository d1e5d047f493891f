"""Posterior of numbers that a model is made with rather than samples: a delay, a limit, a period.

Such a number moves an input along the time axis or bends it, and the density is not smooth in it.
At each of several values the sample sites climb to their mode again, and

    p(number | y) = exp(-E(number)) / integral over the number,

E the negative log joint density at that mode. This is Laplace's approximation of the integral over
the sites (Tierney & Kadane, J. Am. Stat. Assoc. 81:82, 1986) with one curvature for all values of
the number, whose prior is flat within its bounds. Kernels of functions keep their values: they are
those of the highest evidence, not of the mode.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

from pyro_dynogp.inference.density import WALL, Potential
from pyro_dynogp.inference.function_evidence import kernel_sites
from pyro_dynogp.inference.log_joint import Direct
from pyro_dynogp.inference.optimise.chord import along_chord
from pyro_dynogp.inference.optimise.descent import bounded_root, piece
from pyro_dynogp.inference.optimise.gauss_newton import climb
from pyro_dynogp.inference.optimise.innovation_energy import Innovations, has_innovations

# Nats below the top at which the density counts as zero; how often a range is doubled or halved to
# find that depth; points of the grid for each of two numbers.
DEPTH, DOUBLINGS, POINTS = 9.0, 20, 9
# Points for one number: for each step of the first scan, of all of it at least and at most, and in
# all.
SCANNED, SCAN, MOST = 8, (17, 33), 80
# Cells beyond those that are known that are looked into at once.
CELLS = 3
# Peaks are looked for up to so many nats below the top, and a point goes where it promises so many;
# so much of the mass is too much between two points.
RISE, NEWS, SHARE = 60.0, 0.3, 0.1
# Most steps of the sites to their mode.
ITERATIONS = 30
# Gradient, in coordinates that are round at the fitted number, at which they are there.
FLAT = 0.05
# With functions: most iterations at the fitted number, and nats that they gain when they end; most
# with the derivatives that predictions have there, and nats that are left when they end.
MOST_NEWTON, RIDGE, CHORDS, LEFT = 60, 0.02, 8, 0.2
# Negative log densities, up to a constant, of several values of the number or numbers; infinite
# where they cannot be evaluated.
Energies = Callable[[Sequence[tuple[float, ...]]], np.ndarray]
# Lowest energy of the sites, from a point on, and where it is.
Descent = Callable[[Potential, np.ndarray], tuple[float, np.ndarray]]


@dataclass(frozen=True)
class Number:
    """One number of a model.

    Attributes:
        at: its value in the fit. step: how far off it may easily be, to begin with.
        low, high: its bounds.
        cell: (a, b), a <= 0 <= b, where data tell only whole multiples v of b - a apart: each
            stands for all values from v + a to v + b.
    """

    at: float
    step: float
    low: float = -np.inf
    high: float = np.inf
    cell: tuple[float, float] | None = None
    instants: np.ndarray | None = None

    def same(self, value: float) -> float:
        """The value that stands for all that data do not tell from this one."""
        if self.instants is None:
            return value
        place = min(int(np.searchsorted(self.instants, value)), len(self.instants) - 1)
        return float(self.instants[place])


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
    lowest, z = _descent(first)
    known: dict[tuple[float, ...], tuple[float, np.ndarray]] = {}

    def energies(asked: Sequence[tuple[float, ...]]) -> np.ndarray:
        many = [tuple(n.same(x) for n, x in zip(numbers, one, strict=True)) for one in asked]
        tasks: dict[tuple[float, ...], tuple[Potential, np.ndarray]] = {}
        for values in many:
            if values in known or values in tasks:
                continue
            near = _nearest(values, list(known), steps)
            start = z if near is None else known[near][1]
            try:
                tasks[values] = potential(values), start
            except ValueError:  # numbers that make no model, as limits that cross: no density
                known[values] = np.inf, start
        known.update((values, lowest(*task)) for values, task in tasks.items())
        return np.array([known[values][0] for values in many])

    energies([centre])  # where all others start
    if len(numbers) == 1:
        (number,) = numbers
        found_by = _alone if number.cell is None else _in_cells
        return [found_by(lambda values: energies([(one,) for one in values]), number)]
    ranges = [_range(energies, centre, k, one) for k, one in enumerate(numbers)]
    grid = [np.linspace(low, high, POINTS) for low, high in ranges]
    # Every other point of the grid first: the rest start beside them.
    energies(list(itertools.product(*(one[::2] for one in grid))))
    heights = energies(list(itertools.product(*grid)))
    density = np.exp(heights.min() - heights).reshape([POINTS] * len(grid))
    found = []
    for axis, one in enumerate(grid):
        share = density.sum(tuple(other for other in range(density.ndim) if other != axis))
        found.append(_moments(one, share / share.sum()))
    return found


def _nearest(
    values: tuple[float, ...], others: Sequence[tuple[float, ...]], steps: np.ndarray
) -> tuple[float, ...] | None:
    """The nearest of other values, in steps; None where there are none."""
    if not others:
        return None
    far = np.square((np.array(others) - values) / steps).sum(1)
    return others[int(far.argmin())]


def _alone(
    energies: Callable[[Sequence[float]], np.ndarray], number: Number
) -> tuple[float, float]:
    """Posterior mean and standard deviation of one number, whose density may have many peaks.

    Points go where peaks may be, half a step apart or more, then where mass is. A dead time is an
    example: neighbouring numbers of samples explain a record nearly as well, and times between them
    do not.
    """
    low, high = _ends(energies, number, (number.step, number.step))
    count = int(np.clip(SCANNED * (high - low) / number.step, *SCAN))
    scan: list[float] = np.linspace(low, high, count).tolist()
    known: dict[float, float] = {}
    new = [number.at, *scan[::2]]
    while new:
        known |= dict(zip(new, energies(new).tolist(), strict=True))
        missing = [one for one in scan if one not in known]
        x = np.array(sorted(known))
        E = _capped(np.array([known[one] for one in x.tolist()]))
        new = (missing or _peaks(x, E) or _midpoints(x, E))[: max(MOST - len(known), 0)]
    fine = np.unique(np.concatenate([np.linspace(a, b, 20) for a, b in itertools.pairwise(x)]))
    density = np.exp(E.min() - PchipInterpolator(x, E)(fine))
    share = density * np.gradient(fine)
    return _moments(fine, share / share.sum())


def _in_cells(
    energies: Callable[[Sequence[float]], np.ndarray], number: Number
) -> tuple[float, float]:
    """Posterior mean and standard deviation of a number of which data tell multiples only."""
    assert number.cell is not None
    a, b = number.cell
    wide = b - a
    known: dict[int, float] = {}
    new = [round(number.at / wide)]
    while new:
        known |= dict(zip(new, energies([k * wide for k in new]).tolist(), strict=True))
        top, new = min(known.values()), []
        for side in (-1, 1):
            outer = sorted(known, key=lambda k: side * k)[-CELLS:]
            if min(known[k] for k in outer) < top + DEPTH and len(known) < MOST:
                beyond = [outer[-1] + side * i for i in range(1, CELLS + 1)]
                new += [k for k in beyond if number.low <= k * wide <= number.high]
    at = np.array(sorted(known))
    share = np.exp(top - np.array([known[k] for k in at.tolist()]))
    share /= share.sum()
    low, high = np.maximum(at * wide + a, number.low), np.minimum(at * wide + b, number.high)
    middle = 0.5 * (low + high)
    mean = float(share @ middle)
    return mean, float(np.sqrt(share @ ((middle - mean) ** 2 + (high - low) ** 2 / 12.0)))


def _capped(E: np.ndarray) -> np.ndarray:
    """Energies, where they are high or infinite as high as peaks are looked for."""
    return np.asarray(np.minimum(E, E.min() + RISE))


def _peaks(x: np.ndarray, E: np.ndarray) -> list[float]:
    """Where parabolas through low points and their neighbours say that peaks with mass are."""
    found = []
    for i in 1 + np.flatnonzero((E[1:-1] <= E[:-2]) & (E[1:-1] <= E[2:])):
        left, right = x[i] - x[i - 1], x[i + 1] - x[i]
        up, down = (E[i + 1] - E[i]) / right, (E[i - 1] - E[i]) / left
        curvature = (up + down) / (left + right)
        if curvature <= 0.0:
            continue
        slope = (up * left - down * right) / (left + right)
        lower = slope**2 / (4.0 * curvature)  # than the point
        if lower > NEWS and E[i] - lower < E.min() + DEPTH:
            found.append(float(x[i] - slope / (2.0 * curvature)))
    return found


def _midpoints(x: np.ndarray, E: np.ndarray) -> list[float]:
    """Middles of the intervals that may hold much, those that may hold most first."""
    density = np.exp(E.min() - E)
    wide = np.diff(x)
    most = wide * np.maximum(density[1:], density[:-1])
    total = float((0.5 * wide * (density[1:] + density[:-1])).sum())
    order = np.argsort(-most, kind="stable")
    return [float(0.5 * (x[i] + x[i + 1])) for i in order if most[i] > SHARE * total]


def _ends(
    energies: Callable[[Sequence[float]], np.ndarray],
    number: Number,
    widths: tuple[float, float],
) -> tuple[float, float]:
    """Values on both sides beyond which the density is zero, these widths away at least."""
    sides, bounds = (-1.0, 1.0), (number.low, number.high)
    ends, width, there = [number.at, number.at], list(widths), [False, False]
    lowest = float(energies([number.at])[0])
    for _ in range(DOUBLINGS):
        going = [k for k in (0, 1) if not there[k]]
        for k in going:
            ends[k] = _within(number.at + sides[k] * width[k], bounds[k], sides[k])
        here = energies([ends[k] for k in going])
        lowest = min(lowest, float(here.min()))
        for k, height in zip(going, here, strict=True):
            there[k] = ends[k] == bounds[k] or bool(height > lowest + DEPTH)
            width[k] *= 2.0
        if all(there):
            break
    return ends[0], ends[1]


def _moments(x: np.ndarray, share: np.ndarray) -> tuple[float, float]:
    mean = float(share @ x)
    return mean, float(np.sqrt(share @ (x - mean) ** 2))


def _descent(first: Potential) -> tuple[Descent, np.ndarray]:
    """How sites climb to their mode at other numbers, and from where on.

    With functions by Gauss-Newton, to some tenths of a nat; else in coordinates that are round at
    the mode, to a few hundredths.

    Args:
        first: with the fitted number, at the fit's mode.
    """
    z = first.pack(first.at).numpy()
    density = first.log_density
    model = density.model if isinstance(density, Direct) else None
    if model is not None and model.has_function and has_innovations(model):
        return _by_innovations(first, z, kernel_sites(model))
    root = bounded_root(first.hessian(z))

    def lowest(potential: Potential, start: np.ndarray) -> tuple[float, np.ndarray]:
        end, energy, _ = piece(potential.with_jacobian, start, root, ITERATIONS, [], flat=FLAT)
        return (energy if energy < WALL else np.inf), end

    return lowest, z


def _by_innovations(
    first: Potential, z: np.ndarray, held: Sequence[str]
) -> tuple[Descent, np.ndarray]:
    """`_descent` with the derivatives of the first number's predictions for as long as they serve.

    L-BFGS stops on the ridges that functions have, tens of nats too high: only the number of the
    fit is low then, and seems to be certain.
    """
    free = np.setdiff1d(np.arange(first.size), first.places(held))

    def innovations(potential: Potential) -> Innovations:
        return Innovations(potential, free, jacobian=True)

    centre = innovations(first)
    z, _, _ = climb(centre, z, MOST_NEWTON, ridge=RIDGE)
    here = centre.local(z)

    def lowest(potential: Potential, start: np.ndarray) -> tuple[float, np.ndarray]:
        own = innovations(potential)
        if here is not None:
            energy, start, there = along_chord(own, here, start, CHORDS, LEFT)
            if there:
                return energy, start
        end, history, _ = climb(own, start, ITERATIONS)
        return (history[-1] if history else np.inf), end

    return lowest, z


def _range(
    energies: Energies, centre: tuple[float, ...], k: int, number: Number
) -> tuple[float, float]:
    """Between which values of a number the density is not zero, others held where they are."""

    def at(values: Sequence[float]) -> np.ndarray:
        return energies([(*centre[:k], value, *centre[k + 1 :]) for value in values])

    widths = []
    lowest = float(at([number.at])[0])
    for side, bound in ((-1.0, number.low), (1.0, number.high)):
        width = number.step
        for _ in range(DOUBLINGS):  # not deep in the tails to begin with
            if at([_within(number.at + side * width, bound, side)])[0] < lowest + DEPTH:
                break
            width *= 0.5
        widths.append(width)
    return _ends(at, number, (widths[0], widths[1]))


def _within(value: float, bound: float, side: float) -> float:
    return max(value, bound) if side < 0.0 else min(value, bound)
