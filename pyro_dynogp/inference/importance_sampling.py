r"""Draws of the posterior of all parameters by importance sampling around its optima.

The proposal is a mixture of multivariate Student-t distributions, one around each optimum that
carries weight, with the covariance that Laplace's approximation gives there, in coordinates without
bent ridges (`inference.cascade_coordinates`). Every draw has the density of the whole mixture, so
that ratios of the posterior over it give each optimum its posterior probability (Owen 2013, chapter
9). Where Pareto's k says that the ratios are not to be trusted, rounds of draws of linear models
shape the mixture (`inference.adaptive_importance`), and where that does not do, draws are annealed
from it to the posterior itself (`inference.methods.annealed`). Of posteriors that repeat themselves
with pairs in another order one copy is looked at (`inference.pair_order`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import logsumexp
from torch import Tensor

from pyro_dynogp.inference.adaptive_importance import Adapted, adapt
from pyro_dynogp.inference.cascade_coordinates import StraightPotential
from pyro_dynogp.inference.density import WALL, Potential, heaviest
from pyro_dynogp.inference.laplace import laplace, log_evidence
from pyro_dynogp.inference.log_joint import Direct
from pyro_dynogp.inference.methods.annealed import (
    Annealed,
    Joint,
    Prior,
    anneal,
)
from pyro_dynogp.inference.pair_order import PairOrder
from pyro_dynogp.inference.pareto import effective, good_k
from pyro_dynogp.inference.posterior_draws import PosteriorDraws
from pyro_dynogp.inference.student_mixture import StudentMixture
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import seeded

Values = Mapping[str, Tensor]

# Optima that the proposal has components around, and the least weight of one.
MOST_OPTIMA, LEAST_WEIGHT = 4, 0.02
# Optima whose energies differ by less [nats] are one.
SAME = 0.01
# Iterations towards the centre of each component, which need not be found to the last digit.
STEPS = 25
# Samples of the record times draws, which bounds the work, and the draws between which it does.
WORK, FEWEST, MOST = 300_000, 200, 1000
# Most rounds of importance sampling, and effective draws at which they end.
ROUNDS, ENOUGH = 8, 100
# Particles that are annealed, as a share of the draws.
PARTICLES = 0.5
# Samples up to which particles of the prior are annealed, too: with few, most of the posterior may
# be far from all optima. With 60 they found 2 to 4 nats more evidence in four of five systems, with
# 100 they find less, from which shares by evidence suffer.
SHORT = 80
# Most samples of a record along which draws are annealed: with Gaussian noise, and without.
LONGEST, LONGEST_OTHERS = 20_000, 2_000


@dataclass(frozen=True, eq=False)
class Sampled:
    """What importance sampling comes to.

    Attributes:
        draws: with the ratios of the proposal, or of the posterior itself where annealed.
        log_weights: (S,) normalised, smoothed. k: Pareto shape of the proposals' ratios.
        trusted: whether it says that they are good. annealed: whether draws were.
        optima: how many components the first proposal has.
        mode: values of all sites at the optimum that carries most weight.
    """

    draws: PosteriorDraws
    log_weights: np.ndarray
    k: float
    trusted: bool
    optima: int
    annealed: bool
    mode: Values

    @property
    def independent(self) -> float:
        """Effective number of independent draws."""
        if self.draws.ancestor is None:
            return effective(self.log_weights)
        sizes = np.unique(self.draws.ancestor, return_counts=True)[1] / len(self.draws)
        return float(1.0 / np.square(sizes).sum())

    def resampled(self, count: int) -> dict[str, Tensor]:
        """Draws (`count`, *shape) of equal weight, by systematic resampling."""
        chosen = systematic(np.exp(self.log_weights), count)
        return {name: x[chosen] for name, x in self.draws.values.items()}


def systematic(weights: np.ndarray, count: int, shift: float = 0.5) -> np.ndarray:
    """Indices (`count`,) in proportion to weights (S,)."""
    edges = np.cumsum(weights) / weights.sum()
    at = (np.arange(count) + shift) / count
    return np.minimum(np.searchsorted(edges, at), len(weights) - 1)


def draws_for(samples: int) -> int:
    """How many draws a record of so many samples is worth."""
    return int(np.clip(WORK // max(samples, 1), FEWEST, MOST))


def can_anneal(model: Model, samples: int) -> bool:
    """Whether annealing can be afforded, at some 30 densities a draw.

    Not where static functions make every density a run of the moment-matching filter, nor along
    records so long that parameters are all but known.
    """
    exact = model.is_linear and model.likelihood.gaussian
    return not model.has_function and samples <= (LONGEST if exact else LONGEST_OTHERS)


def sample_around(
    model: Model,
    records: Sequence[PreparedRecord],
    optima: Sequence[Values],
    *,
    count: int | None = None,
    longest: int | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Sampled:
    """Draws of the posterior from around its optima.

    Args:
        model: with all trajectories integrated out. records: to which it is fitted.
        optima: values of all sites, the best first. count: of draws; None for what the length of
            the records suggests. longest: most samples along which they are annealed; None for
            what can be afforded. seed: of them. progress: whether annealing shows a bar.
    """
    samples = samples_of(records)
    count = count or draws_for(samples)
    with seeded(seed):
        leading, weights = weighed(Potential(model, (records,), optima[0]), optima)
        potential = StraightPotential(model, (records,), leading[0])
        proposal = proposal_of(potential, leading, weights)
        order = PairOrder.around(potential, proposal.loc[0].numpy())
        target = Joint(potential, samples, order)
        several = potential.linear is not None  # others cost too much for more than one round
        enough, rounds = (enough_draws, ROUNDS) if several else (_good, 1)
        found = adapt(proposal, target.log_prob, count, seed, enough, rounds)
        kind = f"Student-t around {plural(len(weights))}"
        trusted = found.settled
        islands, ran = [], []
        if trusted and found.rounds > 1:
            islands, kind = [_resampled(found, count, order)], f"adapted from {kind}"
        if not (trusted and found.rounds == 1) and _can_anneal(model, samples, longest):
            few = max(FEWEST, int(PARTICLES * count))
            if not trusted:
                z = found.proposal.draw(few, seed)
                ran = run_of(found.proposal, z, target, seed, progress)
                kind = f"annealed from {kind}" if ran else kind
            if samples <= SHORT and model.priors == "default":
                plain = Potential(model, (records,), leading[0])
                others = from_prior(plain, few, samples, seed, progress)
                with torch.no_grad():
                    ran += [replace(x, z=potential.pack(plain.unpack(x.z))) for x in others]
                also = "from" if kind.startswith("annealed") else "annealed from"
                kind += f" and {also} the prior" if others else ""
        islands += ran
        there = np.isfinite(found.log_target) | ~np.isfinite(found.log_target).any()
        z, ancestor, log_weights = found.z[there], None, found.log_weights[there]
        if islands:
            z, ancestor = pooled(islands, count)
            log_weights = np.full(count, -np.log(count))
        log_target = Joint(potential, samples).log_prob(z)
        with torch.no_grad():
            values = FrozenMapping(potential.unpack(z))
            log_jacobian = potential.log_jacobian(z).numpy()
    draws = PosteriorDraws(
        values,
        log_target - log_jacobian,
        None if islands else found.log_proposal[there] - log_jacobian,
        np.zeros(len(z), dtype=int),
        kind,
        ancestor,
    )
    return Sampled(draws, log_weights, found.k, trusted, len(weights), bool(ran), leading[0])


def _can_anneal(model: Model, samples: int, longest: int | None) -> bool:
    return (longest is None or samples <= longest) and can_anneal(model, samples)


def _good(found: Adapted) -> bool:
    """Whether Pareto's k says that the ratios are to be trusted."""
    return found.k <= good_k(len(found.z))


