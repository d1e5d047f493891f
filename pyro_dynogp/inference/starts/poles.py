"""Starting points: poles at random, everything else by linear least squares given the poles."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.data.scaling import Scaling, TimeScale
from pyro_dynogp.layers.noise import TYPICAL
from pyro_dynogp.layers.sites import Site
from pyro_dynogp.lti.grid import TimeGrid
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.response import held_states
from pyro_dynogp.lti.views import numerators
from pyro_dynogp.models.arrival import prompt_columns
from pyro_dynogp.models.horseshoe import HORSESHOE_SCALE
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord

# How far the random walk beside an integrator gets at a start, see `ModesPrior`.
WALKS = 0.1


def starting_values(
    model: Model, records: Sequence[PreparedRecord], *, count: int, seed: int, tries: int = 48
) -> list[dict[str, Tensor]]:
    """Values of every site for the `count` best of `tries` random sets of poles.

    Given the poles, the simulated output is linear in the residues c_j B_j, the feedthrough and
    the offset: ridge regression gives them, and its residual ranks the sets.

    Args:
        model: with its scaling. records: the training records.
        count: how many starts to return, best first. seed: of the random poles.
        tries: sets of poles to look at; fewer for very long records.
    """
    scaling = records[0].scaling
    ((_, layer),) = model.dynamic
    generator = np.random.default_rng(seed)
    total = sum(len(record) for record in records)
    tries = max(count, min(tries, int(2e6 / total)))
    candidates = []
    for _ in range(tries):
        poles = random_poles(layer.pairs, scaling, generator)
        candidates.append(values_given_poles(model, records, scaling, poles))
    candidates.sort(key=lambda candidate: candidate[0])
    return [values for _, values in candidates[:count]]


def grown(
    values: Mapping[str, Tensor],
    start: Mapping[str, Tensor],
    sites: Sequence[Site] = (),
) -> dict[str, Tensor]:
    """A start with what another fit has learnt: values of a smaller model, or of the same one.

    Sites of one name and as many dimensions share their first rows and columns; the rest of the
    start (new inputs, pairs, layers) stays as it is. Of given `sites` the rest of one that is
    shared does nothing yet (`Site.growth`), so that the start explains nearly as much as what it
    has grown from.
    """
    growth = {site.name: site.growth for site in sites}
    out = {}
    for name, value in start.items():
        new = value.clone()
        if name in values and values[name].dim() == new.dim():
            new *= growth.get(name, 1.0)
            common = tuple(
                slice(min(a, b)) for a, b in zip(new.shape, values[name].shape, strict=True)
            )
            new[common] = values[name][common]
        out[name] = new
    return out


def random_poles(pairs: int, scaling: Scaling, generator: np.random.Generator) -> np.ndarray:
    """Poles (P,) with log-uniform natural frequency and uniform damping ratio, slowest first."""
    low, high = TimeScale.of(scaling).rate_bounds
    # Not right at the limits: nothing can be learnt there and gradients vanish.
    rate = np.exp(np.sort(generator.uniform(low + 1.0, high - 0.7, pairs)))
    damping = generator.uniform(0.1, 0.95, pairs)
    return rate * (-damping + 1j * np.sqrt(1.0 - damping**2))


def values_given_poles(
    model: Model, records: Sequence[PreparedRecord], scaling: Scaling, poles: np.ndarray
) -> tuple[float, dict[str, Tensor]]:
    """Mean squared residual, and values of every site, for poles (P,) [1/time unit]."""
    ((wire, layer),) = model.dynamic
    g = wire.name
    P, n_u, n_y = layer.pairs, model.inputs - model.direct, model.outputs
    unit_rate = TimeScale.of(scaling).typical_rate
    designs, targets = [], []
    for record in records:
        u = record.scaled_inputs.numpy()
        parts = [u[:, n_u:], *_design(poles, record.grid, u[:, :n_u])]
        if layer.integrators:
            parts.append(unit_rate * _levels(record.grid, u[:, :n_u]))
        if layer.feedthrough:
            parts.append(u[:, :n_u])
        designs.append(np.concatenate([*parts, np.ones((len(u), 1))], axis=1))
        targets.append(record.scaled_outputs.numpy())
    X, Y = np.concatenate(designs), np.concatenate(targets)
    size = _sizes(X, model.direct + 2 * P * n_u, (n_u + 1) * layer.integrators)
    weights = np.stack([_ridge(X / size, Y[:, a]) for a in range(n_y)]) / size  # n_y, columns
    residual = Y - X @ weights.T
    direct, weights = weights[:, : model.direct], weights[:, model.direct :]
    spread = np.nanstd(residual, axis=0)
    rate = np.abs(poles)
    gains = weights[:, : 2 * P * n_u].reshape(n_y, P, n_u, 2)
    residues = (gains[..., 0] + 1j * gains[..., 1]) * rate[:, None]  # c_aj B_jm
    values: dict[str, Any] = {
        f"{g}_log_decay": np.log(-poles.real / unit_rate),
        f"{g}_log_frequency": np.log(poles.imag / unit_rate),
        "offset": weights[:, -1],
    }
    noise = 0.7 * spread + 1e-3
    if model.likelihood.varying:
        values["log_noise_constant"] = np.log(noise / TYPICAL)
    else:
        values["noise_sd"] = noise
    if model.direct:
        values["direct"] = direct
    direction = np.ones((n_y, P), dtype=complex)
    B = residues[0]
    if model.several_outputs:
        # The best single direction for each pair: first singular vectors of its residues.
        B = np.zeros((P, n_u), dtype=complex)
        reference = model.reference_of(layer, scaling)
        for j in range(P):
            if n_u:
                left, size, right = np.linalg.svd(residues[:, j, :], full_matrices=False)
                turn = np.exp(-1j * np.angle(left[reference, 0]))
                direction[:, j], B[j] = left[:, 0] * turn, size[0] * right[0] / turn
        values[f"{g}_output_gain"] = np.stack([direction.real, direction.imag], -1)
    if layer.integrators:
        first = 2 * P * n_u
        values[f"{g}_integrator_gain"] = weights[:, first : first + n_u]
        values[f"{g}_integrator_drift"] = weights[:, first + n_u]
    if n_u:
        # From residues to sections: b1 = g1 |lambda|, b0 = g0 |lambda|^2.
        section = numerators(torch.as_tensor(poles), torch.as_tensor(B)).numpy()
        section = section / np.stack([rate, rate**2], -1)[:, None, :]
        values[f"{g}_input_gain"] = np.clip(section, -10.0, 10.0)
        prompt = prompt_columns(model.late, scaling, n_u)
        if layer.feedthrough and prompt:
            D = weights[:, -1 - n_u : -1][:, prompt]
            values[f"{g}_feedthrough"] = D if model.several_outputs else D[0]
    if layer.process_noise:
        brownian = layer.brownian or n_y
        share = 0.3 * float(spread.mean()) / math.sqrt(P * brownian)
        values[f"{g}_noise_gain_local_scale"] = np.full(P, math.sqrt(share / HORSESHOE_SCALE))
        # Each Brownian motion in a direction of its own: if they began alike they would stay so.
        angle = (np.arange(brownian) + 0.5) * (0.5 * math.pi / brownian)
        unit = np.stack([np.cos(angle), np.sin(angle)], -1) * math.sqrt(share / HORSESHOE_SCALE)
        unit = np.tile(unit, (P, 1, 1))
        values[f"{g}_noise_gain_unit"] = unit
        if layer.integrators:
            values[f"{g}_integrator_noise"] = np.full((n_y, brownian), WALKS)
    tensors = {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}
    for site in model.all_sites(scaling, len(records)):
        if site.name not in tensors:
            tensors[site.name] = site.typical()
    return float(np.nanmean(residual**2)), tensors


def _design(poles: np.ndarray, grid: TimeGrid, u: np.ndarray) -> list[np.ndarray]:
    """Regressors (n, 2 P n_u) of 2 Re sum B/|lambda| x; none without inputs."""
    n, n_u = u.shape
    if not n_u:
        return []
    one = torch.ones(len(poles), dtype=torch.complex128)
    modes = Modes(torch.as_tensor(poles), one.unsqueeze(-1), one)
    states = np.stack([held_states(modes, grid, u[:, m : m + 1]) for m in range(n_u)], -1)
    states = 2.0 * states * np.abs(poles)[:, None]  # n, P, n_u
    return [np.stack([states.real, -states.imag], -1).reshape(n, -1)]


def _levels(grid: TimeGrid, u: np.ndarray) -> np.ndarray:
    """Integrals (n, n_u + 1) of held inputs, and time."""
    held = np.diff(grid.time.numpy())[:, None] * np.insert(u, u.shape[1], 1.0, axis=1)[:-1]
    return np.concatenate([np.zeros((1, held.shape[1])), np.cumsum(held, axis=0)])


def _sizes(X: np.ndarray, first: int, count: int) -> np.ndarray:
    """Root mean squares of so many columns from one on, and one for others (columns,).

    An integral may be far smaller than time, and a ridge that is for both would hold it down.
    """
    size = np.ones(X.shape[1])
    size[first : first + count] = np.sqrt(np.mean(X[:, first : first + count] ** 2, axis=0))
    return size


def _ridge(X: np.ndarray, y: np.ndarray, strength: float = 1e-4) -> np.ndarray:
    there = np.isfinite(y)
    A = X[there].T @ X[there]
    scale = np.trace(A) / len(A)
    return np.linalg.solve(A + strength * scale * np.eye(len(A)), X[there].T @ y[there])
