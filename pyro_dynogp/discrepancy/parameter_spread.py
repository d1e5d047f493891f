r"""How uncertain parameters are, where what a model leaves of its training data is coloured.

The Fisher matrix F takes one-step errors for white. Where a model without process noise leaves
coloured errors it says too little of the parameters' uncertainty: the inputs that they are learnt
from are slow as well. To first order an estimate moves by (F + P)^-1 J e, with P the curvature of
the prior, J (d, N) the derivatives of the standardised errors, and e what they are. The covariance
is hence (White, Econometrica 50:1, 1982; the prior's part as of a normal)

    (F + P)^-1 (M + P) (F + P)^-1,    M = J cov(e) J^T,

with M = F for white errors. The colour is that of an autoregression, e = w / (1 - A), so that
M = s^2 G G^T, with G^T = (1 - A^T)^-1 J^T the rows of J, filtered backwards in time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.signal import lfilter

from pyro_dynogp.criticism.posterior_draws import laplace
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.laplace import innovations_of
from pyro_dynogp.inference.optimise.descent import bounded_root
from pyro_dynogp.inference.optimise.innovation_energy import Local
from pyro_dynogp.inference.posteriors import Mixture
from pyro_dynogp.statistics.autoregression import fitted_filter
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.support.parallel import seeded

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit


def normal_near(fit: Fit, settings: LoopSettings, share: float = 1.0) -> Mixture:
    """Normal around the mode of a fit, by the Fisher matrix and the colour of one-step errors.

    A Hessian of a model with static functions takes hundreds of gradients, and the climb to the
    mode that Laplace's approximation is around as many; the Fisher matrix takes a few. Without one
    (a last layer with limits, a mode at an edge) it is Laplace's approximation.

    Args:
        fit: a posterior mode. settings: thresholds. share: of the standard deviations.
    """
    records = tuple(fit.model.prepare(fit.records))
    with seeded(fit.seed):
        potential = Potential(fit.model.collapsed, (records,), fit.mode)
        innovations = innovations_of(potential)
        z = potential.pack(fit.mode)
        here = None if innovations is None else innovations.local(z.numpy())
    if innovations is None or here is None:
        root = laplace(fit, fit.mode).scale_tril[0]
    else:
        there = np.concatenate([
            ~np.isnan(y.numpy().reshape(-1)) for y in innovations.density.observations
        ])  # fmt: skip
        n_outputs = fit.records[0].n_outputs
        outputs = np.tile(np.arange(n_outputs), len(there) // n_outputs)[there]
        root = torch.as_tensor(root_beside_colour(here, outputs, settings))
    return Mixture.normal(potential, z, share * root)


def root_beside_colour(here: Local, outputs: np.ndarray, settings: LoopSettings) -> np.ndarray:
    """Root (d, d), lower, of the covariance of the parameters; see the module.

    Errors of an output too few to tell their colour count as white, and so do variances.

    Args:
        here: errors and their derivatives. outputs: (N,) which output each error is of.
        settings: thresholds.
    """
    inner = here.prior + sum(J @ J.T for J in here.slopes[1:])
    for a in np.unique(outputs):
        J, e = here.slopes[0][:, outputs == a], here.level[0][outputs == a]
        if len(e) < settings.measured_samples:
            inner = inner + J @ J.T
            continue
        whiten = fitted_filter(e, settings)
        coefficients = np.concatenate([[1.0], -whiten.coefficients])
        G = lfilter([1.0], coefficients, J[:, ::-1])
        driving = np.square(whiten(e)).mean() * len(e) / max(len(e) - len(J), 1)
        inner = inner + driving * (G @ G.T)
    outer = bounded_root(here.fisher + here.prior)
    curvature, axes = np.linalg.eigh(outer.T @ inner @ outer)
    # The prior may bend upwards somewhere, and rounding makes little of nothing.
    root = outer @ (axes * np.sqrt(np.maximum(curvature, 1e-6)))
    lower = np.asarray(np.linalg.qr(root.T)[1]).T
    return np.asarray(lower * np.where(np.diag(lower) < 0.0, -1.0, 1.0))
