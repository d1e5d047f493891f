"""Trajectories of all layers drawn forwards, from inputs and a first state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.layers.functions import support_points
from pyro_dynogp.layers.noise import Likelihood
from pyro_dynogp.lti.grid import TimeGrid
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.response import mean_response
from pyro_dynogp.lti.roots import root_of
from pyro_dynogp.lti.state import ModalState
from pyro_dynogp.models.known import KnownFunction
from pyro_dynogp.models.system import DynamicSystem, StaticSystem, System, see
from pyro_dynogp.models.wiring import INPUTS, Dynamic
from pyro_dynogp.support.tensors import broadcast


@dataclass(frozen=True, eq=False)
class JointState:
    """Gaussian state of all dynamic layers at one time, real parts of all before imaginary ones.

    Attributes:
        mean: (*b, N). covariance: (*b, N, N).
    """

    mean: Tensor
    covariance: Tensor

    @classmethod
    def of_layers(cls, means: Sequence[Tensor], covariances: Sequence[Tensor]) -> JointState:
        """From complex means (*b, P) and real covariances (*b, 2P, 2P) of the layers' states."""
        half = sum(mean.shape[-1] for mean in means)
        shapes = [mean.shape[:-1] for mean in means]
        batch = broadcast(*shapes, *(covariance.shape[:-2] for covariance in covariances))
        mean = torch.zeros((*batch, 2 * half), dtype=torch.float64)
        joint = torch.zeros((*batch, 2 * half, 2 * half), dtype=torch.float64)
        before = 0
        for part, own in zip(means, covariances, strict=True):
            P = part.shape[-1]
            index = torch.cat([torch.arange(P), torch.arange(P) + half]) + before
            real = torch.cat([part.real, part.imag], -1)
            mean[..., index] = real.expand((*batch, 2 * P))
            joint[..., index[:, None], index] = own.expand((*batch, 2 * P, 2 * P))
            before += P
        return cls(mean, joint)

    def modal(self) -> ModalState:
        """The state of a single layer."""
        half = self.mean.shape[-1] // 2
        return ModalState(
            torch.complex(self.mean[..., :half], self.mean[..., half:]), self.covariance
        )

    def first_of(self, system: System) -> System:
        """A system whose first states are the means."""
        half, before = self.mean.shape[-1] // 2, 0
        first = {}
        for wire, layer in system.dynamic:
            own = slice(before, before + layer.modes.pairs)
            real, imag = self.mean[..., :half], self.mean[..., half:]
            first[wire.name] = torch.complex(real[..., own], imag[..., own])
            before += layer.modes.pairs
        return system.with_layers(lambda wire, layer: replace(layer, first_state=first[wire.name]))

    def root(self) -> Tensor:
        """Square root (*b, N, N) of the covariance, singular or not."""
        return root_of(self.covariance)

    def drawn(self, standard: Tensor) -> Tensor:
        """States (*s, N) that standard normal numbers (*s, N) make."""
        return self.mean + (self.root() @ standard.unsqueeze(-1)).squeeze(-1)


@dataclass(frozen=True, eq=False)
class Randomness:
    """Standard normal numbers behind one set of draws: with the same ones, two draws compare.

    Attributes:
        state: (*shape, N). innovations: (*shape, n) or (*shape, n, w) for each dynamic layer; with
            feedback (*shape, k (n - 1) + 1, 2P), of its state at k parts of each step.
        residual: (*shape, e, K) for each static layer.
    """

    state: Tensor
    innovations: Mapping[str, Tensor]
    residual: Mapping[str, Tensor]

    @classmethod
    def draw(cls, system: System, n: int, shape: torch.Size) -> Randomness:
        """From torch's generator."""
        states = 0
        innovations, residual = {}, {}
        for place, layer in zip(system.wires, system.layers, strict=True):
            if isinstance(layer, DynamicSystem):
                states += 2 * layer.modes.pairs
                event = (n, layer.modes.outputs) if layer.modes.several_outputs else (n,)
                if system.has_feedback:
                    event = (system.substeps * (n - 1) + 1, 2 * layer.modes.pairs)
                innovations[place.name] = torch.randn(*shape, *event, dtype=torch.float64)
            else:
                assert not isinstance(place.layer, Dynamic)
                event = (place.layer.outputs, place.layer.support)
                residual[place.name] = torch.randn(*shape, *event, dtype=torch.float64)
        return cls(torch.randn(*shape, states, dtype=torch.float64), innovations, residual)

    @property
    def first(self) -> Randomness:
        """The first numbers of each posterior draw: enough where none of them is used."""
        return Randomness(
            self.state[:1],
            {name: x[:1] for name, x in self.innovations.items()},
            {name: x[:1] for name, x in self.residual.items()},
        )


