"""The variational posterior of an exact or collapsed model, around one optimum or several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.inference.density import Potential, heaviest
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.laplace import log_evidence
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.mode import best_optima, check_optimizer
from pyro_dynogp.inference.methods.normal import VariationalPosterior, variational
from pyro_dynogp.inference.methods.svi import Schedule
from pyro_dynogp.inference.optimise.maximum import Optimizer
from pyro_dynogp.inference.optimise.optimum import Optimum
from pyro_dynogp.inference.posteriors import Mixture, draws_of_guide
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.model import Model
from pyro_dynogp.support.checkpoints import Piece
from pyro_dynogp.support.errors import invalid, verify, warn
from pyro_dynogp.support.parallel import parallel_map, seeded

Values = dict[str, Tensor]
Hyperparameters = Literal["map", "normal", "multivariate normal"]

# Optima that a posterior can consist of.
MOST_OPTIMA = 4
# Least weight of one that counts.
LEAST_WEIGHT = 0.05
# Iterations of SVI around optima that are found already, and the divergence of a normal from the
# posterior [nats] that so few do not mend. (Wiener, Wiener-Hammerstein and feedback models: of nine
# normals nearer than that SVI left seven with an ELBO lower by 0.4 to 0.8 and raised none by more
# than 0.1; of twelve with up to 2 nats it raised four by 0.1 to 0.5, and two of five with more by
# hundreds.)
POLISH, UNMENDED = 60, 0.5
# Draws that are looked at, and nats for each free number from which on their loss is too large:
# ten times that of a normal with the density's curvature.
CHECKED, TOO_WIDE = 16, 5.0


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

    SVI begins at Laplace's approximation, does not start where that is as near to the posterior as
    its steps would come, and cannot end below it.

    Steps of the run are those of the climbs (of models that are not linear) and of SVI: by default
    1000, with static layers 60.

    Attributes:
        family: "map" fits inducing values, parameters of known functions and first states around up
            to four optima, with all else at the optimum, as the paper does; "normal" gives all
            sites independent normals, "multivariate normal" one for all sites, best for small
            models with well-excited inputs; "auto" is "map" where functions are learnt (Gaussian
            processes, and known ones in feedback with parameters), else "multivariate normal".
            (Beside functions in feedback a normal of all sites leaves what free runs have decided:
            of measured tanks, process noise made one-step errors more probable by 1800 nats, and
            forecasts were off by 0.5 V where they had been off by 0.3.)
        draws: posterior draws to keep.
        particles, learning_rate: of SVI.
        optimizer: for the starts, as of `Mode`.

    Raises:
        ValueError: on unknown names, or numbers below one.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> model, method = dgp.LinearDynamicGP(1, pairs=1), dgp.Normal(draws=40)
        >>> quick = {"restarts": 1, "steps": 20, "workers": 1, "progress": False}
        >>> fit = dgp.fit(model, record, method=method, **quick)
        >>> fit.method, len(fit.draws["noise_sd"])
        ('svi', 40)
    """

    family: Hyperparameters | Literal["auto"] = "auto"
    draws: int = 200
    particles: int = 8
    learning_rate: float = 0.02
    optimizer: Optimizer | None = None

    def __post_init__(self) -> None:
        if self.family not in ("auto", *get_args(Hyperparameters)):
            raise invalid(
                "family (hyperparameters)",
                expected="'map', 'normal' or 'multivariate normal'",
                got=repr(self.family),
            )
        verify(draws=self.draws, particles=self.particles, learning_rate=self.learning_rate)
        check_optimizer(self.optimizer)

    def check(self, model: Model, *, warm: bool) -> None:
        """Refuse "map" for a model in which nothing would be free, and unsuitable optimizers."""
        check_optimizer(self.optimizer, model)
        if self.family == "map" and not model.learns_function and not model.collapsed.state_sites:
            raise invalid(
                "hyperparameters",
                expected="'normal' or 'multivariate normal' for a cascade without static layers",
                got="'map'",
            )

    def family_for(self, model: Model) -> Hyperparameters:
        """The family, where "auto" leaves it to the model."""
        if self.family != "auto":
            return self.family
        return "map" if model.learns_function else "multivariate normal"

    def __call__(self, problem: Problem, run: Run) -> Fitted:
        """The normals around the best optima, and draws of them."""
        model = problem.model
        climbs = None if model.is_linear else run.steps
        return self.around(problem, best_optima(problem, run, self.optimizer, climbs), run)

    def around(self, problem: Problem, optima: Sequence[Optimum], run: Run) -> Fitted:
        """The same, of optima that are found, the best first."""
        model = problem.model
        family = self.family_for(model)
        steps = run.steps or (POLISH if model.has_function else 1000)
        found = posterior_of(
            problem,
            optima,
            family,
            run,
            Schedule(
                min(steps, POLISH) if family == "map" else steps, self.particles, self.learning_rate
            ),
        )
        with seeded(run.seed):
            drawn = draws_of_guide(found.guide, self.draws)
        tail = found.elbo[-50:]
        diagnostics = {
            "elbo": float(tail.mean()),
            "elbo_sd": float(tail.std()),
            "optima": float(found.optima),
        }
        draws = {name: drawn[name] for name in found.mode}
        free = free_sites(problem) if family == "map" else list(found.mode)
        warn_of_wide_draws(problem, found.mode, draws, free)
        energies = [optimum.energy for optimum in optima]
        return problem.fitted(
            run, found.guide, draws, found.mode, found.elbo, energies, diagnostics
        )


