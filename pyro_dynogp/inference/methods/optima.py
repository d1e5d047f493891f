"""The variational posterior of an exact or collapsed model, around one optimum or several."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import pyro
import torch
from torch import Tensor

from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.mode import best_optima, check_optimizer
from pyro_dynogp.inference.methods.normal import VariationalPosterior, variational
from pyro_dynogp.inference.optimise.maximum import Optimizer, Optimum
from pyro_dynogp.inference.posteriors import Mixture, draws_of_guide
from pyro_dynogp.inference.run import Run, at_least_one
from pyro_dynogp.models.model import Model
from pyro_dynogp.support.checkpoints import Checkpoints, Piece
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import parallel_map, seeded

Hyperparameters = Literal["map", "normal", "multivariate normal"]

# Optima that a posterior can consist of.
MOST_OPTIMA = 4
# Least weight of one that counts.
LEAST_WEIGHT = 0.05
# Largest standard deviation of a direction in the evidence of an optimum (unconstrained units):
# about twice that of the priors.
WIDEST = 3.0
# Iterations of SVI around optima that are found already.
POLISH = 60


@dataclass(frozen=True)
class Variational:
    """Result of `posterior_of`.

    Attributes:
        guide: of all sites. mode: their values at the leading optimum.
        elbo: (steps,) of the leading optimum's posterior.
        optima: how many the posterior consists of.
    """

    guide: Mixture
    mode: Mapping[str, Tensor]
    elbo: np.ndarray
    optima: int


@dataclass(frozen=True)
class Normal:
    """A normal posterior by stochastic variational inference, around the best optima.

    Steps of the run are those of the climbs (of models that are not linear) and of SVI: by default
    1000, with static layers 60.

    Attributes:
        family: "map" fits inducing values and first states around up to four optima, with all else
            at the optimum, as the paper does; "normal" gives all sites independent normals,
            "multivariate normal" one for all sites, best for small models with well-excited inputs;
            "auto" is "map" where the model has static layers, else "multivariate normal".
        draws: posterior draws to keep.
        particles, learning_rate: of SVI.
        optimizer: for the starts, as of `Mode`.

    Raises:
        ValueError: on unknown names, or numbers below one.
    """

    family: Hyperparameters | Literal["auto"] = "auto"
    draws: int = 200
    particles: int = 8
    learning_rate: float = 0.02
    optimizer: Optimizer | None = None

    def __post_init__(self) -> None:
        if self.family not in ("auto", *get_args(Hyperparameters)):
            raise invalid(
                "hyperparameters",
                expected="'map', 'normal' or 'multivariate normal'",
                got=repr(self.family),
            )
        at_least_one(draws=self.draws, particles=self.particles)
        check_optimizer(self.optimizer)

    def check(self, model: Model, *, warm: bool) -> None:
        """Refuse "map" for a model in which nothing would be free, and unsuitable optimizers."""
        check_optimizer(self.optimizer, model)
        if self.family == "map" and not model.has_function and not model.collapsed.state_sites:
            raise invalid(
                "hyperparameters",
                expected="'normal' or 'multivariate normal' for a cascade without static layers",
                got="'map'",
            )

    @property
    def identity(self) -> object:
        """All options."""
        return self

    def family_for(self, model: Model) -> Hyperparameters:
        """The family, where "auto" leaves it to the model."""
        if self.family != "auto":
            return self.family
        return "map" if model.has_function else "multivariate normal"

    def __call__(self, problem: Problem, run: Run) -> Fitted:
        """The normals around the best optima, and draws of them."""
        model = problem.model
        climbs = None if model.is_linear else run.steps
        optima = best_optima(problem, run, self.optimizer, climbs)
        family = self.family_for(model)
        steps = run.steps or (POLISH if model.has_function else 1000)
        found = posterior_of(
            problem.target,
            problem.argument,
            optima,
            family,
            free=free_sites(problem),
            steps=min(steps, POLISH) if family == "map" else steps,
            particles=self.particles,
            learning_rate=self.learning_rate,
            run=run,
        )
        with seeded(run.seed):
            drawn = draws_of_guide(found.guide, self.draws)
        tail = found.elbo[-50:]
        diagnostics = {
            "elbo": float(tail.mean()),
            "elbo_sd": float(tail.std()),
            "optima": float(found.optima),
        }
        return Fitted(
            model=model,
            posterior=found.guide,
            draws=FrozenMapping({name: drawn[name] for name in found.mode}),
            mode=FrozenMapping(found.mode),
            history=found.elbo,
            start_energies=np.array([optimum.energy for optimum in optima]),
            diagnostics=FrozenMapping(diagnostics),
            seed=run.seed,
            records=problem.records,
        )


def free_sites(problem: Problem) -> list[str]:
    """Names of inducing values and first states."""
    assert problem.model.scaling is not None
    sites = problem.target.all_sites(problem.model.scaling, len(problem.records))
    return [site.name for site in sites if site.role == "free"]


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
    family: Hyperparameters,
    *,
    free: Sequence[str],
    steps: int,
    particles: int = 8,
    learning_rate: float = 0.02,
    run: Run,
) -> Variational:
    """Fit the posterior by SVI, from the optima.

    With "map" inducing values and first states have multivariate normals and everything else stays
    at the optimum, at up to `MOST_OPTIMA` of them: such a posterior has many modes, and no normal
    spans two. Log densities of draws from a d-dimensional posterior spread by sqrt(d/2) nats, so an
    optimum's evidence, found by Laplace's approximation for all sites, says hardly more than that
    about the mass around it. The weights of the optima are therefore exp(evidence / sqrt(d/2)), not
    exp(evidence), which would keep one whatever the rest is.

    Args:
        target: Pyro model. argument: what it is called with. optima: the best first.
        family: of the posterior. free: names of the sites that vary with "map".
        steps, particles, learning_rate: of SVI. run: seed, processes and so on.
    """
    options: dict[str, Any] = {
        "steps": steps,
        "particles": particles,
        "learning_rate": learning_rate,
        "seed": run.seed,
        "checkpoints": run.checkpoints,
    }
    if family != "map":
        independent = family == "normal"
        best = optima[0].values
        found = variational(
            target,
            (argument,),
            dict(best),
            independent=independent,
            progress=run.progress,
            **options,
        )
        return Variational(found.guide, best, found.elbo, 1)
    leading, weights = _weighted(target, argument, optima, run)
    tasks = []
    for index, values in enumerate(leading):
        moving = {k: v for k, v in values.items() if k in free}
        fixed = {k: v for k, v in values.items() if k not in free}
        own = {
            **options,
            "key": f"posterior-{index}",
            "progress": run.progress and len(leading) == 1,
        }
        tasks.append(_Task(target, argument, fixed, moving, own))
    found_all = parallel_map(
        _around,
        tasks,
        workers=run.workers,
        progress=run.progress and len(tasks) > 1,
        description="posterior",
        news=lambda found: f"elbo {max(level(one) for one in found):.2f}",
    )
    guide = Mixture.of(
        weights, [task.fixed for task in tasks], [found.guide for found in found_all]
    )
    return Variational(guide, leading[0], found_all[0].elbo, len(tasks))


def _weighted(
    target: Any,
    argument: Any,
    optima: Sequence[Optimum],
    run: Run,
) -> tuple[list[dict[str, Tensor]], Tensor]:
    """Values at the optima that carry weight, the weightiest first, and their weights."""
    leading = [one.values for one in optima[:MOST_OPTIMA]]
    if len(leading) == 1:
        return leading, torch.ones(1, dtype=torch.float64)
    evidences = parallel_map(
        _evidence,
        [
            _Place(target, argument, values, run.checkpoints, f"evidence-{index}")
            for index, values in enumerate(leading)
        ],
        workers=run.workers,
        progress=run.progress,
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
