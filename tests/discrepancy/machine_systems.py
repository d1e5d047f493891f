"""Differential equations of the machines, and how they are solved.

A system is dx/dt = A x + B v + sum_j f_j(c_j'x, v) b_j with outputs y = C x + level; the drives v
are held within a part of a sample. Runge-Kutta of fourth order takes one step for each part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Functions f of z = c'x with a scale s, or of z and one of the drives.
TANH, CUBE, ROOT, PRODUCT = 0, 1, 2, 3  # tanh(z / s), z^3, sqrt(max(z, 0)), z v[column]
# Largest step times the fastest rate: relative errors of about 1e-7.
FINENESS, FEWEST, MOST = 0.05, 4, 60


@dataclass(frozen=True, eq=False)
class Term:
    """A nonlinear term f(sees'x) acts, with f by `code`."""

    code: int
    sees: Array
    acts: Array
    scale: float = 1.0
    column: int = 0


@dataclass(frozen=True, eq=False)
class System:
    """A machine in physical units.

    Attributes:
        A: (s, s). B: (s, n_u + 1), the last drive is not an input of the model. C: (n_y, s).
        level: (n_y,) added to the output.
        rest: (s,) state in which the machine starts.
        terms: nonlinear ones.
    """

    A: Array
    B: Array
    C: Array
    level: Array
    rest: Array
    terms: tuple[Term, ...] = ()

    @property
    def rates(self) -> NDArray[np.complex128]:
        """Eigenvalues of A [1 / time unit]."""
        return np.asarray(np.linalg.eigvals(self.A))

    def with_terms(self, *terms: Term) -> System:
        """The system with more terms."""
        return replace(self, terms=(*self.terms, *terms))

    def output(self, states: Array) -> Array:
        """Outputs (n, n_y) of states (n, s)."""
        return np.asarray(states @ self.C.T + self.level)


def parts_of(system: System, step: float) -> int:
    """Number of steps of the solver within a sample, for the linear part of the system."""
    fastest = float(np.abs(system.rates).max())
    return int(np.clip(np.ceil(fastest * step / FINENESS), FEWEST, MOST))


def solve(system: System, v: Array, step: float, parts: int) -> Array:
    """States (n, s) at the samples.

    Args:
        system: to be solved. v: (n parts, n_v) drives in each part of a sample.
        step: between samples. parts: of a sample.
    """
    if len(v) % parts:
        raise ValueError(f"v: expected a multiple of {parts} rows, got {len(v)}.")
    return np.asarray(
        _solved(system.rest, np.ascontiguousarray(v), step / parts, parts, *_packed(system))
    )


def solve_loop(
    system: System,
    wanted: Array,
    disturbance: Array,
    gains: tuple[float, float],
    bias: float,
    step: float,
    parts: int,
) -> Array:
    """Input (n,) of a system with one input and one output under a PI controller.

    u_k = bias + K (e_k + (step / T) sum of e_0 ... e_k), with e = wanted - measured output.

    Args:
        system: under control. wanted: (n,) set point. disturbance: (n,) of the measured output.
        gains: K [input / output] and T [time unit]. bias: input without an error.
        step: between samples. parts: of a sample.
    """
    proportional, reset = gains
    return np.asarray(
        _controlled(
            system.rest, wanted, disturbance, proportional, proportional * step / reset, bias,
            system.C[0], float(system.level[0]), step / parts, parts, _packed(system),
        )
    )  # fmt: skip


Packed = tuple[Array, Array, NDArray[np.int64], Array, Array, Array, NDArray[np.int64]]


def _packed(system: System) -> Packed:
    s, terms = len(system.A), system.terms
    return (
        np.ascontiguousarray(system.A),
        np.ascontiguousarray(system.B),
        np.array([t.code for t in terms], dtype=np.int64),
        np.array([t.sees for t in terms], dtype=float).reshape(-1, s),
        np.array([t.acts for t in terms], dtype=float).reshape(-1, s),
        np.array([t.scale for t in terms], dtype=float),
        np.array([t.column for t in terms], dtype=np.int64),
    )


@numba.njit(cache=True)
def _slope(x, v, A, B, codes, sees, acts, scales, columns):
    s = len(x)
    out = np.zeros(s)
    for i in range(s):
        for j in range(s):
            out[i] += A[i, j] * x[j]
        for j in range(len(v)):
            out[i] += B[i, j] * v[j]
    for k in range(len(codes)):
        z = 0.0
        for j in range(s):
            z += sees[k, j] * x[j]
        if codes[k] == TANH:
            f = np.tanh(z / scales[k])
        elif codes[k] == CUBE:
            f = z**3
        elif codes[k] == ROOT:
            f = np.sqrt(max(z, 0.0))
        else:  # PRODUCT
            f = z * v[columns[k]]
        for i in range(s):
            out[i] += acts[k, i] * f
    return out


@numba.njit(cache=True)
def _advanced(x, v, h, A, B, codes, sees, acts, scales, columns):
    k1 = _slope(x, v, A, B, codes, sees, acts, scales, columns)
    k2 = _slope(x + 0.5 * h * k1, v, A, B, codes, sees, acts, scales, columns)
    k3 = _slope(x + 0.5 * h * k2, v, A, B, codes, sees, acts, scales, columns)
    k4 = _slope(x + h * k3, v, A, B, codes, sees, acts, scales, columns)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


@numba.njit(cache=True)
def _solved(x, v, h, parts, A, B, codes, sees, acts, scales, columns):
    n = len(v) // parts
    states = np.zeros((n, len(x)))
    for k in range(n):
        states[k] = x
        for i in range(parts):
            x = _advanced(x, v[k * parts + i], h, A, B, codes, sees, acts, scales, columns)
    return states


@numba.njit(cache=True)
def _controlled(
    x, wanted, disturbance, gain, reset, bias, C, level, h, parts, packed,
):  # fmt: skip
    n = len(wanted)
    u = np.zeros(n)
    v = np.zeros(packed[1].shape[1])
    total = 0.0
    for k in range(n):
        y = level + disturbance[k]
        for j in range(len(x)):
            y += C[j] * x[j]
        error = wanted[k] - y
        total += reset * error
        u[k] = bias + gain * error + total
        v[0] = u[k]
        for _ in range(parts):
            x = _advanced(x, v, h, *packed)
    return u
