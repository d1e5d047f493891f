"""An output that is a function of one signal, of points in lanes; compiled.

`measured_function` fills the lanes with the nodes of one point: points go through it one by one.
"""

from __future__ import annotations

from numba import njit

from pyro_dynogp.lti.lanes import get, larger, put, splat
from pyro_dynogp.moments.lane_room import project_row, update
from pyro_dynogp.moments.layout import FLOOR
from pyro_dynogp.moments.measured_function import Curve, function_given, moments_of
from pyro_dynogp.support.compiled import WITHIN


@njit(**WITHIN)
def measure_function(time, layout, A, values, used, own, work, count, found):
    """Use the output of a sample; what `innovate_lanes` writes goes to `found` (3, n, 1, WIDTH).

    count: how many points there are; lanes that fill the group learn nothing.
    """
    i = layout.measured
    place = layout.g_start[i]
    f = layout.f_start[i]
    mean, p = project_row(values.G, place, used.G[place], A, own)
    given = own.given
    put(given, 0, mean + get(values.offset, time * used.G.shape[0] + place))
    put(given, 1, larger(p, splat(0.0)) + splat(FLOOR))
    put(given, 2, splat(0.0))
    put(given, 3, splat(0.0))
    for b in range(count):
        curve = Curve(
            values.low[i, b], values.spacing[i, b], values.table_mean[b, f],
            values.table_variance[b, f],
        )  # fmt: skip
        offset, R = values.y_offset[time, 0, b], values.R[time, 0, b]
        expected, variance = moments_of(curve, given[0, b], given[1, b], work)
        y = values.y[time, 0] - offset
        found[2, time, 0, b], given[2, b], given[3, b] = function_given(
            y, R, given[1, b], layout, work
        )
        found[0, time, 0, b] = values.y[time, 0] - (expected + offset)
        found[1, time, 0, b] = variance + R
    update(A, get(given, 2), get(given, 3), own)
