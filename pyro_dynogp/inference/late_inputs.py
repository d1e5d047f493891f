r"""Inputs with dead times that are parameters, for many linear systems on an even clock, in numpy.

With a dead time of (j + f) steps, j whole and 0 <= f < 1, an input acts on a state as u_{k-j} and
w times the change u_{k-j-1} - u_{k-j} do, see `lti.delay` and `models.late_systems`; on the output
at once with f in the place of w. Systems whose dead times have the same whole steps j see the same
signals: the input j steps later, and beside it the change, with w or f times its gains.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pyro_dynogp.inference.linear_systems import LinearSystems
from pyro_dynogp.lti.delay import GONE, NEAR
from pyro_dynogp.lti.held_lanes import Signals
from pyro_dynogp.lti.likelihood import Systems


class Late(NamedTuple):
    """Dead times of some points.

    whole: (K,) steps of all of them. share: (k, K) f. step: [time unit]. place: of the site.
    driving, acting: pairs (column of the signal, which dead time) of the late columns.
    """

    whole: tuple[int, ...]
    share: np.ndarray
    step: float
    place: slice
    driving: Sequence[tuple[int, int]]
    acting: Sequence[tuple[int, int]]


class Seen(NamedTuple):
    """Signals of a record, those of a longer stretch that it is part of, and where it begins."""

    own: Signals
    around: Signals
    first: int


@dataclass(frozen=True, eq=False)
class Part:
    """Points that see the same signals: which they are, their systems, and what they see."""

    points: np.ndarray | slice
    systems: Systems
    signals: Signals
    missing: np.ndarray
    late: Late | None = None

    def gradient(self, x: np.ndarray, systems: LinearSystems, bars: Systems) -> np.ndarray:
        """Gradients (k, d) of these points, of all points x (*, d), by those of their systems."""
        here = x[self.points]
        if self.late is None:
            return systems.gradient(here, self.systems, bars)
        late, own = self.late, self.systems
        n_d = own.D.shape[-1] - len(late.acting)
        share_bar = np.zeros_like(late.share)
        B_bar, D_bar = bars.B.copy(), bars.D[..., :n_d].copy()
        poles_bar = bars.poles.copy()
        for i, (column, k) in enumerate(late.driving):
            assert bars.late is not None
            bar, gain = bars.late[..., i], own.B[..., column]
            w, by_z, by_f = moved_share(own.poles * late.step, late.share[:, k])
            B_bar[..., column] += bar * w.conj()
            w_bar = bar * gain.conj()
            share_bar[:, k] += (w_bar.real * by_f.real + w_bar.imag * by_f.imag).sum(1)
            poles_bar += late.step * w_bar * by_z.conj()
        for i, (column, k) in enumerate(late.acting):
            bar, weight, f = bars.D[..., n_d + i], own.D[..., column], late.share[:, k]
            share_bar[:, k] += (bar * weight).sum(1)
            D_bar[..., column] += f[:, None] * bar
        plain = own._replace(D=own.D[..., :n_d], late=None)
        found = bars._replace(poles=poles_bar, B=B_bar, D=D_bar, late=None)
        out = systems.gradient(here, plain, found)
        out[:, late.place] += share_bar / late.step
        return out


class LateInputs:
    """The inputs of a linear model that have dead times.

    Args:
        systems: of the model. columns: (K,) of the inputs. place: of the site in a vector.
        step: of the clocks of all records [time unit].
    """

    def __init__(
        self, systems: LinearSystems, columns: Sequence[int], place: slice, step: float
    ) -> None:
        feedthrough = f"{systems.name}_feedthrough" in systems.places
        n_u, first = systems.inputs, len(systems.prompt) if feedthrough else 0
        late = list(enumerate(columns))
        self.place, self.step = place, step
        self.driving = [(c, k) for k, c in late if c < n_u]
        self.acting = [(first + c - n_u, k) for k, c in late if c >= n_u]

    def parts(
        self, x: np.ndarray, systems: Systems, seen: Seen, missing: np.ndarray
    ) -> Iterator[Part]:
        """Systems at x (k, d) with the signals that they see, whole steps by whole steps."""
        n, step = len(seen.around.driving), self.step
        steps = x[:, self.place] / step
        # Where nothing has arrived by the end it does not matter how late it is.
        steps = np.where(steps < n, steps, n)
        whole = np.floor(steps)
        share = steps - whole
        for cell in np.unique(whole, axis=0):
            points = np.flatnonzero((whole == cell).all(1))
            later = tuple(int(j) for j in cell)
            late = Late(later, share[points], step, self.place, self.driving, self.acting)
            own = _some(systems, points)
            yield Part(points, _with(own, late), self._late(seen, later), missing, late)

    def _late(self, seen: Seen, whole: Sequence[int]) -> Signals:
        """The signals of the record with late inputs and their changes."""
        rows = seen.first + np.arange(len(seen.own.step))
        driving = _shifted(seen.around.driving, rows, self.driving, whole)
        acting = _shifted(seen.around.acting, rows, self.acting, whole)
        return seen.own._replace(driving=driving, acting=acting)


def _shifted(
    x: np.ndarray, rows: np.ndarray, late: Sequence[tuple[int, int]], whole: Sequence[int]
) -> np.ndarray:
    """Rows of columns (m, c) of which some are late, and beside them their changes."""
    columns = list(x[rows].T)
    for column, k in late:
        there = x[:, column]
        columns[column] = there[np.maximum(rows - whole[k], 0)]
        columns.append(there[np.maximum(rows - whole[k] - 1, 0)] - columns[column])
    return np.ascontiguousarray(np.stack(columns, 1)) if columns else x[rows]


def _some(systems: Systems, points: np.ndarray) -> Systems:
    """Those of some points."""
    own: dict[str, Any] = {
        name: a if a is None else a[points] for name, a in systems._asdict().items()
    }
    return systems._replace(**own)


def _with(systems: Systems, late: Late) -> Systems:
    """Systems with gains of the changes: w or f times those of the inputs."""
    share, z = late.share, systems.poles * late.step
    extra = [systems.B[..., c] * moved_share(z, share[:, k])[0] for c, k in late.driving]
    weights = [systems.D[..., c] * share[:, k, None] for c, k in late.acting]
    D = np.concatenate([systems.D, *(one[..., None] for one in weights)], -1)
    return systems._replace(D=D, late=np.stack(extra, -1) if extra else None)


def moved_share(z: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`lti.delay.moved_share` w (k, P) at z (k, P) and f (k,), and its derivatives by z and f."""
    f, rest = share[:, None], 1.0 - share[:, None]
    gone = z.real < GONE
    z = np.maximum(z.real, GONE) + 1j * z.imag
    near = np.abs(z) < NEAR
    far = np.where(near, 1.0, z)
    first, all_of = np.exp(-far * f), np.exp(-far)
    w = (1.0 - first) / (1.0 - all_of)
    by_z = (f * first - w * all_of) / (1.0 - all_of)
    by_f = far * first / (1.0 - all_of)
    bend = (1.0 - 2.0 * f) / 6.0
    series = f * (1.0 + 0.5 * z * rest * (1.0 + z * bend))
    series_z = 0.5 * f * rest * (1.0 + 2.0 * z * bend)
    series_f = 1.0 + 0.5 * z * (1.0 - 2.0 * f)
    by_z = np.where(near, series_z, by_z)
    # Beyond `GONE` the real part is held.
    by_z = np.where(gone, 0.0, by_z)
    return np.where(near, series, w), by_z, np.where(near, series_f, by_f)
