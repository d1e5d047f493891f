"""Innovations of measured outputs at many systems at once, with gradients, in plain arrays.

The same as `innovations.innovations` of samples less `response.mean_response`, from unknown past
inputs, without tensors: what evaluations by the thousand need. A system that cannot be evaluated
gives NaN or variances that are not positive, and leaves the others alone, to the last bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import overload, types

from pyro_dynogp.lti import held_lanes
from pyro_dynogp.lti import innovation_layout as layout
from pyro_dynogp.lti.held_lanes import Gains, Signals, respond, reverse_respond
from pyro_dynogp.lti.initial_covariance import (
    initial_covariances,
    reverse_initial_covariances,
)
from pyro_dynogp.lti.innovation_layout import Points, Rows
from pyro_dynogp.lti.innovation_passes import reverse_points, run_points
from pyro_dynogp.lti.lanes import WIDTH
from pyro_dynogp.support.compiled import OPTIONS


class Systems(NamedTuple):
    """k linear systems of P poles, n_y outputs and n_u inputs, or the gradients by them.

    Attributes:
        poles: (k, P) complex [1/s]. B: (k, P, n_u), L: (k, P, n_l) complex. C: (k, n_y, P)
            complex, ones where there is one output. drift: (k, P), complex, what drives them
            always. D: (k, n_y, n_d). offset: (k, n_y). variance: (k, n_y) of measurement noise.
        late: (k, P, n_v) complex, gains of the last columns of `driving`, which past inputs have
            not moved the first state through; None for none.
    """

    poles: np.ndarray
    B: np.ndarray
    C: np.ndarray
    L: np.ndarray
    drift: np.ndarray | None
    D: np.ndarray
    offset: np.ndarray
    variance: np.ndarray
    late: np.ndarray | None = None


class Past(NamedTuple):
    """shared: whether modes see the same noise. memory, level: see `initial_covariance`."""

    shared: bool
    memory: float
    level: float


class Tape(NamedTuple):
    """What the reverse pass needs of the forward pass.

    stationary (k, n_y): variances of the outputs that process noise causes.
    """

    stationary: np.ndarray
    systems: Systems
    past: Past
    signals: Signals
    gains: Gains
    points: Points
    rows: Rows
    kept: layout.Kept


class _Bars(NamedTuple):
    """Gradients by all that the groups have: z and d, residuals, noise, and in lanes the rest.

    found, q, state: by gains, q and start of the innovations; held: by gains of the residuals.
    """

    z: np.ndarray
    d: np.ndarray
    residual: np.ndarray
    noise: np.ndarray
    found: Gains
    q: np.ndarray
    state: np.ndarray
    held: Gains


def innovations_of(
    systems: Systems, signals: Signals, missing: np.ndarray, past: Past, *, keep: bool
) -> tuple[np.ndarray, np.ndarray, Tape]:
    """Innovations z and variances d, both (k, n n_y), and the tape of `gradients`.

    Args:
        systems: at which. signals: of the record; `driving` has the columns of B, one of ones
            where there is a drift, and the late ones. missing: (1, n n_y), or (0, n n_y) where
            nothing is. past: of all systems.
        keep: whether gradients will be asked for.
    """
    k, n_y, P = systems.C.shape
    q = np.empty((k, n_y, P), dtype=complex)
    start = np.empty((k, 2 * P * (P + 1)))
    poles, B, C, L = systems.poles, systems.B, systems.C, systems.L
    initial_covariances(poles, B, C, L, past.shared, past.memory, past.level, q, start)
    drift = systems.drift
    parts = [B, *([] if drift is None else [drift[..., None]])]
    driven = np.concatenate([*parts, *([] if systems.late is None else [systems.late])], -1)
    level = np.concatenate([systems.D, systems.offset[..., None]], -1)
    gains = Gains(*(to_lanes(x) for x in (poles, driven, C, level)))
    points = Points(gains.poles, to_lanes(q), gains.C if n_y > 1 else None, to_lanes(start))
    n = len(signals.step)
    kept = layout.keep(k if keep else 0, n, P, n_y)
    z, d, residual = (np.empty((k, n * n_y)) for _ in range(3))
    rows = Rows(signals.step, signals.length, systems.variance[:, None], missing, residual)
    own = held_lanes.room(1, len(signals.length), P, n_y)
    work, x = layout.workspace(P, n_y), layout.records(P, 0)
    _forward(gains, signals, own, points, rows, work, x, z, d, kept)
    stationary = 2.0 * (C.real * q.real - C.imag * q.imag).sum(-1)
    return z, d, Tape(stationary, systems, past, signals, gains, points, rows, kept)


def gradients(tape: Tape, z_bar: np.ndarray, d_bar: np.ndarray) -> Systems:
    """Gradients by the systems of what has the gradients z_bar and d_bar (k, n n_y) by z and d."""
    _, systems, past, signals, gains, points, rows, kept = tape
    k, n_y, P = systems.C.shape
    own = held_lanes.room(len(signals.step), len(signals.length), P, n_y)
    work, x = layout.workspace(P, n_y), layout.records(P, layout.SEGMENT * n_y)
    bars = layout.bars_of(P, n_y)
    residual_bar, noise_bar = np.zeros_like(rows.residual), np.zeros_like(rows.noise)
    found = Gains(*(np.zeros_like(each) for each in gains))
    held = Gains(*(np.zeros_like(each) for each in gains))
    q, state = np.zeros_like(points.q), np.zeros_like(points.start)
    all_bars = _Bars(z_bar, d_bar, residual_bar, noise_bar, found, q, state, held)
    _reverse(gains, signals, own, points, rows, work, x, bars, kept, all_bars)
    poles_bar = from_lanes(found.poles + held.poles, k).view(complex)
    C_bar = from_lanes(found.C + held.C, k).view(complex).reshape(k, n_y, P)
    driven_bar = from_lanes(held.B, k).view(complex).reshape(k, P, -1)
    n_u = systems.B.shape[-1]
    B_bar = np.ascontiguousarray(driven_bar[..., :n_u])
    L_bar = np.zeros_like(systems.L)
    reverse_initial_covariances(
        systems.poles, systems.B, systems.C, systems.L, past.shared, past.memory,
        from_lanes(q, k).view(complex).reshape(k, n_y, P), from_lanes(state, k),
        poles_bar, B_bar, C_bar, L_bar,
    )  # fmt: skip
    level = from_lanes(held.D, k).reshape(k, n_y, -1)
    drift = None if systems.drift is None else driven_bar[..., n_u]
    late = None
    if systems.late is not None:
        late = driven_bar[..., n_u + (systems.drift is not None) :]
    return Systems(
        poles_bar, B_bar, C_bar, L_bar, drift, level[..., :-1], level[..., -1], noise_bar[:, 0],
        late,
    )  # fmt: skip


def to_lanes(x: np.ndarray) -> np.ndarray:
    """(B, ...) to (groups, k, WIDTH); the last point fills what lanes are left."""
    groups = -(-len(x) // WIDTH)
    order = np.minimum(np.arange(groups * WIDTH), len(x) - 1)
    real = np.ascontiguousarray(x).reshape(len(x), -1).view(np.float64)
    return np.ascontiguousarray(real[order].reshape(groups, WIDTH, -1).swapaxes(1, 2))


def from_lanes(x: np.ndarray, count: int) -> np.ndarray:
    """(groups, k, WIDTH) to (count, k), contiguous."""
    rows = x.swapaxes(1, 2).reshape(len(x) * WIDTH, -1)[:count]
    return np.ascontiguousarray(rows)


@njit(**OPTIONS)
def _fresh(work, x):
    """What a group begins with."""
    work.gain[:] = 0.0
    work.before[:] = 0.0
    work.resting[:] = 0.0
    work.frozen[:] = 0.0
    work.step[0] = -1
    x[:] = 0.0


def _row(x, g):
    """Row g of an array; None of none."""
    return None if x is None else x[g]


@overload(_row)
def _row_compiled(x, g):
    # Which of the two it is depends on the type: a branch would have to have one type.
    if isinstance(x, types.NoneType):
        return lambda x, g: None
    return lambda x, g: x[g]


@njit(**OPTIONS)
def _point(points, g):
    """One group of the points."""
    return Points(points.poles[g], points.q[g], _row(points.c, g), points.start[g])


@njit(**OPTIONS)
def _clear(x):
    """Zeros, where there is an array."""
    if x is not None:
        x[:] = 0.0


@njit(**OPTIONS)
def _copy(x, to, g):
    """An array to that of a group, where there is one."""
    if x is not None:
        to[g] = x


@njit(**OPTIONS)
def _forward(gains, signals, own, points, rows, work, x, z, d, kept):
    for g in range(gains.poles.shape[0]):
        respond(g, gains, signals, own, rows.residual)
        _fresh(work, x)
        here = _point(points, g)
        run_points(g, here, rows, work, x, z, d, kept)


@njit(**OPTIONS)
def _reverse(gains, signals, own, points, rows, work, x, bars, kept, every):
    """Gradients of each group, written to those of all of them."""
    for g in range(gains.poles.shape[0]):
        _fresh(work, x)
        for part in (bars.poles, bars.q, bars.state, bars.held, bars.inject, bars.later, bars.w,
                     bars.log_phi, bars.z, bars.d):  # fmt: skip
            part[:] = 0.0
        _clear(bars.c)
        here = _point(points, g)
        z, d, residual, noise = every.z, every.d, every.residual, every.noise
        reverse_points(g, here, rows, work, x, kept, bars, z, d, residual, noise)
        every.found.poles[g] = bars.poles
        _copy(bars.c, every.found.C, g)
        every.q[g] = bars.q
        every.state[g] = bars.state[: every.state.shape[1]]
        respond(g, gains, signals, own, rows.residual)
        reverse_respond(g, gains, signals, own, every.held, residual)
