r"""Log-density of each measured output given other outputs, all trajectories integrated out.

Given the parameters a trajectory is never sampled, and never conditioned on by the sample that it
is to predict: such conditional densities say how well a smoother fits, not how well it predicts.

- "missing sample": p(y_i | all outputs but y_i).
- "forecast": p(y_i | outputs at least `horizon` samples before). At horizon 1 outputs of one time
  follow one another, so that the densities add up to that of the whole record.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.distributions import pointwise
from pyro_dynogp.distributions.pointwise import Moments
from pyro_dynogp.distributions.process import ObservedLTIProcess
from pyro_dynogp.models.output_process import OutputProcess
from pyro_dynogp.support.errors import invalid, verify

Kind = Literal["missing sample", "forecast"]


def pointwise_log_density(
    observed: ObservedLTIProcess | OutputProcess, outputs: Tensor, kind: Kind, *, horizon: int = 1
) -> np.ndarray:
    """Log-density (S, n, n_y) of each output for each element of a batch (S,) of parameters.

    Args:
        observed: a distribution of outputs whose trajectories are integrated out, batch shape (S,)
            or ().
        outputs: y (*event) [output], NaN where missing.
        kind: what is given. horizon: of "forecast" [samples], at least 1.

    Returns:
        In nats, of outputs in their own units; NaN where the output is missing. S = 1 without a
        batch.

    Raises:
        ValueError: on another distribution, whose trajectories are not integrated out.
    """
    if kind not in ("missing sample", "forecast"):
        raise invalid("kind", expected="'missing sample' or 'forecast'", got=repr(kind))
    verify(horizon=horizon)
    with torch.no_grad():
        if isinstance(observed, OutputProcess):
            density = _of_outputs(observed, outputs, kind, horizon).log_density
            return density.reshape(-1, *density.shape[-2:]).numpy()
        if isinstance(observed, ObservedLTIProcess):
            density = _of_process(observed, outputs, kind, horizon).log_density
            n, n_y = len(observed.process.grid), observed.modes.outputs
            return density.reshape(-1, n, n_y).numpy()
    raise invalid(
        "observed",
        expected="an observed site whose trajectories are integrated out (LTIProcess.observed, "
        "or a model of this package)",
        got=type(observed).__name__,
        advice="Densities given a trajectory that was drawn given the sample itself are off by "
        "tens of nats. Integrate the trajectory, or give `pointwise` densities of your own.",
    )


def _of_outputs(observed: OutputProcess, y: Tensor, kind: Kind, horizon: int) -> Moments:
    if kind == "missing sample":
        return observed.left_out(y)
    return observed.one_step(y) if horizon == 1 else observed.ahead(y, horizon)


def _of_process(observed: ObservedLTIProcess, y: Tensor, kind: Kind, horizon: int) -> Moments:
    if kind == "missing sample":
        return pointwise.left_out(observed, y)
    if horizon == 1:
        return pointwise.one_step(observed, y)
    return pointwise.ahead(observed, y, horizon)
