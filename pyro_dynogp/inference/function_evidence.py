r"""Kernels of static functions by the evidence: their values are integrated out.

The highest joint density of a function's values and of its kernel is a poor guide to the kernel:
whitened values near zero under a large output scale and a short lengthscale are more probable than
the same function under a kernel that fits it, because the joint density does not count how few of
the functions of that kernel look like it. Bands are then far too wide, and free runs with the
function in feedback run away. So output scale and kernel parameters, theta, are those of the
highest evidence, all else is the mode given them (type-II maximum a posteriori, empirical Bayes).

Near the mode the log likelihood is quadratic in the whitened values v, with gradient g and Fisher
matrix F at v0. Under another kernel the same function has values v' with v = A v', where
A = (s L)^-1 s' L' and L is the Cholesky factor of the kernel's matrix at the inducing locations.
With P = I + A' F A and m = P^-1 A' (g + F v0) (Rasmussen & Williams 2006, sections 3.4 and 5.2)

    log p(y | theta') = const + g' o - o' F o / 2 - m' m / 2 - log |P| / 2,    o = A m - v0.

Its maximum, and a climb of all other sites with theta held, take turns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.free_runs import free_run_error, noise_sites
from pyro_dynogp.inference.optimise.innovation_energy import Innovations, has_innovations
from pyro_dynogp.inference.optimise.maximum import Effort, maximise, optimizer_near
from pyro_dynogp.inference.optimise.optimum import Optimum
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.dynamic import Values
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.wiring import Static, Wire

# Rounds, iterations of the climb in each, and the gain [nats] with which rounds end. Later ones
# move the evidence by tenths of a nat and no forecast (RMSE of six plants the same to 1 %).
ROUNDS, STEPS, SETTLED = 4, 15, 0.5
# Farthest that a parameter goes in one round, in unconstrained units.
FARTHEST = 1.5
SEARCH_STEPS = 60
# Optima of which the evidence chooses. One that lags by so many nats after a round is left: later
# rounds gain up to 10.
CONSIDERED, BEHIND = 2, 10.0
# With feedback, most that a round may make the error of free runs larger: rounds of eight simulated
# plants made it larger by 10 % at most, one that let process noise in by a factor of four.
WORSE = 1.25


def functions_of(model: Model) -> list[tuple[Wire, Static]]:
    """Static layers with a function that is learnt."""
    return [(wire, wire.layer) for wire in model.wires if isinstance(wire.layer, Static)]


def kernel_sites(model: Model) -> tuple[str, ...]:
    """Names of the sites of all kernels and output scales."""
    each = (model.static_prior(wire, layer).kernel_sites for wire, layer in functions_of(model))
    return tuple(name for names in each for name in names)


def kernels_by_evidence(
    model: Model, records: tuple[PreparedRecord, ...], optima: Sequence[Optimum], run: Run
) -> list[Optimum]:
    """The leading optima with kernels by the evidence, the one that has the most of it first.

    Joint densities under different kernels do not compare. With feedback the first one alone.

    Raises:
        ValueError: where next to none of them predictions are finite.
    """
    if not kernel_sites(model):  # functions that are known
        return list(optima)
    found: list[tuple[Optimum, float]] = []
    for index, one in enumerate(optima[:CONSIDERED]):
        enough = min([np.inf, *(energy for _, energy in found)])
        key = f"kernels-{index}"
        found.append(with_kernels_by_evidence(model, records, one, run, key, enough=enough))
    found = sorted([x for x in found if np.isfinite(x[1])], key=lambda x: x[1])
    if not found:
        raise ValueError(
            "fit: next to the best optimum predictions run away, so that kernels of functions "
            "cannot be learnt. Take another seed, fewer pairs, or a longer record."
        )
    kept = found[:1] if model.has_feedback else found
    return [one for one, energy in kept if energy < found[0][1] + BEHIND]


def with_kernels_by_evidence(
    model: Model,
    records: tuple[PreparedRecord, ...],
    optimum: Optimum,
    run: Run,
    key: str,
    rounds: int = ROUNDS,
    enough: float = np.inf,
) -> tuple[Optimum, float]:
    """An optimum with kernels of the highest evidence, and all else at its mode given them.

    Args:
        model: collapsed, with functions. records: of it. optimum: to begin at.
        run: how. key: of checkpoints. rounds: most of them.
        enough: -log density that another optimum has come to.

    Returns:
        The optimum, or the given one where no round raises the evidence; and its -log density
        without the functions' values [nats], infinite where predictions next to it are not finite.
    """
    names = kernel_sites(model)
    optimizer = optimizer_near(model)
    here = _Expansion.at(model, records, optimum.values)
    if not np.isfinite(here.energy):
        return optimum, np.inf
    noise = noise_sites(model) if model.has_feedback else ()
    error = free_run_error(model, optimum.values, records) if noise else np.inf

    def climbed(values: Values, held: tuple[str, ...], key: str) -> Optimum:
        return maximise(
            model, records, [values], run, optimizer=optimizer, steps=STEPS, key=key,
            effort=Effort(near=True), held=held,
        )[0]  # fmt: skip

    for number in range(rounds):
        values, gain = here.best()
        if not gain >= SETTLED or (number and here.energy > enough + BEHIND):
            break
        found = climbed(values, names, f"{key}-{number}")
        if noise and not free_run_error(model, found.values, records) <= WORSE * error:
            found = climbed(values, (*names, *noise), f"{key}-{number}-noise-held")
            if not free_run_error(model, found.values, records) <= WORSE * error:
                break
        there = _Expansion.at(model, records, found.values)
        if not there.energy < here.energy:
            break
        here = there
        history = np.concatenate([optimum.history, found.history])
        optimum = replace(found, history=history, message=optimum.message)
    return optimum, here.energy


@dataclass(frozen=True, eq=False)
class _Expansion:
    """The log likelihood near a point, as a function of all whitened values.

    Attributes:
        model: collapsed. scaling: of the records. potential: of the model. z: (d,), the point.
        places: (m,), entries of the whitened values. gradient: (m,) and fisher: (m, m), of the log
            likelihood by them.
        joint: energy of the point.
    """

    model: Model
    scaling: Scaling
    potential: Potential
    z: np.ndarray
    places: np.ndarray
    gradient: Tensor
    fisher: Tensor
    joint: float

    @classmethod
    def at(
        cls, model: Model, records: tuple[PreparedRecord, ...], values: dict[str, Tensor]
    ) -> _Expansion:
        """By differences over one-step predictions, where the model has such, else of gradients."""
        potential = Potential(model, (records,), values)
        z = potential.pack(values).numpy()
        places = potential.places([f"{wire.name}_values" for wire, _ in functions_of(model)])
        local = Innovations(potential, places).local(z) if has_innovations(model) else None
        if local is not None:
            energy, slope, fisher = local.energy, local.gradient, local.fisher
        else:
            energy, slopes = potential.value_and_gradient(z)
            slope = slopes[places]
            curvature = potential.hessian_of(z, places.tolist()) - np.eye(len(places))
            eigenvalues, axes = np.linalg.eigh(np.nan_to_num(curvature))
            fisher = (axes * eigenvalues.clip(0.0)) @ axes.T
            fisher[~np.isfinite(curvature)] = np.nan
        gradient = z[places] - slope  # the prior of whitened values is standard normal
        return cls(
            model,
            records[0].scaling,
            potential,
            z,
            places,
            torch.tensor(gradient),
            torch.tensor(fisher),
            energy,
        )

    @property
    def energy(self) -> float:
        """-log density of the kernels and of all else but the functions' values [nats].

        Not finite next to runs that grow without bound.
        """
        inner = torch.eye(len(self.places), dtype=torch.float64) + self.fisher
        return self.joint + 0.5 * float(torch.linalg.slogdet(inner).logabsdet)

    def _roots(self, values: dict[str, Tensor]) -> Iterator[Tensor]:
        """Scaled roots s L of each function and output."""
        for wire, layer in functions_of(self.model):
            function = self.model.static_function(wire, layer, values, self.scaling)
            yield from (scale * function.root for scale in function.output_scale)

    def best(self) -> tuple[dict[str, Tensor], float]:
        """Values of all sites with the kernels of the highest evidence, and what that gains."""
        names = kernel_sites(self.model)
        kernels = self.potential.places(names)
        index, whole = torch.tensor(kernels), torch.tensor(self.z)
        with torch.no_grad():
            old = list(self._roots(self.potential.unpack(whole)))
        v0 = whole[torch.tensor(self.places)]
        identity = torch.eye(len(v0), dtype=torch.float64)
        pull = self.gradient + self.fisher @ v0
        eigenvalues, axes = torch.linalg.eigh(self.fisher)
        half = (axes * eigenvalues.clamp_min(0.0).sqrt()).mT  # F = half' half
        prior = {s.name: s.prior for s in self.model.sites(self.scaling) if s.name in names}

        def level(theta: Tensor) -> tuple[Tensor, Tensor]:
            """Log evidence and prior of kernels, and the whitened values that go with them."""
            values = self.potential.unpack(whole.index_put((index,), theta))
            roots = zip(old, self._roots(values), strict=True)
            A = torch.block_diag(
                *(torch.linalg.solve_triangular(a, b, upper=False) for a, b in roots)
            )
            # The Cholesky factor of P by orthogonal steps: steep likelihoods spoil P itself.
            root = torch.linalg.qr(torch.cat([half @ A, identity]))[1].mT
            m = torch.cholesky_solve((A.mT @ pull)[:, None], root)[:, 0]
            off = A @ m - v0
            found = self.gradient @ off - 0.5 * (off @ self.fisher @ off + m @ m)
            found = found - root.diagonal().abs().log().sum()
            return found + sum(prior[n].log_prob(values[n]).sum() for n in names), m

        def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
            x = torch.tensor(theta, requires_grad=True)
            with torch.enable_grad():
                value = -level(x)[0]
                (slope,) = torch.autograd.grad(value, x)
            return float(value.detach()), slope.numpy()

        begin = self.z[kernels]
        bounds = [(x - FARTHEST, x + FARTHEST) for x in begin]
        found = minimize(
            objective, begin, jac=True, method="L-BFGS-B", bounds=bounds,
            options={"maxiter": SEARCH_STEPS},
        )  # fmt: skip
        with torch.no_grad():
            before, after = level(torch.tensor(begin))[0], level(torch.tensor(found.x))
        z = self.z.copy()
        z[kernels], z[self.places] = found.x, after[1].numpy()
        return self.potential.unpack(torch.tensor(z)), float(after[0] - before)
