"""Passes over all segments of a record, forward and in reverse, and when a gain rests.

Rows are taken in segments. Over one whose steps are all the same and that misses nothing, a gain
(w, d) that is at its end what it was at its beginning is settled: as long as segments of that kind
follow, it is kept, and F alone moves. Each point settles by itself.

A gain that rests is the one of the last row before it rested: the bars of all its rows are added to
those of that row, and A_bar and M_bar pass over the rest of them. This is the gradient of what was
computed, to the last digit of rounding. Records are made again segment by segment.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pyro_dynogp.lti.innovation_adjoint import reverse_segment
from pyro_dynogp.lti.innovation_layout import SEGMENT
from pyro_dynogp.lti.innovation_rows import run_segment
from pyro_dynogp.lti.lanes import WIDTH, get, put
from pyro_dynogp.support.compiled import BORROWING

# A gain rests when no entry changes by more than this over a segment, relative to the largest.
SETTLED = 1e-14


@njit(**BORROWING)
def load_segment(rows, first, last, point, lane, work):
    """Residuals and noise of one point's rows; whether none is missing."""
    n_y = rows.noise.shape[2]
    b = min(point, rows.residual.shape[0] - 1)
    for i in range((last - first) * n_y):
        work.r[i, lane] = rows.residual[b, first * n_y + i]
    varying = rows.noise.shape[1] > 1
    for i in range((last - first) * n_y):
        work.v[i, lane] = rows.noise[point, (first + i // n_y) * varying, i % n_y]
    several = rows.missing.shape[0]
    if several == 0:
        return True
    b = min(point, several - 1)
    whole = True
    for i in range((last - first) * n_y):
        if rows.missing[b, first * n_y + i]:
            work.v[i, lane] = np.inf
            work.r[i, lane] = 0.0
            whole = False
    return whole


@njit(**BORROWING)
def common_step(step, first, last):
    """The step of all samples, or -1 where they differ or one does not move."""
    for k in range(first, last):
        if step[k] != step[first]:
            return -1
    return step[first]


@njit(**BORROWING)
def rests(now, before, lane, P):
    """Whether the gains of one lane are the same now as before."""
    for first in range(0, now.shape[0], 2 * P + 1):
        change = 0.0
        largest = 0.0
        for j in range(first, first + 2 * P):
            change = max(change, abs(now[j, lane] - before[j, lane]))
            largest = max(largest, abs(now[j, lane]))
        d = now[first + 2 * P, lane]
        if not (
            change <= SETTLED * largest and abs(d - before[first + 2 * P, lane]) <= SETTLED * d
        ):
            return False
    return True


@njit(**BORROWING)
def begin_segment(g, first, last, x, rows, work, kept):
    """Load the rows of a segment, decide which lanes rest over it, and keep what is before it."""
    common = common_step(rows.step, first, last)
    held = 0
    for lane in range(WIDTH):
        point = g * WIDTH + lane
        inside = point < rows.noise.shape[0]
        if not inside:
            point = rows.noise.shape[0] - 1
        whole = load_segment(rows, first, last, point, lane, work)
        regular = rows.noise.shape[1] == 1 and whole and common >= 0
        if work.resting[0, lane] > 0.0 and not (regular and common == work.step[0]):
            work.resting[0, lane] = 0.0
            for j in range(work.frozen.shape[0]):
                x[j, lane] = work.frozen[j, lane]
        work.regular[lane] = regular
        rest = work.resting[0, lane] > 0.0
        held += rest
        if inside and kept.record.shape[0] > 0:
            segment = first // SEGMENT
            kept.settled[point, segment] = rest
            for j in range(work.frozen.shape[0] if rest else 0, x.shape[0]):
                kept.record[point, segment, j] = x[j, lane]
            for j in range(work.gain.shape[0] if rest else 0):
                kept.gain[point, segment, j] = work.gain[j, lane]
    work.step[0] = common
    return held == WIDTH


@njit(**BORROWING)
def end_segment(g, first, last, x, work, z, d):
    """Write a segment's innovations and variances; let gains rest that have settled."""
    n_y = work.z.shape[0] // SEGMENT
    P = work.e.shape[0] // 2
    for lane in range(min(WIDTH, z.shape[0] - g * WIDTH)):
        for i in range((last - first) * n_y):
            z[g * WIDTH + lane, first * n_y + i] = work.z[i, lane]
            d[g * WIDTH + lane, first * n_y + i] = work.d[i, lane]
    for lane in range(WIDTH):
        unsettled = work.regular[lane] and not work.resting[0, lane] > 0.0
        if unsettled and rests(work.gain, work.before, lane, P):
            work.resting[0, lane] = 1.0
            for j in range(work.frozen.shape[0]):
                work.frozen[j, lane] = x[j, lane]
        for j in range(work.before.shape[0]):
            work.before[j, lane] = work.gain[j, lane]


@njit(**BORROWING)
def run_points(g, points, rows, work, x, z, d, kept):
    """Innovations z and variances d (B, N) of the points of group g; x (a record) is zero."""
    for j in range(work.frozen.shape[0]):
        put(x, j, get(points.start, j))
    n = rows.step.shape[0]
    for first in range(0, n, SEGMENT):
        last = min(n, first + SEGMENT)
        settled = begin_segment(g, first, last, x, rows, work, kept)
        run_segment(x, 0, first, last, points, rows, work, settled)
        end_segment(g, first, last, x, work, z, d)


@njit(**BORROWING)
def restore_segment(g, first, last, x, rows, work, bars, kept, z_bar, d_bar):
    """Bring back what was before a segment, and pass A_bar and M_bar over gains at rest."""
    n_y = rows.noise.shape[2]
    covariances = bars.later.shape[0]
    resting = 0
    for lane in range(WIDTH):
        point = min(g * WIDTH + lane, z_bar.shape[0] - 1)
        load_segment(rows, first, last, point, lane, work)
        for i in range((last - first) * n_y):
            bars.z[i, lane] = z_bar[point, first * n_y + i]
            bars.d[i, lane] = d_bar[point, first * n_y + i]
        segment = first // SEGMENT
        rests = kept.settled[point, segment]
        rested = work.resting[0, lane] > 0.0
        resting += rests
        work.resting[0, lane] = rests
        bars.inject[0, lane] = rested and not rests
        for j in range(covariances if rests else 0, kept.record.shape[2]):
            x[j, lane] = kept.record[point, segment, j]
        for j in range(work.gain.shape[0] if rests else 0):
            work.gain[j, lane] = kept.gain[point, segment, j]
            if not rested:
                bars.held[j, lane] = 0.0
        if rests and not rested:
            for j in range(covariances):
                bars.later[j, lane] = bars.state[j, lane]
                bars.state[j, lane] = 0.0
        if rested and not rests:
            for j in range(covariances):
                bars.state[j, lane] = bars.later[j, lane]
    return resting == WIDTH


@njit(**BORROWING)
def reverse_points(g, points, rows, work, x, kept, bars, z_bar, d_bar, residual_bar, noise_bar):
    """Gradients of the points of group g: bars and work begin as zeros, the last two are added to.

    x: records of a segment and of the row before it.
    """
    n_y = rows.noise.shape[2]
    n = rows.step.shape[0]
    stride = kept.record.shape[2]
    for segment in range((n + SEGMENT - 1) // SEGMENT - 1, -1, -1):
        first = segment * SEGMENT
        last = min(n, first + SEGMENT)
        settled = restore_segment(g, first, last, x, rows, work, bars, kept, z_bar, d_bar)
        run_segment(x, stride, first, last, points, rows, work, settled)
        reverse_segment(x, stride, first, last, points, rows, work, bars, settled)
        for lane in range(min(WIDTH, z_bar.shape[0] - g * WIDTH)):
            point = g * WIDTH + lane
            b = min(point, residual_bar.shape[0] - 1)
            for k in range(first, last):
                for o in range(n_y):
                    i = (k - first) * n_y + o
                    residual_bar[b, k * n_y + o] += work.r[i, lane]
                    noise_bar[point, k if noise_bar.shape[1] > 1 else 0, o] += work.v[i, lane]
