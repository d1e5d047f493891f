"""Square roots of covariances."""

from __future__ import annotations

import torch
from torch import Tensor

from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError


def root_of(covariance: Tensor) -> Tensor:
    """Square root (*b, N, N) of a covariance, singular or not.

    Raises:
        NotPositiveDefiniteError: where one is not finite: before it a filter has run away.
    """
    if not bool(torch.isfinite(covariance).all()):
        raise NotPositiveDefiniteError(
            "The state that the samples before leave is not finite: functions in feedback make "
            "predictions run away there. Take a function that is bounded, or fit again with "
            "another seed or fewer pairs."
        )
    values, vectors = torch.linalg.eigh(covariance)
    return vectors * values.clamp_min(0.0).sqrt().unsqueeze(-2)
