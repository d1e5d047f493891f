"""Posterior modes of extended models, from what the models that they extend have learnt."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from pyro_dynogp.data.record import Record
from pyro_dynogp.fitting import Fit
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.mode import at_optimum, climb, grow
from pyro_dynogp.inference.optimise.descent import descend
from pyro_dynogp.inference.optimise.lockstep import Functions
from pyro_dynogp.inference.optimise.maximum import Effort, Optimum, maximise
from pyro_dynogp.inference.optimise.side_by_side import each_in_lockstep
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.dynamic import Values
from pyro_dynogp.inference.starts.plans import starting_points
from pyro_dynogp.inference.starts.poles import (
    grown,
    random_poles,
    starting_values,
    values_given_poles,
)
from pyro_dynogp.models.delays import longest_delay, where_inputs_are_known
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord

# Iterations and fresh starts beside the warm one, of linear models and of cascades.
LINEAR_STEPS, LINEAR_STARTS = 120, 2
CASCADE_STEPS, CASCADE_STARTS = 300, 4
# Iterations from what the base of a cascade has learnt, and of linear models that fill its sites.
WARM_STEPS, FILLING_STEPS = 100, 40
# Starts that climb side by side, as processors are kept busy by other trials, and the share of them
# that climbs to the end.
TOGETHER, KEPT = 8, 1 / 2
# Iterations of all variants of an effect, and more of the leading ones: this share, three at least.
FIRST_STEPS, MORE_STEPS = 8, 32
LEADING, FEWEST = 1 / 5, 3


# A linear model in the units of its records, and where it may start.
_Beginning = tuple[Model, tuple[PreparedRecord, ...], list[Values]]


def quick_fit(
    model: Model,
    record: Record,
    seed: int,
    base: Fit | None = None,
    *,
    poles: np.ndarray | None = None,
) -> Fit:
    """Posterior mode of a model, from few starts and from the fit of the model it extends.

    Args:
        model: the model. record: training record. seed: of fresh starts.
        base: fit of the model that it extends, where it may start.
        poles: (P,) that a linear model may start from [1/time unit]; by default those of the base.

    Raises:
        ValueError: where the record does not fit the model, or a channel is constant.
    """
    scaled, records = _scaled(model, record)
    if scaled.is_linear:
        starts = starting_values(scaled, records, count=LINEAR_STARTS, seed=seed)
        starts += _warm_starts(scaled, records, seed, base, poles)
        optima = _linear(scaled, records, starts, LINEAR_STEPS, seed)
    elif base is not None and _begins(scaled, base):
        optima = _grown(scaled, records, seed, base, WARM_STEPS, FILLING_STEPS)
    else:
        optima = _fresh(scaled, records, seed)
    return Fit.of(at_optimum(scaled, optima, seed, records))


def race(
    models: Sequence[Model], record: Record, base: Fit, seed: int
) -> tuple[list[Fit], list[str]]:
    """Variants of one effect, the most probable first, and why others could not be fitted.

    All take a few steps from what the base has learnt, the leading ones more: a variant that is
    far behind after the first (they differ by tens to hundreds of nats) hardly ever wins.

    Args:
        models: variants. record: training record. base: fit of the model that they extend.
        seed: of what has no typical value.
    """
    found: list[Fit] = []
    problems: list[str] = []
    beginnings: list[_Beginning] = []
    for model in models:
        try:
            if not _begins(model, base):
                found.append(quick_fit(model, record, seed, base))
                continue
            scaled, records = _scaled(model, record)
            if not scaled.is_linear:
                optima = _grown(scaled, records, seed, base, FIRST_STEPS, FIRST_STEPS // 3)
                found.append(Fit.of(at_optimum(scaled, optima, seed, records)))
            else:
                beginnings.append((scaled, records, _warm_starts(scaled, records, seed, base)))
        except ValueError as error:  # for instance a channel that is constant there
            problems.append(str(error))
    found = sorted([*found, *_side_by_side(beginnings, FIRST_STEPS, seed)], key=energy)
    cut = max(FEWEST, round(LEADING * len(found)))
    begun = [one for one in found[:cut] if _begins(one.model, base)]
    rest = [one for one in found if not any(one is other for other in begun)]
    further = [_further(one, seed) for one in begun if not one.model.is_linear]
    more = [(one.model, one.model.prepare(one.records), [dict(one.mode)])
            for one in begun if one.model.is_linear]  # fmt: skip
    further += _side_by_side(more, MORE_STEPS, seed)
    return sorted([*further, *rest], key=energy), problems


def energy(fit: Fit) -> float:
    """-log p(y, values) at the mode [nats]."""
    return float(fit.start_energies[0])


def poles_of(fit: Fit) -> np.ndarray | None:
    """Poles (P,) of the pairs of a linear model at its mode [1/time unit]; None for a cascade."""
    if not fit.model.is_linear:
        return None
    ((_, layer),), ((_, made),) = fit.system_at(fit.mode).dynamic, fit.model.dynamic
    poles: np.ndarray = layer.modes.poles[: made.pairs].numpy()
    return poles


def _scaled(model: Model, record: Record) -> tuple[Model, tuple[PreparedRecord, ...]]:
    """The model in the units of a record, and the record as it sees it.

    Outputs count where the model knows its inputs.
    """
    problem = Problem.of(model, where_inputs_are_known(record, longest_delay(model)))
    return problem.model, problem.records


def _begins(model: Model, base: Fit) -> bool:
    """Whether a model begins where its base is: it has the same layers."""
    return len(model.layers) == len(base.model.layers)


def _side_by_side(beginnings: Sequence[_Beginning], steps: int, seed: int) -> list[Fit]:
    """Fits of linear models, each from the most probable of its starts, some steps on.

    Variants that differ in their inputs only (a delay, a limit, which channel) go through the model
    together at each step.
    """
    potentials = [
        Potential(model.collapsed, (records,), starts[0]) for model, records, starts in beginnings
    ]

    def run(potential: Potential, starts: Sequence[Values]) -> Callable[[Functions], Optimum]:
        z = np.stack([potential.pack(one).numpy() for one in starts])

        def climb(functions: Functions) -> Optimum:
            best = z[functions(z)[0].argmin()]
            end, history, message = descend(
                functions, best, steps, every=potential.hessian_cost, first=0
            )
            values = {k: v.detach() for k, v in potential.unpack(torch.tensor(end)).items()}
            return Optimum(float(functions(end[None])[0][0]), values, np.asarray(history), message)

        return climb

    runs = [run(one, starts) for one, (_, _, starts) in zip(potentials, beginnings, strict=True)]
    optima = each_in_lockstep(potentials, runs, jacobian=False)
    return [
        Fit.of(at_optimum(model, [optimum], seed, records))
        for optimum, (model, records, _) in zip(optima, beginnings, strict=True)
    ]


def _further(found: Fit, seed: int) -> Fit:
    """More steps of a cascade's climb that has begun."""
    optima = maximise(
        found.model.collapsed, found.model.prepare(found.records), [dict(found.mode)],
        Run(seed, workers=1), optimizer="preconditioned", steps=MORE_STEPS,
        effort=Effort(near=True),
    )  # fmt: skip
    return Fit.of(at_optimum(found.model, optima, seed, found.records))


