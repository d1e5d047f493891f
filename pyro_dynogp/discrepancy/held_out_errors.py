"""One-step errors of data held out, less what parameters would learn from them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.optimise.gauss_newton import LEAST
from pyro_dynogp.inference.optimise.innovation_energy import Innovations, has_innovations
from pyro_dynogp.inference.posteriors import Mixture
from pyro_dynogp.models.delays import longest_delay, where_inputs_are_known

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit


def one_step_errors(fit: Fit, record: Record, held_out: np.ndarray) -> np.ndarray:
    """Standardised one-step errors (n, n_y), NaN where the output is missing.

    Functions are half-known where training data hardly went, gains and poles after a short record,
    and what is wrong there looks like noise that is coloured, or of changing size. Errors held out
    are those that are left once parameters have learnt from them, along directions of which they
    say more than what was fitted. To first order these are

        e - sum_{s > 1} s^2 / (1 + s^2) v v^T e,    R^T J = U diag(s) V^T,    R R^T = (F + P)^-1,

    e the errors held out, J (D, N) their derivatives by the unconstrained vector, F the Fisher
    matrix of what was fitted and P the curvature of the prior. (All directions would make tests
    less powerful: each is learnt a little better.) Errors stay as they are where they are not
    normal, behind a function with limits and under noise that is not Gaussian; and where nothing of
    the record was fitted.

    Args:
        fit: to what is not held out. record: along which. held_out: (n,) True where it is.
    """
    errors = fit.innovations(record)
    model = fit.model.collapsed
    normal = has_innovations(model) and model.likelihood.gaussian
    if not normal or not isinstance(fit.posterior, Mixture) or held_out.all():
        return errors
    (along,) = model.prepare(where_inputs_are_known(record, longest_delay(model)))
    potential = Potential(model, ((along,),), fit.mode)
    there = ~np.isnan(along.observations.numpy()).reshape(errors.shape)
    z = potential.pack(fit.mode).numpy()
    here = Innovations(potential, jacobian=True).local(z)
    if here is None:  # at an edge of what can be evaluated
        return errors
    own = (held_out[:, None] & there)[there]
    fitted = sum(J[:, ~own] @ J[:, ~own].T for J in here.slopes)
    curvature, axes = np.linalg.eigh(fitted + here.prior)
    root = axes / np.sqrt(np.maximum(np.abs(curvature), LEAST))
    _, s, V = np.linalg.svd(root.T @ here.slopes[0][:, own], full_matrices=False)
    s, V = s[s > 1.0], V[s > 1.0]
    left = errors[there]
    left[own] -= (s**2 / (1.0 + s**2) * (V @ left[own])) @ V
    errors[there] = left
    return errors
