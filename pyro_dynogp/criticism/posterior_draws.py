"""Draws of all parameters with the densities that importance sampling needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyro
import torch
from scipy.special import logsumexp
from torch import Tensor

from pyro_dynogp.criticism import arviz_bridge
from pyro_dynogp.criticism.finding import apart
from pyro_dynogp.criticism.kept_draws import kept
from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.cascade_coordinates import StraightPotential
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.log_joint import log_prob_by_draw
from pyro_dynogp.inference.methods import annealed as annealing
from pyro_dynogp.inference.posteriors import Draws, Mixture
from pyro_dynogp.layers.sites import Arguments, Program
from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import seeded

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted

Values = Mapping[str, Tensor]
# Draws that `check` and `loo` take where they are not told: the same, so that their k agree.
DRAWS = 1000
# Samples times draws that are evaluated at once.
AT_ONCE = 4_000_000


@dataclass(frozen=True, eq=False)
class PosteriorDraws:
    """Draws of every latent site, and how probable they are.

    Attributes:
        values: (S, *shape) of each site.
        log_p: (S,) log p(y, values) [nats], None where it is not known.
        log_q: (S,) log-density under what they were drawn from; None for draws of the posterior
            itself (MCMC).
        group: (S,) optimum that each draw belongs to.
        kind: where they come from, in words.
        ancestor: (S,) number of the independent draw that each descends from, of draws that were
            resampled on their way; None where all are independent.
    """

    values: Values
    log_p: np.ndarray | None
    log_q: np.ndarray | None
    group: np.ndarray
    kind: str
    ancestor: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.group)

    @property
    def log_ratio(self) -> np.ndarray:
        """Log importance ratios (S,) of the posterior over what the draws come from.

        Up to a constant for each optimum: how much each optimum weighs is for the fit to say, and
        its ratios say how well its draws describe the posterior around it.
        """
        if self.log_q is None or self.log_p is None:
            return np.zeros(len(self))
        ratio = self.log_p - self.log_q
        out = np.empty_like(ratio)
        for one in np.unique(self.group):
            own = self.group == one
            out[own] = ratio[own] - (logsumexp(ratio[own]) - np.log(own.sum()))
        return out


def draws_of(
    fit: Fitted, *, count: int = DRAWS, seed: int = 0, anneal: bool = True, progress: bool = False
) -> PosteriorDraws:
    """Draws of all parameters of a fit, computed once and kept with it.

    NUTS: its draws. A variational posterior: fresh draws of it; of a cascade by default those of
    inducing values and first states, with all else at an optimum, whose own uncertainty then
    counts nowhere. A posterior mode: Laplace's approximation around it. Where Pareto's k says that
    a normal does not describe the posterior of a linear model, another one is taken that is normal
    in coordinates without bent ridges (`inference.cascade_coordinates`); where that does not
    either, particles are annealed from it to the posterior itself (`inference.methods.annealed`).

    Args:
        fit: the fit. count: number of draws S (of NUTS all there are). seed: for them.
        anneal: whether particles are annealed; False for the draws of the fit's own normal.
        progress: whether annealing shows a bar.

    Raises:
        ValueError: where draws are to be annealed around the mode of a cascade.
    """
    if anneal and fit.method != "nuts" and not _of_optima(fit):
        own = draws_of(fit, count=count, seed=seed, anneal=False)
        if fit.log_q_sites:
            return own
        k = float(arviz_bridge.psis(own.log_ratio)[1])
        if k <= arviz_bridge.good_k(count):
            return own
        key = ("annealed", count, seed)
        return kept(fit, key, lambda: _annealed(fit, own, k, count, seed, progress))
    return kept(fit, ("own", count, seed), lambda: _own(fit, count, seed))


def _own(fit: Fitted, count: int, seed: int) -> PosteriorDraws:
    """Draws of what the fit holds itself; of a mode, of the normal around it."""
    if fit.method == "nuts":
        n = len(next(iter(fit.draws.values())))
        return PosteriorDraws(fit.draws, None, None, np.zeros(n, dtype=int), "NUTS")
    if fit.method == "map":
        return judged(fit, normal_of(fit).draws(count, seed), "Laplace's approximation")
    return judged(fit, fit.posterior.draws(count, seed))


def _of_optima(fit: Fitted) -> bool:
    """Whether hyperparameters are at points, so that one normal is not what the fit is."""
    return bool(fit.method == "svi" and isinstance(fit.posterior, Mixture) and fit.posterior.points)


def judged(fit: Fitted, draws: Draws, kind: str | None = None) -> PosteriorDraws:
    """Draws of a fit's posterior with the log joint density of each.

    Args:
        fit: whose model and records say the density. draws: of its posterior.
        kind: where they come from, if not what the draws say themselves.
    """
    log_q = None if draws.log_q is None else draws.log_q.numpy()
    log_p = log_joint(fit, draws.values)
    return PosteriorDraws(draws.values, log_p, log_q, draws.group.numpy(), kind or draws.kind)


def laplace(fit: Fitted, values: Values) -> Mixture:
    """Normal around an optimum, from the Hessian of the log joint density there."""
    with seeded(fit.seed):
        potential = Potential(fit.model.collapsed, (fit.model.prepare(fit.records),), values)
        centre, root = potential.laplace(values)
    return Mixture.normal(potential, torch.as_tensor(centre), torch.as_tensor(root))


def normal_of(fit: Fitted) -> Mixture:
    """The normal that a fit is: its variational posterior, or Laplace's around its mode."""
    if isinstance(fit.posterior, Mixture) and fit.posterior.sites and not fit.posterior.points:
        return fit.posterior
    return kept(fit, "laplace", lambda: laplace(fit, fit.mode))


