r"""Log joint density of linear models under Gaussian noise at many vectors, with gradients by hand.

What `density.joint_energy` says of a model that is one layer of linear dynamics, whose noise has
one size and whose first state is integrated out, without tensors or a graph: sites to poles and
gains and back in numpy, likelihoods in compiled code (`lti.likelihood`), everything in scaled
units. The tests hold it against the path through torch. A vector at which there is no density
leaves the others alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.data.scaling import TimeScale
from pyro_dynogp.inference.late_inputs import LateInputs, Part, Seen
from pyro_dynogp.inference.linear_systems import LinearSystems
from pyro_dynogp.inference.log_joint import Direct
from pyro_dynogp.inference.priors_of_vectors import VectorPriors, vector_priors
from pyro_dynogp.lti.held_lanes import Signals
from pyro_dynogp.lti.likelihood import Past, Systems, Tape, gradients, innovations_of
from pyro_dynogp.models.arrival import DELAY, columns_of, prompt_columns
from pyro_dynogp.models.late_systems import common_step
from pyro_dynogp.models.past_inputs import LEVEL
from pyro_dynogp.models.prepared import PreparedRecord, scaled_inputs

# Rounding of a variance from which on it counts as positive, as `lti.semiseparable` has it.
ROUNDING = 4.0 * float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False)
class _Data:
    """A record: signals, missing samples (0 or 1, N), which are there (N,), units of outputs (N,).

    log_scale: what the density per unit of the record is smaller than per scaled unit [nats].
    around: signals before and after the record, too, where they are known; first: its place there.
    """

    signals: Signals
    missing: np.ndarray
    there: np.ndarray
    unit: np.ndarray
    log_scale: float
    around: Signals
    first: int


def _data(record: PreparedRecord, systems: LinearSystems) -> _Data:
    y = record.scaled_outputs.numpy().reshape(-1)
    there = ~np.isnan(y)
    unit = np.tile(np.asarray(record.scaling.output_scale), len(record))
    signals = _signals(record, systems, record.scaled_inputs.numpy(), np.where(there, y, 0.0))
    missing = np.zeros((0, len(y)), dtype=bool) if there.all() else ~there[None]
    around, first = signals, 0
    if record.around is not None:
        u, first = scaled_inputs(record.around.inputs, record.scaling).numpy(), record.around.first
        around = _signals(record, systems, u, y)
    return _Data(signals, missing, there, unit, float(np.log(unit[there]).sum()), around, first)


def _signals(
    record: PreparedRecord, systems: LinearSystems, u: np.ndarray, y: np.ndarray
) -> Signals:
    """What systems see of scaled inputs u (n, n_u), and outputs y (n n_y)."""
    driving, direct = u[:, : systems.inputs], u[:, systems.inputs :]
    feedthrough = f"{systems.name}_feedthrough" in systems.places
    acting = [*([driving[:, list(systems.prompt)]] if feedthrough else []), direct]
    if systems.layer.integrators:
        driving = np.concatenate([driving, np.ones((len(u), 1))], 1)
    return Signals(
        np.asarray(record.grid.step_index),
        record.grid.steps.numpy(),
        np.ascontiguousarray(driving),
        np.ascontiguousarray(np.concatenate(acting, 1)),
        y,
    )


def linear_density(density: object) -> LinearDensity | None:
    """The density of a model to which this module applies; None for others."""
    if not isinstance(density, Direct) or density.fixed:
        return None
    model = density.model
    if not (model.is_linear and model.likelihood.gaussian and not model.likelihood.varying):
        return None
    if model.state_sites or model.initial_state == "zero" or model.has_feedback:
        return None
    if model.late and common_step(density.records) is None:
        return None
    priors = vector_priors(density.sites)
    return None if priors is None else LinearDensity(density, priors)


class LinearDensity:
    """Energies of a linear model at unconstrained vectors, all sites side by side.

    Args:
        density: of the model. priors: of its sites.
    """

    def __init__(self, density: Direct, priors: VectorPriors) -> None:
        model = density.model
        ((wire, layer),) = model.dynamic
        time = TimeScale.of(density.records[0].scaling)
        shapes = {site.name: tuple(site.shape) for site in density.sites}
        scaling, driving = density.records[0].scaling, model.inputs - model.direct
        late = columns_of(model.late, scaling)
        prompt = tuple(prompt_columns(model.late, scaling, driving))
        self._systems = LinearSystems(
            wire.name, layer, driving, model.direct, priors.places, shapes, time, prompt,
            model.reference_of(layer, scaling),
        )  # fmt: skip
        self.priors = priors
        self._data = [_data(record, self._systems) for record in density.records]
        self._late = None
        if late:
            step = common_step(density.records)
            assert step is not None
            self._late = LateInputs(self._systems, late, priors.places[DELAY], step)
        self._past = Past(layer.noise == "shared", 1.0 / time.typical_rate, (0.5 * LEVEL) ** 2)

    @np.errstate(all="ignore")  # what is out of range ends as NaN, which is told apart
    def energies(self, u: np.ndarray, *, jacobian: bool) -> np.ndarray:
        """-log p (k,) at u (k, d), with `jacobian` of the vector; infinite where there is none."""
        values = self.priors.values(u)
        total = self.priors.log_prob(values.x)[0]
        systems, bad = self._systems(values.x), np.zeros(len(u), dtype=bool)
        for data in self._data:
            for part in self._parts(values.x, systems, data):
                z, d, refused, _ = self._innovations(part, keep=False)
                total[part.points] += _log_prob(z, d, data)
                bad[part.points] |= refused
        if jacobian:
            total = total + values.log_jacobian
        return np.where(bad | ~np.isfinite(total), np.inf, -total)

    @np.errstate(all="ignore")
    def with_gradients(self, u: np.ndarray, *, jacobian: bool) -> tuple[np.ndarray, np.ndarray]:
        """`energies` (k,) and their gradients (k, d); zero where there is no density."""
        values = self.priors.values(u)
        total, by_x = self.priors.log_prob(values.x)
        systems, bad = self._systems(values.x), np.zeros(len(u), dtype=bool)
        for data in self._data:
            for part in self._parts(values.x, systems, data):
                z, d, refused, tape = self._innovations(part, keep=True)
                total[part.points] += _log_prob(z, d, data)
                bad[part.points] |= refused
                ratio = np.where(data.there, z / d, 0.0)
                d_bar = np.where(data.there, 0.5 * (ratio * ratio - 1.0 / d), 0.0)
                bars = gradients(tape, -ratio, d_bar)
                by_x[part.points] += part.gradient(values.x, self._systems, bars)
        slope = by_x * values.slope
        if jacobian:
            total, slope = total + values.log_jacobian, slope + values.log_jacobian_slope
        bad |= ~(np.isfinite(total) & np.isfinite(slope).all(1))
        return np.where(bad, np.inf, -total), np.where(bad[:, None], 0.0, -slope)

    @np.errstate(all="ignore")
    def innovations(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Innovations and variances (k, N) of the measured samples, in units of the record.

        NaN where there is no density.
        """
        x = self.priors.values(u).x
        systems = self._systems(x)
        errors, variances = [], []
        for data in self._data:
            z, d = np.empty((2, len(u), len(data.there)))
            for part in self._parts(x, systems, data):
                z[part.points], found, bad, _ = self._innovations(part, keep=False)
                found[bad] = np.nan
                d[part.points] = found
            errors.append((z * data.unit)[:, data.there])
            variances.append((d * data.unit**2)[:, data.there])
        return np.concatenate(errors, 1), np.concatenate(variances, 1)

    def _parts(self, x: np.ndarray, systems: Systems, data: _Data) -> Iterator[Part]:
        """Systems at x (k, d) with what they see of a record: all that see the same together."""
        if self._late is None:
            yield Part(slice(None), systems, data.signals, data.missing)
        else:
            seen = Seen(data.signals, data.around, data.first)
            yield from self._late.parts(x, systems, seen, data.missing)

    def _innovations(
        self, part: Part, *, keep: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Tape]:
        """Z and d (k, N), where there is no density (k,), and the tape."""
        systems = part.systems
        z, d, tape = innovations_of(systems, part.signals, part.missing, self._past, keep=keep)
        least = ROUNDING * np.abs(tape.stationary)
        above = (d.reshape(len(d), -1, least.shape[1]) > least[:, None]).all((1, 2))
        stable = (systems.poles.real[:, : self._systems.layer.pairs] < 0.0).all(1)
        return z, d, ~(above & stable), tape


def _log_prob(z: np.ndarray, d: np.ndarray, data: _Data) -> np.ndarray:
    """Log-density (k,) of a record."""
    terms = np.where(data.there, z * z / d + np.log(2.0 * math.pi * d), 0.0)
    return np.asarray(-0.5 * terms.sum(1) - data.log_scale)


class LinearEnergy(torch.autograd.Function):
    """Energies (k,) of a `LinearDensity` at vectors (k, d), as a node of a graph."""

    @staticmethod
    def forward(ctx: Any, z: Tensor, density: LinearDensity, jacobian: bool) -> Any:
        """Energies, with their gradients at once where they may be asked for."""
        u = z.detach().numpy()
        if not ctx.needs_input_grad[0]:
            return torch.from_numpy(density.energies(u, jacobian=jacobian))
        energy, gradient = density.with_gradients(u, jacobian=jacobian)
        ctx.gradient = torch.from_numpy(gradient)
        return torch.from_numpy(energy)

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> Any:
        """Gradients by the vectors."""
        # Where there is no density the gradient is zero, whatever the bar is.
        bar = bars[0].nan_to_num(0.0, 0.0, 0.0)
        return bar[:, None] * ctx.gradient, None, None
