r"""Chord method: minima near one whose derivatives are known, without derivatives of their own.

With the predictions' derivatives J at one point the gradient g = J' w(z) at others is nearly right,
w being exact, and so is the curvature H = F + prior. Steps z <- z - H^-1 g cost one prediction each
(Ortega & Rheinboldt, Iterative Solution of Nonlinear Equations, 1970, section 7.1).
"""

from __future__ import annotations

import numpy as np

from pyro_dynogp.inference.optimise.innovation_energy import Innovations, Local

# Least curvature: along what hardly curves a gradient that is nearly right leads far away.
LEAST = 1.0
# Shares of a step that are tried until one leads lower.
SHARES = (1.0, 0.3, 0.1)


def along_chord(
    innovations: Innovations, here: Local, z: np.ndarray, steps: int, left: float
) -> tuple[float, np.ndarray, bool]:
    """Lowest energy on the way to a minimum near z (d,), where, and whether it is the minimum.

    Args:
        innovations: of a model with the sites of that one. here: of that one. steps: most of them.
        left: nats to gain at which it is.
    """
    curvature, axes = here.axes
    curvature = np.maximum(np.abs(curvature), LEAST)
    energy, gradient = innovations.beside(here, z)
    for _ in range(steps):
        along = gradient @ axes
        if float((along**2 / curvature).sum()) <= 2.0 * left:
            return energy, z, True
        move = np.zeros(len(z))
        move[innovations.free] = -(axes @ (along / curvature))
        before = energy
        for share in SHARES:
            value, slope = innovations.beside(here, z + share * move)
            if value < energy:
                energy, z, gradient = value, z + share * move, slope
                break
        if not energy < before:
            break
    return energy, z, False