@dataclass(frozen=True, eq=False)
class Switches:
    """Which causes of uncertainty act in a draw.

    Attributes:
        initial_state: whether the first state is drawn, or at its mean.
        process_noise: names of the dynamic layers whose process noise acts.
        functions: whether static functions below a dynamic layer are drawn, or at their mean.
        several_channels: whether those of several channels are, too. The moment-matching filter
            has them at their mean given the inducing values, since a few inducing points leave
            much of a space of several channels open; so must what is predicted from such a fit.
    """

    initial_state: bool
    process_noise: frozenset[str]
    functions: bool
    several_channels: bool = False

    @property
    def any(self) -> bool:
        """Whether any cause acts: else equal parameters give equal draws."""
        return self.initial_state or bool(self.process_noise) or self.functions

    @classmethod
    def all_on(cls, system: System, several_channels: bool = False) -> Switches:
        """Everything acts; functions of several channels only if asked for."""
        names = {wire.name for wire, layer in system.dynamic if layer.modes.has_process_noise}
        return cls(True, frozenset(names), True, several_channels)


@dataclass(frozen=True, eq=False)
class Drawn:
    """Draws of all layers (scaled).

    Attributes:
        signals: (*shape, n, w) by layer; of a last static layer its mean given its input.
        mean: (*shape, n, n_y) of the noise-free output given everything drawn below the last layer.
        variance: (*shape, n, n_y) of the last layer itself: process noise or the static function.
    """

    signals: Mapping[str, Tensor]
    mean: Tensor
    variance: Tensor


def draw_layers(
    system: System,
    grid: TimeGrid,
    inputs: Tensor,
    start: JointState,
    random: Randomness,
    switches: Switches,
) -> Drawn:
    """Draw every layer's trajectory, first to last.

    Args:
        system: the layers, batch shape *b. grid: time axis. inputs: (n, n_u) scaled.
        start: state at the first sample. random: numbers of shape (*shape, ...), which *b
            broadcasts to. switches: which causes act.
    """
    state = start.drawn(random.state) if switches.initial_state else start.mean
    lead = random.state.shape[:-1]
    state = state.expand((*lead, state.shape[-1]))
    half = state.shape[-1] // 2
    driving = system.driving(inputs)
    signals: dict[str, Tensor] = {INPUTS: driving.expand(lead + driving.shape[-2:])}
    before = 0
    mean = signals[INPUTS]
    variance = torch.zeros(())
    for place, layer in zip(system.wires, system.layers, strict=True):
        x = see(signals, place)
        if isinstance(layer, DynamicSystem):
            modes = layer.modes
            own = slice(before, before + modes.pairs)
            other = slice(half + before, half + before + modes.pairs)
            x0 = torch.complex(state[..., own], state[..., other])
            before += modes.pairs
            driven = x if modes.inputs else None
            value = mean_response(modes, grid, driven, x0).output
            mean, variance = value, torch.zeros_like(value)
            if place.name in switches.process_noise:
                noise = fresh_noise(modes, grid)
                value = value + noise.from_innovations(random.innovations[place.name])
                variance = noise.variance.expand(value.shape)
            if not modes.several_outputs:
                value, mean, variance = (v.unsqueeze(-1) for v in (value, mean, variance))
        else:
            assert not isinstance(place.layer, Dynamic)
            value, mean, variance = draw_static(
                place.layer.support, layer, x, random.residual[place.name], switches
            )
            if place.last:
                value = mean
        signals[place.name] = value
    level = system.level(inputs)
    if level is not None:
        mean = mean + level
    return Drawn(signals, mean, variance.expand(mean.shape))


