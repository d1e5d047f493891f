"""One model on several versions of its records, which differ in their inputs: evaluated together.

Channels that are delayed, bent or shifted make such versions: only the inputs differ, and the batch
of points that goes through a model at once may have other inputs for each point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeGuard, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.optimise.lockstep import Functions, in_lockstep
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import Records, as_measured
from pyro_dynogp.support.tensors import as_tensor

Result = TypeVar("Result")
# What sets the units of a model's sites but for its inputs.
_FRAME = ("time_step", "duration", "output_offset", "output_scale", "time_unit")


def each_in_lockstep(
    potentials: Sequence[Potential],
    runs: Sequence[Callable[[Functions], Result]],
    *,
    jacobian: bool,
) -> list[Result]:
    """Results of optimisers side by side, each on a density of its own, in their order.

    Each is called with values and gradients of its potential's density, of the values or with
    `jacobian` of the unconstrained vector. Points of potentials that are versions of one another
    are evaluated together, others one potential after the other.
    """
    if not potentials:
        return []
    groups = _groups(potentials)

    def functions(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        which, z = points[:, 0].astype(int), points[:, 1:]
        values, gradients = np.empty(len(z)), np.zeros(z.shape)
        for group in groups:
            rows = np.flatnonzero(np.isin(which, group.members))
            if len(rows):
                d = group.first.size
                found = group.values_and_gradients(which[rows], z[rows, :d], jacobian)
                values[rows], gradients[rows, :d] = found
        return values, gradients

    # A point says first whose it is; vectors are filled up to the longest.
    longest = max(one.size for one in potentials)

    def named(i: int) -> Callable[[Functions], Result]:
        d = potentials[i].size

        def run(joint: Functions) -> Result:
            def own(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
                points = np.zeros((len(z), 1 + longest))
                points[:, 0], points[:, 1 : 1 + d] = i, z
                values, gradients = joint(points)
                return values, gradients[:, :d]

            return runs[i](own)

        return run

    return in_lockstep(functions, [named(i) for i in range(len(runs))])


class _Group:
    """Potentials of one model on versions of the same records."""

    def __init__(self, members: Sequence[int], potentials: Sequence[Potential]) -> None:
        self.members = list(members)
        self.own = [potentials[i] for i in members]
        self.first = self.own[0]
        if len(self.own) > 1:
            versions = [_inputs(one, _scaling(self.first)) for one in self.own]
            self.inputs = tuple(torch.stack(each) for each in zip(*versions, strict=True))

    def values_and_gradients(
        self, which: np.ndarray, z: np.ndarray, jacobian: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Energies (k,) and gradients (k, d) at z (k, d), of potentials `which` (k,)."""
        if len(self.own) == 1:
            return self.first.values_and_gradients(z, jacobian=jacobian)
        places = torch.tensor([self.members.index(i) for i in which])
        inputs = tuple(one[places] for one in self.inputs)
        return self.first.values_and_gradients(z, jacobian=jacobian, inputs=inputs)


def _groups(potentials: Sequence[Potential]) -> list[_Group]:
    members: list[list[int]] = []
    for i, one in enumerate(potentials):
        others = (group for group in members if _alike(potentials[group[0]], one))
        found = next(others, None)
        if found is None:
            members.append([i])
        else:
            found.append(i)
    return [_Group(group, potentials) for group in members]


def _alike(a: Potential, b: Potential) -> bool:
    """Whether two densities are those of one model, of records that differ in their inputs only."""
    one, other = a.model, b.model
    if not (type(a) is type(b) is Potential and _is_scaled(one) and _is_scaled(other)):
        return False
    same = replace(one, channels=(), scaling=None) == replace(other, channels=(), scaling=None)
    same_frame = all(
        np.array_equal(getattr(one.scaling, field), getattr(other.scaling, field))
        for field in _FRAME
    )
    first, second = _records(a), _records(b)
    return (
        same
        and same_frame
        and [(s.name, s.shape) for s in a.sites] == [(s.name, s.shape) for s in b.sites]
        and len(first) == len(second)
        and all(
            np.array_equal(x.time, y.time) and np.array_equal(x.outputs, y.outputs, equal_nan=True)
            for x, y in zip(first, second, strict=True)
        )
    )


def _is_scaled(model: Any) -> TypeGuard[Model]:
    return isinstance(model, Model) and model.scaling is not None


def _records(potential: Potential) -> tuple[Record, ...]:
    return as_measured(cast(Records, potential.args[0]))


def _inputs(potential: Potential, scaling: Scaling) -> list[Tensor]:
    """Inputs (n, n_u) of each record, of which `scaling` makes what its own scaling makes."""
    own = _scaling(potential)
    ratio = as_tensor(scaling.input_scale) / as_tensor(own.input_scale)
    return [
        as_tensor(scaling.input_offset)
        + ratio * (record.tensors().inputs - as_tensor(own.input_offset))
        for record in _records(potential)
    ]


def _scaling(potential: Potential) -> Scaling:
    scaling: Scaling = potential.model.scaling  # type: ignore[attr-defined]
    return scaling
