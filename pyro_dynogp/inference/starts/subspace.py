"""Starting points from subspace identification: poles of state-space models of every order.

What past inputs and outputs say about future outputs, less what future inputs do, has the column
space of the extended observability matrix; that of the first rows, moved by one sample, is the
state matrix (Van Overschee & De Moor 1994, Automatica 30:75, in the form of PO-MOESP: Verhaegen
1994, Automatica 30:61). Its eigenvalues are poles. Orders below that of the model leave pairs that
do nothing yet: a record that excites few modes has its optimum there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.linalg
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor

from pyro_dynogp.data.scaling import Scaling, TimeScale
from pyro_dynogp.inference.starts.poles import grown, random_poles, values_given_poles
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord

# Samples of past and of future beyond the order; so many windows for each row at least, and about
# so many of each record at most, evenly spread.
BEYOND, WINDOWS, MOST = 6, 1.5, 50_000
# Frequency over decay rate of a pair that two real poles make; largest share of a rate bound.
REAL, INSIDE = 0.1, 0.95


def subspace_starts(
    model: Model, records: Sequence[PreparedRecord], seed: int
) -> list[dict[str, Tensor]]:
    """Values of every site for each order up to that of a linear model, best fit first.

    None where steps differ, or where gaps leave too few stretches without one.

    Args:
        model: linear. records: the training records.
        seed: of the poles of pairs that do nothing yet.
    """
    scaling = records[0].scaling
    ((wire, layer),) = model.dynamic
    generator = np.random.default_rng(seed)
    sites = model.all_sites(scaling, len(records))
    found: list[tuple[float, dict[str, Tensor]]] = []
    inputs, levels = model.inputs - model.direct, layer.integrators * layer.outputs
    for poles in subspace_poles(records, layer.pairs, inputs, levels):
        small = replace(model, layers=(replace(layer, pairs=len(poles), name=wire.name),))
        misfit, values = values_given_poles(small, records, scaling, poles)
        if len(poles) < layer.pairs:
            rest = random_poles(layer.pairs - len(poles), scaling, generator)
            every = np.concatenate([poles, rest])
            values = grown(values, values_given_poles(model, records, scaling, every)[1], sites)
        found.append((misfit, values))
    found.sort(key=lambda one: one[0])
    return [values for _, values in found]


def subspace_poles(
    records: Sequence[PreparedRecord], pairs: int, inputs: int, integrators: int = 0
) -> list[np.ndarray]:
    """Poles (p,) [1/time unit] of models of 1 to `pairs` conjugate pairs, as `subspace_starts`.

    Args:
        records: training records. pairs: most. inputs: the first so many have dynamics.
        integrators: poles beside them; so many that are nearest to zero are left out.
    """
    scaling = records[0].scaling
    steps = [np.diff(each.record.time) for each in records if len(each) > 1]
    step = float(scaling.time_step)
    if not steps or any(np.ptp(one) > 1e-6 * step or one[0] > 1.5 * step for one in steps):
        return []
    blocks = 2 * pairs + BEYOND
    signals = [
        (each.scaled_inputs[:, :inputs].numpy(), each.scaled_outputs.numpy())
        for each in records
        if len(each) > 2 * blocks
    ]
    outputs = len(scaling.output_scale)
    rows = 2 * blocks * (inputs + outputs)
    windows = [np.concatenate([_windows(x, 2 * blocks) for x in pair], axis=1) for pair in signals]
    data = np.concatenate(windows) if windows else np.zeros((0, rows))
    data = data[np.isfinite(data).all(1)]
    if len(data) < WINDOWS * rows:
        return []
    # Columns in the order future inputs, past inputs, past outputs, future outputs.
    half, all_inputs = blocks * inputs, 2 * blocks * inputs
    past = [data[:, :half], data[:, all_inputs : all_inputs + blocks * outputs]]
    future = [data[:, half:all_inputs], data[:, all_inputs + blocks * outputs :]]
    R = scipy.linalg.qr(np.concatenate([future[0], *past, future[1]], axis=1), mode="r")[0][:rows]
    start = rows - blocks * outputs
    left, size, _ = np.linalg.svd(R[half:start, start:].T, full_matrices=False)
    found = []
    for p in range(1, pairs + 1):
        order = 2 * p + integrators
        observability = left[:, :order] * np.sqrt(size[:order])
        upper, lower = observability[:-outputs], observability[outputs:]
        state = np.linalg.lstsq(upper, lower, rcond=None)[0]
        values = np.linalg.eigvals(state)
        values = values[np.argsort(np.abs(values - 1.0))[integrators:]] if integrators else values
        found.append(_pairs(values, scaling)[:pairs])
    return found


def _windows(x: np.ndarray, length: int) -> np.ndarray:
    """Windows of a signal (n, w), a row each (m, length w), sample by sample."""
    every = sliding_window_view(x, length, axis=0)
    some = every[:: -(-len(every) // MOST)].swapaxes(1, 2)
    return some.reshape(len(some), -1)


def _pairs(eigenvalues: np.ndarray, scaling: Scaling) -> np.ndarray:
    """One stable pole [1/time unit] of each conjugate pair; two real ones make a pair."""
    scale = TimeScale.of(scaling)
    low, high = (np.exp(bound) for bound in scale.rate_bounds)
    with np.errstate(divide="ignore"):
        rates = np.log(eigenvalues.astype(complex)) / scale.step
    real = np.sort(rates[np.abs(rates.imag) <= 1e-9 * high].real)
    joined = np.array([group.mean() for group in np.array_split(real, -(-len(real) // 2) or 1)
                       if len(group)])  # fmt: skip
    poles = np.concatenate([rates[rates.imag > 1e-9 * high], joined * (1.0 + 0j)])
    decay = np.clip(np.abs(poles.real), low, INSIDE * high)
    frequency = np.where(poles.imag > 0.0, poles.imag, REAL * decay)
    return -decay + 1j * np.clip(frequency, low / 5.0, INSIDE * high)
