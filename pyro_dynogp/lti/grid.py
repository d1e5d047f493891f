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

    Times are numbers with a last digit, so that equal steps differ by what was rounded away: steps
    closer than two units in the last place of the times count as one, and its length is their
    mean. Times themselves are left as they are.

    Attributes:
        time: (n,) sampling times [s], float64, never decreasing.
        steps: (m,) the distinct steps d > 0 [s], rising.
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

    def divided(self, parts: int) -> TimeGrid:
        """Each step in equal parts: every `parts`-th time is one of this grid."""
        if parts == 1:
            return self
        shares = torch.arange(parts, dtype=torch.float64, device=self.time.device) / parts
        between = self.time[:-1, None] + shares * self.time.diff()[:, None]
        index = np.concatenate([self.step_index[:1], np.repeat(self.step_index[1:], parts)])
        return TimeGrid(torch.cat([between.flatten(), self.time[-1:]]), self.steps / parts, index)

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
    distinct, index = _distinct(differences, 2.0 * np.spacing(np.abs(values).max()))
    repeated = int(distinct.shape[0] > 0 and distinct[0] == 0.0)
    index = np.concatenate([np.array([-1]), index - repeated]).astype(np.int64)
    return TimeGrid(t, torch.as_tensor(distinct[repeated:], device=t.device), index)


def held(x: Tensor, parts: int) -> Tensor:
    """Values (*b, n, c) of each sample at all parts of the step after it; a single row stays so."""
    return x if parts == 1 else x.repeat_interleave(parts, -2)[..., : 1 - parts, :]


def _distinct(differences: np.ndarray, rounding: float) -> tuple[np.ndarray, np.ndarray]:
    """Distinct steps (m,), rising, and which of them each difference (n - 1,) is.

    Differences belong together that lie within `rounding` above the smallest of them; zero stays by
    itself.
    """
    exact, inverse, count = np.unique(differences, return_inverse=True, return_counts=True)
    first = np.arange(len(exact))  # of those that count as the same
    near = (np.diff(exact) <= rounding) & (exact[:-1] > 0.0)
    for k in np.flatnonzero(near) + 1:
        if exact[k] - exact[first[k - 1]] <= rounding:
            first[k] = first[k - 1]
    new = first == np.arange(len(exact))
    step = np.cumsum(new) - 1
    members = np.bincount(step, weights=count)
    mean = np.bincount(step, weights=count * exact) / members
    alone = members == count[new]
    return np.where(alone, exact[new], mean), step[inverse.reshape(-1)]
