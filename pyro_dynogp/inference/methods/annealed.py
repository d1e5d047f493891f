r"""Annealed sequential Monte Carlo: particles carried from one density to another, all at once.

Particles of a density p_0 follow p_0^{1-b} p_1^b from b = 0 to 1. Each step of b is as long as half
of them stay effective; a quarter as many are resampled, and moved by Hamiltonian Monte Carlo in
coordinates whitened by the particles' own covariance (Del Moral, Doucet & Jasra 2006; Buchholz,
Chopin & Jacob 2021). All states that the moves pass through are particles of the next step, so that
no density is evaluated in vain (Dau & Chopin, J. R. Stat. Soc. B 84:114, 2022). What comes out are
draws of p_1 and the ratio of the two normalising constants. No normal shape is assumed: ridges and
pairs that swap places are no obstacle where the particles of p_0 cover them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from pyro_dynogp.inference.density import (
    Potential,
    denormals_flushed,
    each_with_gradient,
    energies_of,
    within_edges,
)
from pyro_dynogp.inference.log_joint import Direct
from pyro_dynogp.inference.methods.moves import (
    SPREAD,
    Density,
    Particles,
    evaluate,
    move,
    next_size,
    root_of,
)
from pyro_dynogp.inference.pair_order import PairOrder
from pyro_dynogp.inference.student_mixture import resample
from pyro_dynogp.support.parallel import seeded

# Effective share of particles after a step; one in so many of all particles starts a chain.
EFFECTIVE, CHAINS = 0.5, 4
# Hamiltonian moves of each chain at each temperature, all kept; at the end as many that are not
# kept, and then one for each particle.
MOVES = 2
MOST_TEMPERATURES = 60
# Samples times particles that are evaluated at once.
AT_ONCE = 400_000


@dataclass(frozen=True, eq=False)
class Joint:
    """Log p(y, values) with the Jacobian of a potential's coordinates.

    Attributes:
        potential: the density. samples: of the data.
        order: of the pairs, outside of which the density counts as zero; None for all orders.
    """

    potential: Potential
    samples: int = 1
    order: PairOrder | None = None

    def log_prob(self, z: Tensor) -> np.ndarray:
        """Value (S,) alone."""
        far = self._far(z)
        near = z.masked_fill(far[:, None], 0.0)
        with torch.no_grad(), denormals_flushed():
            portions = near.split(max(1, AT_ONCE // self.samples))
            energy = torch.cat([energies_of(self._energy, portion) for portion in portions])
        return (-energy.masked_fill(far, torch.inf)).numpy()

    def _far(self, z: Tensor) -> Tensor:
        """Where the density counts as zero (S,)."""
        far = ~(z.abs() <= self.potential.reach).all(-1)
        if self.order is not None:
            near = z.masked_fill(far[:, None], 0.0)  # squares of what is beyond may overflow
            far |= ~torch.from_numpy(self.order.holds(near.numpy()))
        return far

    def __call__(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Value (S,) and gradient (S, d)."""
        far = self._far(z)
        near = z.masked_fill(far[:, None], 0.0)
        portions = near.split(max(1, AT_ONCE // self.samples))
        found = [each_with_gradient(self._energy, portion) for portion in portions]
        energy, slope = (torch.cat(x) for x in zip(*found, strict=True))
        return -energy.masked_fill(far, torch.inf), -slope.masked_fill(far[:, None], 0.0)

    def _energy(self, z: Tensor) -> Tensor:
        return self.potential.energy(z, jacobian=True)


@dataclass(frozen=True, eq=False)
class Prior:
    """The prior of all sites of a model, in a potential's coordinates.

    Attributes:
        potential: of a `Model` whose trajectories are integrated out. density: of its sites.
    """

    potential: Potential
    density: Direct

    def __call__(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Value (S,), and gradient (S, d)."""
        far = ~(z.abs() <= self.potential.reach).all(-1)
        energy, slope = each_with_gradient(self._energy, z.masked_fill(far[:, None], 0.0))
        return -energy.masked_fill(far, torch.inf), -slope.masked_fill(far[:, None], 0.0)

    def _energy(self, z: Tensor) -> Tensor:
        values = self.potential.unpack(z)
        return -self.density.prior.log_prob(values) - self.potential.log_jacobian(z)

    def draw(self, count: int, seed: int) -> Tensor:
        """Vectors (S, d)."""
        with seeded(seed), torch.no_grad():
            values = {site.name: site.prior.sample((count,)) for site in self.density.sites}
        inverse = [
            site.transform.inv(values[site.name]).reshape(count, -1)
            for site in self.potential.sites
        ]
        return within_edges(torch.cat(inverse, -1))


@dataclass(frozen=True, eq=False)
class Annealed:
    """Particles of the target.

    Attributes:
        z: (S, d) unconstrained. log_evidence: log of the target's normalising constant over the
            start's.
        temperatures: b after each step. acceptance: of the moves at each.
        ancestor: (S,) first particle that each one descends from.
    """

    z: Tensor
    log_evidence: float
    temperatures: tuple[float, ...]
    acceptance: tuple[float, ...]
    ancestor: np.ndarray


def anneal(
    z: Tensor,
    start: Density,
    target: Density,
    *,
    seed: int = 0,
    progress: bool = False,
    base: Tensor | None = None,
) -> Annealed:
    """Carry particles z (S, d) of `start` to `target`.

    Args:
        z: particles. start, target: log-densities. seed: of what is drawn.
        progress: whether to show a bar.
        base: root (d, d), lower, of a covariance near that of the target, which the particles' own
            is shrunk to; None for their variances alone.

    Raises:
        RuntimeError: where no particle has a density under the target, or the steps become too
            many: the start is too far from the target.
    """
    generator = torch.Generator().manual_seed(seed)
    count = len(z)
    chains = -(-count // CHAINS)
    now = evaluate(z, start, target, 0.0, torch.arange(count))
    b, log_evidence, size, spread = 0.0, 0.0, 0.5, SPREAD[0]
    temperatures: list[float] = []
    accepted: list[float] = []
    bar = tqdm(desc="annealing", disable=not progress, total=100)
    while b < 1.0:
        if len(temperatures) == MOST_TEMPERATURES:
            raise RuntimeError(
                f"annealing: after {MOST_TEMPERATURES} steps the temperature is {b:.3g} of 1. The "
                "posterior is too far from where the particles start: use method='nuts'."
            )
        gain = (now.target - now.start).nan_to_num(-torch.inf, torch.inf, -torch.inf)
        if not bool(torch.isfinite(gain).any()):
            raise RuntimeError("annealing: no particle has a density under the target.")
        step = _step(gain, 1.0 - b)
        weight = step * gain
        log_evidence += float(torch.logsumexp(weight, 0)) - float(np.log(len(gain)))
        chosen = resample(weight, chains, generator)
        root = root_of(now.z, torch.softmax(weight, 0), base)
        b = 1.0 if b + step > 1.0 - 1e-9 else b + step
        chain, states, rates = now.of(chosen), [], []
        for _ in range(MOVES if b < 1.0 else MOVES + CHAINS):
            chain, chance, factor = move(chain, start, target, b, root, size, spread, generator)
            size = next_size(size, factor, chance)
            spread = max(0.5 * spread, SPREAD[1])
            states.append(chain)
            rates.append(float(chance.mean()))
        now = Particles.joined(states if b < 1.0 else states[MOVES:])
        temperatures.append(b)
        accepted.append(float(np.mean(rates)))
        bar.update(round(100 * b) - bar.n)
    bar.close()
    last = now.of(torch.arange(count))
    return Annealed(
        last.z, log_evidence, tuple(temperatures), tuple(accepted), last.ancestor.numpy().copy()
    )


def _step(gain: Tensor, most: float) -> float:
    """Longest step at which EFFECTIVE of the particles stay effective, by bisection."""

    def effective(step: float) -> float:
        w = torch.softmax(step * gain, 0)
        return float(1.0 / w.square().sum()) / len(gain)

    if effective(most) >= EFFECTIVE:
        return most
    low, high = 0.0, most
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(middle) >= EFFECTIVE else (low, middle)
    # Where less than half of them have any density the first step only drops the others.
    return max(low, 1e-6 * most)