def enough_draws(found: Adapted) -> bool:
    """The same, with as many effective draws as another round may be worth."""
    return _good(found) and found.effective >= min(ENOUGH, 0.25 * len(found.z))


def _resampled(found: Adapted, count: int, order: PairOrder | None) -> Annealed:
    """Draws of equal weight of several rounds, with the evidence that their ratios say."""
    chosen = systematic(np.exp(found.log_weights), count)
    ratio = found.log_target - found.log_proposal
    evidence = float(logsumexp(ratio)) - np.log(len(ratio))
    evidence += 0.0 if order is None else order.log_orders
    return Annealed(found.z[chosen], evidence, (), (), np.unique(chosen, return_inverse=True)[1])


def run_of(
    start: StudentMixture | Prior,
    z: Tensor,
    target: Joint,
    seed: int,
    progress: bool,
    base: Tensor | None = None,
) -> list[Annealed]:
    """One run of annealing; none where particles cannot get from the start to the posterior."""
    try:
        run = anneal(z, start, target, seed=seed, progress=progress, base=base)
    except RuntimeError:  # Pareto's k of the draws that there are then says how good they are
        return []
    if target.order is None:
        return [run]
    return [replace(run, log_evidence=run.log_evidence + target.order.log_orders)]


def from_prior(
    potential: Potential, count: int, samples: int, seed: int, progress: bool
) -> list[Annealed]:
    """Particles annealed from the prior: straight coordinates serve around an optimum alone."""
    density = potential.log_density
    assert isinstance(density, Direct)  # of a model whose trajectories are integrated out
    prior = Prior(potential, density)
    z = prior.draw(count, seed)
    return run_of(prior, z, Joint(potential, samples), seed, progress)


