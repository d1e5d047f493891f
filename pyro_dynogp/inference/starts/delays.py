"""Starts of models whose dead times are parameters.

The density has an optimum by the dead time for each way in which poles make up for a wrong one, and
where an input goes up and down faster than the system, no slope that leads to the right one. Dead
times are therefore tried on a grid: those at which a regression leaves least, and coarse ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.data.signals import delayed
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.starts.poles import starting_values
from pyro_dynogp.inference.starts.subspace import subspace_starts
from pyro_dynogp.models.arrival import DELAY, arrived, columns_of, medians, prompt_columns
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord

Values = dict[str, Tensor]
# Lags of the output and of each input in regressions; how many minima are kept.
LAGS, KEPT = 3, 3
# Longest dead time that regressions try, as a share of the longest record; numbers that they may
# look at; ratio of dead times beyond which not every whole step is tried.
LONGEST, WORK, RATIO = 0.25, 2e6, 1.05
# Coarse dead times for climbs: so many, from a quarter of a step on.
COARSE = 8
# Starts of each dead time of either kind, and sets of random poles to choose from.
EACH, TRIES = 2, 12
# Dead times around an optimum that are climbed from again [steps].
AROUND = (-2.0, -1.0, -0.5, 0.5, 1.0, 2.0)
# Samples that are left out: what arrives within so many likely dead times and steps.
UNKNOWN, STEPS = 1.5, 2.0


def likely_delays(model: Model, records: Sequence[PreparedRecord]) -> list[np.ndarray]:
    """Dead times (K,) [time unit] at which a regression of the output leaves least, best first.

    The first output is regressed on its own past and on inputs of `LAGS` samples that are delayed;
    of several dead times all are taken as one first, and then changed one by one.

    Args:
        model: with K free dead times. records: prepared for it.

    Source: autoregressions with exogenous inputs over a range of delays, Ljung, System
    Identification (2nd ed., 1999), section 16.4.
    """
    scaling = records[0].scaling
    columns, step = columns_of(model.late, scaling), float(scaling.time_step)
    grid = step * _tried(records, len(columns))
    left = _Left(records, columns, float(grid[-1]))
    if not left.enough:
        return []
    together = np.array([left(np.full(len(columns), d)) for d in grid])
    found = [np.full(len(columns), grid[i]) for i in _lowest(together)]
    if len(columns) == 1:
        return found
    best = found[0].copy()
    for k in [*range(len(columns))] * 2:
        each = [np.where(np.arange(len(columns)) == k, d, best) for d in grid]
        best = min(each, key=left)
    return [best, *found]


def _tried(records: Sequence[PreparedRecord], count: int) -> np.ndarray:
    """Whole steps up to a share of the longest record: all of them as far as work allows."""
    longest = max(len(record) for record in records)
    samples = sum(len(record) for record in records)
    most = max(2, int(LONGEST * longest))
    dense = int(min(most, max(40, WORK / (samples * count))))
    ratios = np.arange(1, 1 + max(0, int(np.log(most / dense) / np.log(RATIO))))
    return np.concatenate([np.arange(dense + 1), np.floor(dense * RATIO**ratios)])


def _lowest(left: np.ndarray) -> np.ndarray:
    around = np.concatenate([[np.inf], left, [np.inf]])
    low = np.flatnonzero((left <= around[:-2]) & (left <= around[2:]))
    return low[np.argsort(left[low], kind="stable")][:KEPT]


class _Left:
    """What regressions leave of the first output (sum of squares), as a function of dead times.

    The rows are those that no dead time up to `longest` reaches before the record from.
    """

    def __init__(
        self, records: Sequence[PreparedRecord], columns: Sequence[int], longest: float
    ) -> None:
        self.columns = columns
        self.signals, known, target = [], [], []
        for record in records:
            time, u = record.grid.time.numpy(), record.scaled_inputs.numpy()
            y = record.scaled_outputs.numpy()[:, 0]
            first = int(np.searchsorted(time, time[0] + longest)) + LAGS
            rows = np.arange(first, len(record))
            past = np.stack([y[rows - lag] for lag in range(1, LAGS + 1)], 1)
            others = [u[:, c] for c in range(u.shape[1]) if c not in columns]
            one = np.ones((len(rows), 1))
            known.append(np.concatenate([one, past, *(_lagged(x, rows) for x in others)], 1))
            target.append(y[rows])
            self.signals.append((time, u, rows))
        X, y = np.concatenate(known), np.concatenate(target)
        self.there = np.isfinite(X).all(1) & np.isfinite(y)
        X, y = X[self.there], y[self.there]
        self.enough = len(y) > 2 * (X.shape[1] + LAGS * len(columns))
        self.basis = np.linalg.qr(X)[0]
        self.rest = self._without(y)

    def _without(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(x - self.basis @ (self.basis.T @ x))

    def __call__(self, delays: np.ndarray) -> float:
        parts = []
        for time, u, rows in self.signals:
            late = [delayed(u[:, c], time, d) for c, d in zip(self.columns, delays, strict=True)]
            parts.append(np.concatenate([_lagged(x, rows) for x in late], 1))
        X = self._without(np.concatenate(parts)[self.there])
        return float(np.square(self.rest - X @ np.linalg.lstsq(X, self.rest, rcond=1e-8)[0]).sum())


def _lagged(x: np.ndarray, rows: np.ndarray) -> np.ndarray:
    return np.stack([x[rows - lag] for lag in range(LAGS)], 1)


def delayed_starts(
    model: Model, records: Sequence[PreparedRecord], count: int, seed: int
) -> list[Values]:
    """Starts of a linear model at several dead times, the densest first of each.

    Args:
        model: linear, with free dead times. records: prepared for it. count: how many.
        seed: of random poles.
    """
    scaling = records[0].scaling
    columns = columns_of(model.late, scaling)
    ((wire, layer),) = model.dynamic
    prompt = prompt_columns(model.late, scaling, wire.channels)
    at_once = layer.feedthrough and len(prompt) > 0
    plain = replace(model, channels=(), layers=(replace(layer, feedthrough=at_once),))
    direct = f"{wire.name}_feedthrough"
    longest = LONGEST * float(scaling.duration)
    coarse = np.geomspace(0.25 * float(scaling.time_step), longest, COARSE)
    likely = likely_delays(model, records)
    tried = [*likely, *(np.full(len(columns), d) for d in coarse)]
    # No dead time at all is at minus infinity of the unconstrained vector.
    tried = [np.maximum(delays, 0.1 * float(scaling.time_step)) for delays in tried]
    groups = []
    for delays in tried:
        at = torch.from_numpy(delays)
        late = [arrived(record, columns, at) for record in records]
        found = subspace_starts(plain, late, seed)[:EACH]
        found += starting_values(plain, late, count=EACH, seed=seed, tries=TRIES)
        groups.append([{**values, DELAY: at.clone()} for values in found])
        for values in groups[-1] if at_once else ():
            values[direct] = values[direct][..., prompt]
    every = [values for group in groups for values in group]
    potential = Potential(model.collapsed, (records,), every[0])
    energies = iter(potential.energies_at(every))
    ranked = [sorted([(next(energies), i, v) for i, v in enumerate(group)], key=lambda one: one[:2])
              for group in groups]  # fmt: skip
    # The best of each dead time in turn: those that are likely, and then the densest.
    first, rest = ranked[: len(likely)], sorted(ranked[len(likely) :], key=lambda g: g[0][:2])
    turns = [one[k] for k in range(EACH) for one in [*first, *rest] if k < len(one)]
    return [values for _, _, values in turns[:count]]


def with_delays(
    model: Model, records: Sequence[PreparedRecord], linear: Mapping[str, Tensor] | None
) -> tuple[Tensor, list[PreparedRecord]]:
    """Dead times of a linear fit, or typical ones for none, and records with inputs so late."""
    scaling = records[0].scaling
    usual = torch.tensor(medians(model.late, scaling), dtype=torch.float64)
    delays = usual if linear is None else linear[DELAY]
    columns = columns_of(model.late, scaling)
    return delays, [arrived(record, columns, delays) for record in records]


def moved(values: Values, step: float) -> list[Values]:
    """An optimum with each of its dead times a little shorter and longer."""
    found = []
    for k in range(len(values[DELAY])):
        for steps in AROUND:
            later = values[DELAY].clone()
            later[k] += steps * step
            if float(later[k]) > 0.0:
                found.append({**values, DELAY: later})
    return found


def without_unknown(model: Model, records: Sequence[PreparedRecord]) -> tuple[PreparedRecord, ...]:
    """Records with outputs missing until the first of their inputs is likely to have arrived.

    What acted before a record is not in it. How many samples that concerns depends on the dead
    times, but all of them have to be compared on the same samples: what would arrive within 1.5
    times the likely ones and two steps is left out, at most a quarter of each record.
    """
    likely = likely_delays(model, records)
    longest = float(likely[0].max()) if likely else 0.0
    return tuple(_begun(record, UNKNOWN * longest) for record in records)


def _begun(record: PreparedRecord, longest: float) -> PreparedRecord:
    time = record.record.time
    reach = longest + STEPS * float(record.scaling.time_step)
    count = int(np.searchsorted(time, time[0] + min(reach, LONGEST * record.record.duration)))
    outputs = record.record.outputs.copy()
    outputs[:count] = np.nan
    if not np.isfinite(outputs).any(0).all():
        return record
    return PreparedRecord.of(record.record.with_outputs(outputs), record.scaling)
