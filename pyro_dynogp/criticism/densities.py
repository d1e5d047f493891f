r"""Log-density of each measured output given other outputs, all trajectories integrated out.

Given the parameters a trajectory is never sampled, and never conditioned on by the sample that it
is to predict: such conditional densities say how well a smoother fits, not how well it predicts.

- "missing sample": p(y_i | all outputs but y_i). Exact in O(n) for a Gaussian process with
  covariance C of the samples, whose leave-one-out moments are mean y_i - [C^{-1} r]_i/[C^{-1}]_ii
  and variance 1/[C^{-1}]_ii (Sundararajan & Keerthi 2001); by the moment-matching smoother for
  other cascades.
- "forecast": p(y_i | outputs at least `horizon` samples before). At horizon 1 outputs of one time
  follow one another, so that the densities add up to that of the whole record.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.distributions.process import ObservedLTIProcess
from pyro_dynogp.distributions.trajectory import apply, split_missing
from pyro_dynogp.lti.filtering import predict_k_steps
from pyro_dynogp.models.assembly import assemble
from pyro_dynogp.models.outputs import ObservedCascade
from pyro_dynogp.moments import filtering, smoothing
from pyro_dynogp.moments.problem import each
from pyro_dynogp.support.errors import invalid

Kind = Literal["missing sample", "forecast"]


def pointwise_log_density(
    observed: Any, outputs: Tensor, kind: Kind, *, horizon: int = 1
) -> np.ndarray:
    """Log-density (S, n, n_y) of each output for each element of a batch (S,) of parameters.

    Args:
        observed: an `ObservedLTIProcess` or an `ObservedCascade`, batch shape (S,) or ().
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
    if not isinstance(horizon, int) or horizon < 1:
        raise invalid("horizon", expected="a whole number >= 1", got=repr(horizon))
    with torch.no_grad():
        if isinstance(observed, ObservedLTIProcess):
            return _linear(observed, outputs, kind, horizon)
        if isinstance(observed, ObservedCascade):
            return _cascade(observed, outputs, kind, horizon)
    raise invalid(
        "observed",
        expected="an observed site whose trajectories are integrated out (LTIProcess.observed, "
        "or ObservedCascade)",
        got=type(observed).__name__,
        advice="Densities given a sampled trajectory, which has seen the sample itself, are off by "
        "tens of nats. Integrate the trajectory, or give `pointwise` densities of your own.",
    )


def _linear(observed: ObservedLTIProcess, y: Tensor, kind: Kind, horizon: int) -> np.ndarray:
    residual, missing = split_missing(observed.rows(y - observed.mean))
    v = observed.noise_rows
    v = v if missing is None else v.masked_fill(missing, torch.inf)
    K = observed.covariance(v)
    if kind == "missing sample":
        precision = K.inverse_diagonal()
        variance = 1.0 / precision
        departure = apply(K.solve, K, residual) * variance
    elif horizon == 1:
        variance = K.innovation_variance
        departure = apply(K.innovations, K, residual)
    else:
        moments = predict_k_steps(K, residual, horizon)
        variance = moments.variance + observed.noise_rows
        departure = residual - moments.mean
    log_density = -0.5 * (math.log(2.0 * math.pi) + variance.log() + departure.square() / variance)
    if missing is not None:
        log_density = log_density.masked_fill(missing, torch.nan)
    n = len(observed.process.grid)
    return log_density.reshape(-1, n, observed.modes.outputs).numpy()


def _cascade(observed: ObservedCascade, y: Tensor, kind: Kind, horizon: int) -> np.ndarray:
    scaled = y if y.dim() > 1 else y.unsqueeze(-1)
    scaled = (scaled - observed.shift) / observed.scale
    problem = assemble(observed.system, observed.grid, observed.inputs).with_outputs(scaled)
    layout = problem.layout
    elements, _ = problem.elements()

    def density(b: int) -> np.ndarray:
        values = elements[b]
        if kind == "missing sample":
            _, means, covariances, _, _ = filtering.run(layout, values)
            found = smoothing.leave_one_out(layout, values, means, covariances)
        elif horizon == 1:
            found = smoothing.innovate(layout, values)
        else:
            found = smoothing.predict_ahead(layout, values, horizon)
        return np.asarray(found[2])

    log_density = np.stack(each(density, len(elements)))
    return log_density - np.log(observed.scale.numpy())