def pooled(islands: Sequence[Annealed], count: int) -> tuple[Tensor, np.ndarray]:
    """Particles (`count`, d) of several runs, and the first particle that each descends from.

    Each run estimates the evidence without bias, and its particles stand for so much of it: where
    one start has missed most of the posterior, its estimate is low (Verge, Dubarry, Del Moral &
    Moulines, Statistics and Computing 25:243, 2015).
    """
    evidence = np.array([island.log_evidence for island in islands])
    share = np.exp(evidence - evidence.max())
    chosen = systematic(share, count)
    z, ancestor = [], []
    for index, island in enumerate(islands):
        own = int((chosen == index).sum())
        some = systematic(np.ones(len(island.z)), own)
        z.append(island.z[some])
        ancestor.append(island.ancestor[some] + index * len(island.z))
    return torch.cat(z), np.unique(np.concatenate(ancestor), return_inverse=True)[1]


def weighed(potential: Potential, optima: Sequence[Values]) -> tuple[list[Values], Tensor]:
    """Values at the optima that carry weight, the weightiest first, and their weights (K,).

    The highest optimum may be a needle: with few samples a system that passes through all of them.
    What counts is the mass around each, by Laplace's approximation (`heaviest`). The posterior
    probabilities are for the importance ratios to say.
    """
    different = distinct(potential, optima)
    each = [log_evidence(potential, one) for one in different]
    evidence = torch.tensor(each, dtype=torch.float64)
    order, weights = heaviest(evidence, different[0], least=LEAST_WEIGHT, most=MOST_OPTIMA)
    return [different[index] for index in order], weights


def proposal_of(
    potential: Potential, optima: Sequence[Values], weights: Tensor, steps: int = STEPS
) -> StudentMixture:
    """Student-t distributions around optima, in the coordinates of a potential.

    Each centre is what so many steps lead to.

    Pairs of all optima are in the order that those of the first have.
    """
    found = [laplace(potential, optima[0], steps)]
    order = PairOrder.around(potential, found[0][0])
    for values in optima[1:]:
        ordered = values if order is None else order.put(potential, values)
        found.append(laplace(potential, ordered, steps))
    return StudentMixture(
        weights,
        torch.stack([torch.as_tensor(centre) for centre, _ in found]),
        torch.stack([torch.as_tensor(root) for _, root in found]),
    )


def distinct(potential: Potential, optima: Sequence[Values]) -> list[Values]:
    """Optima, each density once: what has the same one differs in the names of pairs."""
    energies = potential.energies_at(optima)
    kept: list[int] = []
    for index in np.argsort(energies, kind="stable").tolist():
        if energies[index] < WALL and (not kept or energies[index] - energies[kept[-1]] > SAME):
            kept.append(index)
    return [optima[index] for index in kept]


def samples_of(records: Sequence[PreparedRecord]) -> int:
    """Measured numbers of all records."""
    return sum(record.observations.numel() for record in records)


def plural(optima: int) -> str:
    """The number of optima in words."""
    return "the mode" if optima == 1 else f"{optima} optima"
