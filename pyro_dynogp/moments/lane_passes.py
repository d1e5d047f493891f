"""The filter over many points of a problem, eight at a time where it is one of `filter_lanes`."""

from __future__ import annotations

import numpy as np

from pyro_dynogp.lti.lanes import WIDTH
from pyro_dynogp.lti.primitives import array, flatten_batch
from pyro_dynogp.moments.filter_lanes import innovate_lanes
from pyro_dynogp.moments.lane_room import InUse, room
from pyro_dynogp.moments.layout import Values
from pyro_dynogp.moments.nodes import Bench, bench
from pyro_dynogp.moments.problem import EVENTS, FilterProblem, each

# Points from which lanes pay: fewer leave most of them empty.
FEWEST = 3
# What is no array of lanes: tables are looked up point by point, and all points share y.
_TABLES = ("table_mean", "table_variance")


def lanes_serve(problem: FilterProblem) -> bool:
    """Whether points go through in lanes: several, of one y."""
    return problem.y.dim() == 2 and problem.batch_shape.numel() >= FEWEST


def innovate_together(problem: FilterProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What `smoothing.innovate` has, each (*b, n, n_y), of all points; NaN where y is missing.

    A point's numbers are those of that, to the bit under Gaussian noise, whatever points are
    beside it.

    Raises:
        AssertionError: where `lanes_serve` does not hold.
    """
    assert lanes_serve(problem)
    names = [name for name in Values._fields if name != "y"]
    flat, batch = flatten_batch(
        [getattr(problem, name) for name in names], [EVENTS[name] for name in names]
    )
    count = flat[0].shape[0]
    y = array(problem.y)
    parts = dict(zip(names, (array(x) for x in flat), strict=True))
    layout = problem.layout
    channels = int(layout.channels.max(initial=1))
    widest = int(layout.outputs.max(initial=1))
    N, E = parts["m0"].shape[-1], int(layout.f_start[-1])
    gaussian, curved = len(layout.share) == 1, layout.measured >= 0
    kept = 3 if curved else 2 if gaussian else 4

    def group(g: int) -> np.ndarray:
        rows = np.minimum(np.arange(g * WIDTH, (g + 1) * WIDTH), count - 1)
        own = room(N, E, channels, widest, layout.nodes.shape[1])
        found = np.full((kept, *y.shape, WIDTH), np.nan)
        there = min(count - g * WIDTH, WIDTH)
        work = Bench(*bench(len(layout.share)))
        innovate_lanes(layout, *_lanes(parts, rows, y), own, work, there, found)
        return np.moveaxis(found, -1, 0)[:there]

    found = np.concatenate(each(group, -(-count // WIDTH)))
    error, variance = found[:, 0], found[:, 1]
    # Where there is no density, or runs have grown without bound.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if curved:
            density = found[:, 2]
        elif gaussian:
            density = -0.5 * (error**2 / variance + np.log(2.0 * np.pi * variance))
        else:
            density = found[:, 2] + np.log(found[:, 3]) - 0.5 * np.log(2.0 * np.pi)
    shape = (*batch, *y.shape)
    return error.reshape(shape), variance.reshape(shape), density.reshape(shape)


def _lanes(parts: dict[str, np.ndarray], rows: np.ndarray, y: np.ndarray) -> tuple[Values, InUse]:
    """Points of one group; those that fill it are its last one again."""
    group = {name: x[rows] for name, x in parts.items()}
    lanes = {
        name: x if name in _TABLES else np.ascontiguousarray(np.moveaxis(x, 0, -1))
        for name, x in group.items()
    }
    used = InUse(
        (group["table_variance"] != 0.0).any((0, 2)),
        *((group[name] != 0.0).any(0) for name in ("G", "H", "gamma")),
    )
    return Values(**lanes, y=y), used
