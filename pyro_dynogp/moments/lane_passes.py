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
    groups = -(-count // WIDTH)
    lanes, used = _in_groups(parts, groups), _in_use(parts)
    each_found = np.full((groups, kept, *y.shape, WIDTH), np.nan)

    def group(g: int) -> None:
        own = room(N, E, channels, widest, layout.nodes.shape[1])
        work = Bench(*bench(len(layout.share)))
        values = Values(**{name: x[g] for name, x in lanes.items()}, y=y)
        there = min(count - g * WIDTH, WIDTH)
        innovate_lanes(layout, values, used, own, work, there, each_found[g])

    each(group, groups)
    found = np.moveaxis(each_found, -1, 1).reshape(groups * WIDTH, kept, *y.shape)[:count]
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


def _in_groups(parts: dict[str, np.ndarray], groups: int) -> dict[str, np.ndarray]:
    """Arrays of lanes (groups, ..., WIDTH); what fills the last group is the last point again."""
    count = len(parts["m0"])
    rows = np.minimum(np.arange(groups * WIDTH), count - 1)
    found = {}
    for name, x in parts.items():
        several = (x if len(rows) == count else x[rows]).reshape(groups, WIDTH, *x.shape[1:])
        lanes = several if name in _TABLES else np.moveaxis(several, 1, -1)
        found[name] = np.ascontiguousarray(lanes)
    return found


def _in_use(parts: dict[str, np.ndarray]) -> InUse:
    """What is not zero at every point."""
    return InUse(
        (parts["table_variance"] != 0.0).any((0, 2)),
        *((parts[name] != 0.0).any(0) for name in ("G", "H", "gamma")),
    )
