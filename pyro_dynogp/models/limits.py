"""A sensor that stops: limits of a last layer's linear mean, and outputs that are exactly there."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.models.output_process import OutputProcess
from pyro_dynogp.models.wiring import Layer, Limits, Static
from pyro_dynogp.support.errors import invalid


def scaled_limits(limits: Limits, scaling: Scaling | None) -> tuple[float, float]:
    """Limits of the (single) output in scaled units, infinite where there is none.

    Raises:
        ValueError: where there is no scaling yet.
    """
    if scaling is None:
        raise invalid(
            "scaling", expected="that of the training record, for a layer with limits",
            got="None", advice="Use model.scaled_to(record).",
        )  # fmt: skip
    low, high = (
        sign * math.inf if limit is None
        else (limit - float(scaling.output_offset[0])) / float(scaling.output_scale[0])
        for limit, sign in zip(limits, (-1.0, 1.0), strict=True)
    )  # fmt: skip
    return low, high


def at_limits(layers: Sequence[Layer], record: Record) -> np.ndarray:
    """Where the output (n,) of a record is exactly at a limit of the last layer."""
    last = layers[-1]
    if not isinstance(last, Static) or last.limits is None or not record.n_outputs:
        return np.zeros(len(record), dtype=bool)
    known = [limit for limit in last.limits if limit is not None]
    there: np.ndarray = np.isin(record.outputs[:, 0], known)
    return there


def log_probability_scale(at: np.ndarray, outputs: OutputProcess) -> Tensor:
    """What makes probabilities () or (k,) of the densities of outputs that are exactly at a limit.

    Their density, which has no upper bound where the noise vanishes, times sqrt(2 pi) times the
    noise's scale is at most one, as the probability of being beyond the limit is.

    Args:
        at: (n,) where they are. outputs: of the record.
    """
    sd = outputs.noise_sd[..., 0]
    sd = sd.expand((*sd.shape[:-1], len(at)))[..., torch.as_tensor(at)]
    return (sd.log() + 0.5 * math.log(2.0 * math.pi)).sum(-1)
