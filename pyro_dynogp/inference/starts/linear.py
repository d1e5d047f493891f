"""Linear models whose optima start the dynamic layers of cascades, and their own starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import zip_longest

from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.inference.optimise.maximum import maximise, optimizer_for
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.delays import delayed_starts
from pyro_dynogp.inference.starts.dynamic import Values
from pyro_dynogp.inference.starts.poles import starting_values
from pyro_dynogp.inference.starts.subspace import subspace_starts
from pyro_dynogp.models.architectures import LinearDynamicGP
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.wiring import Dynamic, Wire

# Most starts of linear fits of each kind; iterations of those that come before cascades.
RANDOM = 6
LINEAR_STEPS = 40
# A linear model, the records that it is fitted to, and its optima, best first.
Twin = tuple[Model, Sequence[PreparedRecord], Sequence[Values]]


def linear_twin(model: Model, layer: Dynamic, scaling: Scaling) -> Model:
    """The linear model whose optimum starts a dynamic layer."""
    return LinearDynamicGP(
        inputs=model.inputs,
        direct=model.direct,
        outputs=layer.outputs if layer.outputs == model.outputs else 1,
        pairs=layer.pairs,
        integrators=layer.integrators,
        noise=layer.noise,
        brownian=layer.brownian,
        feedthrough=layer.feedthrough,
        process_noise=(layer.process_noise and not layer.feedback) or model.inputs == model.direct,
        channels=model.late,
        scaling=scaling,
    )


def leading_layers(model: Model) -> tuple[Wire, ...]:
    """Dynamic layers that can take over a linear fit: they see as many channels as inputs."""
    return tuple(
        one
        for one in model.wires
        if isinstance(one.layer, Dynamic) and one.channels == model.inputs - model.direct
    )


def one_output(records: Sequence[PreparedRecord]) -> tuple[PreparedRecord, ...]:
    """Records with their reference output alone."""
    reference = records[0].scaling.reference_output
    names = [records[0].record.output_names[reference]]
    selected = [each.record.select(outputs=names) for each in records]
    scaling = Scaling.from_records(selected)
    return tuple(PreparedRecord.of(record, scaling) for record in selected)


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
            training = tuple(records) if linear.outputs == model.outputs else one_output(records)
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


def linear_starts(
    model: Model, records: Sequence[PreparedRecord], count: int | None, seed: int
) -> list[Values]:
    """Starts of a linear model: of subspace identification and with random poles, in turn.

    Of a model with free dead times those of `delayed_starts`, as many in all.

    Args:
        model: the model. records: to which it is fitted. seed: of random poles.
        count: how many; None for `RANDOM` of each kind, as far as there are orders.
    """
    if model.late:
        return delayed_starts(model, records, count or 2 * RANDOM, seed)
    subspace = subspace_starts(model, records, seed)[:RANDOM]
    random = starting_values(model, records, count=count or RANDOM, seed=seed)
    both = [one for pair in zip_longest(subspace, random) for one in pair if one is not None]
    return both[:count]


def fresh_starts(
    base: Model, model: Model, records: Sequence[PreparedRecord], seed: int, *, compared: bool
) -> list[Values]:
    """Starts of a first fit that a linear model has beside what its base has learnt, if any.

    With a dead time more, which learnt poles have imitated; and with more poles, as what is new may
    take the place of what is learnt.

    Args:
        base: linear. model: that extends it. records: to which it is fitted. seed: of random poles.
        compared: whether it is one of several variants: of more poles their order is the same
            without.
    """
    later = len(model.delayed) > len(base.delayed)
    before, after = (one.dynamic[0][1] for one in (base, model))
    more = after.pairs > before.pairs or after.integrators > before.integrators
    return linear_starts(model, records, None, seed) if later or (more and not compared) else []
