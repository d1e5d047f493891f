"""Trajectories of systems with feedback, drawn sample by sample."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.layers.functions import support_points
from pyro_dynogp.lti.grid import TimeGrid
from pyro_dynogp.lti.primitives import array, flatten_batch
from pyro_dynogp.lti.roots import root_of
from pyro_dynogp.models.assembly import Assembly, assemble
from pyro_dynogp.models.draws import (
    Drawn,
    JointState,
    Randomness,
    Switches,
    draw_layers,
    draw_static,
)
from pyro_dynogp.models.filter_functions import Block, functions_of
from pyro_dynogp.models.known import KnownFunction
from pyro_dynogp.models.system import StaticSystem, System, see
from pyro_dynogp.models.wiring import Dynamic, Static
from pyro_dynogp.moments.problem import EVENTS, each
from pyro_dynogp.moments.stepping import step_through


def draw_outputs(
    system: System,
    grid: TimeGrid,
    inputs: Tensor,
    start: JointState,
    random: Randomness,
    switches: Switches,
) -> Drawn:
    """Draw every layer's trajectory: layer by layer, with feedback sample by sample.

    Args: as those of `draw_layers`. With feedback process noise and functions are in the mean, and
        what is left to the variance is that of a static output layer that nothing else sees.
    """
    if not system.has_feedback:
        return draw_layers(system, grid, inputs, start, random, switches)
    silent = torch.zeros(1, 1, dtype=torch.float64)
    assembly = assemble(start.first_of(system), grid, inputs, silent)
    first = torch.zeros_like(random.state)
    if switches.initial_state:
        first = (start.root() @ random.state.unsqueeze(-1)).squeeze(-1)
    a = _step(system, assembly, first, random, switches)[..., :: assembly.substeps, :]
    signals: dict[str, Tensor] = {}
    before = 0
    for name, signal in assembly.signals.items():
        value = signal.known[..., :: assembly.substeps, :]
        if signal.rows is not None:
            value = value + a[..., before : before + value.shape[-1]]
            before += value.shape[-1]
        signals[name] = value.expand((*first.shape[:-1], *value.shape[-2:]))
    wire, layer = system.output
    mean = signals[wire.name]
    variance = torch.zeros_like(mean)
    if isinstance(layer, StaticSystem) and not wire.pathwise:
        assert not isinstance(wire.layer, Dynamic)
        seen = see(signals, wire)
        _, mean, variance = draw_static(
            wire.layer.support, layer, seen, random.residual[wire.name], switches
        )
    level = system.level(inputs)
    return Drawn(signals, mean if level is None else mean + level, variance.expand(mean.shape))


def _step(
    system: System, assembly: Assembly, first: Tensor, random: Randomness, switches: Switches
) -> Tensor:
    """What is not known of all signals (*shape, n, R), side by side; first: (*shape, N) state."""
    lead, problem = first.shape[:-1], assembly.problem
    elements, batch = problem.elements()
    blocks = [_drawn(block, system, random, switches) for block in assembly.blocks]
    values = functions_of(blocks)[1]
    kicks, root = _process_noise(system, problem.Q, random, switches)
    drawn, _ = flatten_batch(
        [*values.values(), first, kicks], [*(EVENTS[name] for name in values), 1, 2]
    )
    *functions, starts, kicked = (array(x) for x in drawn)
    random_rows = [s.rows for s in assembly.signals.values() if s.rows is not None]
    rows = torch.cat([r.expand((*batch, *r.shape[-2:])) for r in random_rows], -2)
    root = root.expand((*batch, *root.shape[-3:]))
    roots, lines = (
        array(root.reshape(-1, *root.shape[-3:])),
        array(rows.reshape(-1, *rows.shape[-2:])),
    )
    element = torch.arange(len(elements)).reshape(batch).expand(lead).flatten().tolist()

    def one(index: int) -> np.ndarray:
        at = element[index]
        own = {name: x[index] for name, x in zip(values, functions, strict=True)}
        numbers = elements[at]._replace(**own)
        found: np.ndarray = step_through(
            problem.layout, numbers, starts[index], kicked[index], roots[at], lines[at]
        )
        return found

    found = np.stack(each(one, len(element)))
    return torch.from_numpy(found).reshape(*lead, *found.shape[1:])


def _drawn(block: Block, system: System, random: Randomness, switches: Switches) -> Block:
    """The block with one draw of its function, where that is drawn."""
    function = block.function
    if function is None or block.with_variance or not switches.functions:
        return block
    if isinstance(function, KnownFunction):
        return block
    if function.channels > 1 and not switches.several_channels:
        return block
    layer = next(w.layer for w in system.wires if w.name == function.name)
    assert isinstance(layer, Static)
    support = support_points(function, layer.support)
    return replace(block, function=function.drawn(random.residual[function.name], support))


def _process_noise(
    system: System, Q: Tensor, random: Randomness, switches: Switches
) -> tuple[Tensor, Tensor]:
    """Standard normals (*shape, n, N) of each step, and roots (*b, k, N, N) of what it adds."""
    N = Q.shape[-1]
    on = torch.zeros(N, dtype=torch.float64)
    parts = []
    before = 0
    for wire, layer in system.dynamic:
        P = layer.modes.pairs
        own = torch.arange(before, before + P)
        on[torch.cat([own, own + N // 2])] = float(wire.name in switches.process_noise)
        parts.append(random.innovations[wire.name])
        before += P
    if not bool(on.any()):
        return torch.zeros(0, N, dtype=torch.float64), torch.zeros(1, N, N, dtype=torch.float64)
    real, imag = zip(*(part.chunk(2, -1) for part in parts), strict=True)
    return torch.cat([*real, *imag], -1), root_of(Q * on * on.unsqueeze(-1))
