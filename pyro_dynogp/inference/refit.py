"""The same fit on other data of the same system: from its optima, with its scaling and priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.importance import with_draws_around
from pyro_dynogp.inference.methods.mode import optimizer_for
from pyro_dynogp.inference.methods.nuts import sample_posterior
from pyro_dynogp.inference.methods.optima import POLISH, Hyperparameters, posterior_of
from pyro_dynogp.inference.methods.svi import Schedule
from pyro_dynogp.inference.optimise.maximum import Effort, Optimum, maximise
from pyro_dynogp.inference.posteriors import Mixture, Sampled, draws_of_guide
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.prepared import as_measured
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import seeded

# Most iterations from the old optimum: of linear models, of Adam, of SVI for all sites.
LINEAR_STEPS, CASCADE_STEPS, SVI_STEPS = 300, 200, 400
# Adam's first step: the old optimum is close by.
REFIT_RATE = 0.004
FittedKind = TypeVar("FittedKind", bound=Fitted)
# Of NUTS, whose chains start at the mode.
WARMUP = 300


def refit(fit: FittedKind, records: Record | Sequence[Record]) -> FittedKind:
    """Fit again by the same method, beginning at the optima of the old fit, in this process.

    The scaling, and with it every prior, stays that of the old fit: what changes is the data alone.

    Args:
        fit: the old fit. records: as many as it has, each with the same channels.

    Raises:
        ValueError: on a fit with trajectories as sites, whose guide belongs to its record, or on
            another number of records.
    """
    several = (records,) if isinstance(records, Record) else tuple(records)
    if not fit.collapsed:
        raise invalid(
            "fit",
            expected="a fit whose trajectories are integrated out",
            got="one with trajectories as sites, whose guide belongs to its record",
            advice="Fit with guide='collapsed', or do without refits.",
        )
    if len(several) != len(fit.records):
        raise invalid("records", expected=f"{len(fit.records)}, as before", got=str(len(several)))
    problem = Problem(fit.model, fit.model.prepare(several))
    run = Run(fit.seed, workers=1)
    cascade, optimizer = fit.model.has_function, optimizer_for(fit.model)
    optima = maximise(
        problem.target,
        problem.records,
        optima_of(fit),
        run,
        optimizer=optimizer,
        steps=CASCADE_STEPS if cascade else LINEAR_STEPS,
        effort=Effort(kept=1.0, rate=REFIT_RATE),
    )
    best = optima[0]
    changed: dict[str, Any] = {
        "mode": FrozenMapping(best.values),
        "history": best.history,
        "records": as_measured(problem.records),
    }
    if fit.method == "map":
        draws = {name: value.unsqueeze(0) for name, value in best.values.items()}
        changed |= {"posterior": Mixture.at(best.values), "draws": FrozenMapping(draws)}
        return replace(fit, **changed)
    if fit.method == "importance":
        count = len(next(iter(fit.draws.values())))
        around = with_draws_around(problem, optima, run, count)
        kept = ("posterior", "draws", "mode", "history", "records", "diagnostics")
        return replace(fit, **{name: getattr(around, name) for name in kept})
    if fit.method == "nuts":
        sampled = FrozenMapping(_sampled(fit, problem, best, run))
        return replace(fit, posterior=Sampled(sampled), draws=sampled, **changed)
    family = family_of(fit)
    schedule = Schedule(POLISH if family == "map" else SVI_STEPS)
    found = posterior_of(problem, optima, family, run, schedule)
    changed |= {"mode": FrozenMapping(found.mode), "history": found.elbo}
    count = len(next(iter(fit.draws.values())))
    with seeded(fit.seed):
        drawn = draws_of_guide(found.guide, count)
    draws = {name: drawn[name] for name in best.values}
    return replace(fit, draws=FrozenMapping(draws), posterior=found.guide, **changed)


def optima_of(fit: Fitted) -> list[dict[str, Tensor]]:
    """Values of all sites at each optimum that a fit consists of, the leading one first."""
    posterior = fit.posterior
    if isinstance(posterior, Mixture) and posterior.points and posterior.sites:
        return posterior.centres
    return [dict(fit.mode)]


def family_of(fit: Fitted) -> Hyperparameters:
    """What `fit` was told about hyperparameters."""
    assert isinstance(fit.posterior, Mixture)
    if fit.posterior.points:
        return "map"
    root = fit.posterior.scale_tril[0]
    independent = torch.equal(root, torch.diag(root.diagonal()))
    return "normal" if independent else "multivariate normal"


def _sampled(fit: Fitted, problem: Problem, best: Optimum, run: Run) -> dict[str, Tensor]:
    chains = int(fit.diagnostics["chains"])
    found = sample_posterior(
        problem.target,
        problem.records,
        best.values,
        run,
        chains=chains,
        draws=len(next(iter(fit.draws.values()))) // chains,
        warmup=WARMUP,
    )
    return {name: value.flatten(0, 1) for name, value in found.draws.items()}
