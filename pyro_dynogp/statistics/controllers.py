r"""Inputs that a recorded controller computes from the output and a set point.

A controller of few terms is an exact linear relation between samples,

    u_k = sum_{j=1}^{L} a_j u_{k-j} + sum_{j=0}^{L} (b_j y_{k-j} + c_j r_{k-j}) + d,

PI and PID with L = 1 and 2. In a record without feedback the output has noise that the input knows
nothing of, and no such relation holds. With both u and r as inputs, a model with a direct path can
turn the relation round and compute the output, noise included, which says nothing of the plant.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from pyro_dynogp.data.signals import held

# In `where` of evidence of an input that is computed from the output: the channel it is set by.
SET = "set point"
# Samples that a controller looks back.
LAGS = 3
# Share of an input's variance below which its own past and the set point foretell it: it could be
# anything's function then.
FORETOLD = 1e-8


class Controller(NamedTuple):
    """How an input is computed: with which set point ("" for a constant one), and what is left.

    share: of what the input's own past and the set point leave of it, variance.
    """

    set_point: str
    share: float


def controller_of(
    u: np.ndarray, y: np.ndarray, channels: Mapping[str, np.ndarray]
) -> Controller | None:
    """The controller that comes nearest to computing an input; None where u says nothing.

    Args:
        u: (n,) input. y: (n,) output, NaN where missing. channels: (n,) that may be set points.
    """
    found = []
    for name, r in {"": None, **channels}.items():
        own = [_lagged(u, 1)]
        if r is not None:
            own.append(_lagged(held(r), 0))
        answers = _lagged(y, 0)
        rows = np.isfinite(answers).all(1)
        base = np.column_stack([*own, np.ones(len(u))])
        rows[:LAGS] = False
        if rows.sum() <= 2 * (base.shape[1] + answers.shape[1]):
            continue
        before = _left(base[rows], u[rows])
        after = _left(np.column_stack([base, answers])[rows], u[rows])
        if before > FORETOLD * np.var(u[rows]):
            found.append(Controller(name, after / before))
    return min(found, key=lambda one: one.share, default=None)


def _lagged(x: np.ndarray, first: int) -> np.ndarray:
    """Values of `first` to `LAGS` samples before (n, LAGS + 1 - first), standardised."""
    size = np.nanstd(x)
    x = (x - np.nanmean(x)) / (size if size > 0 else 1.0)
    return np.column_stack([np.roll(x, lag) for lag in range(first, LAGS + 1)])


def _left(design: np.ndarray, x: np.ndarray) -> float:
    """Mean square of what least squares leaves."""
    coefficients = np.linalg.lstsq(design, x, rcond=None)[0]
    return float(np.mean((x - design @ coefficients) ** 2))
