"""The no-U-turn sampler on the exact marginal model, chains in parallel."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyro
import torch
from pyro.infer import MCMC, NUTS
from pyro.ops.stats import effective_sample_size, split_gelman_rubin
from torch import Tensor

from pyro_dynogp.inference.cascade_coordinates import potential_for_sampling
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.laplace import laplace
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.mode import best_optima, check_optimizer
from pyro_dynogp.inference.optimise.maximum import Optimizer
from pyro_dynogp.inference.posteriors import Sampled
from pyro_dynogp.inference.run import Run
from pyro_dynogp.layers.sites import Program
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import Records
from pyro_dynogp.support.errors import verify, whole
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import child_seeds, parallel_map, seeded

# How often a start is moved towards the mode, each time by a factor of sqrt(2).
MOVES = 40


@dataclass(frozen=True)
class Chains:
    """Draws of several chains.

    Attributes:
        draws: (chains, draws, *shape) of every latent site.
        r_hat: split R-hat of every site (*shape).
        effective_samples: of every site (*shape).
        divergences: number of divergent transitions after warm-up.
    """

    draws: dict[str, Tensor]
    r_hat: dict[str, Tensor]
    effective_samples: dict[str, Tensor]
    divergences: int


@dataclass(frozen=True)
class Nuts:
    """The no-U-turn sampler, from around the best optimum.

    Steps of the run are those of the climbs of models that are not linear.

    Attributes:
        chains: number of them. warmup, draws: of each.
        optimizer: for the starts, as of `Mode`.

    Raises:
        ValueError: on an unknown optimizer, or numbers below one, or below four for draws.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> model, method = dgp.LinearDynamicGP(1, pairs=1), dgp.Nuts(chains=1, warmup=5, draws=5)
        >>> fit = dgp.fit(model, record, method=method, restarts=1, workers=1, progress=False)
        >>> len(fit.draws["noise_sd"])
        5
    """

    chains: int = 4
    warmup: int = 500
    draws: int = 500
    optimizer: Optimizer | None = None

    def __post_init__(self) -> None:
        verify(chains=self.chains, warmup=self.warmup)
        whole(4).check("draws", self.draws)  # fewer make no statistic of a chain
        check_optimizer(self.optimizer)

    def check(self, model: Model, *, warm: bool) -> None:
        """Every model can be sampled; not every optimizer finds its mode."""
        check_optimizer(self.optimizer, model)

    def __call__(self, problem: Problem, run: Run) -> Fitted:
        """Draws of all chains, one after the other."""
        optima = best_optima(problem, run, self.optimizer, None if problem.model.is_linear
                             else run.steps)  # fmt: skip
        best = optima[0]
        chain = sample_posterior(
            problem.target,
            problem.records,
            best.values,
            run,
            chains=self.chains,
            draws=self.draws,
            warmup=self.warmup,
        )
        diagnostics = {"divergences": float(chain.divergences), "chains": float(self.chains),
                       "warmup": float(self.warmup)}  # fmt: skip
        for site, values in chain.r_hat.items():
            diagnostics[f"r_hat {site}"] = float(values.max())
        for site, values in chain.effective_samples.items():
            diagnostics[f"effective samples {site}"] = float(values.min())
        draws = FrozenMapping({k: v.flatten(0, 1) for k, v in chain.draws.items()})
        energies = [optimum.energy for optimum in optima]
        return problem.fitted(
            run, Sampled(draws), draws, best.values, best.history, energies, diagnostics
        )


@dataclass(frozen=True)
class _Task:
    model: Program
    records: Records
    values: dict[str, Tensor]
    centre: np.ndarray
    root: np.ndarray
    draws: int
    warmup: int
    target_accept: float
    seed: int
    progress: bool


def _run_chain(task: _Task) -> tuple[Tensor, int]:
    """Draws (draws, d) in the potential's coordinates, and how many moves of a chain diverged."""
    with seeded(task.seed):
        potential = potential_for_sampling(task.model, (task.records,), task.values)
        centre, root = torch.tensor(task.centre), torch.tensor(task.root)

        def energy(parameters: dict[str, Tensor]) -> Tensor:
            x = parameters["x"]
            try:
                with pyro.validation_enabled(False):
                    return potential.energy(centre + root @ x, jacobian=True)
            except ValueError:  # poles or covariance out of floating-point range: a divergence
                return math.nan * x.sum()

        # Coordinates in which the posterior is nearly standard normal; chains start apart.
        start = within_reach(energy, torch.randn(centre.shape[0], dtype=torch.float64))
        kernel = NUTS(
            potential_fn=energy,
            target_accept_prob=task.target_accept,
            max_tree_depth=8,
            # The first windows of the adaptation have fewer draws than there are dimensions: where
            # the coordinates are good already it only makes them worse (tenfold steps).
            adapt_mass_matrix=not potential.nearly_normal,
            full_mass=not potential.nearly_normal,
        )
        mcmc = MCMC(
            kernel,
            num_samples=task.draws,
            warmup_steps=task.warmup,
            initial_params={"x": start},
            disable_progbar=not task.progress,
        )
        mcmc.run()
        x = mcmc.get_samples()["x"]
        divergences = len(mcmc.diagnostics()["divergences"]["chain 0"])
    return centre + x @ root.mT, divergences


def within_reach(energy: Callable[[dict[str, Tensor]], Tensor], start: Tensor) -> Tensor:
    """The start, moved towards the mode at zero until the posterior has weight there.

    The Laplace approximation has draws where a density that is no Gaussian is tens of orders of
    magnitude below what it is at the mode. A chain that begins there never finds a step.
    """
    with torch.no_grad():
        limit = energy({"x": torch.zeros_like(start)}) + 2.0 * start.numel()
        for _ in range(MOVES):
            if energy({"x": start}) < limit:  # not if it is not a number
                break
            start = start / math.sqrt(2.0)
    return start


def sample_posterior(
    model: Program,
    records: Records,
    values: dict[str, Tensor],
    run: Run,
    *,
    chains: int = 4,
    draws: int = 500,
    warmup: int = 500,
    target_accept: float = 0.8,
) -> Chains:
    """Run NUTS from around the posterior mode `values`.

    Coordinates are whitened by the Laplace approximation at the mode. Those of a cascade are the
    ones of `coordinates`; other models have a dense mass matrix, which warm-up adapts, besides.
    Each chain starts at a draw of the approximation, or between it and the mode
    (`within_reach`).
    """
    potential = potential_for_sampling(model, (records,), values)
    z, root = laplace(potential, values)
    tasks = [
        _Task(
            model,
            records,
            values,
            z,
            root,
            draws,
            warmup,
            target_accept,
            child,
            run.progress and i == 0,
        )
        for i, child in enumerate(child_seeds(run.seed, chains))
    ]
    results = parallel_map(_run_chain, tasks, workers=run.workers)
    drawn = torch.stack([x for x, _ in results])
    with torch.no_grad():
        sites = {k: v.contiguous() for k, v in potential.unpack(drawn).items()}
    several = chains > 1
    return Chains(
        draws=sites,
        r_hat={k: split_gelman_rubin(v) for k, v in sites.items()} if several else {},
        effective_samples={k: effective_sample_size(v) for k, v in sites.items()},
        divergences=sum(count for _, count in results),
    )
