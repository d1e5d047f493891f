"""The variational posterior of an exact or collapsed model, around one optimum or several."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pyro
import torch
from torch import Tensor

from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.normal import VariationalPosterior, variational
from pyro_dynogp.inference.optimise.maximum import Optimum
from pyro_dynogp.inference.posteriors import GaussianGuide, MixtureGuide
from pyro_dynogp.support.checkpoints import Checkpoints, Piece
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.parallel import parallel_map

Hyperparameters = Literal["map", "normal", "multivariate normal"]

# Optima that a posterior can consist of.
MOST_OPTIMA = 4
# Least weight of one that counts.
LEAST_WEIGHT = 0.05
# Largest standard deviation of a direction in the evidence of an optimum (unconstrained units):
# about twice that of the priors.
WIDEST = 3.0


@dataclass(frozen=True)
class Posterior:
    """Result of `posterior_of`.

    Attributes:
        guide: of all sites. mode: their values at the leading optimum.
        elbo: (steps,) of the leading optimum's posterior.
        optima: how many the posterior consists of.
    """

    guide: GaussianGuide | MixtureGuide
    mode: Mapping[str, Tensor]
    elbo: np.ndarray
    optima: int


@dataclass(frozen=True)
class _Task:
    target: Any
    argument: Any
    fixed: Mapping[str, Tensor]
    free: dict[str, Tensor]
    options: Mapping[str, Any]


def _around(task: _Task) -> VariationalPosterior:
    conditioned = pyro.poutine.condition(task.target, data=dict(task.fixed))
    return variational(conditioned, (task.argument,), task.free, **task.options)


@dataclass(frozen=True)
class _Place:
    target: Any
    argument: Any
    values: dict[str, Tensor]
    checkpoints: Checkpoints
    key: str


def _evidence(task: _Place) -> float:
    def find() -> Piece:
        potential = Potential(task.target, (task.argument,), task.values)
        found = potential.log_evidence(task.values, widest=WIDEST)
        return {"evidence": torch.tensor(found, dtype=torch.float64)}

    return float(task.checkpoints.piece(task.key, find)["evidence"])


def posterior_of(
    target: Any,
    argument: Any,
    optima: Sequence[Optimum],
    hyperparameters: Hyperparameters,
    *,
    steps: int,
    particles: int,
    learning_rate: float,
    seed: int,
    workers: int | None,
    checkpoints: Checkpoints,
    progress: bool,
) -> Posterior:
    """Fit the posterior by SVI, from the optima.

    With "map" inducing values and first states have multivariate normals and everything else stays
    at the optimum, at up to `MOST_OPTIMA` of them: such a posterior has many modes, and no normal
    spans two. Log densities of draws from a d-dimensional posterior spread by sqrt(d/2) nats, so an
    optimum's evidence, found by Laplace's approximation for all sites, says hardly more than that
    about the mass around it. The weights of the optima are therefore exp(evidence / sqrt(d/2)), not
    exp(evidence), which would keep one whatever the rest is.

    Raises:
        ValueError: on "map" for a model without inducing values and first states.
    """
    options: dict[str, Any] = {
        "steps": steps,
        "particles": particles,
        "learning_rate": learning_rate,
        "seed": seed,
        "checkpoints": checkpoints,
    }
    if hyperparameters != "map":
        independent = hyperparameters == "normal"
        best = optima[0].values
        found = variational(
            target, (argument,), dict(best), independent=independent, progress=progress, **options
        )
        return Posterior(found.guide, best, found.elbo, 1)
    if not any(_is_free(name) for name in optima[0].values):
        raise invalid(
            "hyperparameters",
            expected="'normal' or 'multivariate normal' for a cascade without static layers",
            got="'map'",
        )
    leading, weights = _weighted(target, argument, optima, workers, checkpoints, progress)
    tasks = []
    for index, values in enumerate(leading):
        free = {k: v for k, v in values.items() if _is_free(k)}
        fixed = {k: v for k, v in values.items() if k not in free}
        own = {**options, "key": f"posterior-{index}", "progress": progress and len(leading) == 1}
        tasks.append(_Task(target, argument, fixed, free, own))
    found_all = parallel_map(
        _around,
        tasks,
        workers=workers,
        progress=progress and len(tasks) > 1,
        description="posterior",
        news=lambda found: f"elbo {max(level(one) for one in found):.2f}",
    )
    guide = MixtureGuide.of(
        weights, [task.fixed for task in tasks], [found.guide for found in found_all]
    )
    return Posterior(guide, leading[0], found_all[0].elbo, len(tasks))


def _weighted(
    target: Any,
    argument: Any,
    optima: Sequence[Optimum],
    workers: int | None,
    checkpoints: Checkpoints,
    progress: bool,
) -> tuple[list[dict[str, Tensor]], Tensor]:
    """Values at the optima that carry weight, the weightiest first, and their weights."""
    leading = [one.values for one in optima[:MOST_OPTIMA]]
    if len(leading) == 1:
        return leading, torch.ones(1, dtype=torch.float64)
    evidences = parallel_map(
        _evidence,
        [
            _Place(target, argument, values, checkpoints, f"evidence-{index}")
            for index, values in enumerate(leading)
        ],
        workers=workers,
        progress=progress,
        description="evidence",
        news=lambda found: f"log evidence {max(found):.2f}",
    )
    levels = torch.tensor(evidences, dtype=torch.float64)
    weights, order = torch.softmax(levels / spread(leading[0]), 0).sort(descending=True)
    heavy = weights >= LEAST_WEIGHT
    return [leading[index] for index in order[heavy]], weights[heavy] / weights[heavy].sum()


def spread(values: Mapping[str, Tensor]) -> float:
    """sqrt(d/2), the standard deviation of a d-dimensional normal's log density over its draws."""
    return math.sqrt(0.5 * sum(value.numel() for value in values.values()))


def level(found: VariationalPosterior) -> float:
    """ELBO over the last steps."""
    return float(found.elbo[-50:].mean())


def _is_free(site: str) -> bool:
    return site.endswith("_values") or "_initial_state" in site
