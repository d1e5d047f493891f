"""Poles and gains of one linear layer from values of its sites and back, at many points, in numpy.

The formulas are those of `models.priors.ModesPrior.modes`, in scaled units; their derivatives are
by hand. Sums are over single rows and complex numbers are pairs of real ones, so that each point
rounds alike whatever others there are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pyro_dynogp.data.scaling import TimeScale
from pyro_dynogp.lti.likelihood import Systems
from pyro_dynogp.models.horseshoe import HORSESHOE_SCALE
from pyro_dynogp.models.priors import CRITICAL, WALK, WALKED
from pyro_dynogp.models.wiring import Dynamic

Parts = dict[str, np.ndarray]


class _Poles(NamedTuple):
    """Decay, undamped and damped frequency and absolute value (k, P) of poles [1/s]."""

    decay: np.ndarray
    undamped: np.ndarray
    frequency: np.ndarray
    size: np.ndarray


@dataclass(frozen=True)
class LinearSystems:
    """The map from values of sites to systems.

    Attributes:
        name: of the layer. layer: which one. inputs: that it sees. direct: that act at once.
        prompt: columns of the inputs that have a direct path, where there is any.
        places: of each site its part of a vector. shapes: of each site.
        time: scale of the training record.
        reference: the output whose entries of C are positive, where there are several.
    """

    name: str
    layer: Dynamic
    inputs: int
    direct: int
    places: Mapping[str, slice]
    shapes: Mapping[str, tuple[int, ...]]
    time: TimeScale
    prompt: tuple[int, ...]
    reference: int = 0

    @property
    def states(self) -> int:
        """P of the systems, integrators and their walks counted."""
        return self.layer.modes

    def __call__(self, x: np.ndarray) -> Systems:
        """Systems at values x (k, d) of all sites, side by side."""
        k, layer = len(x), self.layer
        poles = self._poles(x)
        lam = np.zeros((k, self.states), dtype=complex)
        lam.real[:, : layer.pairs], lam.imag[:, : layer.pairs] = -poles.decay, poles.frequency
        B = np.zeros((k, self.states, self.inputs), dtype=complex)
        L = np.zeros((k, self.states, self._brownian), dtype=complex)
        C = np.ones((k, layer.outputs, self.states), dtype=complex)
        drift = None
        if self.inputs:
            gain = self._own(x, "input_gain") * poles.size[..., None, None]
            self._put(B, poles, gain[..., 0], gain[..., 1] * poles.size[..., None])
        if layer.process_noise:
            noise = self._noise(x)
            self._put(L, poles, noise[..., 0], noise[..., 1] * poles.size[..., None])
        if layer.outputs > 1:
            _put_direction(C[..., : layer.pairs], self._own(x, "output_gain"), self.reference)
        if layer.integrators:
            drift = self._integrate(x, lam, B, C, L)
        offset = self._part(x, "offset")
        variance = self._part(x, "noise_sd") ** 2
        return Systems(lam, B, C, L, drift, self._acting(x), offset, variance)

    def gradient(self, x: np.ndarray, systems: Systems, bars: Systems) -> np.ndarray:
        """Gradients (k, d) by x from those by the systems at x."""
        out = np.zeros_like(x)
        layer, P = self.layer, self.layer.pairs
        poles = self._poles(x)
        decay_bar = -bars.poles.real[:, :P]
        frequency_bar, size_bar = bars.poles.imag[:, :P].copy(), np.zeros_like(decay_bar)
        size = poles.size[..., None]
        for gains, found in ((systems.B, bars.B), (systems.L, bars.L)):
            if gains.shape[-1] == 0 or (gains is systems.L and not layer.process_noise):
                continue
            ratio = found.imag[:, :P] / poles.frequency[..., None]
            b0_bar = -0.5 * ratio
            b1_bar = 0.5 * found.real[:, :P] + 0.5 * ratio * poles.decay[..., None]
            decay_bar = decay_bar + (gains.real[:, :P] * ratio).sum(-1)
            frequency_bar -= (gains.imag[:, :P] * ratio).sum(-1)
            if gains is systems.B:
                raw, site = self._own(x, "input_gain"), f"{self.name}_input_gain"
                raw_bar = np.stack([b1_bar * size, b0_bar * size * size], -1)
                each = raw[..., 0] * b1_bar + 2.0 * raw[..., 1] * size * b0_bar
                self._give(out, site, raw_bar)
            else:
                share_bar = np.stack([b1_bar, b0_bar * size], -1) * self._intensity
                each = self._noise(x)[..., 1] * b0_bar
                local, unit = (self._own(x, f"noise_gain_{n}") for n in ("local_scale", "unit"))
                self._give(out, f"{self.name}_noise_gain_unit", share_bar * local[..., None, None])
                own = (share_bar * unit).reshape(len(x), P, -1).sum(-1)
                self._give(out, f"{self.name}_noise_gain_local_scale", own)
            size_bar += each.sum(-1)
        decay_bar = decay_bar + size_bar * poles.decay / poles.size
        frequency_bar += size_bar * poles.frequency / poles.size
        along = frequency_bar / poles.frequency
        decay_bar = decay_bar + along * CRITICAL**2 * poles.decay
        self._give(out, f"{self.name}_log_decay", decay_bar * poles.decay)
        self._give(out, f"{self.name}_log_frequency", along * poles.undamped**2)
        if layer.outputs > 1:
            raw = self._own(x, "output_gain")
            bar = _direction_gradient(raw, systems.C[..., :P], bars.C[..., :P], self.reference)
            self._give(out, f"{self.name}_output_gain", bar)
        if layer.integrators:
            self._give_integrators(out, bars)
        first = 0
        if f"{self.name}_feedthrough" in self.places:
            first = len(self.prompt)
            self._give(out, f"{self.name}_feedthrough", bars.D[..., :first])
        if self.direct:
            self._give(out, "direct", bars.D[..., first:])
        self._give(out, "offset", bars.offset)
        self._give(out, "noise_sd", 2.0 * self._part(x, "noise_sd") * bars.variance)
        return out

    @property
    def _brownian(self) -> int:
        layer = self.layer
        return (layer.brownian or layer.outputs) if layer.process_noise else 0

    @property
    def _intensity(self) -> float:
        return HORSESHOE_SCALE * math.sqrt(4.0 * self.time.typical_rate)

    def _part(self, x: np.ndarray, site: str) -> np.ndarray:
        return np.ascontiguousarray(x[:, self.places[site]]).reshape(len(x), *self.shapes[site])

    def _own(self, x: np.ndarray, site: str) -> np.ndarray:
        return self._part(x, f"{self.name}_{site}")

    def _give(self, out: np.ndarray, site: str, bar: np.ndarray) -> None:
        out[:, self.places[site]] = bar.reshape(len(out), -1)

    def _poles(self, x: np.ndarray) -> _Poles:
        rate = self.time.typical_rate
        decay = rate * np.exp(self._own(x, "log_decay"))
        undamped = rate * np.exp(self._own(x, "log_frequency"))
        frequency = np.sqrt(undamped**2 + (CRITICAL * decay) ** 2)
        return _Poles(decay, undamped, frequency, np.sqrt(decay**2 + frequency**2))

    def _noise(self, x: np.ndarray) -> np.ndarray:
        """n1 and n0 (k, P, n_l, 2) of the noise's sections, n0 over |lambda|."""
        local, unit = self._own(x, "noise_gain_local_scale"), self._own(x, "noise_gain_unit")
        return np.asarray(self._intensity * local[..., None, None] * unit)

    def _put(self, gains: np.ndarray, poles: _Poles, b1: np.ndarray, b0: np.ndarray) -> None:
        """Residues of sections (b1 s + b0) / ((s - lambda)(s - conj lambda))."""
        P, real = self.layer.pairs, 0.5 * b1
        gains.real[:, :P] = real
        gains.imag[:, :P] = -(0.5 * b0 - real * poles.decay[..., None]) / poles.frequency[..., None]

    def _acting(self, x: np.ndarray) -> np.ndarray:
        """D (k, n_y, n_d): feedthrough, then inputs that act at once."""
        shape = (len(x), self.layer.outputs, -1)
        parts = [np.zeros((*shape[:2], 0))]
        if f"{self.name}_feedthrough" in self.places:
            parts.append(self._own(x, "feedthrough").reshape(len(x), self.layer.outputs, -1))
        if self.direct:
            parts.append(self._part(x, "direct").reshape(len(x), self.layer.outputs, -1))
        return np.concatenate(parts, -1)

    @property
    def _rate(self) -> float:
        """Unit of the rates of integrators."""
        return 0.5 * self.time.typical_rate

    @property
    def _walked(self) -> float:
        """Unit of their walks."""
        return 0.5 * WALKED / math.sqrt(self.time.duration)

    def _places_of_integrators(self) -> tuple[slice, slice]:
        P, n_y = self.layer.pairs, self.layer.outputs
        return slice(P, P + n_y), slice(P + n_y, P + 2 * n_y)

    def _integrate(
        self, x: np.ndarray, lam: np.ndarray, B: np.ndarray, C: np.ndarray, L: np.ndarray
    ) -> np.ndarray:
        """Fill in integrators and walks; the drift (k, P)."""
        level, walk = self._places_of_integrators()
        C[..., level] = np.eye(self.layer.outputs)
        if self.inputs:
            B[:, level] = self._rate * self._own(x, "integrator_gain")
        if self.layer.process_noise:
            lam[:, walk] = -WALK / self.time.duration
            C[..., walk] = np.eye(self.layer.outputs)
            L[:, walk] = self._walked * self._own(x, "integrator_noise")
        drift = np.zeros_like(lam)
        drift[:, level] = self._rate * self._own(x, "integrator_drift")
        return drift

    def _give_integrators(self, out: np.ndarray, bars: Systems) -> None:
        level, walk = self._places_of_integrators()
        assert bars.drift is not None
        self._give(out, f"{self.name}_integrator_drift", self._rate * bars.drift.real[:, level])
        if self.inputs:
            self._give(out, f"{self.name}_integrator_gain", self._rate * bars.B.real[:, level])
        if self.layer.process_noise:
            self._give(out, f"{self.name}_integrator_noise", self._walked * bars.L.real[:, walk])


