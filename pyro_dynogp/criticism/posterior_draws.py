"""Draws of all parameters of a fit, with the densities that importance sampling needs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.criticism.finding import apart
from pyro_dynogp.inference.cascade_coordinates import StraightPotential
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.importance_sampling import sample_around, samples_of, systematic
from pyro_dynogp.inference.laplace import laplace as laplace_of
from pyro_dynogp.inference.log_joint import log_joint_of
from pyro_dynogp.inference.methods.annealed import Joint, anneal
from pyro_dynogp.inference.pareto import good_k, psis
from pyro_dynogp.inference.posterior_draws import PosteriorDraws
from pyro_dynogp.inference.posteriors import Draws, Mixture, Sampled
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import seeded

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted

Values = Mapping[str, Tensor]
# Draws that `check` and `loo` take where they are not told: the same, so that their k agree.
DRAWS = 1000


def draws_of(
    fit: Fitted, *, count: int = DRAWS, seed: int = 0, anneal: bool = True, progress: bool = False
) -> PosteriorDraws:
    """Draws of all parameters of a fit, and how probable they are.

    By importance or NUTS: what the fit holds. A variational posterior: fresh draws of it; of a
    cascade by default those of inducing values and first states, with all else at an optimum, whose
    own uncertainty then counts nowhere. A posterior mode: Laplace's approximation around it. Where
    Pareto's k says that a normal does not describe the posterior of a linear model, the draws are
    what importance sampling around the mode gives (`inference.importance_sampling`).

    Args:
        fit: the fit. count: number of draws S, of what is drawn here. seed: for them.
        anneal: False for the draws of the fit's own normal, whatever their k.
        progress: whether annealing shows a bar.

    Raises:
        ValueError: where no posterior can be drawn from the mode of a cascade.
    """
    own = _own(fit, count, seed)
    if not anneal or own.log_q is None or isinstance(fit.posterior, Sampled) or _of_optima(fit):
        return own
    k = float(psis(own.log_ratio)[1])
    if k <= good_k(count):
        return own
    shape = apart(k, good_k(count))[0]
    if fit.model.has_function:  # annealing would take an hour
        if fit.method == "svi":
            return own  # the posterior that was chosen; its k goes with every result
        raise invalid(
            "fit",
            expected="a posterior that can be drawn from",
            got=f"a posterior mode around which Laplace's approximation is useless (k = {shape})",
            advice="Fit with the default method or 'nuts', or use parameters='mode'.",
        )
    found = sample_around(
        fit.model.collapsed, _data(fit), [fit.mode], count=count, seed=seed, progress=progress
    ).draws
    return replace(found, kind=f"{found.kind}; {own.kind} has Pareto k {shape}")


def _own(fit: Fitted, count: int, seed: int) -> PosteriorDraws:
    """Draws of what the fit holds itself; of a mode, of the normal around it."""
    posterior = fit.posterior
    if isinstance(posterior, Sampled) and not posterior.log_q_sites:
        if posterior.source is not None:
            return posterior.source
        n = fit.n_draws
        return PosteriorDraws(fit.draws, None, None, np.zeros(n, dtype=int), posterior.kind)
    if fit.method == "map":
        return judged(fit, normal_of(fit).draws(count, seed), "Laplace's approximation")
    return judged(fit, posterior.draws(count, seed))


def wider_draws(fit: Fitted, count: int, seed: int) -> PosteriorDraws | None:
    """Draws of wider normals than those around the optima of a fit; None where it is none of these.

    Leaving data out widens a posterior, and ratios of a narrower proposal have heavy tails. Of d
    unknowns the variances are 1 + d^-1/2 times as large, for which of S draws of the posterior
    itself about 0.6 S are effective: with s their factor, (sqrt(2 s - 1) / s)^d S.

    Args:
        fit: the fit. count: number of draws. seed: for them.
    """
    posterior = fit.posterior
    if not isinstance(posterior, Mixture) or not _of_optima(fit):
        return None
    root = math.sqrt(1.0 + posterior.loc.shape[-1] ** -0.5)
    wider = replace(posterior, scale_tril=root * posterior.scale_tril)
    return judged(fit, wider.draws(count, seed))


def equal_draws(fit: Fitted, *, count: int = DRAWS, seed: int = 0) -> PosteriorDraws:
    """Draws of equal weight of what the fit says its posterior is; of a mode, of its normal."""
    if fit.method == "importance":
        zeros = np.zeros(fit.n_draws, dtype=int)
        return PosteriorDraws(fit.draws, None, None, zeros, fit.posterior.kind)
    return draws_of(fit, count=count, seed=seed, anneal=False)


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
        potential = Potential(fit.model.collapsed, (_data(fit),), values)
        centre, root = laplace_of(potential, values)
    return Mixture.normal(potential, torch.as_tensor(centre), torch.as_tensor(root))


def normal_of(fit: Fitted) -> Mixture:
    """The normal that a fit is: its variational posterior, or Laplace's around its mode."""
    if isinstance(fit.posterior, Mixture) and fit.posterior.sites and not fit.posterior.points:
        return fit.posterior
    return laplace(fit, fit.mode)


def carried(
    old: Fitted, draws: PosteriorDraws, new: Fitted, *, seed: int, progress: bool = False
) -> PosteriorDraws:
    """Draws of a posterior moved to that given other data, without a fit (Chopin 2002).

    Particles are annealed from the one to the other; draws of another density are resampled by
    their ratios first.

    Args:
        old: a fit. draws: of its posterior; of a model with static functions signals may have
            either sign, of which straight coordinates know one alone: these are not used then.
        new: the same with other records. seed: of the moves. progress: whether to show a bar.
    """
    model = old.model.collapsed
    before: Potential
    after: Potential
    if model.has_function:
        before, after = (Potential(model, (_data(fit),), old.mode) for fit in (old, new))
    else:
        straight = StraightPotential(model, (_data(old),), old.mode)
        before, after = straight, straight.on((_data(new),))
    start, target = (
        Joint(potential, samples_of(_data(fit))) for potential, fit in ((before, old), (after, new))
    )
    count = len(draws)
    shift = float(np.random.default_rng(seed).random())
    first = systematic(np.exp(psis(draws.log_ratio)[0]), count, shift)
    z = before.pack(draws.values)[first]
    found = anneal(z, start, target, seed=seed, progress=progress)
    with torch.no_grad():
        values = FrozenMapping(after.unpack(found.z))
    roots = np.arange(count) if draws.ancestor is None else draws.ancestor
    kind, group = "annealed from draws given other data", np.zeros(count, dtype=int)
    return PosteriorDraws(values, None, None, group, kind, roots[first[found.ancestor]])


def log_joint(fit: Fitted, values: Values) -> np.ndarray:
    """Log p(y, values) (S,) of draws, y the training records; -inf where it has no value."""
    records = _data(fit)
    samples = samples_of(records)
    return log_joint_of(fit.model.collapsed, (records,), values, samples)


def _data(fit: Fitted) -> tuple[PreparedRecord, ...]:
    """What a fit's model is called with."""
    return tuple(fit.model.prepare(fit.records))