def free_sites(problem: Problem) -> list[str]:
    """Names of inducing values, parameters of known functions, and first states."""
    sites = problem.target.all_sites(problem.scaling, len(problem.records))
    return [site.name for site in sites if site.role == "free"]


def warn_of_wide_draws(
    problem: Problem,
    mode: Mapping[str, Tensor],
    draws: Mapping[str, Tensor],
    free: Sequence[str],
) -> None:
    """Warn where draws are far less likely than their mode: their bands are those of nothing.

    Draws of a normal that has the curvature of the density at its mode are half a nat for each
    free number less likely on average. A scale that is too large in a steep direction costs
    thousands, and no other figure shows it but the ELBO.

    Args:
        problem: model and records. mode: values of all sites. draws: (S, *shape) of all sites.
        free: names of the sites that are drawn.
    """
    count = min(CHECKED, len(next(iter(draws.values()))))
    points = [dict(mode), *({k: v[i] for k, v in draws.items()} for i in range(count))]
    potential = Potential(problem.target, (problem.records,), dict(mode))
    energies = potential.energies_at(points)
    loss, numbers = float(np.median(energies[1:]) - energies[0]), sum(mode[k].numel() for k in free)
    if loss > TOO_WIDE * numbers:
        warn(
            f"fit: half of the posterior's draws are less likely than its mode by {loss:.3g} nats "
            f"or more, where about {0.5 * numbers:.0f} are expected of {numbers} free numbers. The "
            "normal around the mode is too wide, and bands are not to be trusted. Try other "
            "restarts, more steps, or another optimizer; method='map' has the mode alone."
        )


@dataclass(frozen=True)
class _Around:
    """One optimum of a problem; of the sites some stay at it, others are free."""

    problem: Problem
    run: Run
    fixed: Values
    free: Values
    key: str
    schedule: Schedule

    def posterior(self) -> VariationalPosterior:
        """The normal of the free sites."""
        return variational(
            self.problem.target, (self.problem.records,), self.free, self.run, self.schedule,
            key=self.key, fixed=self.fixed, close=UNMENDED,
        )  # fmt: skip

    def evidence(self) -> float:
        """Laplace's approximation of log p(y) [nats]; all sites are free."""

        def compute() -> Piece:
            potential = Potential(self.problem.target, (self.problem.records,), self.free)
            found = log_evidence(potential, self.free)
            return {"evidence": torch.tensor(found, dtype=torch.float64)}

        return float(self.run.checkpoints.piece(self.key, compute)["evidence"])


def posterior_of(
    problem: Problem,
    optima: Sequence[Optimum],
    family: Hyperparameters,
    run: Run,
    schedule: Schedule,
) -> Variational:
    """Fit the posterior by SVI, from the optima.

    With "map" inducing values and first states have multivariate normals and everything else stays
    at the optimum, at up to `MOST_OPTIMA` of them: such a posterior has many modes, and no normal
    spans two. Their weights are those of `heaviest`, by Laplace's approximation for all sites.

    Args:
        problem: model and records. optima: the best first. family: of the posterior.
        run: seed, processes and so on. schedule: of SVI.
    """
    if family != "map":
        best = optima[0].values
        found = variational(
            problem.target,
            (problem.records,),
            dict(best),
            run,
            schedule,
            independent=family == "normal",
        )
        return Variational(found.guide, best, found.elbo, 1)
    leading, weights = _weighted(problem, optima, run)
    free = free_sites(problem)
    each = replace(run, progress=run.progress and len(leading) == 1)
    tasks = [
        _Around(
            problem,
            each,
            {k: v for k, v in values.items() if k not in free},
            {k: v for k, v in values.items() if k in free},
            f"posterior-{index}",
            schedule,
        )
        for index, values in enumerate(leading)
    ]
    normals = parallel_map(
        _Around.posterior,
        tasks,
        workers=run.workers,
        progress=run.progress and len(tasks) > 1,
        description="posterior",
        news=lambda done: f"elbo {max(level(normal) for normal in done):.2f}",
    )
    guide = Mixture.of(weights, [task.fixed for task in tasks], [n.guide for n in normals])
    return Variational(guide, leading[0], normals[0].elbo, len(tasks))


def _weighted(problem: Problem, optima: Sequence[Optimum], run: Run) -> tuple[list[Values], Tensor]:
    """Values at the optima that carry weight, the weightiest first, and their weights."""
    leading = [optimum.values for optimum in optima[:MOST_OPTIMA]]
    if len(leading) == 1:
        return leading, torch.ones(1, dtype=torch.float64)
    evidences = parallel_map(
        _Around.evidence,
        [
            _Around(problem, run, {}, values, f"evidence-{index}", Schedule())
            for index, values in enumerate(leading)
        ],
        workers=run.workers,
        progress=run.progress,
        description="evidence",
        news=lambda done: f"log evidence {max(done):.2f}",
    )
    levels = torch.tensor(evidences, dtype=torch.float64)
    order, weights = heaviest(levels, leading[0], least=LEAST_WEIGHT, most=MOST_OPTIMA)
    return [leading[index] for index in order], weights


def level(found: VariationalPosterior) -> float:
    """ELBO over the last steps."""
    return float(found.elbo[-50:].mean())
