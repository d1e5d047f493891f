"""Fits of a cascade whose trajectories stay sample sites: Pyro's SVI with a guide of layers."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pyro
import torch
from pyro.infer import Trace_ELBO, TraceMeanField_ELBO
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.guides.families import (
    Family,
    FullRank,
    GaussMarkov,
    InducingTimes,
    MeanField,
    SameAsPrior,
)
from pyro_dynogp.guides.layer_guide import LayerGuide
from pyro_dynogp.inference.fitted import Fit
from pyro_dynogp.inference.methods.mode import GuideChoice, starting_points
from pyro_dynogp.inference.methods.svi import Trained, train
from pyro_dynogp.layers.noise import Gaussian
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.wiring import Dynamic
from pyro_dynogp.support.checkpoints import Checkpoints, Piece
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.parallel import child_seeds, parallel_map, seeded

Values = dict[str, Tensor]
# Inducing times of a trajectory, as a share of its samples and at most.
INDUCING_SHARE, INDUCING_MOST = 0.5, 400
# First standard deviation of pseudo-observations (layers have unit scale).
PSEUDO_SD = 0.3


def with_trajectories(model: Model) -> Model:
    """The model that a guide of layers fits: a linear Gaussian last layer is integrated exactly."""
    exact = isinstance(model.layers[-1], Dynamic) and model.likelihood == Gaussian()
    return replace(model, integrate="last" if exact else "none")


def layer_guide(model: Model, choice: Any, values: Mapping[str, Tensor], n: int) -> LayerGuide:
    """Guide for a cascade with its trajectories as sites.

    Trajectories: Gauss-Markov sites or inducing times; whitened inducing values: a multivariate
    normal for each static layer; values of a last static layer and residuals of functions: as the
    model has them; everything else: mean field. A mapping overrides single sites.

    Raises:
        ValueError: for an unknown name.
    """
    kinds: dict[str, Family] = {
        "gauss-markov": GaussMarkov(init_sd=PSEUDO_SD),
        "inducing times": InducingTimes(
            count=min(n, INDUCING_MOST, max(2, int(INDUCING_SHARE * n))), init_scale=0.1
        ),
    }
    chosen: Mapping[str, Family] = {} if isinstance(choice, str) else choice
    kind = choice if isinstance(choice, str) else "gauss-markov"
    if kind not in kinds:
        raise invalid(
            "guide",
            expected=f"'collapsed', one of {sorted(kinds)}, a mapping of sites to families, or a "
            "Pyro function",
            got=repr(choice),
        )
    statics = {one.name for one in model.wires if not isinstance(one.layer, Dynamic)}

    def family(name: str, prior: Any) -> Family:
        base, _, number = name.rpartition("_")
        layer = base if number.isdigit() else name
        if any(layer == one.name for one in model.wires if isinstance(one.layer, Dynamic)):
            return kinds[kind]
        if layer in statics or (name.endswith("_residual") and base in statics):
            return SameAsPrior()
        if name.endswith("_values") and base in statics:
            return FullRank(init_scale=0.03)
        return MeanField(init_scale=0.03)

    return LayerGuide(model, chosen, family, values=values)


@dataclass(frozen=True)
class _Task:
    model: Model
    records: Record | tuple[Record, ...]
    guide: Any
    values: Values
    steps: int
    particles: int
    learning_rate: float
    draws: int
    seed: int
    key: str
    checkpoints: Checkpoints
    progress: bool


def _run(task: _Task) -> Piece:
    """Train from one start; the ELBO and draws of every site, kept as one piece."""

    def compute() -> Piece:
        args = (task.records,)
        with pyro.get_param_store().scope(), pyro.validation_enabled(False):
            own = callable(task.guide) and not isinstance(task.guide, Mapping)
            guide: Callable[..., Any]
            if own:
                # A `LayerGuide` remembers the sites of its first call.
                guide = through = copy.deepcopy(task.guide)
                loss: Any = Trace_ELBO(num_particles=task.particles)
            else:
                n = max(len(r) for r in _several(task.records))
                guide = layer_guide(task.model, task.guide, task.values, n)
                through = guide.single_pass()
                loss = TraceMeanField_ELBO(
                    num_particles=task.particles, vectorize_particles=True, max_plate_nesting=0
                )
            trained = train(
                task.model,
                through,
                args,
                loss,
                steps=task.steps,
                learning_rate=task.learning_rate,
                seed=task.seed,
                checkpoints=task.checkpoints,
                progress=task.progress,
                label=task.key,
                key=task.key,
                rise=0.5,
                layers={one.name: one.described for one in task.model.wires},
            )
            with seeded(task.seed):
                draws, log_q = _draw(guide, args, task.draws, vectorised=not own)
        return _pack(trained, draws, log_q)

    return task.checkpoints.piece(f"{task.key}-result", compute)


def _level(piece: Piece) -> float:
    """ELBO over the last steps."""
    return float(piece["elbo"][-50:].mean())


def _several(records: Record | tuple[Record, ...]) -> tuple[Record, ...]:
    return (records,) if isinstance(records, Record) else records


def _pack(trained: Trained, draws: Values, log_q: Values) -> Piece:
    return {
        "elbo": torch.tensor(trained.elbo, dtype=torch.float64),
        **{f"draw/{name}": value for name, value in draws.items()},
        **{f"log_q/{name}": value for name, value in log_q.items()},
    }


def _draw(
    guide: Callable[..., Any], args: Any, count: int, *, vectorised: bool
) -> tuple[Values, Values]:
    """Draws (S, *shape) of every latent site, and the log-density (S,) of every site's draws."""

    def latent(trace: Any) -> tuple[Values, Values]:
        trace.compute_log_prob()
        sites = {
            name: node
            for name, node in trace.nodes.items()
            if node["type"] == "sample"
            and not node["is_observed"]
            and type(node["fn"]).__name__ != "_Subsample"
        }
        own = {n: s["value"] for n, s in sites.items() if not s["infer"].get("is_auxiliary")}
        return own, {name: site["log_prob"] for name, site in sites.items()}

    def stack(traces: Sequence[Values]) -> Values:
        return {name: torch.stack([one[name] for one in traces]) for name in traces[0]}

    with torch.no_grad():
        if vectorised:
            with pyro.plate("draws", count, dim=-1):
                draws, log_q = latent(pyro.poutine.trace(guide).get_trace(*args))
            return draws, {k: v.expand(count) for k, v in log_q.items()}
        traces = [latent(pyro.poutine.trace(guide).get_trace(*args)) for _ in range(count)]
    log_q = stack([{k: v.sum() for k, v in one.items()} for _, one in traces])
    return stack([own for own, _ in traces]), log_q


