"""What is linear in the inputs."""

from __future__ import annotations

import numpy as np

from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.regression import with_past
from pyro_dynogp.statistics.responses import standardised
from pyro_dynogp.statistics.shares_of_inputs import Paths, own


def linear_responses(residuals: Residuals, path: Paths) -> np.ndarray:
    """What is linear in the inputs, with the model's own dynamics and with others."""
    return np.column_stack([own(residuals), with_past(standardised(path.shares))])
