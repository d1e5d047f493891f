"""Draws of all parameters with the densities that importance sampling needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp
from torch import Tensor

Values = Mapping[str, Tensor]


@dataclass(frozen=True, eq=False)
class PosteriorDraws:
    """Draws of every latent site, and how probable they are.

    Attributes:
        values: (S, *shape) of each site.
        log_p: (S,) log p(y, values) [nats], None where it is not known.
        log_q: (S,) log-density under what they were drawn from; None for draws of the posterior
            itself (MCMC).
        group: (S,) optimum that each draw belongs to.
        kind: where they come from, in words.
        ancestor: (S,) number of the independent draw that each descends from, of draws that were
            resampled on their way; None where all are independent.
    """

    values: Values
    log_p: np.ndarray | None
    log_q: np.ndarray | None
    group: np.ndarray
    kind: str
    ancestor: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.group)

    @property
    def log_ratio(self) -> np.ndarray:
        """Log importance ratios (S,) of the posterior over what the draws come from.

        Up to a constant for each optimum: how much each optimum weighs is for the fit to say, and
        its ratios say how well its draws describe the posterior around it.
        """
        if self.log_q is None or self.log_p is None:
            return np.zeros(len(self))
        ratio = self.log_p - self.log_q
        out = np.empty_like(ratio)
        for one in np.unique(self.group):
            own = self.group == one
            out[own] = ratio[own] - (logsumexp(ratio[own]) - np.log(own.sum()))
        return out
