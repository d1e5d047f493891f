"""What a model asks of the records that it is given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from pyro_dynogp.data.channels import Channel, count_direct, prepared
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.records import as_records
from pyro_dynogp.layers.noise import Likelihood
from pyro_dynogp.support.errors import invalid

if TYPE_CHECKING:
    from pyro_dynogp.models.model import Model


def prepare(model: Model, records: Record | Sequence[Record]) -> tuple[Record, ...]:
    """Records with the channels that a model makes from them."""
    return tuple(prepared(record, model.channels) for record in as_records(records))


def check_records(model: Model, records: Record | Sequence[Record]) -> tuple[Record, ...]:
    """Records, prepared, whose channels and units fit a model with inputs, outputs and scaling."""
    checked = prepare(model, records)
    for record in checked:
        for what, expected, got in (
            ("inputs", model.inputs, record.n_inputs),
            ("outputs", model.outputs, record.n_outputs or model.outputs),
        ):
            if expected != got:
                raise invalid(
                    "record",
                    expected=f"{expected} {what}, as the model has",
                    got=f"{got}",
                    advice=f"Choose channels with record.select(...) or set {what}={got}.",
                )
        if model.scaling is not None:
            model.scaling.check(record, outputs=record.n_outputs > 0)
    return checked


def check_direct(inputs: int, direct: int, channels: Sequence[Channel]) -> None:
    """Whether so many inputs can act directly.

    Raises:
        ValueError: where they are more than the inputs, or fewer than direct channels make.
    """
    least = count_direct(channels)
    if not isinstance(direct, int) or not least <= direct <= inputs:
        raise invalid(
            "direct", expected=f"a whole number from {least} to {inputs}", got=repr(direct)
        )


def check_feedback(integrate: str, likelihood: Likelihood) -> None:
    """Whether a model with feedback can do with these options.

    Raises:
        ValueError: on trajectories as sites, or noise that varies with the output.
    """
    if integrate != "all":
        raise invalid(
            "integrate",
            expected="'all' for a model with feedback, whose trajectories depend on each other "
            "sample by sample and cannot be sample sites",
            got=repr(integrate),
        )
    if likelihood.varying and likelihood.of == "output":
        raise invalid(
            "likelihood",
            expected="noise of constant size, or one that varies with the inputs, for a model with "
            "feedback",
            got=repr(likelihood),
        )
