r"""Parameters that a posterior leaves at their optimum, as directions in which they may move.

Beside functions in feedback poles and gains of a default posterior stay at their optimum: draws of
all of them together run away, as free runs go far where the density ends. Of small moves nothing
runs away. With z the unconstrained vector, H = F + F_prior its precision at the mode (F the Fisher
matrix of one-step predictions) and h the entries that are held, what is left unknown of these is
normal with covariance S = (H^-1)_hh, and the others follow them by (H^-1)_fh S^-1. A free run moves
by its derivative along the columns of (H^-1)_(.h) S^(-1/2), each times a standard normal number:
equation (16) of docs/explanation/mathematics.md. The root is the symmetric one, so that columns do
not depend on the order of parameters but for their own.

Source: linearised Laplace predictions: D. MacKay, Neural Computation 4(3):448, 1992, and Immer,
Korzepa and Bauer, AISTATS 2021, for neural networks. Kernels and process noise are not among them:
the former are those of the highest evidence, the latter what free runs have left.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.free_runs import noise_sites
from pyro_dynogp.inference.function_evidence import kernel_sites
from pyro_dynogp.inference.laplace import fisher_root
from pyro_dynogp.inference.posteriors import Mixture, Posterior
from pyro_dynogp.models.model import Model

# Share of a standard deviation by which parameters are moved for a derivative.
MOVE = 0.01


def held_sites(model: Model, posterior: Posterior) -> tuple[str, ...]:
    """Names of the sites that stay at their optimum, of a posterior that draws functions alone.

    None without feedback, of modes, and of other posteriors.
    """
    if not (isinstance(posterior, Mixture) and posterior.sites and model.has_feedback):
        return ()
    return tuple(name for name in posterior.points if name not in _kept(model))


def _kept(model: Model) -> tuple[str, ...]:
    return (*kernel_sites(model), *noise_sites(model), "noise_sd")


def moved_along(
    model: Model, records: Sequence[Record], mode: Mapping[str, Tensor], held: Sequence[str]
) -> dict[str, Tensor] | None:
    """Values (1 + 2 p, *shape) of all sites: at the mode, moved along p directions, and back.

    None where predictions next to the mode are not finite.

    Args:
        model: collapsed, with its scaling. records: of training. mode: values of all sites.
        held: names of sites, see `held_sites`.
    """
    kept = {name: mode[name] for name in _kept(model) if name in mode}
    free = {name: x for name, x in mode.items() if name not in kept}
    potential = Potential(model, (model.prepare(records),), free, kept)
    whole = fisher_root(potential, free)
    if whole is None:
        return None
    places = potential.places(held)
    covariance = whole @ whole.T
    values, axes = np.linalg.eigh(covariance[np.ix_(places, places)])
    directions = MOVE * (axes / np.sqrt(values)) @ axes.T @ covariance[places]
    z = potential.pack(free).numpy()
    points = np.concatenate([z[None], z + directions, z - directions])
    moved = {name: x.detach() for name, x in potential.unpack(torch.from_numpy(points)).items()}
    return moved | {name: x.expand(len(points), *x.shape) for name, x in kept.items()}


def slopes_of(runs: np.ndarray) -> np.ndarray:
    """Derivatives (p, n, n_y) of free runs along the p directions, of variance one each.

    Args:
        runs: (1 + 2 p, n, n_y), of the values of `moved_along`.
    """
    p = len(runs) // 2
    return np.asarray((runs[1 : p + 1] - runs[p + 1 :]) / (2.0 * MOVE))
