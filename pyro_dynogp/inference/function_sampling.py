r"""Draws of the posterior of all parameters of models with static functions.

Such a posterior has 50 dimensions and more, half of them tight along curves. Student-t
distributions around the optima are first proposals, which rounds of draws shape
(`inference.adaptive_importance`). Where Pareto's k says that their ratios are to be trusted, these
are the result. Else particles are annealed from the last proposal to the posterior and, along short
records, others from the prior: an optimum of a few hundred samples may be a needle, and most of the
posterior far from it. What each run estimates the evidence to be says how many of the chains that
follow begin at its particles (`pooled` does the same with particles of linear models). These chains
of Hamiltonian moves forget what few ancestors the particles have; their states are the draws.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.inference.adaptive_importance import Adapted, adapt
from pyro_dynogp.inference.cascade_coordinates import StraightPotential
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.importance_sampling import (
    Sampled,
    enough_draws,
    from_prior,
    plural,
    proposal_of,
    run_of,
    samples_of,
    systematic,
    weighed,
)
from pyro_dynogp.inference.methods.annealed import Annealed, Joint
from pyro_dynogp.inference.methods.moves import Chains, chains_from, root_of
from pyro_dynogp.inference.posterior_draws import PosteriorDraws
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import seeded

Values = Mapping[str, Tensor]

# Draws of a round that shapes the proposal, and most rounds.
ROUND, ROUNDS = 500, 4
# Particles that are annealed from the proposal, and from the prior.
PARTICLES, FROM_PRIOR = 100, 200
# Samples up to which particles of the prior are annealed, too, of forward models and with feedback.
# With 100 they find 10 to 100 nats more evidence than others in 12 of 14 systems. With 200 they
# find less in four of five forward ones; with feedback forecasts are 2 to 36 % better.
SHORT, SHORT_FEEDBACK = 150, 250
# Runs' evidence that counts as none [nats]: with other seeds it differs by 1 to 25.
DOUBT = 5.0
# Chains, their moves until the step size is found, and those that are kept.
CHAINS, BURNT, KEPT = 24, 6, 10


class NoDrawsError(RuntimeError):
    """No particle got from the proposal, or from the prior, to the posterior.

    Attributes:
        k: Pareto shape of the proposal's ratios.
    """

    def __init__(self, k: float) -> None:
        super().__init__("annealing: no run got to the posterior.")
        self.k = k


@dataclass(frozen=True, eq=False)
class Island:
    """A run of annealing, and the coordinates that its particles have.

    Attributes:
        run: the particles. potential: of the coordinates. base: root (d, d) of a covariance that
            theirs is shrunk to, None for their variances.
    """

    run: Annealed
    potential: Potential
    base: Tensor | None

    def chains(self, count: int, samples: int, seed: int, times: int = 1) -> Chains:
        """Chains that begin at so many of the particles; `times` as of `sample_functions`."""
        z = self.run.z
        weight = torch.full((len(z),), 1.0 / len(z), dtype=torch.float64)
        begin = z[systematic(np.ones(len(z)), count)]
        target = Joint(self.potential, samples)
        root = root_of(z, weight, self.base)
        burnt, kept = times * BURNT, times * KEPT
        return chains_from(begin, target, root, burnt=burnt, kept=kept, seed=seed)


def sample_functions(
    model: Model,
    records: Sequence[PreparedRecord],
    optima: Sequence[Values],
    *,
    seed: int = 0,
    progress: bool = False,
    times: int = 1,
) -> tuple[Sampled, float]:
    """Draws of the posterior of a model with static functions, and R-hat of their log-density.

    R-hat is 1 where the draws are independent.

    Args:
        model: with all trajectories integrated out. records: to which it is fitted.
        optima: values of all sites, the best first. seed: of the draws.
        progress: whether annealing shows a bar.
        times: as many particles, and moves of chains, as usual.

    Raises:
        NoDrawsError: where annealing fails from every start.
    """
    samples = samples_of(records)
    with seeded(seed):
        leading, weights = weighed(Potential(model, (records,), optima[0]), optima)
        straight = StraightPotential(model, (records,), leading[0])
        proposal = proposal_of(straight, leading, weights, steps=0)
        target = Joint(straight, samples)
        found = adapt(proposal, target.log_prob, ROUND, seed, enough_draws, ROUNDS)
        kind = f"Student-t around {plural(len(weights))}"
        if found.settled:
            return _weighted(found, straight, kind, leading[0], len(weights)), 1.0
        base = found.proposal.scale_tril[0]
        z = found.proposal.draw(times * PARTICLES, seed)
        ran = run_of(found.proposal, z, target, seed, progress, base)
        islands = [Island(run, straight, base) for run in ran]
        kinds = [kind] if ran else []
        short = SHORT_FEEDBACK if model.has_feedback else SHORT
        if samples <= short and model.priors == "default":
            plain = Potential(model, (records,), leading[0])
            ran = from_prior(plain, times * FROM_PRIOR, samples, seed, progress)
            islands += [Island(run, plain, None) for run in ran]
            kinds += ["the prior"] if ran else []
        if not islands:
            raise NoDrawsError(found.k)
        chains = [
            (island.potential, island.chains(count, samples, seed, times))
            for island, count in zip(islands, shares(islands), strict=True)
            if count
        ]
    kind = f"{CHAINS} chains annealed from {' and from '.join(kinds)}"
    draws = _of_chains(chains, kind)
    log_weights = np.full(len(draws), -np.log(len(draws)))
    joined = Chains(
        torch.cat([each.z for _, each in chains], 1),
        torch.cat([each.log_target for _, each in chains], 1),
    )
    sampled = Sampled(draws, log_weights, found.k, False, len(weights), True, leading[0])
    return sampled, joined.r_hat


def shares(islands: Sequence[Island]) -> list[int]:
    """How many chains begin at each run's particles, by the evidence found.

    Estimates are so uncertain that they count in units of `DOUBT`, not of nats: else chance would
    say which run gives all draws.
    """
    evidence = np.array([island.run.log_evidence for island in islands]) / DOUBT
    chosen = systematic(np.exp(evidence - evidence.max()), CHAINS)
    return [int((chosen == index).sum()) for index in range(len(islands))]


def _weighted(
    found: Adapted, potential: Potential, kind: str, mode: Values, optima: int
) -> Sampled:
    """Draws of the proposals with their ratios, where these are to be trusted."""
    there = np.isfinite(found.log_target)
    z = found.z[there]
    with torch.no_grad():
        values = FrozenMapping(potential.unpack(z))
        log_jacobian = potential.log_jacobian(z).numpy()
    draws = PosteriorDraws(
        values,
        found.log_target[there] - log_jacobian,
        found.log_proposal[there] - log_jacobian,
        np.zeros(len(z), dtype=int),
        kind if found.rounds == 1 else f"adapted from {kind}",
    )
    return Sampled(draws, found.log_weights[there], found.k, True, optima, False, mode)


def _of_chains(chains: Sequence[tuple[Potential, Chains]], kind: str) -> PosteriorDraws:
    """The states of all chains, each chain an ancestor of its own."""
    values: list[dict[str, Tensor]] = []
    log_p: list[np.ndarray] = []
    ancestor: list[np.ndarray] = []
    first = 0
    with torch.no_grad():
        for potential, found in chains:
            z = found.z.flatten(0, 1)
            values.append(potential.unpack(z))
            log_p.append((found.log_target.flatten() - potential.log_jacobian(z)).numpy())
            m, count = found.log_target.shape
            ancestor.append(first + np.tile(np.arange(count), m))
            first += count
    together = {name: torch.cat([each[name] for each in values]) for name in values[0]}
    number = np.concatenate(ancestor)
    return PosteriorDraws(
        FrozenMapping(together), np.concatenate(log_p), None, np.zeros(len(number), dtype=int),
        kind, number,
    )  # fmt: skip