def _annealed(
    fit: Fitted, own: PosteriorDraws, k: float, count: int, seed: int, progress: bool
) -> PosteriorDraws:
    """Draws of the posterior where the fit's own normal, of Pareto shape k, will not do."""
    shape = apart(k, arviz_bridge.good_k(count))[0]
    if fit.model.has_function:  # annealing would take an hour
        if fit.method == "svi":
            return own  # the posterior that was chosen; its k goes with every result
        raise invalid(
            "fit",
            expected="a posterior that can be drawn from",
            got=f"a posterior mode around which Laplace's approximation is useless (k = {shape})",
            advice="Fit with method='svi' (the default of cascades) or 'nuts', or use "
            "parameters='mode'.",
        )
    with seeded(seed):
        prepared = (fit.model.prepare(fit.records),)
        potential = StraightPotential(fit.model.collapsed, prepared, fit.mode)
        loc, root = map(torch.as_tensor, potential.laplace(fit.mode))
        z, start = annealing.around(loc, root, count, seed)
        target = annealing.Joint(potential, _samples(fit.records))
        ratio = (target(z)[0] - start(z)[0]).numpy()
        straight = float(arviz_bridge.psis(ratio)[1]) <= arviz_bridge.good_k(count)
        found = None
        if not straight:
            found = annealing.anneal(z, start, target, seed=seed, progress=progress)
            z = found.z
        with torch.no_grad():
            values = FrozenMapping(potential.unpack(z))
    log_p = log_joint(fit, values)
    way = "annealed" if found else "a Student-t in straight coordinates"
    return PosteriorDraws(
        values,
        log_p,
        None if found else log_p - ratio,
        np.zeros(count, dtype=int),
        f"{way} from {own.kind}, whose own Pareto k is {shape}",
        found.ancestor if found else None,
    )


def carried(
    old: Fitted, draws: PosteriorDraws, new: Fitted, *, seed: int, progress: bool = False
) -> PosteriorDraws:
    """Draws of a posterior moved to that given other data, without a fit (Chopin 2002).

    Particles are annealed from the one to the other; draws of another density are resampled by
    their ratios first.

    Args:
        old: a fit without static functions. draws: of its posterior.
        new: the same with other records. seed: of the moves. progress: whether to show a bar.
    """
    data = (old.model.prepare(old.records),)
    before = StraightPotential(old.model.collapsed, data, old.mode)
    after = before.on((new.model.prepare(new.records),))
    start, target = (
        annealing.Joint(potential, _samples(fit.records))
        for potential, fit in ((before, old), (after, new))
    )
    count = len(draws)
    generator = np.random.default_rng(seed)
    weight = np.exp(arviz_bridge.psis(draws.log_ratio)[0])
    first = np.searchsorted(np.cumsum(weight), (np.arange(count) + generator.random()) / count)
    first = np.minimum(first, count - 1)
    z = before.pack(draws.values)[first]
    found = annealing.anneal(z, start, target, seed=seed, progress=progress)
    with torch.no_grad():
        values = FrozenMapping(after.unpack(found.z))
    roots = np.arange(count) if draws.ancestor is None else draws.ancestor
    kind = "annealed from draws given other data"
    group = np.zeros(count, dtype=int)
    return PosteriorDraws(values, None, None, group, kind, roots[first[found.ancestor]])


def log_joint(fit: Fitted, values: Values) -> np.ndarray:
    """Log p(y, values) (S,) of draws, y the training records; -inf where it has no value."""
    return log_joint_of(
        fit.model.collapsed, (fit.model.prepare(fit.records),), values, _samples(fit.records)
    )


def log_joint_of(
    model: Program, args: Arguments, values: Values, samples: int = 1000
) -> np.ndarray:
    """Log-density (S,) of a Pyro model at S draws of its latent sites, those of the data included.

    Draws go through the model together where it broadcasts, in portions of bounded memory.
    """
    count = len(next(iter(values.values())))
    portion = max(1, AT_ONCE // max(samples, 1))
    parts = []
    for first in range(0, count, portion):
        some = {name: x[first : first + portion] for name, x in values.items()}
        parts.append(_portion(model, args, some))
    return np.concatenate(parts)


def _portion(model: Program, args: Arguments, values: Values) -> np.ndarray:
    count = len(next(iter(values.values())))
    try:
        with torch.no_grad(), pyro.validation_enabled(False):
            trace = pyro.poutine.trace(pyro.poutine.condition(model, data=dict(values))).get_trace(
                *args
            )
            trace.compute_log_prob()
    except (NotPositiveDefiniteError, torch.linalg.LinAlgError, ValueError) as error:
        # Pyro wraps what a distribution raises in a ValueError.
        singular = (NotPositiveDefiniteError, torch.linalg.LinAlgError)
        if not isinstance(error, singular) and not isinstance(error.__cause__, singular):
            raise
        if count == 1:  # this draw: the density cannot be evaluated there
            return np.array([-np.inf])
        each = [_portion(model, args, {k: v[i : i + 1] for k, v in values.items()}) for i in
                range(count)]  # fmt: skip
        return np.concatenate(each)
    for name, node in trace.nodes.items():
        latent = node["type"] == "sample" and not node["is_observed"] and name not in values
        if latent and type(node["fn"]).__name__ != "_Subsample":
            raise invalid("values", expected=f"draws of every site, {name!r} too", got="none of it")
    total = log_prob_by_draw(trace, count).numpy()
    return np.where(np.isfinite(total), total, -np.inf)


def _samples(records: Sequence[Record]) -> int:
    return sum(len(record) * max(record.n_outputs, 1) for record in records)
