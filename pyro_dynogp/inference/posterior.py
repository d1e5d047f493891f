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

from pyro_dynogp._errors import invalid
from pyro_dynogp.inference.checkpoints import Checkpoints
from pyro_dynogp.inference.guides import GaussianGuide, MixtureGuide
from pyro_dynogp.inference.maximum import Optimum
from pyro_dynogp.inference.variational import VariationalPosterior, variational
from pyro_dynogp.parallel import parallel_map

Hyperparameters = Literal["map", "normal", "multivariate normal"]

# Optima that a posterior can consist of.
MOST_OPTIMA = 4


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
    optimum's height says no more than that about the mass around it. The weights of the optima
    are therefore exp(ELBO / sqrt(d/2)), not exp(ELBO), which would keep one whatever the rest is.

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
    scale = spread(optima[0].values)
    leading = [o for o in optima[:MOST_OPTIMA] if o.energy - optima[0].energy < 5.0 * scale]
    tasks = []
    for index, optimum in enumerate(leading):
        free = {k: v for k, v in optimum.values.items() if _is_free(k)}
        fixed = {k: v for k, v in optimum.values.items() if k not in free}
        if not free:
            raise invalid(
                "hyperparameters",
                expected="'normal' or 'multivariate normal' for a cascade without static layers",
                got="'map'",
            )
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
    order = sorted(range(len(tasks)), key=lambda index: -level(found_all[index]))
    levels = torch.tensor([level(found_all[index]) for index in order], dtype=torch.float64)
    guide = MixtureGuide.of(
        torch.softmax(levels / scale, 0),
        [tasks[index].fixed for index in order],
        [found_all[index].guide for index in order],
    )
    first = order[0]
    return Posterior(guide, leading[first].values, found_all[first].elbo, len(order))


def spread(values: Mapping[str, Tensor]) -> float:
    """sqrt(d/2), the standard deviation of a d-dimensional normal's log density over its draws."""
    return math.sqrt(0.5 * sum(value.numel() for value in values.values()))


def level(found: VariationalPosterior) -> float:
    """ELBO over the last steps."""
    return float(found.elbo[-50:].mean())


def _is_free(site: str) -> bool:
    return site.endswith("_values") or "_initial_state" in site
