r"""A cascade with its trajectories integrated out: the moment-matching filter as distribution.

A signal is the sum of a known part, what the recorded inputs would cause by themselves, and of rows
over the joint vector a = [x; f] of all modal states and all random static outputs. Known parts pass
through the exact mean response; only the rest is filtered. A dynamic layer that sees a trajectory
directly (skip connections, two dynamic layers in a row) does so through an identity function, for
which moment matching is exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyro
import torch
from pyro.distributions import TorchDistribution, constraints
from torch import Tensor

from pyro_dynogp._errors import invalid
from pyro_dynogp._tensors import as_tensor, broadcast
from pyro_dynogp.distributions.trajectory import real_or_missing
from pyro_dynogp.layers.static import StaticFunction
from pyro_dynogp.lti.covariance import complex_expm1, modal_covariance, real_covariance
from pyro_dynogp.lti.fused import propagators
from pyro_dynogp.lti.grid import TimeGrid, time_grid
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.response import mean_response
from pyro_dynogp.models import known
from pyro_dynogp.models.cascade import (
    CascadeSystem,
    DynamicSystem,
    StaticSystem,
    scaled_inputs,
)
from pyro_dynogp.models.layers import INPUTS, Dynamic, Wire
from pyro_dynogp.moments import smoothing
from pyro_dynogp.moments.functions import KERNELS
from pyro_dynogp.moments.problem import TABLE, FilterProblem, each, log_density, make_layout
from pyro_dynogp.record import Record
from pyro_dynogp.scaling import Scaling

# Points of the table of a static function of one channel.
GRID = 801


# What a channel is that is no static output.
KNOWN, TRAJECTORY = -1, -2


@dataclass(frozen=True, eq=False)
class Signal:
    """A signal inside the cascade.

    Attributes:
        known: (*b, n, w) what known inputs cause.
        rows: (*b, w, A) over [x; f], None where the signal is known altogether.
        outputs: for each channel the static output that it is, KNOWN, or TRAJECTORY.
    """

    known: Tensor
    rows: Tensor | None
    outputs: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Block:
    """One static function inside the filter: its inputs, and how it is evaluated."""

    rows: Tensor
    known: Tensor
    function: StaticFunction | None  # None: the identity
    with_variance: bool

    @property
    def channels(self) -> int:
        """Inputs of the function."""
        return int(self.rows.shape[-2])

    @property
    def outputs(self) -> int:
        """Outputs of the function."""
        return self.channels if self.function is None else int(self.function.whitened.shape[-2])


@dataclass(frozen=True, eq=False)
class Assembly:
    """A cascade along a time axis: everything but the measured outputs.

    Attributes:
        problem: for the filter, with `y` missing everywhere.
        signals: every layer's output, by name.
        known_state: (*b, N) real state of all dynamic layers at the last sample that known inputs
            cause, ordered as the filter's.
    """

    problem: FilterProblem
    signals: dict[str, Signal]
    known_state: Tensor

    def with_outputs(self, y: Tensor) -> FilterProblem:
        """The problem with scaled outputs y (*b, n, n_y), NaN where missing."""
        return replace(self.problem, y=y)


def count_states(system: CascadeSystem) -> int:
    """N, the real states of all dynamic layers."""
    layers = system.layers
    return sum(2 * one.modes.pairs for one in layers if isinstance(one, DynamicSystem))


def count_outputs(wires: Sequence[Wire]) -> int:
    """E, the random static outputs, identities included."""
    random: dict[str, str] = {INPUTS: "known"}
    total = 0
    for one in wires:
        sources = [random[name] for name in one.sources]
        if isinstance(one.layer, Dynamic):
            total += one.channels if "trajectory" in sources else 0
            random[one.name] = "trajectory"
        elif any(kind != "known" for kind in sources):
            total += one.layer.outputs
            random[one.name] = "function"
        else:
            random[one.name] = "known"
    return total


class _Assembler:
    """Walks through the layers once; holds what has been found so far."""

    def __init__(
        self, system: CascadeSystem, grid: TimeGrid, inputs: Tensor, process_noise: bool
    ) -> None:
        self.system, self.grid, self.process_noise = system, grid, process_noise
        self.batch = system.batch_shape
        self.states = count_states(system)
        self.total = self.states + count_outputs(system.wires)
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
        self.extra: Tensor | None = None

    def expand(self, x: Tensor, event: int) -> Tensor:
        return x.expand(self.batch + x.shape[x.dim() - event :])

    def sources(self, one: Wire) -> Signal:
        parts = [self.signals[name] for name in one.sources]
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

    def add_block(self, signal: Signal, function: StaticFunction | None, last: bool) -> Signal:
        assert signal.rows is not None
        block = Block(signal.rows, signal.known, function, with_variance=last)
        self.blocks.append(block)
        first, count = self.outputs_before, block.outputs
        self.outputs_before += count
        known = signal.known.new_zeros((*self.batch, len(self.grid), count))
        return Signal(
            known, self.expand(self.unit_rows(first, count), 2), tuple(range(first, first + count))
        )

    def static(self, one: Wire, layer: StaticSystem) -> Signal:
        seen = self.sources(one)
        if seen.rows is not None:
            return self.add_block(seen, layer.function, not one.pathwise)
        known = layer(seen.known)
        if one.last:
            self.extra = layer.function.variance(seen.known)
        return Signal(known, None, (KNOWN,) * one.layer.outputs)

    def dynamic(self, one: Wire, layer: DynamicSystem) -> Signal:
        seen = self.sources(one)
        known = seen.known
        if TRAJECTORY in seen.outputs:  # a trajectory feeds the layer: hold it through an identity
            held = self.add_block(seen, None, False)
            seen = Signal(held.known, held.rows, held.outputs)
            known = held.known
        modes = layer.modes if self.process_noise else layer.modes.without_process_noise()
        responded = mean_response(
            modes, self.grid, known if modes.inputs else None, layer.first_state
        )
        response = responded.output
        response = response if modes.several_outputs else response.unsqueeze(-1)
        self.last_states.append(self.expand(responded.state, 1))
        gain = propagators(modes, self.grid.steps)[1].unsqueeze(-1) * modes.B.unsqueeze(-3)
        E = self.total - self.states
        select = torch.zeros(modes.inputs, E, dtype=torch.complex128)
        for i, o in enumerate(seen.outputs):
            if o >= 0:
                select[i, o] = 1.0
        self.gains.append(self.expand(gain @ select, 3))
        self.modes.append(modes)
        self.covariances.append(layer.prior_state(self.process_noise).covariance)  # type: ignore
        rows = self.state_rows(modes)
        if seen.rows is not None:
            rows = rows + modes.D @ seen.rows
        self.pairs_before += modes.pairs
        return Signal(self.expand(response, 2), rows, (TRAJECTORY,) * modes.outputs)

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
        """Whether the only output is a tabulated function of one signal."""
        if output.rows is None or output.outputs != (self.outputs_before - 1,):
            return False
        last = self.blocks[-1]
        return last.function is not None and last.channels == last.outputs == 1

    def finish(self, noise_sd: Tensor) -> Assembly:
        steps = self.grid.steps
        m = len(steps)
        phi = [self.expand(propagators(one, steps)[0], 2) for one in self.modes]
        nothing = torch.zeros((*self.batch, m, 0), dtype=torch.complex128)
        joined = torch.cat(phi, -1) if phi else nothing
        E = self.total - self.states
        gains = torch.cat(self.gains, -2) if self.gains else nothing.new_zeros((m, 0, E))
        output = self.signals[self.system.wires[-1].name]
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
        forms, values = _functions(self.blocks)
        blocks = self.blocks
        problem = FilterProblem(
            layout=make_layout(
                self.grid.step_index,
                [b.channels for b in blocks],
                [b.outputs for b in blocks],
                forms,
                share,
                multiple,
                measured=self.function_is_measured(output),
            ),
            re=joined.real,
            im=joined.imag,
            Q=self.joint([step_noises(one, steps) for one in self.modes], 3),
            gamma=torch.cat([gains.real, gains.imag], -2),
            m0=torch.zeros(self.states, dtype=torch.float64),
            P0=self.joint(self.covariances, 2),
            G=torch.cat([b.rows for b in blocks], -2)
            if blocks
            else torch.zeros(0, self.total, dtype=torch.float64),
            offset=torch.cat([self.expand(b.known, 2) for b in blocks], -1)
            if blocks
            else torch.zeros(n, 0, dtype=torch.float64),
            H=H,
            y_offset=offset,
            y=torch.full((n, n_y), torch.nan, dtype=torch.float64),
            R=variance,
            **values,
        )
        known = torch.cat(self.last_states, -1) if self.last_states else nothing[..., 0, :0]
        return Assembly(problem, self.signals, torch.cat([known.real, known.imag], -1))


def assemble(
    system: CascadeSystem, grid: TimeGrid, inputs: Tensor, *, process_noise: bool = True
) -> Assembly:
    """Write a cascade as a problem for the filter.

    Args:
        system: the layers given their parameters, batch shape *b.
        grid: time axis. inputs: (n, n_u) scaled.
        process_noise: False for the deterministic system from an unknown first state.

    Raises:
        ValueError: where a static layer of several channels has a kernel that is not radial.
    """
    walk = _Assembler(system, grid, inputs, process_noise)
    for one, layer in zip(system.wires, system.layers, strict=True):
        if isinstance(layer, DynamicSystem):
            walk.signals[one.name] = walk.dynamic(one, layer)
        else:
            walk.signals[one.name] = walk.static(one, layer)
    return walk.finish(system.noise_sd(inputs, grid))


def step_noises(modes: Modes, steps: Tensor) -> Tensor:
    """Covariance (*b, m, 2P, 2P) that process noise adds to [Re x; Im x] within each step."""
    lam = modes.poles
    hermitian, symmetric = modal_covariance(modes)
    d = steps[:, None, None]
    plus = (lam.unsqueeze(-1) + lam.conj().unsqueeze(-2)).unsqueeze(-3)
    same = (lam.unsqueeze(-1) + lam.unsqueeze(-2)).unsqueeze(-3)
    return real_covariance(
        -hermitian.unsqueeze(-3) * complex_expm1(plus * d),
        -symmetric.unsqueeze(-3) * complex_expm1(same * d),
    )


def _functions(blocks: Sequence[Block]) -> tuple[list[int], dict[str, Tensor]]:
    """Form of each static function, and the tensors that `Values` keeps of it."""
    widest = max((b.channels for b in blocks), default=1)
    radial = [b for b in blocks if b.function is not None and b.channels > 1]
    M = max((b.function.whitened.shape[-1] for b in radial if b.function), default=1)
    forms: list[int] = []
    columns: dict[str, list[Tensor]] = {}
    for block in blocks:
        form, values = _function(block, M, widest)
        forms.append(form)
        for name, value in values.items():
            columns.setdefault(name, []).append(value)
    if not blocks:
        return [], {name: torch.zeros(shape, dtype=torch.float64) for name, shape in _EMPTY.items()}
    joined = {}
    for name, parts in columns.items():
        event = len(_EMPTY[name])
        batch = broadcast(*(p.shape[: p.dim() - event] for p in parts))
        joined[name] = torch.cat(
            [p.expand(batch + p.shape[p.dim() - event :]) for p in parts], -event
        )
    return forms, joined


# Shapes without any static layer; all are joined along the first of these dimensions.
_EMPTY: dict[str, tuple[int, ...]] = {
    "table_mean": (0, 4),
    "table_variance": (0, 4),
    "low": (0,),
    "spacing": (0,),
    "weight": (0, 1),
    "Z": (0, 1, 1),
    "inverse": (0, 1),
    "constant": (0,),
    "slope": (0, 1),
}


def _function(block: Block, M: int, widest: int) -> tuple[int, dict[str, Tensor]]:
    d, e = block.channels, block.outputs

    def zeros(*shape: int) -> Tensor:
        return torch.zeros(shape, dtype=torch.float64)

    values = {
        "table_mean": zeros(e, GRID),
        "table_variance": zeros(e, GRID),
        "low": zeros(1),
        "spacing": zeros(1) + 1.0,
        "weight": zeros(e, M),
        "Z": zeros(1, M, widest),
        "inverse": zeros(1, widest),
        "constant": zeros(e),
        "slope": zeros(e, widest),
    }
    function = block.function
    if function is None:
        values["slope"] = torch.eye(d, widest, dtype=torch.float64)
        return KERNELS["rbf"], values
    if d == 1:
        low, high = table_range(function)
        share = torch.linspace(0.0, 1.0, GRID, dtype=torch.float64)
        grid = low.unsqueeze(-1) + (high - low).unsqueeze(-1) * share
        mean, variance = function.moments(grid.unsqueeze(-1))
        values["table_mean"] = mean.mT
        if block.with_variance:
            values["table_variance"] = variance.mT
        values["low"] = low.unsqueeze(-1)
        values["spacing"] = ((high - low) / (GRID - 1)).unsqueeze(-1)
        return TABLE, values
    radial = function.kernel.radial
    if radial is None:
        raise invalid(
            "kernel",
            expected="RBF or Matern (with ARD) for a layer of several channels that is "
            "integrated out",
            got="another kernel",
            advice="Use integrate='none' and another guide ('gauss-markov'), which take any.",
        )
    name, lengthscale = radial
    weight = function.weights
    if function.kernel.radial_variance is not None:
        weight = weight * function.kernel.radial_variance[..., None, None]
    pad = torch.nn.functional.pad
    count = weight.shape[-1]
    values["weight"] = pad(weight, (0, M - count))
    values["Z"] = pad(function.locations, (0, widest - d, 0, M - count)).unsqueeze(-3)
    values["inverse"] = pad(1.0 / lengthscale, (0, widest - d)).unsqueeze(-2)
    values["constant"] = function.constant
    if function.slope is not None:
        values["slope"] = pad(function.slope, (0, widest - d))
    return KERNELS[name], values


def table_range(function: StaticFunction) -> tuple[Tensor, Tensor]:
    """Range (*b) of a function's table: where it has inducing points, and well beyond.

    It moves with the parameters, and gradients know: a table that did not would leave steps in the
    likelihood.
    """
    z = function.locations.squeeze(-1)
    low, high = z.amin(-1), z.amax(-1)
    margin = 0.5 * (high - low)
    if function.kernel.radial is not None:
        # A function is back at its prior mean within some lengthscales.
        margin = margin + 3.0 * function.kernel.radial[1].squeeze(-1)
    return low - margin, high + margin


class ObservedCascade(TorchDistribution):
    """Measured outputs of a cascade, all trajectories integrated out by moment matching.

    The log-density is that of a Gaussian assumed-density filter over the joint state of all dynamic
    layers: exact where the static layers are linear and the noise is Gaussian, else as good as
    Gaussian moments are: joint ones of a static layer's input and output inside the cascade; where
    the last layer is a function of one signal, those of the state given each sample. Where only the
    last layer's trajectory is unknown no filter is needed: see `pyro_dynogp.models.known`. Event
    shape (n,), or (n, n_y). NaN marks a missing sample.

    Args:
        system: layers given their parameters. time: (n,) or a `TimeGrid`. inputs: (*b, n, n_u)
            scaled.
        scale, shift: (n_y,) of the outputs: y = shift + scale * (scaled y).
    """

    arg_constraints: dict[str, constraints.Constraint] = {}  # noqa: RUF012
    has_rsample = False

    def __init__(
        self,
        system: CascadeSystem,
        time: Any,
        inputs: Tensor,
        scale: Tensor,
        shift: Tensor,
        *,
        validate_args: bool | None = None,
    ) -> None:
        self.system, self.grid, self.inputs = system, time_grid(time), inputs
        self.scale, self.shift = scale, shift
        n_y = scale.shape[-1]
        self._several = n_y > 1
        event = (len(self.grid), n_y) if self._several else (len(self.grid),)
        super().__init__(system.batch_shape, torch.Size(event), validate_args=validate_args)

    @property
    def support(self) -> constraints.Constraint:
        """Real trajectories in which NaN marks a missing sample."""
        return constraints.independent(real_or_missing, len(self.event_shape))

    def expand(self, batch_shape: Any, _instance: Any = None) -> ObservedCascade:
        """Broadcast to a larger batch shape."""
        new = self._get_checked_instance(ObservedCascade, _instance)
        new.__dict__.update(self.__dict__)
        new._batch_shape = torch.Size(batch_shape)
        return new

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (*s, *batch) of outputs (*s, *batch, *event) in the record's units [nats]."""
        y = value if self._several else value.unsqueeze(-1)
        scaled = (y - self.shift) / self.scale
        if known.has_exact_density(self.system):
            found = known.log_density(self.system, self.grid, self.inputs, scaled)
        else:
            found = log_density(assemble(self.system, self.grid, self.inputs).with_outputs(scaled))
        there = (~torch.isnan(y)).to(torch.float64)
        jacobian = (there * self.scale.log()).sum((-2, -1))
        batch = broadcast(y.shape[:-2], self.batch_shape)
        return (found - jacobian).expand(batch)

    def innovations(self, value: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """One-step prediction errors and their variances (*batch, K) of scaled outputs.

        K counts the samples that are not missing, outputs of one time together. No gradient.
        """
        y = value if self._several else value.unsqueeze(-1)
        scaled = (y - self.shift) / self.scale
        problem = assemble(self.system, self.grid, self.inputs).with_outputs(scaled)
        elements, batch = problem.elements()
        found = each(lambda b: smoothing.innovate(problem.layout, elements[b]), len(elements))
        there = ~np.isnan(found[0][0])
        r = np.stack([one[0][there] for one in found])
        S = np.stack([one[1][there] for one in found])
        return r.reshape(*batch, -1), S.reshape(*batch, -1)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Draw outputs: every trajectory from its own distribution, layer by layer, then noise."""
        from pyro_dynogp.prediction.sampling import draw_outputs

        shape = torch.Size(sample_shape)
        with torch.no_grad():
            y = draw_outputs(self.system, self.grid, self.inputs, shape + self.batch_shape)
        y = self.shift + self.scale * y
        return y if self._several else y.squeeze(-1)


def collapsed_of(
    system: CascadeSystem, scaling: Scaling, record: Record, inputs: Tensor | None = None
) -> ObservedCascade:
    """The distribution of a record's outputs; `inputs` are scaled, by default the record's."""
    return ObservedCascade(
        system,
        record.time,
        scaled_inputs(scaling, record) if inputs is None else inputs,
        as_tensor(scaling.output_scale),
        as_tensor(scaling.output_offset),
    )


def outputs_with_gaps(record: Record) -> Tensor:
    """Outputs (n,) or (n, n_y), NaN where missing."""
    y = record.tensors().outputs
    return y if record.n_outputs > 1 else y[:, 0]


def observe_collapsed(
    system: CascadeSystem, scaling: Scaling, record: Record, suffix: str, inputs: Tensor
) -> None:
    """Observe (or sample) the outputs of one record, of scaled inputs (*b, n, n_u)."""
    y = outputs_with_gaps(record) if record.n_outputs else None
    pyro.sample(f"y{suffix}", collapsed_of(system, scaling, record, inputs), obs=y)