def starting_trajectories(model: Model, records: Sequence[Record], values: Values) -> Values:
    """First trajectories of the dynamic layers: smoothed by the moment-matching filter."""
    assert model.scaling is not None
    out: Values = {}
    for index, record in enumerate(records):
        suffix = "" if len(records) == 1 else f"_{index}"
        with torch.no_grad():
            system = model.collapsed.system(values, model.scaling)
            system = model.begin(system, model.states_of(values, suffix))
            outputs = output_process(system, model.scaling, record)
            found = outputs.smooth(record.tensors().observations)
        for one in model.wires:
            integrated = one.last and model.integrate == "last"
            if isinstance(one.layer, Dynamic) and not integrated:
                path = torch.tensor(found[one.name].mean[0])
                out[one.name + suffix] = path if one.layer.outputs > 1 else path[:, 0]
    return out


def fit_layered(
    model: Model,
    records: Sequence[Record],
    guide: GuideChoice,
    *,
    seed: int,
    restarts: int,
    steps: int,
    particles: int,
    learning_rate: float,
    draws: int,
    checkpoints: Checkpoints,
    workers: int | None,
    progress: bool,
) -> Fit:
    """Fit with trajectories as sample sites; see `fit`."""
    own = callable(guide) and not isinstance(guide, Mapping)
    if isinstance(guide, torch.nn.Module):
        raise invalid(
            "guide",
            expected="a Pyro function whose parameters are in the parameter store",
            got=f"{type(guide).__name__}, which holds them itself",
            advice="Restarts would share them. Write the guide as a function with pyro.param, or "
            "use dgp.LayerGuide.",
        )
    target = replace(model, integrate="none") if own else with_trajectories(model)
    if isinstance(guide, str | Mapping):
        layer_guide(target, guide, {}, 2)  # refuse an unknown name before any work
    argument = records[0] if len(records) == 1 else tuple(records)
    points: list[Values] = [{}] * restarts
    if not own:
        found = starting_points(
            target, records, restarts, steps, seed, workers, progress, checkpoints
        )
        points = [{**v, **starting_trajectories(target, records, v)} for v in found]
    tasks = [
        _Task(
            target,
            argument,
            guide,
            point,
            steps,
            particles,
            learning_rate,
            draws,
            one_seed,
            f"start-{index}",
            checkpoints,
            progress and workers == 1,
        )
        for index, (point, one_seed) in enumerate(
            zip(points, child_seeds(seed, restarts), strict=True)
        )
    ]
    results = parallel_map(
        _run,
        tasks,
        workers=workers,
        progress=progress,
        description="SVI",
        news=lambda found: f"elbo {max(_level(piece) for piece in found):.2f}",
    )
    levels = [_level(piece) for piece in results]
    order = np.argsort([-level for level in levels])
    best = results[int(order[0])]
    sampled = {k[len("draw/") :]: v for k, v in best.items() if k.startswith("draw/")}
    parameters = _parameter_sites(model, records)
    missing = [name for name in parameters if name not in sampled]
    if missing:
        raise invalid(
            "guide", expected=f"a guide that samples every parameter, {missing} too", got="not them"
        )
    kept = {name: sampled[name] for name in parameters}
    elbo = best["elbo"].numpy()
    tail = elbo[-50:]
    return Fit(
        model=model,
        method="svi",
        draws=MappingProxyType(kept),
        mode=MappingProxyType({k: v.median(0).values for k, v in kept.items()}),
        history=elbo,
        start_energies=-np.array(levels)[order],
        diagnostics=MappingProxyType({"elbo": float(tail.mean()), "elbo_sd": float(tail.std())}),
        seed=seed,
        records=tuple(records),
        trajectories=MappingProxyType({k: v for k, v in sampled.items() if k not in kept}),
        log_q_sites=MappingProxyType(
            {k[len("log_q/") :]: v for k, v in best.items() if k.startswith("log_q/")}
        ),
    )


def _parameter_sites(model: Model, records: Sequence[Record]) -> list[str]:
    """Names of the sites that the collapsed model has."""
    assert model.scaling is not None
    return [site.name for site in model.collapsed.all_sites(model.scaling, len(records))]
