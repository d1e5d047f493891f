"""What a model of a plant's structure can absorb of an effect, and what is left beyond that."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from tests.discrepancy.plant_dynamics import Array, Function, System, mode, mode_slope, response

# Powers of the linear output that a model's own static nonlinearity can add.
POWERS = 8
Poles = NDArray[np.complex128]


def absorbed(system: System, u: Array, window: slice, shape: Function | None) -> Array:
    """Orthonormal basis (n, K) of what a model of this structure can absorb, to first order.

    Any gains (exactly), small changes of the poles, feedthrough and offset; with a static
    nonlinearity `shape` behind the system, these through its slope, and any smooth function of the
    linear output.
    """
    columns = [*u.T]
    for pole, gains in zip(system.poles, system.gains, strict=True):
        x = mode(pole, u)
        turned = mode_slope(pole, u @ gains, x @ gains)
        columns += [*x.real.T, *x.imag.T, turned.real, turned.imag]
    slope, free = _through(system, u, window, shape)
    return _basis(np.column_stack([free, slope[:, None] * np.column_stack(columns)[window]]))


def unexplained(effect: Array, basis: Array) -> float:
    """Root mean square of what is left of an effect (n,) beyond the basis."""
    return _rms(effect - basis @ (basis.T @ effect))


def unexplained_by_fit(
    effect: Array, system: System, u: Array, window: slice, shape: Function | None,
    starts: Sequence[Poles],
) -> float:  # fmt: skip
    """The same where poles may move far: least squares over poles and gains, from several starts.

    Exact for a linear model; a static nonlinearity is taken along its slope at the plant's own
    linear output, as in `absorbed`.
    """
    slope, free = _through(system, u, window, shape)
    target = effect + slope * response(system, u)[window]
    free = np.column_stack([free, slope[:, None] * u[window]])

    def parts(x: Array) -> tuple[Poles, list[NDArray[np.complex128]], Array, Array]:
        poles = -np.exp(x[::2]) + 1j * np.exp(x[1::2])
        states = [mode(p, u) for p in poles]
        columns = [slope[:, None] * z[window] for s in states for z in (s.real, s.imag)]
        matrix = np.column_stack([*columns, free])
        return poles, states, matrix, _basis(matrix)

    def left(x: Array) -> Array:
        Q = parts(x)[3]
        return np.asarray(target - Q @ (Q.T @ target))

    def jacobian(x: Array) -> Array:  # Kaufman's, of separable least squares
        poles, states, matrix, Q = parts(x)
        weights = np.linalg.lstsq(matrix, target, rcond=1e-10)[0]
        n_u, columns = u.shape[1], []
        for m, (pole, state) in enumerate(zip(poles, states, strict=True)):
            real, imaginary = np.split(weights[2 * n_u * m : 2 * n_u * (m + 1)], 2)
            turned = mode_slope(pole, u, state)[window]
            for direction in (pole.real, 1j * pole.imag):
                moved = direction * turned
                columns.append(-slope * (moved.real @ real + moved.imag @ imaginary))
        J = np.column_stack(columns)
        return np.asarray(J - Q @ (Q.T @ J))

    found = []
    for poles in starts:
        x = np.column_stack([np.log(-poles.real), np.log(poles.imag)]).ravel()
        bounds = (x - 3.0, x + 3.0)
        best = least_squares(left, x, jacobian, bounds, max_nfev=25, ftol=1e-6)
        found.append(_rms(best.fun))
    return min(found)


def _through(
    system: System, u: Array, window: slice, shape: Function | None
) -> tuple[Array, Array]:  # fmt: skip
    """Slope (n,) of the nonlinearity along the linear output, and columns that are free: (n, K)."""
    g = response(system, u)[window]
    if shape is None:
        return np.ones(len(g)), np.ones((len(g), 1))
    step = 1e-4
    slope = (shape(g + step) - shape(g - step)) / (2 * step)
    middle, half = (g.max() + g.min()) / 2, (g.max() - g.min()) / 2
    return slope, np.polynomial.chebyshev.chebvander((g - middle) / half, POWERS)


def _basis(columns: Array) -> Array:
    scaled = columns / np.sqrt(np.square(columns).sum(axis=0))
    left, values, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(left[:, values > 1e-7 * values[0]])


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))
