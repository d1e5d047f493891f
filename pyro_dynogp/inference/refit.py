"""The same fit on other data of the same system: from its optima, with its scaling and priors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.fit import draws_of_guide
from pyro_dynogp.inference.fitted import Fit
from pyro_dynogp.inference.methods.nuts import sample_posterior
from pyro_dynogp.inference.methods.optima import Hyperparameters, posterior_of
from pyro_dynogp.inference.optimise.maximum import Optimum, maximise
from pyro_dynogp.inference.posteriors import GaussianGuide, MixtureGuide
from pyro_dynogp.support.checkpoints import NOTHING_KEPT
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.parallel import seeded

# Iterations from the old optimum: of L-BFGS, of Adam, of SVI for all sites.
LINEAR_STEPS, CASCADE_STEPS, SVI_STEPS = 300, 200, 400
# Adam's first step: the old optimum is close by.
REFIT_RATE = 0.004
# Of NUTS, whose chains start at the mode.
WARMUP = 300


def refit(fit: Fit, records: Record | Sequence[Record]) -> Fit:
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
    target: Any = fit.model.collapsed
    argument = several[0] if len(several) == 1 else several
    cascade = fit.model.has_function
    optima = maximise(
        target,
        argument,
        [dict(values) for values in optima_of(fit)],
        optimizer="adam" if cascade else "lbfgs",
        steps=CASCADE_STEPS if cascade else LINEAR_STEPS,
        seed=fit.seed,
        workers=1,
        kept=1.0,
        rate=REFIT_RATE,
    )
    best = optima[0]
    changed: dict[str, Any] = {
        "mode": MappingProxyType(best.values),
        "history": best.history,
        "records": several,
        "trajectories": {},
    }
    if fit.method == "map":
        draws = {name: value.unsqueeze(0) for name, value in best.values.items()}
        return replace(fit, draws=MappingProxyType(draws), **changed)
    if fit.method == "nuts":
        draws = _sampled(fit, target, argument, best)
        return replace(fit, draws=MappingProxyType(draws), **changed)
    family = family_of(fit)
    found = posterior_of(
        target,
        argument,
        optima,
        family,
        steps=60 if family == "map" else SVI_STEPS,
        particles=8,
        learning_rate=0.02,
        seed=fit.seed,
        workers=1,
        checkpoints=NOTHING_KEPT,
        progress=False,
    )
    changed |= {"mode": MappingProxyType(dict(found.mode)), "history": found.elbo}
    count = len(next(iter(fit.draws.values())))
    with seeded(fit.seed):
        draws = draws_of_guide(found.guide, argument, count, best.values)
    return replace(fit, draws=MappingProxyType(draws), posterior=found.guide, **changed)


def optima_of(fit: Fit) -> list[Mapping[str, Tensor]]:
    """Values of all sites at each optimum that a fit consists of, the leading one first."""
    posterior = fit.posterior
    if not isinstance(posterior, MixtureGuide):
        return [fit.mode]
    found: list[Mapping[str, Tensor]] = []
    for k in range(len(posterior.weights)):
        centre = GaussianGuide(posterior.loc[k], posterior.scale_tril[k], posterior.sites)
        points = {name: x[k] for name, x in posterior.points.items()}
        found.append({**points, **centre.values_at(posterior.loc[k])})
    return found


def family_of(fit: Fit) -> Hyperparameters:
    """What `fit` was told about hyperparameters."""
    if isinstance(fit.posterior, MixtureGuide):
        return "map"
    assert isinstance(fit.posterior, GaussianGuide)
    root = fit.posterior.scale_tril
    independent = torch.equal(root, torch.diag(root.diagonal()))
    return "normal" if independent else "multivariate normal"


def _sampled(fit: Fit, target: Any, argument: Any, best: Optimum) -> dict[str, Tensor]:
    chains = int(fit.diagnostics["chains"])
    found = sample_posterior(
        target,
        argument,
        best.values,
        chains=chains,
        draws=len(next(iter(fit.draws.values()))) // chains,
        warmup=WARMUP,
        seed=fit.seed,
        workers=1,
        progress=False,
    )
    return {name: value.flatten(0, 1) for name, value in found.draws.items()}
