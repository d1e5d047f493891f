"""Climbs in which output gains of several outputs keep their length, which nothing depends on.

Their directions alone matter, and their prior is normal, so that its density is highest where they
have no length, and no direction. A climb that went there would turn them with every step. In polar
coordinates a length has the density of a chi distribution: with the logarithm of the Jacobian added
a climb stays where gains usually are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from pyro_dynogp.inference.density import Site, parts
from pyro_dynogp.inference.optimise.lockstep import Functions
from pyro_dynogp.models.gauge import usual_length


class Lengths:
    """Jacobians of the lengths in a vector of all sites.

    Args:
        sites: of a model.
    """

    def __init__(self, sites: Sequence[Site]) -> None:
        self._places: list[tuple[np.ndarray, float]] = []
        size = sum(site.unconstrained.numel() for site in sites)
        for site, entries in parts(sites, torch.arange(size)):
            if site.name.endswith("_output_gain"):
                signals, pairs, _ = site.shape
                places: np.ndarray = entries.transpose(0, 1).reshape(pairs, -1).numpy()
                self._places.append((places, usual_length(signals)))

    def energies(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is added to energies at z (k, d), (k,), none at usual lengths; gradients (k, d)."""
        total, gradients = np.zeros(len(z)), np.zeros_like(z)
        for places, usual in self._places:
            raw = z[:, places]  # k, P, 2 n_y
            square = np.maximum((raw * raw).sum(-1), 1e-300)
            total -= usual**2 * 0.5 * (np.log(square) - 2.0 * np.log(usual)).sum(-1)
            gradients[:, places] = -(usual**2) * raw / square[..., None]
        return total, gradients

    def added(self, functions: Functions) -> Functions:
        """Energies and gradients with those of the lengths."""
        if not self._places:
            return functions

        def both(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            (values, gradients), (more, further) = functions(z), self.energies(z)
            return values + more, gradients + further

        return both
