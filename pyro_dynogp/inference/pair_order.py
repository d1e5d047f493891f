"""One order of the pairs of a linear layer: where exchanging them would only repeat a posterior.

A posterior of P pairs is P! times the same, once for each order of them. Samplers that know this
look at one copy alone: vectors whose pairs lie nearer to those of a centre in their own order than
in any other. Every vector has one order that is such, so that nothing is lost (Stephens, J. R.
Stat. Soc. B 62:795, 2000).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.log_joint import Direct

Values = Mapping[str, Tensor]


@dataclass(frozen=True, eq=False)
class PairOrder:
    """The order of pairs around a centre.

    Attributes:
        poles: (2, P) places of the pairs' log decay rates and frequencies in a vector.
        axes: of each site the dimension of the pairs. centre: (P, 2), there.
    """

    poles: np.ndarray
    axes: Mapping[str, int]
    centre: np.ndarray

    @classmethod
    def around(cls, potential: Potential, centre: np.ndarray) -> PairOrder | None:
        """Around a vector (d,); None where a model is not of pairs that can be exchanged."""
        density = potential.log_density
        if potential.linear is None or not isinstance(density, Direct):
            return None
        ((wire, _),) = density.model.dynamic
        names = (f"{wire.name}_log_{x}" for x in ("decay", "frequency"))
        poles = np.stack([potential.places([name]) for name in names])
        pair = wire.dims["pair"]
        axes = {site.name: site.dims.index(pair) for site in density.sites if pair in site.dims}
        return cls(poles, axes, centre[poles].T)

    @property
    def log_orders(self) -> float:
        """Logarithm of P!, how many orders there are."""
        return math.lgamma(len(self.centre) + 1)

    def _distances(self, z: np.ndarray) -> np.ndarray:
        """Squared distances (S, P, P) of the pairs of vectors z (S, d) from those of the centre."""
        off = z[:, self.poles.T][:, :, None] - self.centre
        return np.asarray((off * off).sum(-1))

    def holds(self, z: np.ndarray) -> np.ndarray:
        """Whether the pairs of vectors z (S, d) are in this order, (S,)."""
        distances = np.nan_to_num(self._distances(z), nan=np.inf)
        own = np.arange(len(self.centre))
        inside: np.ndarray = (distances.argmin(2) == own).all(1)  # each is at its own anyway
        for index in np.flatnonzero(~inside & np.isfinite(distances).all((1, 2))):
            inside[index] = (linear_sum_assignment(distances[index])[1] == own).all()
        return inside

    def put(self, potential: Potential, values: Values) -> dict[str, Tensor]:
        """Values of all sites with their pairs in this order."""
        distances = self._distances(potential.pack(values).numpy()[None])[0]
        order = np.argsort(linear_sum_assignment(distances)[1])
        return {
            name: value.index_select(self.axes[name], value.new_tensor(order).long())
            if name in self.axes
            else value
            for name, value in values.items()
        }