def _linear(
    model: Model,
    records: Sequence[PreparedRecord],
    starts: Sequence[Values],
    steps: int,
    seed: int,
) -> list[Optimum]:
    return maximise(
        model.collapsed, records, starts, Run(seed, workers=1), optimizer="preconditioned",
        steps=steps, effort=Effort(together=TOGETHER, kept=KEPT),
    )  # fmt: skip


def _warm_starts(
    model: Model,
    records: Sequence[PreparedRecord],
    seed: int,
    base: Fit | None,
    poles: np.ndarray | None = None,
) -> list[Values]:
    """From the poles of the base, and from all that it has learnt."""
    assert model.scaling is not None
    starts: list[Values] = []
    if poles is None and base is not None:
        poles = poles_of(base)
    if poles is not None:
        generator = np.random.default_rng(seed)
        ((_, layer),) = model.dynamic
        more = layer.pairs - len(poles)
        for _ in range(1 if more <= 0 else 3):
            kept = poles[: layer.pairs]
            if more > 0:
                fresh = random_poles(more, model.scaling, generator)
                kept = np.concatenate([kept, fresh])
            starts.append(values_given_poles(model, records, model.scaling, kept)[1])
    if base is not None and _begins(model, base):
        starts.append(grown(base.mode, starts[-1]))
    return starts


def _fresh(model: Model, records: Sequence[PreparedRecord], seed: int) -> list[Optimum]:
    """Without a function a cascade starts at its optimum but for the noise: one start is enough."""
    count = CASCADE_STARTS if model.has_function else 1
    target, run = model.collapsed, Run(seed, workers=1)
    starts = starting_points(target, records, run, count=count, steps=LINEAR_STEPS)
    return climb(
        target, records, starts, [], run, optimizer="adam", steps=CASCADE_STEPS,
        effort=Effort(together=TOGETHER),
    )  # fmt: skip


def _grown(
    model: Model, records: Sequence[PreparedRecord], seed: int, base: Fit, steps: int, filling: int
) -> list[Optimum]:
    """From what a cascade of the same layers has learnt; what it lacks is filled and silent."""
    target, run = model.collapsed, Run(seed, workers=1)
    (start,) = starting_points(target, records, run, count=1, steps=filling)
    assert model.scaling is not None
    learnt = grown(base.mode, start, model.all_sites(model.scaling, len(records)))
    return grow(target, records, learnt, start, run, steps=steps)