def draw_static(
    support_count: int, layer: StaticSystem, x: Tensor, residual: Tensor, switches: Switches
) -> tuple[Tensor, Tensor, Tensor]:
    """One function along x, or its mean; mean and variance at each point."""
    function = layer.function
    if isinstance(function, KnownFunction):
        mean, variance = function.moments(x)
        return mean, mean, variance
    support = support_points(function, support_count)
    if function.channels > 1:

        def at(part: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            if not (switches.functions and switches.several_channels):
                mean = function.mean(part)
                return mean, mean, torch.zeros_like(mean)
            mean, variance = function.moments(part)
            return function.path(part, residual, support), mean, variance

        # Stretch by stretch: kernel matrices of all points at once would not fit.
        points = x.shape[:-2].numel() * (function.locations.shape[-2] + support.shape[-2])
        stretches = x.split(max(1, KERNEL_ENTRIES // points), -2)
        value, mean, variance = (
            torch.cat(part, -2) for part in zip(*map(at, stretches), strict=True)
        )
        return value, mean, variance
    # Functions of one channel are read off a fine grid: far fewer kernel evaluations.
    batch = function.batch_shape
    over = tuple(range(x.dim() - 2 - len(batch)))
    # Runs that grow without bound leave the others their grid: beyond it functions are straight.
    ends = [part.unsqueeze(-2) for part in function.locations.aminmax(dim=-2)]
    far = WIDEST * (ends[1] - ends[0])
    near = x.clamp(ends[0] - far, ends[1] + far).where(x.isfinite(), ends[0])
    low, high = (near.amin(over), near.amax(over)) if over else (near, near)
    low, high = low.amin(-2).squeeze(-1), high.amax(-2).squeeze(-1) + 1e-9
    share = torch.linspace(0.0, 1.0, FINE, dtype=torch.float64)
    grid = (low.unsqueeze(-1) + (high - low).unsqueeze(-1) * share).unsqueeze(-1)
    place = (x.squeeze(-1) - low.unsqueeze(-1)) / (high - low).unsqueeze(-1) * (FINE - 1)
    on_mean, on_variance = function.moments(grid)
    mean = _read(on_mean, place)
    if not switches.functions:
        return mean, mean, torch.zeros_like(mean)
    return (
        _read(function.path(grid, residual, support), place),
        mean,
        _read(on_variance, place).clamp_min(0.0),
    )


# Most entries of a kernel matrix along a trajectory (32 MB).
KERNEL_ENTRIES = 4_000_000
# Points of the grid that a function of one channel is read off, and how far the grid goes beyond
# the points where the function is learnt, at most [their width].
FINE, WIDEST = 1025, 3.0


def _read(values: Tensor, place: Tensor) -> Tensor:
    """Linear interpolation of values (*b, FINE, e) at places (*s, n): (*s, n, e)."""
    first = place.nan_to_num().floor().clamp(0, FINE - 2).long()
    part = (place - first).unsqueeze(-1)
    full = values.expand((*first.shape[:-1], *values.shape[-2:]))
    index = first.unsqueeze(-1).expand((*first.shape, values.shape[-1]))
    return torch.gather(full, -2, index) * (1 - part) + torch.gather(full, -2, index + 1) * part


def fresh_noise(modes: Modes, grid: TimeGrid) -> LTIProcess:
    """What process noise adds to the output from a known first state on."""
    P = modes.pairs
    alone = Modes(
        poles=modes.poles,
        output_gain=modes.output_gain,
        noise_gain=modes.noise_gain,
        noise=modes.noise,
    )
    known = ModalState(
        torch.zeros_like(modes.poles), torch.zeros(2 * P, 2 * P, dtype=torch.float64)
    )
    return LTIProcess(alone, grid, None, known)


def first_state(system: System) -> JointState:
    """State of all dynamic layers at the first sample: what past inputs and process noise left."""
    priors = [layer.prior_state() for _, layer in system.dynamic]
    if not priors:
        return JointState(torch.zeros(0).double(), torch.zeros(0, 0).double())
    covariances = [prior.covariance for prior in priors if prior.covariance is not None]
    return JointState.of_layers([prior.mean for prior in priors], covariances)


def noise_variance(
    likelihood: Likelihood, sd: Tensor, count: int, generator: np.random.Generator
) -> np.ndarray:
    """Variance (count, n, n_y) of noise of scale sd (*b, n, n_y) for each of many components.

    A Student-t's is drawn.
    """
    flat = sd.reshape(-1, *sd.shape[-2:]).numpy()
    variance = np.broadcast_to(flat, (len(flat), *flat.shape[1:])) ** 2
    variance = np.tile(variance, (-(-count // len(variance)), 1, 1))[:count]
    return variance * variance_multiples(likelihood, variance.shape, generator)


def variance_multiples(
    likelihood: Likelihood, shape: tuple[int, ...], generator: np.random.Generator
) -> np.ndarray | float:
    """Draws of what multiplies the variance of Gaussian noise: inverse gammas for a Student-t."""
    nu = likelihood.degrees_of_freedom
    return 1.0 if nu is None else 0.5 * nu / generator.standard_gamma(0.5 * nu, shape)
