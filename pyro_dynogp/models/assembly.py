r"""A cascade written as a problem for the moment-matching filter.

A signal is the sum of a known part, what the recorded inputs would cause by themselves, and of rows
over the joint vector a = [x; f] of all modal states and all random static outputs. Known parts pass
through the exact mean response; only the rest is filtered. A dynamic layer that sees a trajectory
directly (skip connections, two dynamic layers in a row) does so through an identity function, for
which moment matching is exact. A static output that comes back to an earlier dynamic layer is held
until the next sample, as any other that a dynamic layer sees; its known part is nothing. Of a
first-order lag in feedback the next layer sees the mean over each step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pyro_dynogp.layers.functions import StaticFunction
from pyro_dynogp.lti.covariance import step_noises
from pyro_dynogp.lti.fused import propagators
from pyro_dynogp.lti.grid import TimeGrid, held
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.response import mean_response
from pyro_dynogp.models.filter_functions import Block, functions_of, inducing_range
from pyro_dynogp.models.known import KnownFunction
from pyro_dynogp.models.lag_means import LagMean, has_mean, mean_of_lag
from pyro_dynogp.models.selection import signal_of
from pyro_dynogp.models.signal import KNOWN, TRAJECTORY, Signal, places_of_outputs
from pyro_dynogp.models.system import DynamicSystem, StaticSystem, System
from pyro_dynogp.models.wiring import INPUTS, Wire
from pyro_dynogp.moments.problem import FilterProblem, make_layout


@dataclass(frozen=True, eq=False)
class Assembly:
    """A cascade along a time axis: everything but the measured outputs.

    Attributes:
        problem: for the filter, with `y` missing everywhere.
        signals: every layer's output, by name.
        known_state: (*b, N) real state of all dynamic layers at the last sample that known inputs
            cause, ordered as the filter's.
        blocks: static functions of the problem, in its order.
        substeps: times of the problem from one sample to the next; outputs between are missing.
    """

    problem: FilterProblem
    signals: dict[str, Signal]
    known_state: Tensor
    blocks: tuple[Block, ...]
    substeps: int = 1

    def with_outputs(self, y: Tensor) -> FilterProblem:
        """The problem with scaled outputs y (*b, n, n_y), NaN where missing."""
        if self.substeps > 1:
            given, y = y, self.problem.y.expand(*y.shape[:-2], -1, -1).clone()
            y[..., :: self.substeps, :] = given
        return replace(self.problem, y=y)


def count_states(system: System) -> int:
    """N, the real states of all dynamic layers."""
    layers = system.layers
    return sum(2 * layer.modes.pairs for layer in layers if isinstance(layer, DynamicSystem))


class _Assembler:
    """Walks through the layers once; holds what has been found so far."""

    def __init__(self, system: System, grid: TimeGrid, inputs: Tensor) -> None:
        self.system, self.grid = system, grid
        self.batch = system.batch_shape
        self.states = count_states(system)
        self.first_output, outputs = places_of_outputs(system.wires)
        self.total = self.states + outputs
        driving = system.driving(inputs)
        self.level = system.level(inputs)
        self.signals = {INPUTS: Signal(driving, None, (KNOWN,) * driving.shape[-1])}
        self.blocks: list[Block] = []
        self.modes: list[Modes] = []
        self.gains: list[Tensor] = []  # (*b, m, P, E) complex, held static outputs to modal state
        self.covariances: list[Tensor] = []
        self.last_states: list[Tensor] = []
        self.pairs_before = 0
        self.outputs_before = 0
        self.fed: dict[str, tuple[Modes, Tensor]] = {}  # dynamic layers, shares in their inputs
        self.extra: Tensor | None = None

    def expand(self, x: Tensor, event: int) -> Tensor:
        return x.expand(self.batch + x.shape[x.dim() - event :])

    def sources(self, place: Wire) -> Signal:
        parts = [self.signals[signal_of(name)].seen(name) for name in place.sources]
        known = torch.cat([self.expand(p.known, 2) for p in parts], -1)
        outputs = tuple(o for p in parts for o in p.outputs)
        if all(p.rows is None for p in parts):
            return Signal(known, None, outputs)
        zeros = [
            known.new_zeros((*self.batch, p.known.shape[-1], self.total))
            if p.rows is None
            else self.expand(p.rows, 2)
            for p in parts
        ]
        return Signal(known, torch.cat(zeros, -2), outputs)

    def unit_rows(self, first: int, count: int) -> Tensor:
        rows = torch.zeros(count, self.total, dtype=torch.float64)
        rows[torch.arange(count), self.states + first + torch.arange(count)] = 1.0
        return rows

    def add_block(
        self,
        signal: Signal,
        function: StaticFunction | KnownFunction | None,
        last: bool,
        back: bool = False,
    ) -> Signal:
        assert signal.rows is not None
        # What comes back is bounded, and with it what stable dynamics make of it.
        ends = None
        if back and isinstance(function, StaticFunction) and function.channels == 1:
            ends = inducing_range(function)
        block = Block(signal.rows, signal.known, function, last, ends)
        self.blocks.append(block)
        first, count = self.outputs_before, block.outputs
        self.outputs_before += count
        known = signal.known.new_zeros((*self.batch, len(self.grid), count))
        return Signal(
            known, self.expand(self.unit_rows(first, count), 2), tuple(range(first, first + count))
        )

    def static(self, place: Wire, layer: StaticSystem) -> Signal:
        seen = self.sources(place)
        if seen.rows is not None:
            back = any(place.name in w.feedback for w in self.system.wires)
            return self.add_block(seen, layer.function, not place.pathwise, back)
        known = layer(seen.known)
        if place.last:
            self.extra = layer.function.variance(seen.known)
        return Signal(known, None, (KNOWN,) * place.layer.outputs)

    def dynamic(self, place: Wire, layer: DynamicSystem) -> dict[str, Signal]:
        seen = self.sources(place)
        known = seen.known
        modes, means = layer.modes, dict[int, LagMean]()
        if TRAJECTORY in seen.outputs:  # a trajectory feeds the layer: hold it through an identity
            means = self.means(place)
            seen = self.add_block(seen, None, False)
            known = seen.known
            for channel, mean in means.items():
                known[..., channel] = mean.known
        if place.fed:
            known = torch.cat([known, known.new_zeros((*known.shape[:-1], place.fed))], -1)
        driven = known if modes.inputs else None
        responded = mean_response(modes, self.grid, driven, layer.first_state)
        response = responded.output
        response = response if modes.several_outputs else response.unsqueeze(-1)
        self.last_states.append(self.expand(responded.state, 1))
        gain = propagators(modes, self.grid.steps)[1].unsqueeze(-1) * modes.B.unsqueeze(-3)
        shares = self.shares((*seen.outputs, *self.fed_back(place)), means)
        self.gains.append(self.expand(gain @ shares.to(torch.complex128), 3))
        self.modes.append(modes)
        self.fed[place.name] = modes, shares
        covariance = layer.prior_state().covariance
        assert covariance is not None  # a prior always has one
        self.covariances.append(covariance)
        rows = self.state_rows(modes)
        if seen.rows is not None:
            rows = rows + modes.D[..., : place.channels] @ seen.rows
        self.pairs_before += modes.pairs
        response, first, found = self.expand(response, 2), 0, {}
        for name, count in place.signals.items():
            own = slice(first, first + count)
            outputs = (TRAJECTORY,) * count
            found[name] = Signal(response[..., own], rows[..., own, :], outputs)
            first += count
        return found

    def means(self, place: Wire) -> dict[int, LagMean]:
        """Channels of a layer that are means of first-order lags over each step."""
        found, first = {}, 0
        wires = {wire.name: wire for wire in self.system.wires}
        for name in place.sources if self.system.has_feedback and len(self.grid.steps) else ():
            known = self.signals[signal_of(name)].seen(name).known
            if name in self.fed and has_mean(wires[name], place):
                modes, shares = self.fed[name]
                found[first] = mean_of_lag(modes, self.grid, known[..., 0], shares)
            first += known.shape[-1]
        return found

    def shares(self, outputs: Sequence[int], means: Mapping[int, LagMean]) -> Tensor:
        """Share of each held static output in each input of a dynamic layer, (*b, m, n_u, E)."""
        m = len(self.grid.steps)
        found = torch.zeros(
            *self.batch, m, len(outputs), self.total - self.states, dtype=torch.float64
        )
        for channel, output in enumerate(outputs):
            if channel in means:
                found[..., channel, :] = means[channel].gains
                found[..., channel, output] += means[channel].share
            elif output >= 0:
                found[..., channel, output] = 1.0
        return found

    def fed_back(self, place: Wire) -> list[int]:
        """Static outputs that come back to a dynamic layer."""
        width = {w.name: w.layer.outputs for w in self.system.wires}
        return [self.first_output[name] + a for name in place.feedback for a in range(width[name])]

    def state_rows(self, modes: Modes) -> Tensor:
        C = self.expand(modes.C, 2)
        half = self.states // 2
        before = C.real.new_zeros((*C.shape[:-1], self.pairs_before))
        after = C.real.new_zeros((*C.shape[:-1], half - self.pairs_before - modes.pairs))
        static = C.real.new_zeros((*C.shape[:-1], self.total - self.states))
        return torch.cat([before, 2.0 * C.real, after, before, -2.0 * C.imag, after, static], -1)

    def layer_states(self, place: int) -> Tensor:
        """Where the real state [Re x; Im x] of a dynamic layer stands in the joint one."""
        start = sum(m.pairs for m in self.modes[:place])
        own = torch.arange(start, start + self.modes[place].pairs)
        return torch.cat([own, own + self.states // 2])

    def joint(self, parts: Sequence[Tensor], event: int) -> Tensor:
        """Block-diagonal matrices from those of each dynamic layer (*b, ..., 2P, 2P)."""
        lead = (len(self.grid.steps),) if event == 3 else ()
        out = torch.zeros((*self.batch, *lead, self.states, self.states), dtype=torch.float64)
        for place, part in enumerate(parts):
            index = self.layer_states(place)
            out[..., index[:, None], index] = self.expand(part, event)
        return out

    def function_is_measured(self, output: Signal) -> bool:
        """Whether the only output is a tabulated function of one signal, of no other effect."""
        if output.rows is None or output.outputs != (self.outputs_before - 1,):
            return False
        if self.system.output[0].pathwise:
            return False
        last = self.blocks[-1]
        return last.function is not None and last.channels == last.outputs == 1

    def finish(self, noise_sd: Tensor) -> Assembly:
        steps = self.grid.steps
        m = len(steps)
        phi = [self.expand(propagators(modes, steps)[0], 2) for modes in self.modes]
        nothing = torch.zeros((*self.batch, m, 0), dtype=torch.complex128)
        joined = torch.cat(phi, -1) if phi else nothing
        E = self.total - self.states
        gains = torch.cat(self.gains, -2) if self.gains else nothing.new_zeros((m, 0, E))
        output = self.signals[self.system.output[0].name]
        n, n_y = len(self.grid), output.known.shape[-1]
        offset = output.known
        if self.level is not None:
            offset = offset + self.level
        H = output.rows
        if H is None:
            H = torch.zeros(n_y, self.total, dtype=torch.float64)
        variance = noise_sd.square()
        if self.extra is not None:
            variance = variance + self.extra
        share, multiple = self.system.noise.likelihood.components()
        forms, values = functions_of(self.blocks)
        blocks = self.blocks
        problem = FilterProblem(
            layout=make_layout(
                self.grid.step_index,
                [b.channels for b in blocks],
                [b.outputs for b in blocks],
                forms,
                share,
                multiple,
                linear=[b.is_linear for b in blocks],
                measured=self.function_is_measured(output),
            ),
            re=joined.real,
            im=joined.imag,
            Q=self.joint([step_noises(modes, steps) for modes in self.modes], 3),
            gamma=torch.cat([gains.real, gains.imag], -2),
            m0=torch.zeros(self.states, dtype=torch.float64),
            P0=self.joint(self.covariances, 2),
            G=torch.cat([b.rows[..., list(b.order), :] for b in blocks], -2)
            if blocks
            else torch.zeros(0, self.total, dtype=torch.float64),
            offset=torch.cat([self.expand(b.known[..., list(b.order)], 2) for b in blocks], -1)
            if blocks
            else torch.zeros(n, 0, dtype=torch.float64),
            H=H,
            y_offset=offset,
            y=torch.full((n, n_y), torch.nan, dtype=torch.float64),
            R=variance,
            **values,
        )
        known = torch.cat(self.last_states, -1) if self.last_states else nothing[..., 0, :0]
        known_state = torch.cat([known.real, known.imag], -1)
        return Assembly(problem, self.signals, known_state, tuple(blocks))


def assemble(
    system: System, grid: TimeGrid, inputs: Tensor, noise_sd: Tensor | None = None
) -> Assembly:
    """Write a cascade as a problem for the filter.

    Args:
        system: the layers given their parameters, batch shape *b.
        grid: time axis. inputs: (n, n_u) scaled.
        noise_sd: (*b, n, n_y) of scaled outputs; by default what the system has along the inputs.

    Raises:
        ValueError: where a static layer of several channels has a kernel that is not radial.
    """
    noise_sd = system.noise_sd(inputs, grid) if noise_sd is None else noise_sd
    parts = system.substeps
    walk = _Assembler(system, grid.divided(parts), held(inputs, parts))
    for place, layer in zip(system.wires, system.layers, strict=True):
        if isinstance(layer, DynamicSystem):
            walk.signals |= walk.dynamic(place, layer)
        else:
            walk.signals[place.name] = walk.static(place, layer)
    return replace(walk.finish(held(noise_sd, parts)), substeps=parts)
