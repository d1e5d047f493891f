"""Fit a model to measured records: one call for every model and method, one frozen result."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pyro
import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.density import WALL
from pyro_dynogp.inference.fitted import Fit, Method
from pyro_dynogp.inference.methods.mode import GuideChoice, best_optima
from pyro_dynogp.inference.methods.nuts import sample_posterior
from pyro_dynogp.inference.methods.optima import Hyperparameters, posterior_of
from pyro_dynogp.inference.methods.trajectories import fit_layered
from pyro_dynogp.inference.optimise.maximum import Optimizer, Optimum, maximise
from pyro_dynogp.inference.posteriors import Guide
from pyro_dynogp.inference.starts.poles import grown, starting_values
from pyro_dynogp.models.model import Model
from pyro_dynogp.support.checkpoints import Checkpoints
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.parallel import seeded

__all__ = ["Fit", "fit"]

# Iterations of SVI around the optima of a cascade.
POLISH = 60


def fit(
    model: Model,
    record: Record | Sequence[Record],
    *,
    method: Method | None = None,
    guide: GuideChoice = None,
    hyperparameters: Hyperparameters | None = None,
    start: Fit | None = None,
    seed: int = 0,
    restarts: int | None = None,
    steps: int | None = None,
    optimizer: Optimizer | None = None,
    draws: int | None = None,
    chains: int = 4,
    warmup: int = 500,
    particles: int = 8,
    learning_rate: float = 0.02,
    checkpoint: str | Path | None = None,
    workers: int | None = None,
    progress: bool = True,
) -> Fit:
    """Fit a model to one record, or to several that share all parameters.

    The marginal posterior (exact for a linear model, by the moment-matching filter for a cascade)
    is climbed from several starts, in parallel. "map" keeps the best optimum; "svi" fits a
    multivariate normal to the posterior around it (of a cascade, unless `hyperparameters` says
    otherwise, to that of inducing values and first states around up to four optima, with everything
    else at the optimum: see `pyro_dynogp.inference.methods.optima`);
    "nuts" samples it. The starts of a cascade are the best linear fits, spread over its layers;
    where static layers see process noise they climb without any first, and the better half goes on.

    With another `guide` a cascade keeps its trajectories as sample sites, and Pyro's SVI fits them
    and the parameters together, from every start; the best is kept by its ELBO.

    Args:
        model: a `LinearDynamicGP` or a `Cascade` (`Wiener`, `Hammerstein`, ...).
        record: training record, or a sequence of them; scaling is learnt from it alone.
        method: "map", "svi" or "nuts"; "map" by default for a linear model, "svi" for a cascade.
        guide: of a cascade. "collapsed" (default): trajectories integrated out. "gauss-markov" or
            "inducing times": the family of all trajectories. A mapping from site names to
            families of `pyro_dynogp.guides`: these sites so, all others as "gauss-markov" has
            them. A Pyro function: your own guide for the model with all its trajectories.
        hyperparameters: of a cascade with "svi" and the collapsed guide: "map" (default) keeps
            poles, gains, noise, lengthscales at the optimum, as the paper does; "normal" gives
            all sites independent normals; "multivariate normal" one for all sites, which is best
            for small models with well-excited inputs.
        start: a fit to start from beside the restarts: of the same model to other data, or of a
            model that this one extends (what sites have in common is taken over).
        seed: the same seed gives the same numbers to the last bit on one machine.
        restarts: number of starting points (default 6; 8 for a cascade, 2 with trajectories as
            sites).
        steps: most iterations of a start (default 500; Adam 1500; cascade 600) and, with "svi", of
            SVI (default 1000; cascade 60, and no more while its hyperparameters stay at the
            optimum, around which it begins all but normal).
        optimizer: "lbfgs", "preconditioned" (L-BFGS in coordinates that Hessians make round, which
            gets to the top of long ridges) or "adam", for the starts; "lbfgs" by default for a
            linear model, "adam" for a cascade. The highest mode may be one that fits the noise.
        draws: posterior draws to keep ("svi", default 200) or to sample per chain ("nuts", 500).
        chains, warmup: of NUTS.
        particles, learning_rate: of SVI.
        checkpoint: a folder that keeps finished pieces of the work. The same call goes on from
            there after a kill, and ends in the same bits.
        workers: processes; None for all processors, 1 for none but this one.
        progress: whether to show progress bars.

    Raises:
        ValueError: on channels that do not fit the model, constant or entirely missing outputs,
            unknown options, or where no start leads anywhere.
    """
    cascade = model.has_function
    if method is None:
        method = "svi" if cascade or guide not in (None, "collapsed") else "map"
    if method not in ("map", "svi", "nuts"):
        raise invalid("method", expected="'map', 'svi' or 'nuts'", got=repr(method))
    if optimizer is None:
        optimizer = "adam" if cascade else "lbfgs"
    if optimizer not in ("lbfgs", "preconditioned", "adam"):
        expected = "'lbfgs', 'preconditioned' or 'adam'"
        raise invalid("optimizer", expected=expected, got=repr(optimizer))
    asked = restarts is not None
    if restarts is None:
        restarts = 8 if cascade else 6
    counts = {"restarts": restarts, "chains": chains, "particles": particles}
    for name, count in {**counts, "steps": 1 if steps is None else steps}.items():
        if count < 1:
            raise invalid(name, expected="a whole number >= 1", got=repr(count))
    if hyperparameters not in (None, "map", "normal", "multivariate normal"):
        raise invalid(
            "hyperparameters",
            expected="'map', 'normal' or 'multivariate normal'",
            got=repr(hyperparameters),
        )
    if guide is not None and model.is_linear and model.integrate == "all":
        raise invalid("guide", expected="None for a linear model, which is exact", got=repr(guide))
    if start is not None and guide not in (None, "collapsed"):
        raise invalid("start", expected="None with this guide", got="a fit")
    learnt = None if start is None else dict(start.mode)
    records = model.check(record)
    model = model.scaled_to(records)
    argument = records[0] if isinstance(record, Record) else records
    kept = Checkpoints.at(
        checkpoint,
        model,
        [one.fingerprint for one in records],
        method,
        _identity(guide),
        hyperparameters,
        (seed, restarts, steps, optimizer, draws, chains, warmup, particles, learning_rate),
        *([] if learnt is None else [{name: v.tolist() for name, v in learnt.items()}]),
    )
    if guide not in (None, "collapsed"):
        if method != "svi":
            raise invalid("method", expected="'svi' with this guide", got=repr(method))
        return fit_layered(
            model,
            records,
            guide,
            seed=seed,
            restarts=restarts if asked else 2,
            steps=steps or 1000,
            particles=particles,
            learning_rate=learning_rate,
            draws=draws or 200,
            checkpoints=kept,
            workers=workers,
            progress=progress,
        )
    target = model.collapsed
    if not model.is_linear:
        optima = best_optima(
            target, records, restarts, steps or 600, optimizer, seed, workers, progress, kept,
            learnt,
        )  # fmt: skip
    else:
        climb = steps if steps is not None and method == "map" else None
        starts = starting_values(model, records, count=restarts, seed=seed)
        if learnt is not None:
            starts = [grown(learnt, starts[0]), *starts]
        optima = maximise(
            target,
            argument,
            starts,
            optimizer=optimizer,
            steps=climb or (1500 if optimizer == "adam" else 500),
            seed=seed,
            workers=workers,
            progress=progress,
            checkpoints=kept,
        )
    if optima[0].energy >= WALL:
        raise ValueError(
            "fit: no start reached a point where the likelihood can be evaluated. Check the "
            "record for jumps of many orders of magnitude, or try fewer pairs."
        )
    if method == "map":
        return at_optimum(model, optima, seed, records)
    common = _common(model, method, optima, seed, records)
    best = optima[0]
    if method == "svi":
        chosen = hyperparameters or ("map" if cascade else "multivariate normal")
        most = steps or (POLISH if cascade else 1000)
        found = posterior_of(
            target,
            argument,
            optima,
            chosen,
            steps=min(most, POLISH) if chosen == "map" else most,
            particles=particles,
            learning_rate=learning_rate,
            seed=seed,
            workers=workers,
            checkpoints=kept,
            progress=progress,
        )
        with seeded(seed):
            sampled = draws_of_guide(found.guide, argument, draws or 200, best.values)
        tail = found.elbo[-50:]
        common["mode"] = MappingProxyType(dict(found.mode))
        return Fit(
            draws=MappingProxyType(sampled),
            history=found.elbo,
            diagnostics=MappingProxyType(
                {
                    "elbo": float(tail.mean()),
                    "elbo_sd": float(tail.std()),
                    "optima": float(found.optima),
                }
            ),
            posterior=found.guide,
            **common,
        )
    chain = sample_posterior(
        target,
        argument,
        best.values,
        chains=chains,
        draws=draws or 500,
        warmup=warmup,
        seed=seed,
        workers=workers,
        progress=progress,
    )
    diagnostics = {"divergences": float(chain.divergences), "chains": float(chains)}
    for site, values in chain.r_hat.items():
        diagnostics[f"r_hat {site}"] = float(values.max())
    for site, values in chain.effective_samples.items():
        diagnostics[f"effective samples {site}"] = float(values.min())
    return Fit(
        draws=MappingProxyType({k: v.flatten(0, 1) for k, v in chain.draws.items()}),
        history=best.history,
        diagnostics=MappingProxyType(diagnostics),
        **common,
    )


def _identity(guide: GuideChoice) -> object:
    """What tells one guide from another, the same in every process."""
    if guide is None or isinstance(guide, str):
        return guide
    if isinstance(guide, Mapping):
        return sorted(guide.items())
    named = guide if hasattr(guide, "__qualname__") else type(guide)
    code = getattr(guide, "__code__", None)
    body = None
    if code is not None:
        constants = tuple(c for c in code.co_consts if isinstance(c, int | float | str))
        body = (code.co_code, code.co_names, constants)
    return (named.__module__, named.__qualname__, body)


def at_optimum(model: Any, optima: Sequence[Optimum], seed: int, records: Sequence[Record]) -> Fit:
    """The fit that the best of several optima is: a posterior mode."""
    best = optima[0]
    return Fit(
        draws=MappingProxyType({k: v.unsqueeze(0) for k, v in best.values.items()}),
        history=best.history,
        diagnostics=MappingProxyType({"iterations": float(len(best.history))}),
        **_common(model, "map", optima, seed, records),
    )


def _common(
    model: Any, method: Method, optima: Sequence[Optimum], seed: int, records: Sequence[Record]
) -> dict[str, Any]:
    return {
        "model": model,
        "method": method,
        "mode": MappingProxyType(optima[0].values),
        "start_energies": np.array([optimum.energy for optimum in optima]),
        "seed": seed,
        "records": tuple(records),
    }


def draws_of_guide(guide: Guide, args: Any, count: int, sites: Iterable[str]) -> dict[str, Tensor]:
    """Draws (count, *shape) of the sites named."""
    with torch.no_grad(), pyro.plate("draws", count, dim=-1):
        trace = pyro.poutine.trace(guide).get_trace(args)
    return {name: trace.nodes[name]["value"] for name in sites}
