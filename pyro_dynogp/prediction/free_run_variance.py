"""What parameters that stay at their optimum add to the variance of free runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from pyro_dynogp.inference.held_parameters import slopes_of
from pyro_dynogp.models.draws import JointState
from pyro_dynogp.models.output_process import Components
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.support.errors import warn

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted

# Standard deviation of noise, in those of the output, beside which outputs say nothing.
LOUD = 1e6
NOT_FINITE = (
    "Next to the optimum predictions are not finite. Bands leave out what the training record does "
    "not say of poles, gains and other parameters. Take a longer record, or fewer pairs."
)


def with_held_parameters(
    fit: Fitted,
    found: Components,
    record: PreparedRecord,
    begin: Callable[[Fitted], JointState],
    seed: int,
) -> Components:
    """Components with the variance that parameters add to first order which are held.

    As they are where no parameters are held, see `inference.held_parameters`. Means do not change;
    joint samples are displaced along the derivatives.

    Args:
        fit: the fit. found: of its draws. record: along which. seed: of the samples.
        begin: gives the state at the first sample for other values of the parameters.
    """
    if not fit.held:
        return found
    slopes = None
    if fit.moved is not None:
        slopes = slopes_of(mean_runs(fit.moved, record, begin(fit.moved)))
    if slopes is None or not np.isfinite(slopes).all():
        warn(NOT_FINITE)
        return found
    extra = np.square(slopes).sum(0)

    def parts() -> Mapping[str, np.ndarray]:
        shares = dict(found.parts())
        return shares | {"parameters": shares.get("parameters", 0.0) + extra}

    def draw() -> np.ndarray:
        y = found.draw()
        standard = np.random.default_rng(seed).standard_normal((len(y), len(slopes)))
        return y + np.einsum("sp,pnk->snk", standard, slopes)

    return replace(found, variance=found.variance + extra, parts=parts, draw=draw)


def mean_runs(fit: Fitted, record: PreparedRecord, start: JointState) -> np.ndarray:
    """Runs (K, n, n_y) along the inputs without noise, from the mean of a state, for each draw."""
    with torch.no_grad():
        known = JointState(start.mean, torch.zeros_like(start.covariance))
        outputs = output_process(fit.system.without_process_noise, record, start=known)
        outputs.noise_sd = torch.full_like(outputs.noise_sd, LOUD)
        mean = outputs.one_step(torch.zeros(outputs.event_shape, dtype=torch.float64)).mean
    return mean.reshape(-1, len(record.grid), fit.model.outputs).numpy()