def _put_direction(C: np.ndarray, raw: np.ndarray, at: int) -> None:
    """Write raw (k, n_y, P, 2) of unit length, entries of output `at` real, positive."""
    re, im = raw[..., 0], raw[..., 1]
    x, y = re[:, at : at + 1], im[:, at : at + 1]
    first = np.sqrt(x**2 + y**2)
    cosine, sine = x / first, -y / first  # of the turn
    norm = np.sqrt((re * re + im * im).sum(1, keepdims=True))
    C.real[:] = (re * cosine - im * sine) / norm
    C.imag[:] = (re * sine + im * cosine) / norm


def _direction_gradient(raw: np.ndarray, C: np.ndarray, bar: np.ndarray, at: int) -> np.ndarray:
    """Gradients (k, n_y, P, 2) by raw from those by C = raw exp(-i theta) / |raw|."""
    re, im = raw[..., 0], raw[..., 1]
    x, y = re[:, at : at + 1], im[:, at : at + 1]
    square = (x**2 + y**2)[:, 0]
    first = np.sqrt(square)[:, None]
    cosine, sine = x / first, -y / first
    norm = np.sqrt((re * re + im * im).sum(1, keepdims=True))
    along = (bar.real * C.real + bar.imag * C.imag).sum(1, keepdims=True) / norm
    across = (bar.imag * C.real - bar.real * C.imag).sum(1)  # by the angle of the turn
    out = np.stack(
        [
            (bar.real * cosine + bar.imag * sine) / norm - along * re / norm,
            (bar.imag * cosine - bar.real * sine) / norm - along * im / norm,
        ],
        -1,
    )
    # The turn is minus the angle of entry `at`, whose gradient is (-im, re) / |first|^2.
    out[:, at, :, 0] += across * im[:, at] / square
    out[:, at, :, 1] -= across * re[:, at] / square
    return out
