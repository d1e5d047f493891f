"""The first state of a record that a fitted model is used on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.inference.optimise.descent import newton
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.system import System

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted

States = Mapping[str, Tensor]
# Samples from which a first state is estimated: it is forgotten soon after.
SAMPLES = 400


def unknown_beginning(fit: Fitted) -> System:
    """The fitted system after past inputs of which nothing is known."""
    return fit.model.begin(fit.system, {})


def beginning(
    fit: Fitted,
    record: PreparedRecord,
    *,
    predicting: bool = False,
    states: States | None = None,
) -> System:
    """The fitted system at the beginning of a record.

    On a training record the first state is that of the posterior draws. On another record that of
    layers which a static layer sees is estimated from the record's first samples: the mode of the
    numbers that describe it, at the mode of the parameters. (For others it is integrated out.)

    Args:
        fit: the fit. record: along which.
        predicting: whether first states that can be integrated out are unknown on training
            records, too: predictions serve every record in the same way.
        states: of `estimated`, where they are there already.
    """
    model = fit.model
    if not model.state_sites or not record.has_outputs:
        return unknown_beginning(fit)
    index = training_index(fit, record)
    if index is not None:
        states = model.states_of(fit.draws, "" if len(fit.records) == 1 else f"_{index}")
    elif states is None:
        states = estimate(fit, record)
    if predicting:
        needed = {wire.name for wire in model.seen_by_functions}
        states = {name: state for name, state in states.items() if name in needed}
    return model.begin(fit.system, states)


def training_index(fit: Fitted, record: PreparedRecord) -> int | None:
    """Index of a record among the training records."""
    own = record.record.fingerprint
    return next((i for i, known in enumerate(fit.records) if known.fingerprint == own), None)


def estimated(fit: Fitted, record: PreparedRecord) -> dict[str, Tensor] | None:
    """First states that `beginning` estimates, which all draws share; None where it does not."""
    known = not fit.model.state_sites or training_index(fit, record) is not None
    return None if known or not record.has_outputs else estimate(fit, record)


def estimate(fit: Fitted, record: PreparedRecord) -> dict[str, Tensor]:
    """Most probable first state of a record, as standard normal numbers (2P,) by layer.

    Of layers that a static layer sees. One start is zero, two are random, others are what the fit
    has learnt of its training records: a record may begin as one of them does, and functions in
    feedback may run away from other states.
    """
    model = fit.model
    head = PreparedRecord.of(record.record[:SAMPLES], record.scaling)
    system = fit.system_at(fit.mode)
    seen = model.seen_by_functions
    sizes = {wire.name: 2 * layer.modes for wire, layer in model.dynamic if wire in seen}
    total = sum(sizes.values())
    if not total:
        return {}

    def split(z: Tensor) -> dict[str, Tensor]:
        return dict(zip(sizes, torch.split(z, list(sizes.values()), -1), strict=True))

    def energies(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with torch.enable_grad():  # predictions are made without
            z = torch.tensor(x, requires_grad=True)
            outputs = output_process(model.begin(system, split(z)), head)
            value = 0.5 * z.square().sum(-1) - outputs.log_prob(head.observations)
            (gradient,) = torch.autograd.grad(value.sum(), z)
        return value.detach().numpy(), gradient.numpy()

    generator = np.random.default_rng(0)
    starts = np.concatenate([
        np.zeros((1, total)), 0.5 * generator.standard_normal((2, total)), _learnt(fit, sizes)
    ])  # fmt: skip
    found, values = newton(energies, starts)
    return split(torch.tensor(found[values.argmin()]))


def _learnt(fit: Fitted, sizes: Mapping[str, int]) -> np.ndarray:
    """First states (k, N) of the training records, of layers of so many numbers each."""
    count = len(fit.records) if fit.model.state_sites else 0
    found = []
    for index in range(count):
        states = fit.model.states_of(fit.mode, "" if count == 1 else f"_{index}")
        if all(name in states for name in sizes):
            found.append(np.concatenate([states[name].detach().numpy() for name in sizes]))
    return np.array(found).reshape(-1, sum(sizes.values()))
