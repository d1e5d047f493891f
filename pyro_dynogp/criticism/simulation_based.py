"""Simulation-based calibration: whether a method of inference is right over its prior."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import pyro
import torch
from torch import Tensor

from pyro_dynogp.criticism.posterior_draws import equal_draws, log_joint
from pyro_dynogp.criticism.rank_results import SimulationBasedCalibration, judged
from pyro_dynogp.criticism.ranks import rank_of
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.records import one_record
from pyro_dynogp.inference.isolation import isolated
from pyro_dynogp.inference.methods.base import Method, Problem
from pyro_dynogp.inference.methods.choose import method_of
from pyro_dynogp.inference.posteriors import MethodName
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.training import train_model
from pyro_dynogp.models.model import Model
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.parallel import child_seeds, parallel_map, seeded

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted

JOINT = "log joint"
# NUTS draws so many times as many as are kept, so that those are nearly independent.
THIN = 5


@dataclass(frozen=True)
class _Task:
    """One replicate.

    Attributes:
        model: whose scaling states the prior. blank: record without outputs.
        missing: (n, n_y) gaps. method: of inference. draws: L.
        run: of the fit; its seed is for all of it. learnt: what it may start from.
    """

    model: Model
    blank: Record
    missing: np.ndarray
    method: Method
    draws: int
    run: Run
    learnt: Mapping[str, Tensor] | None


@dataclass(frozen=True)
class _Outcome:
    """Ranks by quantity, or why there are none, and the fewest effective draws of a site."""

    ranks: Mapping[str, int]
    failure: str
    effective: float


@isolated
def simulation_based_calibration(
    model: Model,
    record: Record,
    *,
    method: MethodName = "svi",
    replicates: int = 50,
    draws: int = 99,
    level: float = 0.95,
    seed: int = 0,
    workers: int | None = None,
    progress: bool = True,
    **fit_options: Any,
) -> SimulationBasedCalibration:
    """Whether a method of inference finds parameters again that were drawn from the prior.

    Parameters are drawn from the prior, outputs from the model at them, and the model is fitted to
    these outputs alone, from starting points of its own. The rank of each true value among draws
    of its posterior is uniform if prior, likelihood and inference agree (Talts, Betancourt,
    Simpson, Vehtari & Gelman 2018). Ranked are every number of every site that the fit has, and
    the log joint density, which sees the data (Modrák et al. 2023) and all sites together.

    Nothing is conditioned on: a draw from the prior whose outputs cannot be computed, or to which
    no fit can be made, is neither drawn again nor left out silently. It is counted in `failures`,
    with its reason, and in the verdict; if there are many, the ranks of the others need not be
    uniform even where all is right.

    Of "map" the posterior is Laplace's approximation around the mode. Of a cascade outputs come
    from the model with all its trajectories, so that the moment-matching filter is tested, too;
    sites that its fit keeps at the optimum (``hyperparameters="map"``) have no posterior and are
    found miscalibrated, rightly. With several pairs, which can be swapped, a posterior around one
    optimum has the truth's pairs in another order: look at the log joint and the noise then.

    Args:
        model: with a scaling (``model.scaled_to(record)``), which states the prior and stays.
        record: gives times and inputs, and where it has outputs which ones are missing.
        method: of `fit`. replicates: number N of simulated records.
        draws: L, posterior draws that a truth is ranked among; NUTS makes five times as many,
            thinned to these.
        level: probability that nothing is found where all is right.
        seed: for everything. workers: processes. progress: whether to show a bar.
        fit_options: of `fit`: restarts, steps, chains, warmup, hyperparameters, ...

    Raises:
        ValueError: on a model without scaling or with priors="paper", whose draws exceed
            floating-point range; several records; numbers out of range; options of `fit` that it
            cannot have here; where no replicate could be fitted.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> model = dgp.LinearDynamicGP(1, pairs=1).scaled_to(record)
        >>> options = {"method": "map", "replicates": 3, "draws": 9}
        >>> quick = {"restarts": 1, "workers": 1, "progress": False}
        >>> found = dgp.simulation_based_calibration(model, record[:30], **options, **quick)
        >>> type(found).__name__
        'SimulationBasedCalibration'
    """
    _check(model, record, method, replicates, draws, level, fit_options)
    model.check(record)
    blank = record.with_outputs(np.empty((len(record), 0)), names=(), units=())
    gaps = record.missing if record.n_outputs else np.zeros((len(record), model.outputs), bool)
    chosen, run, learnt = _method(model, method, draws, fit_options)
    tasks = [
        _Task(model, blank, gaps, chosen, draws, replace(run, seed=child), learnt)
        for child in child_seeds(seed, replicates)
    ]
    outcomes = parallel_map(
        _replicate,
        tasks,
        workers=workers,
        progress=progress,
        description="simulation-based calibration",
        news=lambda done: f"{sum(bool(outcome.failure) for outcome in done)} failed",
    )
    good = [outcome for outcome in outcomes if not outcome.failure]
    failures = tuple(outcome.failure for outcome in outcomes if outcome.failure)
    if not good:
        raise invalid(
            "model", expected="a prior to whose data fits can be made",
            got=f"{replicates} replicates that all failed, the first with: {failures[0]}",
        )  # fmt: skip
    ranks = {name: np.array([outcome.ranks[name] for outcome in good]) for name in good[0].ranks}
    few = sum(outcome.effective < draws for outcome in good)
    notes = []
    if few:
        notes.append(
            f"In {few} of {len(good)} fits a site had fewer than {draws} effective draws: ranks "
            "pile up at both ends for that reason alone. Raise warmup or chains, or lower draws."
        )
    result = judged(ranks, draws, method=method, failures=failures, level=level, seed=seed)
    return replace(result, notes=tuple(notes))


def _check(
    model: object,
    record: object,
    method: object,
    replicates: object,
    draws: object,
    level: object,
    options: Mapping[str, Any],
) -> None:
    if not isinstance(model, Model):
        raise invalid("model", expected="a LinearDynamicGP or a Cascade", got=type(model).__name__)
    if model.scaling is None:
        raise invalid(
            "model", expected="a model with its scaling, which states its prior", got="none",
            advice="Use model.scaled_to(record) with a typical record.",
        )  # fmt: skip
    if model.priors == "paper":
        raise invalid(
            "model", expected="priors that can be drawn from", got="priors='paper', which are flat"
        )
    one_record(record, "Calibrate one after the other.")
    if method not in get_args(MethodName):
        raise invalid("method", expected=f"one of {list(get_args(MethodName))}", got=repr(method))
    for name, value, least in (("replicates", replicates, 2), ("draws", draws, 9)):
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise invalid(name, expected=f"a whole number >= {least}", got=repr(value))
    if not isinstance(level, float) or not 0.5 <= level < 1.0:
        raise invalid("level", expected="a probability from 0.5 to below 1", got=repr(level))
    if "checkpoint" in options:
        raise invalid(
            "checkpoint", expected="none: every replicate is another run", got="one for all"
        )


def _replicate(task: _Task) -> _Outcome:
    """Truth, data, fit and ranks; errors of the numbers are outcomes, others are raised."""
    try:
        truth, record = _simulated(task)
        fitted = _fitted(task, record)
        return _ranked(task, truth, fitted)
    except (ValueError, RuntimeError, FloatingPointError) as error:  # singular, out of range
        reason = " ".join(str(error).split())
        return _Outcome({}, f"{type(error).__name__}: {reason[:200]}", np.inf)


def _simulated(task: _Task) -> tuple[dict[str, Tensor], Record]:
    """Values of all sites from the prior, and a record of what the model makes of them."""
    with seeded(task.run.seed), torch.no_grad(), pyro.poutine.block():
        trace = pyro.poutine.trace(task.model).get_trace(task.blank)
    sites = {name: node["value"] for name, node in trace.nodes.items() if node["type"] == "sample"}
    y = sites.pop("y").numpy().reshape(task.missing.shape)
    if not np.isfinite(y).all():
        raise FloatingPointError("the outputs drawn from the model are not finite")
    scaling = task.model.scaling
    assert scaling is not None
    y = np.where(task.missing, np.nan, y)
    names, units = scaling.output_names, scaling.output_units
    return sites, task.blank.with_outputs(y, names=names, units=units)


def _method(
    model: Model, name: MethodName, draws: int, options: Mapping[str, Any]
) -> tuple[Method, Run, Mapping[str, Tensor] | None]:
    """The method that gives so many draws, what its runs share, and values that it starts from."""
    loose = dict(options)
    run = Run(workers=1, restarts=loose.pop("restarts", None), steps=loose.pop("steps", None))
    start = loose.pop("start", None)
    if name == "nuts":
        loose["draws"] = -(-THIN * draws // loose.get("chains", 4))
    elif name in ("svi", "importance"):
        loose["draws"] = draws
    chosen = method_of(name, model, loose)
    chosen.check(model, warm=start is not None)
    return chosen, run, None if start is None else dict(start.mode)


def _fitted(task: _Task, record: Record) -> Fitted:
    problem = Problem(task.model, task.model.prepare(record), task.learnt)
    return train_model(problem, task.method, task.run)


def _ranked(task: _Task, truth: Mapping[str, Tensor], fitted: Fitted) -> _Outcome:
    generator = np.random.default_rng(task.run.seed)
    own = equal_draws(fitted, count=task.draws, seed=task.run.seed)
    known = {name: truth[name].unsqueeze(0) for name in own.values}
    log_p = log_joint(fitted, own.values) if own.log_p is None else own.log_p
    kept = np.linspace(0, len(own) - 1, task.draws).round().astype(int)
    ranks = {}
    for name, values in own.values.items():
        flat = values[kept].reshape(task.draws, -1).numpy()
        for i, true in enumerate(known[name].reshape(-1).tolist()):
            label = f"{name}[{i}]" if flat.shape[1] > 1 else name
            ranks[label] = rank_of(flat[:, i], true, generator)
    ranks[JOINT] = rank_of(log_p[kept], float(log_joint(fitted, known)[0]), generator)
    effective = [v for k, v in fitted.diagnostics.items() if k.startswith("effective samples ")]
    return _Outcome(ranks, "", min(effective, default=np.inf))
