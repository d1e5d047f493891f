"""A system along a record with dead times that are parameters: inputs as they arrive.

What arrives between two samples is exact for linear dynamics (`lti.delay`). On an even clock a late
input is u_{k-j-1} for the first part f of a step and u_{k-j} for the rest, which moves a state as
u_{k-j} and w times the change u_{k-j-1} - u_{k-j} do over the whole step: the dynamic layers that
see the inputs get one input more for each that is late, the change, with w times its gains. On
others each state has an equivalent input of its own, and what it differs by from the mean over the
step is two inputs more, of real and imaginary parts. Elsewhere (static layers of inputs, several
layers on an uneven clock, inputs that act at once) inputs are averaged over each step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.data.clock import is_regular, sampling_time
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.lti.delay import equivalent_inputs, moved_share
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.models.arrival import arriving
from pyro_dynogp.models.prepared import PreparedRecord, scaled_inputs
from pyro_dynogp.models.system import DynamicSystem, System
from pyro_dynogp.models.wiring import INPUTS, Wire
from pyro_dynogp.support.tensors import joined

# Steps that differ by less than this share of them are one.
SAME = 1e-9


@dataclass(frozen=True, eq=False)
class Arrived:
    """A system and what it sees along a record.

    Attributes:
        system: with more inputs where changes are inputs of their own, between those of the layers
            and those that act at once. scaling: of these inputs.
        inputs: (*b, n, n_u) [input]. scaled: the same in standard deviations.
    """

    system: System
    scaling: Scaling
    inputs: Tensor
    scaled: Tensor


def arrive(system: System, record: PreparedRecord) -> Arrived:
    """The system with the inputs of a record as they arrive."""
    if system.delays is None:
        return Arrived(system, record.scaling, record.inputs, record.scaled_inputs)
    n_u = record.inputs.shape[-1] - (0 if system.direct is None else system.direct.shape[-1])
    late = [c for c in system.delays.columns if c < n_u]
    step, seeing = even_step(record), sum(INPUTS in w.reads for w in system.wires)
    known = len(record.surroundings.time)
    if not late or not _takes_changes(system) or (step is None and (seeing > 1 or known < 2)):
        return Arrived(system, record.scaling, *arriving(record, system.delays))
    if step is None:
        return _with_differences(system, record, late, n_u)
    return _with_changes(system, record, late, n_u, step)


def even_step(record: PreparedRecord) -> float | None:
    """Step of the clock of a record and of what is known around it; None where steps differ."""
    time = record.surroundings.time.numpy()
    return sampling_time(time) if len(time) > 1 and is_regular(time) else None


def common_step(records: Sequence[PreparedRecord]) -> float | None:
    """Step of the clocks of several records; None where they differ, or steps of one do."""
    steps = [even_step(record) for record in records]
    first = steps[0]
    same = all(s is not None and first is not None and abs(s - first) <= SAME * s for s in steps)
    return first if same else None


def _takes_changes(system: System) -> bool:
    """Whether all that sees the inputs is dynamic layers that see nothing else."""
    seeing = [w for w in system.wires if INPUTS in w.reads]
    layers = {wire.name for wire, _ in system.dynamic}
    plain = all(w.name in layers and w.sources == (INPUTS,) and not w.fed for w in seeing)
    likelihood = system.noise.likelihood
    return plain and (not likelihood.varying or likelihood.follows_output)


def _with_changes(
    system: System, record: PreparedRecord, late: list[int], n_u: int, step: float
) -> Arrived:
    assert system.delays is not None
    _, inputs, first = record.surroundings
    rows = first + torch.arange(len(record))
    # Where nothing has arrived by the end it does not matter how late it is.
    steps = (system.delays.values / step).clamp_max(float(len(inputs)))
    whole = steps.detach().floor()
    share = {c: (steps - whole)[..., k] for k, c in enumerate(system.delays.columns)}
    averaged = arriving(record, system.delays)[0]
    columns, changes = list(averaged.unbind(-1)), []
    for k, c in enumerate(system.delays.columns):
        if c < n_u:
            place = rows - whole[..., k, None].long()
            columns[c] = inputs[:, c][place.clamp_min(0)]
            changes.append(inputs[:, c][(place - 1).clamp_min(0)] - columns[c])
    found = torch.stack([*columns[:n_u], *changes, *columns[n_u:]], -1)

    def gains(modes: Modes) -> Tensor:
        each = [modes.B[..., c] * moved_share(modes.poles * step, share[c]) for c in late]
        return torch.stack(each, -1)

    return _arrived(system, record, found, late, n_u, gains)


def _with_differences(system: System, record: PreparedRecord, late: list[int], n_u: int) -> Arrived:
    assert system.delays is not None
    time, inputs, first = record.surroundings
    ((_, layer),) = [pair for pair in system.dynamic if pair[0].sources == (INPUTS,)]
    averaged = arriving(record, system.delays)[0]
    own = slice(first, first + len(record))
    parts = []
    for k, c in enumerate(system.delays.columns):
        if c < n_u:
            d = system.delays.values[..., k]
            m = equivalent_inputs(layer.modes.poles, inputs[:, c], time, d)[..., own, :]
            parts += [m.real - averaged[..., c, None], m.imag]
    found = joined([averaged[..., :n_u], *parts, averaged[..., n_u:]], 2, -1)
    P = layer.modes.pairs

    def gains(modes: Modes) -> Tensor:
        each = [modes.B[..., c] for c in late]
        turned = 1j * (modes.poles != 0.0)  # an integrator's are real
        return torch.cat([torch.diag_embed(b * x) for b in each for x in (1.0, turned)], -1)

    repeated = [c for c in late for _ in range(2 * P)]
    return _arrived(system, record, found, repeated, n_u, gains)


def _arrived(
    system: System,
    record: PreparedRecord,
    inputs: Tensor,
    more: list[int],
    n_u: int,
    gains: Callable[[Modes], Tensor],
) -> Arrived:
    """The system with more inputs, of the scales of some, and with given gains (*b, P, columns)."""
    scaling = _with_columns(record.scaling, more, n_u)

    def changed(wire: Wire, layer: DynamicSystem) -> DynamicSystem:
        if wire.sources != (INPUTS,):
            return layer
        modes = layer.modes
        B = joined([modes.B, gains(modes)], 2, -1)
        D = modes.D if modes.several_outputs else modes.D.squeeze(-2)
        D = torch.nn.functional.pad(D, (0, len(more)))
        modes = replace(modes, input_gain=B, feedthrough=D)
        return replace(layer, modes=modes, past=layer.past_inputs)

    return Arrived(
        replace(system.with_layers(changed), delays=None),
        scaling,
        inputs,
        scaled_inputs(inputs, scaling),
    )


def _with_columns(scaling: Scaling, late: list[int], n_u: int) -> Scaling:
    """The scaling with those of the changes behind those of the first n_u inputs."""

    def more(x: np.ndarray, new: np.ndarray) -> np.ndarray:
        return np.concatenate([x[:n_u], new, x[n_u:]])

    names, units = scaling.input_names, scaling.input_units
    return replace(
        scaling,
        input_offset=more(scaling.input_offset, np.zeros(len(late))),
        input_scale=more(scaling.input_scale, scaling.input_scale[late]),
        input_names=(*names[:n_u], *(f"change of {names[c]}" for c in late), *names[n_u:]),
        input_units=(*units[:n_u], *(units[c] for c in late), *units[n_u:]),
        input_order=(
            *(c if c < n_u else c + len(late) for c in scaling.input_order),
            *range(n_u, n_u + len(late)),
        ),
    )
