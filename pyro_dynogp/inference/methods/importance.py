"""The posterior of all parameters by importance sampling around the optima."""

from __future__ import annotations

from dataclasses import dataclass, replace

from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.function_sampling import NoDrawsError, sample_functions
from pyro_dynogp.inference.importance_sampling import Sampled as Found
from pyro_dynogp.inference.importance_sampling import sample_around, samples_of
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.mode import at_optimum, best_optima, check_optimizer
from pyro_dynogp.inference.methods.optima import Normal
from pyro_dynogp.inference.optimise.maximum import Optimizer
from pyro_dynogp.inference.optimise.optimum import Optimum
from pyro_dynogp.inference.pareto import good_k
from pyro_dynogp.inference.posteriors import Sampled
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.model import Model
from pyro_dynogp.support.errors import verify_fields, warn
from pyro_dynogp.support.frozen import FrozenMapping

# Samples of a record beyond which draws are not annealed by default, of linear models with
# Gaussian noise, of others, and with feedback: normals around kernels by the evidence do as well
# there, in a third of the time. Of a linear model annealing takes a quarter of the climb along 1400
# samples (two pairs), 20 to 40 % along 2000 (five pairs), 40 to 90 % along 4000.
LONGEST_LINEAR, LONGEST, LONGEST_FEEDBACK = 2000, 1000, 150


@dataclass(frozen=True)
class Importance:
    """Draws of all parameters: importance sampling around the optima, annealed where that fails.

    Optima are found as by `Mode`. Draws of Student-t distributions around up to four of them get
    weights by the posterior. Where Pareto's k of the weights is too high, rounds of draws shape the
    distributions (of models under Gaussian noise); where it stays too high, draws are annealed to
    the posterior (`inference.importance_sampling`; of models with static functions
    `inference.function_sampling`, along 150 samples or fewer, 250 with feedback, from the prior,
    too).
    Bands then know the uncertainty of every parameter, and each optimum has its posterior
    probability.

    Annealing takes about as long as the climbs or longer, and matters less the longer a record is.
    Along more than `longest` samples, where k asks for it, the fit is the posterior mode instead.
    Models with static functions have along more than `longest` samples the posterior that `Normal`
    gives: inducing values, parameters of known functions in feedback, and first states alone have
    draws, all else stays at its optimum. Without functions to learn (`Product`) it is a normal of
    all parameters, where k asks for another one.

    Attributes:
        draws: posterior draws to keep, of equal weight.
        longest: most samples along which draws are annealed; None for 2000 of a linear model with
            Gaussian noise, 1000 of others, 150 with feedback.
        optimizer: for the climbs, as of `Mode`.

    Raises:
        ValueError: on an unknown optimizer, or fewer than one draw.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> model, method = dgp.LinearDynamicGP(1, pairs=1), dgp.Importance(draws=50)
        >>> fit = dgp.fit(model, record, method=method, restarts=1, workers=1, progress=False)
        >>> len(fit.draws["noise_sd"])
        50
    """

    draws: int = 300
    longest: int | None = None
    optimizer: Optimizer | None = None

    def __post_init__(self) -> None:
        verify_fields(self)
        check_optimizer(self.optimizer)

    def check(self, model: Model, *, warm: bool) -> None:
        """Every model; not every optimizer takes every model."""
        check_optimizer(self.optimizer, model)

    @property
    def identity(self) -> object:
        """All options."""
        return self

    def __call__(self, problem: Problem, run: Run) -> Fitted:
        """The draws, the mode and how it was found; steps of the run are those of each start."""
        optima = best_optima(problem, run, self.optimizer, run.steps)
        return with_draws_around(problem, optima, run, self.draws, self.longest)


def usual_longest(model: Model) -> int:
    """Most samples along which draws are annealed by default."""
    if model.has_feedback:
        return LONGEST_FEEDBACK
    return LONGEST_LINEAR if model.is_linear and model.likelihood.gaussian else LONGEST


def with_draws_around(
    problem: Problem,
    optima: list[Optimum],
    run: Run,
    draws: int,
    longest: int | None = None,
) -> Fitted:
    """The fit that draws around several optima, the best first, are."""
    model = problem.model
    longest = longest or usual_longest(model)
    # Process noise that free runs have ruled out would come back as draws are sought.
    if model.has_gaussian_process or (
        model.learns_function and samples_of(problem.records) > longest
    ):
        return _of_functions(problem, optima, run, draws, longest)
    found = sample_around(
        problem.target,
        problem.records,
        [optimum.values for optimum in optima],
        longest=longest,
        seed=run.seed,
        progress=run.progress,
    )
    failed = not found.annealed and not found.trusted
    if failed and model.has_function:
        return _of_functions(problem, optima, run, draws, longest)
    if failed and samples_of(problem.records) > longest:
        mode = at_optimum(problem.model, optima, run.seed, problem.records)
        return replace(mode, diagnostics=FrozenMapping({**mode.diagnostics, "pareto_k": found.k}))
    if failed:
        good = good_k(len(found.draws))
        warn(
            f"fit: Pareto's k of the posterior's draws is {found.k:.2f} (good: up to {good:.2f}), "
            f"and they say as much as {found.independent:.0f} independent ones: do not trust their "
            "weights, and bands made of them. Use method='nuts' or 'svi', or a smaller model."
        )
    return _fitted(problem, optima, run, draws, found)


def _of_functions(
    problem: Problem, optima: list[Optimum], run: Run, draws: int, longest: int
) -> Fitted:
    """The fit of a model with static functions; normals where no draws are made."""
    if samples_of(problem.records) > longest:
        return Normal(draws=draws).around(problem, optima, run)
    values = [optimum.values for optimum in optima]
    try:
        found, r_hat = sample_functions(
            problem.target, problem.records, values, seed=run.seed, progress=run.progress
        )
    except NoDrawsError as error:
        warn(
            f"fit: no draws got to the posterior of all parameters (Pareto's k {error.k:.2f}). "
            "Inducing values and first states have a normal posterior instead, all else stays at "
            "its optimum, and bands are too narrow. Use method='nuts', or a smaller model."
        )
        fit = Normal(draws=draws).around(problem, optima, run)
        return replace(fit, diagnostics=FrozenMapping({**fit.diagnostics, "pareto_k": error.k}))
    return _fitted(problem, optima, run, draws, found, r_hat=r_hat)


def _fitted(
    problem: Problem, optima: list[Optimum], run: Run, draws: int, found: Found, **more: float
) -> Fitted:
    """The fit with draws that were found."""
    values = FrozenMapping(found.resampled(draws))
    diagnostics = {
        "iterations": float(len(optima[0].history)),
        "pareto_k": found.k,
        "optima": float(found.optima),
        "annealed": float(found.annealed),
        "independent draws": found.independent,
        **more,
    }
    return problem.fitted(
        run, Sampled(values, "importance", source=found.draws), values, found.mode,
        optima[0].history, [optimum.energy for optimum in optima], diagnostics,
    )  # fmt: skip
