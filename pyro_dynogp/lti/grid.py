"""The time axis of a recursion: distinct steps, and for every sample which of them leads to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import Numbers, as_tensor


@dataclass(frozen=True)
class TimeGrid:
    """Sampling times, prepared once for all recursions along them.

    Nothing is rounded: two steps count as one only where they are equal to the last bit.

    Attributes:
        time: (n,) sampling times [s], float64, never decreasing.
        steps: (m,) the distinct steps d > 0 [s].
        step_index: (n,) int64; `steps[step_index[k]]` leads from sample k - 1 to sample k;
            -1 for the first sample and where a time is repeated.
    """

    time: Tensor
    steps: Tensor
    step_index: np.ndarray

    def __len__(self) -> int:
        return int(self.time.shape[0])

    def to(self, device: torch.device) -> TimeGrid:
        """The same grid with its tensors on a device."""
        if self.time.device == device:
            return self
        return TimeGrid(self.time.to(device), self.steps.to(device), self.step_index)

    def rows(self, outputs: int) -> tuple[np.ndarray, np.ndarray]:
        """Step index and output index of the n * n_y rows, the outputs of one time together."""
        step = np.full((len(self), outputs), -1, dtype=np.int64)
        step[:, 0] = self.step_index
        out = np.tile(np.arange(outputs, dtype=np.int64), len(self))
        return step.reshape(-1), out


def time_grid(time: Numbers | TimeGrid) -> TimeGrid:
    """Prepare sampling times.

    Args:
        time: (n,) times [s], array, tensor or a `TimeGrid` (returned as it is).

    Raises:
        ValueError: where time is empty, not one-dimensional, not finite, or decreases.
    """
    if isinstance(time, TimeGrid):
        return time
    t = as_tensor(time).detach()
    if t.dim() != 1 or t.shape[0] == 0:
        raise invalid("time", expected="a vector (n,) with n >= 1", got=f"shape {tuple(t.shape)}")
    values = t.cpu().numpy()
    if not np.isfinite(values).all():
        bad = int(np.flatnonzero(~np.isfinite(values))[0])
        raise invalid("time", expected="finite times", got=f"{values[bad]} at index {bad}")
    differences = np.diff(values)
    if (differences < 0).any():
        bad = int(np.flatnonzero(differences < 0)[0])
        raise invalid(
            "time",
            expected="times that do not decrease",
            got=f"{values[bad + 1]} after {values[bad]} at index {bad + 1}",
            advice="Sort the samples by time.",
        )
    distinct, inverse = np.unique(differences, return_inverse=True)
    repeated = int(distinct.shape[0] > 0 and distinct[0] == 0.0)
    index = np.concatenate([np.array([-1]), inverse.reshape(-1) - repeated]).astype(np.int64)
    return TimeGrid(t, torch.as_tensor(distinct[repeated:], device=t.device), index)
