"""Importance sampling in rounds, each from a mixture that the draws so far have shaped.

Draws of all rounds have weights by the mixture of all proposals so far (adaptive multiple
importance sampling: Cornuet, Marin, Mira & Robert, Scand. J. Stat. 39:798, 2012). Components take
the means and covariances that the weighted draws have, each draw shared out by the components'
probabilities (population Monte Carlo: Cappe, Douc, Guillin, Marin & Robert, Stat. Comput. 18:447,
2008). Weights are tempered until a tenth of a round is effective, so that no component collapses
around a few draws. No gradient is needed: a round costs as much as a few steps of annealing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import logsumexp
from torch import Tensor

from pyro_dynogp.inference.pareto import effective, psis
from pyro_dynogp.inference.student_mixture import StudentMixture

# Share of a round that tempered weights keep effective, and so many draws for each dimension.
EFFECTIVE, EACH = 0.1, 3.0
# Least weight of a component.
LEAST = 0.02
# Log-densities (S,) at vectors (S, d).
Density = Callable[[Tensor], np.ndarray]


@dataclass(frozen=True, eq=False)
class Adapted:
    """What rounds of importance sampling come to.

    Attributes:
        z: (S, d) draws of all rounds. log_target: (S,). log_proposal: (S,) of the mixture of all
            proposals. log_weights: (S,) normalised, smoothed. k: Pareto shape of the ratios.
        proposal: that the next round would have. rounds: how many there were.
        settled: whether they gave enough draws.
    """

    z: Tensor
    log_target: np.ndarray
    log_proposal: np.ndarray
    log_weights: np.ndarray
    k: float
    proposal: StudentMixture
    rounds: int
    settled: bool = False

    @property
    def effective(self) -> float:
        """How many equal weights say as much."""
        return effective(self.log_weights)


def adapt(
    start: StudentMixture,
    target: Density,
    count: int,
    seed: int,
    enough: Callable[[Adapted], bool],
    rounds: int,
) -> Adapted:
    """Rounds of `count` draws until there are enough: in the first, or in two on end.

    A k that is good once among many rounds is so by chance; a round that finds more of the target
    raises it again.

    Args:
        start: first proposal. target: log-density. count: draws of a round. seed: of them.
        enough: whether a round leaves enough. rounds: most.
    """
    proposals: list[StudentMixture] = []
    z = torch.zeros((0, start.loc.shape[1]), dtype=torch.float64)
    log_target, log_each = np.zeros(0), np.zeros((0, 0))
    proposal, before = start, True
    while True:
        fresh = proposal.draw(count, seed + len(proposals))
        # Densities of proposals so far at fresh draws, and of the new one at all.
        past = [one.log_prob(fresh).numpy() for one in proposals]
        z = torch.cat([z, fresh])
        left = np.concatenate([log_each, np.reshape(past, (len(past), count))], 1)
        log_each = np.concatenate([left, proposal.log_prob(z).numpy()[None]])
        log_target = np.concatenate([log_target, target(fresh)])
        proposals.append(proposal)
        log_proposal = logsumexp(log_each, 0) - np.log(len(proposals))
        ratio = log_target - log_proposal
        log_weights, k = np.full(len(z), -np.log(len(z))), np.inf
        there = bool(np.isfinite(ratio).any())
        if there:
            log_weights, shape = psis(ratio)
            k = float(shape)
        found = Adapted(z, log_target, log_proposal, log_weights, k, proposal, len(proposals))
        now = there and enough(found)
        if (now and before) or not there:
            return replace(found, settled=now)
        before = now
        proposal = _shaped(proposal, z, _tempered(ratio, max(EFFECTIVE * count, EACH * z.shape[1])))
        if found.rounds == rounds:
            return replace(found, proposal=proposal)


def _tempered(ratio: np.ndarray, least: float) -> np.ndarray:
    """Weights (S,), of the highest power of the ratios at which so many stay effective."""
    there = np.isfinite(ratio)

    def weights(power: float) -> np.ndarray:
        scaled = np.full(len(ratio), -np.inf)
        scaled[there] = power * ratio[there]
        return scaled - logsumexp(scaled)

    if effective(weights(1.0)) >= least:
        return np.asarray(np.exp(weights(1.0)))
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(weights(middle)) >= least else (low, middle)
    return np.asarray(np.exp(weights(low)))


def _shaped(before: StudentMixture, z: Tensor, weights: np.ndarray) -> StudentMixture:
    """The mixture with the moments of weighted draws, shrunk to the covariances before.

    What few draws say of a covariance counts little: d over d and their effective number is the
    share of the one before.
    """
    d = z.shape[1]
    shares = torch.softmax(before.components(z), -1) * torch.from_numpy(weights)[:, None]
    total = shares.sum(0)
    loc, roots, kept = [], [], torch.nonzero(total > LEAST)[:, 0].tolist()
    for index in kept:
        own = shares[:, index] / total[index]
        centre = own @ z
        off = z - centre
        root = before.scale_tril[index]
        share = d / (d + 1.0 / float(own.square().sum()))
        covariance = (1.0 - share) * ((off.mT * own) @ off) + share * (root @ root.mT)
        loc.append(centre)
        roots.append(torch.linalg.cholesky(0.5 * (covariance + covariance.mT)))
    return StudentMixture(total[kept] / total[kept].sum(), torch.stack(loc), torch.stack(roots))
