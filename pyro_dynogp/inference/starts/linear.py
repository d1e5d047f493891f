"""Linear fits: their starts, and what they give to the layers of a cascade."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest

from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.inference.optimise.gauss_newton import has_innovations
from pyro_dynogp.inference.optimise.maximum import Optimizer, maximise
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.plans import (
    Values,
    leading_layers,
    linear_twin,
    plans,
    starting_point,
)
from pyro_dynogp.inference.starts.poles import starting_values
from pyro_dynogp.inference.starts.subspace import subspace_starts
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.wiring import Dynamic
from pyro_dynogp.support.parallel import seeded

# Most starts of linear fits of each kind; iterations of those that come before cascades.
RANDOM = 6
LINEAR_STEPS = 40
# A linear model, the records that it is fitted to, and its optima, best first.
Twin = tuple[Model, Sequence[PreparedRecord], Sequence[Values]]


def starting_points(
    model: Model, records: Sequence[PreparedRecord], run: Run, *, count: int, steps: int
) -> list[Values]:
    """Values of every site for each restart, from the optima of linear fits."""
    return spread(model, records, linear_twins(model, records, run, steps), count, run.seed)


def spread(
    model: Model,
    records: Sequence[PreparedRecord],
    twins: Mapping[str, Twin],
    count: int,
    seed: int,
) -> list[Values]:
    """Values of every site for each of so many restarts, from the optima of the twins."""
    optima = {name: values for name, (_, _, values) in twins.items()}
    with seeded(seed):  # what has no typical value is drawn
        return [starting_point(model, records, one) for one in plans(model, optima, count, seed)]


def linear_twins(
    model: Model, records: Sequence[PreparedRecord], run: Run, steps: int
) -> dict[str, Twin]:
    """A fitted linear model for each layer that can take over one."""
    scaling = records[0].scaling
    twins: dict[str, Twin] = {}
    known: dict[Model, Twin] = {}
    for one in leading_layers(model):
        assert isinstance(one.layer, Dynamic)
        linear = linear_twin(model, one.layer, scaling)
        if linear not in known:
            training = tuple(records) if linear.outputs == model.outputs else _one_output(records)
            twin = replace(linear, scaling=training[0].scaling)
            found = maximise(
                twin,
                training,
                linear_starts(twin, training, None, run.seed),
                run,
                optimizer=optimizer_for(twin),
                steps=min(LINEAR_STEPS, steps),
                key=f"linear-{one.name}",
            )
            known[linear] = twin, training, [optimum.values for optimum in found]
        twins[one.name] = known[linear]
    return twins


def _one_output(records: Sequence[PreparedRecord]) -> tuple[PreparedRecord, ...]:
    names = [records[0].record.output_names[0]]
    selected = [each.record.select(outputs=names) for each in records]
    scaling = Scaling.from_records(selected)
    return tuple(PreparedRecord.of(record, scaling) for record in selected)


def linear_starts(
    model: Model, records: Sequence[PreparedRecord], count: int | None, seed: int
) -> list[Values]:
    """Starts of a linear model: of subspace identification and with random poles, in turn.

    Args:
        model: the model. records: to which it is fitted. seed: of random poles.
        count: how many; None for `RANDOM` of each kind, as far as there are orders.
    """
    subspace = subspace_starts(model, records, seed)[:RANDOM]
    random = starting_values(model, records, count=count or RANDOM, seed=seed)
    both = [one for pair in zip_longest(subspace, random) for one in pair if one is not None]
    return both[:count]


def optimizer_for(model: Model) -> Optimizer:
    """Gauss-Newton for Gaussian innovations, Adam for functions that do not feed back."""
    if has_innovations(model):
        return "gauss-newton"
    return "adam" if model.has_function and not model.has_feedback else "lbfgs"
