r"""Normals around modes: Laplace's approximation, from a Hessian or from the Fisher matrix.

The Fisher matrix F of one-step predictions (`optimise.innovation_energy`) takes d + 1 runs of
the filter that go through it together, where differences for a Hessian take gradients at 2 d
points, and it is never indefinite. Of static functions' values, given all else, the normal with
precision F + F_prior is nearly the posterior (Wiener, Hammerstein and Wiener-Hammerstein models of
150 to 1500 samples, 32 to 38 values: log ratios of the posterior over draws have standard
deviations of 0.2 to 0.9 nats).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from torch import Tensor

from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.log_joint import Direct
from pyro_dynogp.inference.optimise.descent import WIDEST, bounded_root, descend, polished
from pyro_dynogp.inference.optimise.gauss_newton import climb
from pyro_dynogp.inference.optimise.innovation_energy import Innovations, has_innovations

# Most iterations to the mode of the unconstrained vector's density: by gradients and Hessians, and
# by Gauss-Newton.
STEPS, FISHER_STEPS = 120, 25


def laplace(
    potential: Potential, values: Mapping[str, Tensor], steps: int = STEPS
) -> tuple[np.ndarray, np.ndarray]:
    """Centre (d,) and root (d, d) of the Laplace approximation of the unconstrained vector.

    The centre is the mode of that vector's own density (with Jacobian), climbed to from `values` in
    so many iterations at most: the mode of the constrained density can lie on a boundary, at minus
    infinity.
    """
    every = potential.hessian_cost
    z, _, _ = descend(
        potential.with_jacobian, potential.pack(values).numpy(), steps, every=every, first=0
    )
    z, _, _ = polished(potential.with_jacobian, z)
    return z, bounded_root(potential.hessian(z))


def fisher_normal(
    potential: Potential, values: Mapping[str, Tensor], steps: int = FISHER_STEPS
) -> tuple[np.ndarray, np.ndarray] | None:
    """The same by Gauss-Newton, with the Fisher matrix for the Hessian.

    None where there is no such matrix: where the last layer has limits, of models that are not this
    library's, at an edge of what can be evaluated.
    """
    innovations = innovations_of(potential)
    if innovations is None:
        return None
    z = climb(innovations, potential.pack(values).numpy(), steps)[0]
    root = _root_at(innovations, z)
    return None if root is None else (z, root)


def fisher_root(potential: Potential, values: Mapping[str, Tensor]) -> np.ndarray | None:
    """Root (d, d) of the covariance that the Fisher matrix and the prior give at `values`.

    None where predictions next to them are not finite, and as of `fisher_normal`.
    """
    innovations = innovations_of(potential)
    return None if innovations is None else _root_at(innovations, potential.pack(values).numpy())


def _root_at(innovations: Innovations, z: np.ndarray) -> np.ndarray | None:
    here = innovations.local(z)
    return None if here is None else bounded_root(here.fisher + here.prior)


def innovations_of(potential: Potential) -> Innovations | None:
    """Of the unconstrained vector's density, where the model has such."""
    density = potential.log_density
    if not isinstance(density, Direct) or not has_innovations(density.model):
        return None
    return Innovations(potential, jacobian=True)


def log_evidence(potential: Potential, values: Mapping[str, Tensor]) -> float:
    """Laplace's approximation of log p(y) from the neighbourhood of `values` alone [nats].

    A Gaussian integral of the unconstrained vector's density with the curvature there: by it optima
    of one model are compared, of which a high one may be a needle. Directions that are flatter than
    a standard deviation of `WIDEST` count as that wide (Tierney & Kadane 1986). Of models with
    static functions it is the Fisher matrix's, where there is one.
    """
    z = potential.pack(values).numpy()
    innovations = innovations_of(potential)
    here = innovations.local(z) if innovations and innovations.has_functions else None
    if here is None:
        energy = potential.value_and_gradient(z, jacobian=True)[0]
        matrix = potential.hessian(z, step=1e-3)
    else:
        energy, matrix = here.energy, here.fisher + here.prior
    curvature = np.maximum(np.linalg.eigvalsh(matrix), WIDEST**-2)
    return float(-energy - 0.5 * np.log(curvature / (2.0 * math.pi)).sum())
