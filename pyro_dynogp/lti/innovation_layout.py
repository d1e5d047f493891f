"""Arrays of the compiled innovations: what a group of points in lanes reads and writes.

Eight points are computed together, one in each lane (`lanes`). A record of a row holds, as vectors
of lanes: A and M interleaved (re A, im A, re M, im M) before the row's sample, F before it, w,
1 / sqrt(d) and zeta; the sample is used when the next row begins.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pyro_dynogp.lti.lanes import WIDTH

# Samples of a segment.
SEGMENT = 32


class Points(NamedTuple):
    """Of a group of points, in lanes: poles, q and c (n_y, P), A and M before the first row.

    Pairs of real and imaginary part alternate. c is None for one output whose states it scales.
    """

    poles: np.ndarray
    q: np.ndarray
    c: np.ndarray | None
    start: np.ndarray


class Rows(NamedTuple):
    """Step of each sample (n,), -1 for none; the steps' lengths; noise, missing and residuals.

    noise (B, 1 or n, n_y), missing (0, 1 or B, N) and residual (1 or B, N) are those of each point.
    """

    step: np.ndarray
    length: np.ndarray
    noise: np.ndarray
    missing: np.ndarray
    residual: np.ndarray


class Kept(NamedTuple):
    """Of each point and segment, for the reverse pass: record before it, gain, whether settled."""

    record: np.ndarray
    gain: np.ndarray
    settled: np.ndarray


class Work(NamedTuple):
    """What a group needs in passing: arrays of lanes, but for the last two.

    phi: propagators of no step, then those of the step. r, v, z, d: of a segment's rows. gain: w
    and d of each output at the last sample, in lanes of `resting` settled; before: those of the
    segment before. frozen: A and M of settled lanes. regular: lanes that may settle; step: theirs.
    """

    e: np.ndarray
    phi: np.ndarray
    r: np.ndarray
    v: np.ndarray
    z: np.ndarray
    d: np.ndarray
    gain: np.ndarray
    before: np.ndarray
    resting: np.ndarray
    frozen: np.ndarray
    regular: np.ndarray
    step: np.ndarray


def workspace(P: int, n_y: int) -> Work:
    """Arrays for one group."""
    rows, gains = SEGMENT * n_y, n_y * (2 * P + 1)
    sizes = (2 * P, 4 * P, rows, rows, rows, rows, gains, gains, 1, 2 * P * (P + 1))
    e, phi, *others, frozen = (np.zeros((size, WIDTH)) for size in sizes)
    phi[0 : 2 * P : 2] = 1.0
    r, v, z, d, gain, before, resting = others
    regular, step = np.zeros(WIDTH, dtype=np.bool_), np.full(1, -1)
    return Work(e, phi, r, v, z, d, gain, before, resting, frozen, regular, step)


def record_size(P: int) -> int:
    """Vectors of a record."""
    return 2 * P * (P + 1) + 4 * P + 2


def records(P: int, rows: int) -> np.ndarray:
    """Room for a record and those of `rows` rows after it."""
    return np.zeros(((rows + 1) * record_size(P), WIDTH))


def keep(points: int, n: int, P: int, n_y: int) -> Kept:
    """Room for what the reverse pass of some points needs; no memory is touched."""
    segments = -(-n // SEGMENT)
    return Kept(
        np.empty((points, segments, record_size(P))),
        np.empty((points, segments, n_y * (2 * P + 1))),
        np.zeros((points, segments), dtype=np.bool_),
    )


class Bars(NamedTuple):
    """Of a group, in lanes: gradients by poles, q, c; by A, M and F of the row at hand.

    held: by a resting gain; inject: lanes whose gain rests after the segment at hand; later: A_bar
    and M_bar behind the rest; w, log_phi: of a row. z, d, r, v: of a segment's rows.
    """

    poles: np.ndarray
    q: np.ndarray
    c: np.ndarray | None
    state: np.ndarray
    held: np.ndarray
    inject: np.ndarray
    later: np.ndarray
    w: np.ndarray
    log_phi: np.ndarray
    z: np.ndarray
    d: np.ndarray


def bars_of(P: int, n_y: int, several: bool) -> Bars:
    """Zeros for one group."""
    outputs, covariances, rows = 2 * P * n_y, 2 * P * (P + 1), SEGMENT * n_y
    sizes = (2 * P, outputs, outputs, covariances + 2 * P, outputs + n_y, 1, covariances)
    arrays = [np.zeros((size, WIDTH)) for size in (*sizes, 2 * P, 2 * P, rows, rows)]
    return Bars(*arrays) if several else Bars(*arrays)._replace(c=None)
