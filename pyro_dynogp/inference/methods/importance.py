"""The posterior of all parameters by importance sampling around the optima."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import torch

from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.importance_sampling import Sampled as Found
from pyro_dynogp.inference.importance_sampling import sample_around
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.mode import best_optima, check_optimizer
from pyro_dynogp.inference.optimise.maximum import Optimizer, Optimum
from pyro_dynogp.inference.pareto import good_k
from pyro_dynogp.inference.posterior_draws import PosteriorDraws
from pyro_dynogp.inference.posteriors import Sampled
from pyro_dynogp.inference.run import Run, at_least_one
from pyro_dynogp.models.model import Model
from pyro_dynogp.support.checkpoints import Piece
from pyro_dynogp.support.frozen import FrozenMapping


@dataclass(frozen=True)
class Importance:
    """Draws of all parameters: importance sampling around the optima, annealed where that fails.

    Optima are found as by `Mode`. Draws of Student-t distributions around up to four of them get
    weights by the posterior; where Pareto's k of the weights is too high, and the model has no
    static functions, they are annealed to it (`inference.importance_sampling`). Bands then know
    the uncertainty of every parameter, and each optimum has its posterior probability.

    Attributes:
        draws: posterior draws to keep, of equal weight.
        optimizer: for the climbs, as of `Mode`.

    Raises:
        ValueError: on an unknown optimizer, or fewer than one draw.
    """

    draws: int = 300
    optimizer: Optimizer | None = None

    def __post_init__(self) -> None:
        at_least_one(draws=self.draws)
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
        return with_draws_around(problem, optima, run, self.draws)


def with_draws_around(problem: Problem, optima: list[Optimum], run: Run, draws: int) -> Fitted:
    """The fit that draws around several optima, the best first, are."""
    energies = [optimum.energy for optimum in optima]
    found = _kept(problem, optima, run)
    if not found.annealed and not found.k <= good_k(len(found.draws)):
        warnings.warn(
            f"fit: Pareto's k of the posterior's draws is {found.k:.2f} (good: up to "
            f"{good_k(len(found.draws)):.2f}): do not trust their weights, and bands made of them. "
            "Use method='nuts' or 'svi', or a smaller model.",
            stacklevel=2,
        )
    best = optima[0]
    values = FrozenMapping(found.resampled(draws))
    diagnostics = {
        "iterations": float(len(best.history)),
        "pareto_k": found.k,
        "optima": float(found.optima),
        "annealed": float(found.annealed),
        "independent draws": found.independent,
    }
    return problem.fitted(
        run, Sampled(values, "importance", source=found.draws), values, best.values,
        best.history, np.array(energies), diagnostics,
    )  # fmt: skip


def _kept(problem: Problem, optima: list[Optimum], run: Run) -> Found:
    """What importance sampling comes to, from the run's folder where it was there before."""

    def compute() -> Piece:
        found = sample_around(
            problem.target,
            problem.records,
            [optimum.values for optimum in optima],
            seed=run.seed,
            progress=run.progress,
        )
        draws = found.draws
        kept = {f"site {name}": value for name, value in draws.values.items()}
        kept |= {f"mode {name}": value for name, value in found.mode.items()}
        arrays = {
            "log_p": draws.log_p, "log_q": draws.log_q, "ancestor": draws.ancestor,
            "log_weights": found.log_weights, "k": found.k, "optima": found.optima,
        }  # fmt: skip
        kept |= {name: torch.as_tensor(x) for name, x in arrays.items() if x is not None}
        return kept | {"kind": torch.tensor(list(draws.kind.encode()), dtype=torch.uint8)}

    piece = run.checkpoints.piece("importance", compute)
    sites = {name[5:]: value for name, value in piece.items() if name.startswith("site ")}
    arrays = {name: piece[name].numpy() for name in ("log_p", "log_q", "ancestor") if name in piece}
    draws = PosteriorDraws(
        FrozenMapping({name: sites[name] for name in optima[0].values}),
        arrays["log_p"],
        arrays.get("log_q"),
        np.zeros(len(arrays["log_p"]), dtype=int),
        bytes(piece["kind"].tolist()).decode(),
        arrays.get("ancestor"),
    )
    return Found(
        draws, piece["log_weights"].numpy(), float(piece["k"]), int(piece["optima"]),
        draws.log_q is None,
        FrozenMapping({name: piece[f"mode {name}"] for name in draws.values}),
    )  # fmt: skip
