"""Fits of a cascade whose trajectories stay sample sites: Pyro's SVI with a guide of layers."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pyro
import torch
from pyro.infer import Trace_ELBO, TraceMeanField_ELBO
from torch import Tensor

from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.svi import Schedule, Trained, train
from pyro_dynogp.inference.methods.trajectory_guide import (
    GuideChoice,
    layer_guide,
    parameter_sites,
    starting_trajectories,
    with_trajectories,
)
from pyro_dynogp.inference.posteriors import Sampled
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.plans import starting_points
from pyro_dynogp.layers.sites import Arguments, Program
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.support.checkpoints import Piece
from pyro_dynogp.support.errors import invalid, verify
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.parallel import child_seeds, parallel_map, seeded

Values = dict[str, Tensor]


@dataclass(frozen=True)
class _Task:
    model: Model
    records: tuple[PreparedRecord, ...]
    method: Trajectories
    values: Values
    run: Run
    schedule: Schedule
    key: str


def _run(task: _Task) -> Piece:
    """Train from one start; the ELBO and draws of every site, kept as one piece."""

    def compute() -> Piece:
        args = (task.records,)
        with pyro.get_param_store().scope(), pyro.validation_enabled(False):
            method = task.method
            own = callable(method.guide) and not isinstance(method.guide, Mapping)
            guide: Program
            through: Program
            if own:
                # A `LayerGuide` remembers the sites of its first call.
                guide = copy.deepcopy(cast(Program, method.guide))
                through = guide
                loss: Any = Trace_ELBO(num_particles=task.schedule.particles)
            else:
                n = max(len(r) for r in task.records)
                guide = layer_guide(task.model, method.guide, task.values, n)
                through = guide.single_pass()
                loss = TraceMeanField_ELBO(
                    num_particles=task.schedule.particles,
                    vectorize_particles=True,
                    max_plate_nesting=0,
                )
            trained = train(
                task.model,
                through,
                args,
                loss,
                task.run,
                task.schedule,
                key=task.key,
                rise=0.5,
                layers={place.name: place.described for place in task.model.wires},
            )
            with seeded(task.run.seed):
                draws, log_q = _draw(guide, args, method.draws, vectorised=not own)
        return _pack(trained, draws, log_q)

    return task.run.checkpoints.piece(f"{task.key}-result", compute)


def _level(piece: Piece) -> float:
    """ELBO over the last steps."""
    return float(piece["elbo"][-50:].mean())


def _pack(trained: Trained, draws: Values, log_q: Values) -> Piece:
    return {
        "elbo": torch.tensor(trained.elbo, dtype=torch.float64),
        **{f"draw/{name}": value for name, value in draws.items()},
        **{f"log_q/{name}": value for name, value in log_q.items()},
    }


def _draw(
    guide: Program, args: Arguments, count: int, *, vectorised: bool
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
        return {name: torch.stack([trace[name] for trace in traces]) for name in traces[0]}

    with torch.no_grad():
        if vectorised:
            with pyro.plate("draws", count, dim=-1):
                draws, log_q = latent(pyro.poutine.trace(guide).get_trace(*args))
            return draws, {k: v.expand(count) for k, v in log_q.items()}
        traces = [latent(pyro.poutine.trace(guide).get_trace(*args)) for _ in range(count)]
    log_q = stack([{k: v.sum() for k, v in densities.items()} for _, densities in traces])
    return stack([own for own, _ in traces]), log_q


@dataclass(frozen=True)
class Trajectories:
    """SVI with the trajectories of a model as sample sites, from every start; the best by its ELBO.

    Steps of the run are those of SVI (default 1000); it has two starts by default.

    Attributes:
        guide: "gauss-markov" or "inducing times": the family of all trajectories. A mapping from
            site names to families of `pyro_dynogp.guides`: these sites so, all others as
            "gauss-markov" has them. A Pyro function: your own guide for the model with all its
            trajectories.
        draws: posterior draws to keep.
        particles, learning_rate: of SVI.

    Raises:
        ValueError: on numbers below one, or a guide that holds its own parameters.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> model = dgp.Wiener(1, pairs=1, inducing=6)
        >>> method = dgp.Trajectories(draws=20, particles=2)
        >>> quick = {"restarts": 1, "steps": 3, "workers": 1, "progress": False}
        >>> dgp.fit(model, record, method=method, **quick).method
        'svi'
    """

    guide: GuideChoice = "gauss-markov"
    draws: int = 200
    particles: int = 8
    learning_rate: float = 0.02

    def __post_init__(self) -> None:
        verify(draws=self.draws, particles=self.particles, learning_rate=self.learning_rate)
        if isinstance(self.guide, torch.nn.Module):
            raise invalid(
                "guide",
                expected="a Pyro function whose parameters are in the parameter store",
                got=f"{type(self.guide).__name__}, which holds them itself",
                advice="Restarts would share them. Write the guide as a function with pyro.param, "
                "or use dgp.LayerGuide.",
            )

    @property
    def _written(self) -> bool:
        """Whether the guide is a function of the user's."""
        return callable(self.guide) and not isinstance(self.guide, Mapping)

    def check(self, model: Model, *, warm: bool) -> None:
        """Refuse an unknown guide, a linear model that is exact, and a start from another fit."""
        if model.is_linear and model.integrate == "all":
            got = repr(self.guide)
            raise invalid("guide", expected="None for a linear model, which is exact", got=got)
        if warm:
            raise invalid("start", expected="None with this guide", got="a fit")
        if not self._written:
            layer_guide(self._target(model), self.guide, {}, 2)

    def _target(self, model: Model) -> Model:
        return replace(model, integrate="none") if self._written else with_trajectories(model)

    def __call__(self, problem: Problem, run: Run) -> Fitted:
        """The best start's draws, with their log-density by site."""
        pieces = self._trained(problem, run)
        levels = [_level(piece) for piece in pieces]
        order = np.argsort([-level for level in levels])
        best = pieces[int(order[0])]
        sampled = {k[len("draw/") :]: v for k, v in best.items() if k.startswith("draw/")}
        parameters = parameter_sites(problem.model, problem.records)
        missing = [name for name in parameters if name not in sampled]
        if missing:
            raise invalid(
                "guide",
                expected=f"a guide that samples every parameter, {missing} too",
                got="not them",
            )
        kept = {name: sampled[name] for name in parameters}
        elbo = best["elbo"].numpy()
        tail = elbo[-50:]
        log_q = {k[len("log_q/") :]: v for k, v in best.items() if k.startswith("log_q/")}
        others = {k: v for k, v in sampled.items() if k not in kept}
        draws = FrozenMapping(kept)
        return problem.fitted(
            run,
            Sampled(draws, "svi", FrozenMapping(others), FrozenMapping(log_q)),
            draws,
            {k: v.median(0).values for k, v in kept.items()},
            elbo,
            -np.array(levels)[order],
            {"elbo": float(tail.mean()), "elbo_sd": float(tail.std())},
        )

    def _trained(self, problem: Problem, run: Run) -> list[Piece]:
        """What each start comes to."""
        restarts, steps = run.restarts or 2, run.steps or 1000
        target = self._target(problem.model)
        points: list[Values] = [{}] * restarts
        if not self._written:
            found = starting_points(target, problem.records, run, count=restarts, steps=steps)
            points = [{**v, **starting_trajectories(target, problem.records, v)} for v in found]
        tasks = [
            _Task(
                target,
                problem.records,
                self,
                point,
                replace(run, seed=seed, progress=run.progress and run.workers == 1),
                Schedule(steps, self.particles, self.learning_rate),
                f"start-{index}",
            )
            for index, (point, seed) in enumerate(
                zip(points, child_seeds(run.seed, restarts), strict=True)
            )
        ]
        return parallel_map(
            _run,
            tasks,
            workers=run.workers,
            progress=run.progress,
            description="SVI",
            news=lambda found: f"elbo {max(_level(piece) for piece in found):.2f}",
        )
