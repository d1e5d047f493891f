"""A cascade with its trajectories integrated out: the moment-matching filter as distribution."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyro
import torch
from pyro.distributions import TorchDistribution, constraints
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.distributions.trajectory import real_or_missing
from pyro_dynogp.lti.grid import time_grid
from pyro_dynogp.models import known
from pyro_dynogp.models.assembly import assemble
from pyro_dynogp.models.system import CascadeSystem, scaled_inputs
from pyro_dynogp.moments import smoothing
from pyro_dynogp.moments.problem import each, log_density
from pyro_dynogp.support.tensors import as_tensor, broadcast


class ObservedCascade(TorchDistribution):
    """Measured outputs of a cascade, all trajectories integrated out by moment matching.

    The log-density is that of a Gaussian assumed-density filter over the joint state of all dynamic
    layers: exact where the static layers are linear and the noise is Gaussian, else as good as
    Gaussian moments are: joint ones of a static layer's input and output inside the cascade; where
    the last layer is a function of one signal, those of the state given each sample. Where only the
    last layer's trajectory is unknown no filter is needed: see `pyro_dynogp.models.known`. Event
    shape (n,), or (n, n_y). NaN marks a missing sample.

    Args:
        system: layers given their parameters. time: (n,) or a `TimeGrid`. inputs: (*b, n, n_u)
            scaled.
        scale, shift: (n_y,) of the outputs: y = shift + scale * (scaled y).
    """

    arg_constraints: dict[str, constraints.Constraint] = {}  # noqa: RUF012
    has_rsample = False

    def __init__(
        self,
        system: CascadeSystem,
        time: Any,
        inputs: Tensor,
        scale: Tensor,
        shift: Tensor,
        *,
        validate_args: bool | None = None,
    ) -> None:
        self.system, self.grid, self.inputs = system, time_grid(time), inputs
        self.scale, self.shift = scale, shift
        n_y = scale.shape[-1]
        self._several = n_y > 1
        event = (len(self.grid), n_y) if self._several else (len(self.grid),)
        super().__init__(system.batch_shape, torch.Size(event), validate_args=validate_args)

    @property
    def support(self) -> constraints.Constraint:
        """Real trajectories in which NaN marks a missing sample."""
        return constraints.independent(real_or_missing, len(self.event_shape))

    def expand(self, batch_shape: Any, _instance: Any = None) -> ObservedCascade:
        """Broadcast to a larger batch shape."""
        new = self._get_checked_instance(ObservedCascade, _instance)
        new.__dict__.update(self.__dict__)
        new._batch_shape = torch.Size(batch_shape)
        return new

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (*s, *batch) of outputs (*s, *batch, *event) in the record's units [nats]."""
        y = value if self._several else value.unsqueeze(-1)
        scaled = (y - self.shift) / self.scale
        if known.has_exact_density(self.system):
            found = known.log_density(self.system, self.grid, self.inputs, scaled)
        else:
            found = log_density(assemble(self.system, self.grid, self.inputs).with_outputs(scaled))
        there = (~torch.isnan(y)).to(torch.float64)
        jacobian = (there * self.scale.log()).sum((-2, -1))
        batch = broadcast(y.shape[:-2], self.batch_shape)
        return (found - jacobian).expand(batch)

    def innovations(self, value: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """One-step prediction errors and their variances (*batch, K) of scaled outputs.

        K counts the samples that are not missing, outputs of one time together. No gradient.
        """
        y = value if self._several else value.unsqueeze(-1)
        scaled = (y - self.shift) / self.scale
        problem = assemble(self.system, self.grid, self.inputs).with_outputs(scaled)
        elements, batch = problem.elements()
        found = each(lambda b: smoothing.innovate(problem.layout, elements[b]), len(elements))
        there = ~np.isnan(found[0][0])
        r = np.stack([one[0][there] for one in found])
        S = np.stack([one[1][there] for one in found])
        return r.reshape(*batch, -1), S.reshape(*batch, -1)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Draw outputs: every trajectory from its own distribution, layer by layer, then noise."""
        from pyro_dynogp.models.draws import draw_outputs

        shape = torch.Size(sample_shape)
        with torch.no_grad():
            y = draw_outputs(self.system, self.grid, self.inputs, shape + self.batch_shape)
        y = self.shift + self.scale * y
        return y if self._several else y.squeeze(-1)


def collapsed_of(
    system: CascadeSystem, scaling: Scaling, record: Record, inputs: Tensor | None = None
) -> ObservedCascade:
    """The distribution of a record's outputs; `inputs` are scaled, by default the record's."""
    return ObservedCascade(
        system,
        record.time,
        scaled_inputs(scaling, record) if inputs is None else inputs,
        as_tensor(scaling.output_scale),
        as_tensor(scaling.output_offset),
    )


def observe_collapsed(
    system: CascadeSystem, scaling: Scaling, record: Record, suffix: str, inputs: Tensor
) -> None:
    """Observe (or sample) the outputs of one record, of scaled inputs (*b, n, n_u)."""
    y = record.tensors().observations if record.n_outputs else None
    pyro.sample(f"y{suffix}", collapsed_of(system, scaling, record, inputs), obs=y)
