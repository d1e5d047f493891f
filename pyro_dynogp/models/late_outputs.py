"""Outputs along a record whose first inputs acted before it, and so are unknown."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.distributions.pointwise import Moments
from pyro_dynogp.models.draws import JointState
from pyro_dynogp.models.output_process import LayerMoments, OutputProcess
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.system import System

Found = TypeVar("Found")


class LateOutputs(OutputProcess):
    """Measured outputs of a system with dead times; see `OutputProcess`.

    The state is unknown where the first input arrives, as it is at the beginning of other records:
    the density is that of what follows. Before that no output is measured, and what is said of it
    is what follows from the first value of the input, held.

    Args:
        system: as of `OutputProcess`. record: with `arrived` above zero.
        engine: what computes outputs along both parts.
    """

    def __init__(self, system: System, record: PreparedRecord, engine: type[OutputProcess]) -> None:
        super().__init__(system, record)
        self.first = record.arrived
        self.before = engine(system, record.head(self.first))
        self.known = engine(system, record.begun)

    def _split(self, y: Tensor) -> tuple[Tensor, Tensor]:
        dim = -2 if self.several else -1
        return y.narrow(dim, 0, self.first), y.narrow(dim, self.first, y.shape[dim] - self.first)

    def _each(self, of: Callable[[OutputProcess, Tensor], Found], y: Tensor) -> list[Found]:
        """What both parts say, each of its own outputs."""
        parts = zip((self.before, self.known), self._split(y), strict=True)
        return [of(part, own) for part, own in parts]

    def _moments(self, of: Callable[[OutputProcess, Tensor], Moments], y: Tensor) -> Moments:
        """What both parts say, one after the other."""
        found = self._each(of, y)
        return Moments(
            torch.cat([one.mean for one in found], -2),
            torch.cat([one.variance for one in found], -2),
            torch.cat([one.log_density for one in found], -2),
        )

    def log_prob(self, value: Tensor) -> Tensor:
        """See `OutputProcess`."""
        return self.known.log_prob(self._split(value)[1]).expand(self.batch_shape)

    def innovations(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `OutputProcess`."""
        both = zip(*self._each(lambda part, own: part.innovations(own), y), strict=True)
        error, variance, rest = (torch.cat(x, -2 if self.several else -1) for x in both)
        return error, variance, rest

    def one_step(self, y: Tensor) -> Moments:
        """See `OutputProcess`."""
        return self._moments(lambda part, own: part.one_step(own), y)

    def ahead(self, y: Tensor, horizon: int) -> Moments:
        """See `OutputProcess`."""
        return self._moments(lambda part, own: part.ahead(own, horizon), y)

    def left_out(self, y: Tensor) -> Moments:
        """See `OutputProcess`."""
        return self._moments(lambda part, own: part.left_out(own), y)

    def prediction_errors(self, y: Tensor, horizon: int, count: int) -> Tensor | None:
        """See `OutputProcess`."""
        found = self._each(lambda part, own: part.prediction_errors(own, horizon, count), y)
        drawn = [errors for errors in found if errors is not None]
        return torch.cat(drawn, -2) if len(drawn) == len(found) else None

    def smooth(self, y: Tensor | None) -> dict[str, LayerMoments]:
        """See `OutputProcess`."""
        if y is None:
            before, after = self.before.smooth(None), self.known.smooth(None)
        else:
            before, after = self._each(lambda part, own: part.smooth(own), y)
        return {
            name: LayerMoments(
                np.concatenate([before[name].mean, late.mean], -2),
                np.concatenate([before[name].sd, late.sd], -2),
            )
            for name, late in after.items()
        }

    def state_after(
        self, y: Tensor, gap: float, next_inputs: Tensor, *, process_noise: bool = True
    ) -> JointState:
        """See `OutputProcess`."""
        _, late = self._split(y)
        return self.known.state_after(late, gap, next_inputs, process_noise=process_noise)
