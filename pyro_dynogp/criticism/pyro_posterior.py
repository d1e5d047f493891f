"""Draws of the posterior of any Pyro model, and densities of what was measured at each of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_args

import numpy as np
import torch
import xarray as xr
from torch import Tensor

from pyro_dynogp.criticism import arviz_bridge
from pyro_dynogp.criticism.densities import Kind
from pyro_dynogp.criticism.inference_data import NOT_FOR_LOO, pareto_attrs
from pyro_dynogp.criticism.labelled import Coordinate, Variable, dataset_of
from pyro_dynogp.criticism.site_densities import (
    elementwise_density,
    integrated_density,
    is_integrated,
    measured,
)
from pyro_dynogp.criticism.site_dimensions import dimensions_for
from pyro_dynogp.criticism.subjects import Subject, fingerprint_of, no_refit
from pyro_dynogp.inference.posterior_draws import PosteriorDraws
from pyro_dynogp.support.errors import invalid, verify
from pyro_dynogp.support.parallel import seeded
from pyro_dynogp.support.shown import shown
from pyro_dynogp.support.version import __version__


@shown
@dataclass(repr=False, frozen=True, eq=False)
class PyroPosterior:
    """A Pyro model with draws of its posterior; make one by `from_pyro`.

    A `Subject` of `pyro_dynogp.loo`, for targets and draws that need no refit.

    Attributes:
        draws: values (S, *shape) of every latent site, log_p, log_q.
        observed: value of each observed site; NaN where a trajectory's sample is missing.
        sites: S distributions of each observed site, one at each draw.
        derived: (S, *shape) of what `pyro.deterministic` names.
        trajectories: names of latent sites whose value is a whole trajectory.
        chains: how many chains the draws make up, one after the other.
        coords, dims, units: labels of dimensions, names of a site's dimensions, unit of a site.
        seed: for replicates.
    """

    draws: PosteriorDraws
    observed: Mapping[str, Tensor]
    sites: Mapping[str, Sequence[Any]]
    derived: Mapping[str, Tensor]
    trajectories: tuple[str, ...]
    chains: int
    coords: Mapping[str, Any]
    dims: Mapping[str, Sequence[str]]
    units: Mapping[str, str]
    seed: int

    def pointwise(self, kind: Kind, horizon: int = 1) -> np.ndarray:
        """Log-densities (S, N) [nats] of all N measured samples, one site after the other.

        Missing and masked samples are left out, in the order of `places`.

        Where a trajectory is integrated out by the site's own distribution (`LTIProcess.observed`,
        `OutputProcess`): as `criticism.densities` has them. Where a site factorises, and no
        latent site is a trajectory: the density given the draw, of either kind, since samples are
        then independent given the draw. A latent time series of another make than this package's
        is not recognised as one: its densities would be given what the sample itself has told it.

        Args:
            kind: "missing sample" or "forecast". horizon: of "forecast" [samples].

        Raises:
            ValueError: where a latent site is a trajectory, which has seen the sample that it would
                predict; on another kind, or a horizon below 1.
        """
        if kind not in get_args(Kind):
            raise invalid("kind", expected=f"one of {list(get_args(Kind))}", got=repr(kind))
        verify(horizon=horizon)
        parts = []
        for name, value in self.observed.items():
            if self.trajectories and is_integrated(self.sites[name][0]):
                raise invalid(
                    "model",
                    expected="a model whose trajectories are all integrated out",
                    got=f"latent trajectories {list(self.trajectories)}",
                    advice="They were fitted to the sample that they would have to predict.",
                )
            found = [
                integrated_density(distribution, value, kind, horizon)
                if self.trajectories or is_integrated(distribution)  # which refuses what factorises
                else elementwise_density(distribution, value).numpy()
                for distribution in self.sites[name]
            ]
            there = measured(self.sites[name][0], value).reshape(-1).numpy()
            parts.append(np.stack(found).reshape(len(found), -1)[:, there])
        densities = np.concatenate(parts, axis=1)
        if np.isnan(densities).any():
            draw = int(np.flatnonzero(np.isnan(densities).any(1))[0])
            raise invalid(
                "posterior",
                expected="draws at which every density is a number",
                got=f"NaN at draw {draw}",
            )
        return densities

    @cached_property
    def places(self) -> Mapping[str, np.ndarray]:
        """Where each measured sample stands: "record", "sample", "output" (N,), all integer.

        Every observed site is a record, or several, see `measured`.
        """
        rows, records = [], 0
        for name, value in self.observed.items():
            there = measured(self.sites[name][0], value).numpy()
            rows.append(np.argwhere(there) + np.array([records, 0, 0]))
            records += len(there)
        record, sample, output = np.concatenate(rows).T
        return {"record": record, "sample": sample, "output": output}

    @property
    def data(self) -> str:
        """Fingerprint of the observed values, gaps included."""
        return fingerprint_of([value.numpy() for value in self.observed.values()])

    def fresh(self, record: int, first: int, last: int) -> np.ndarray:
        """Refused: how the model would begin elsewhere is for its author to say."""
        raise no_refit()

    def without(self, left_out: np.ndarray) -> Subject:
        """Refused: how the posterior was found is for its author to say."""
        raise no_refit()

    def to_arviz(self) -> Any:
        """ArviZ's InferenceData.

        Groups: posterior (latent sites and deterministic quantities), posterior_predictive
        (replicates of the observed sites at each draw, latent trajectories included),
        log_likelihood, sample_stats (``lp`` = log p(y, values), and of a guide ``log_q``, with the
        Pareto shape of their ratios in attrs) and observed_data. Elementwise log-likelihoods, or
        one-step-ahead densities where a trajectory is integrated out: attrs of the variable say
        which.
        """
        kept = {**self.draws.values, **self.derived}
        posterior = {k: self._variable(k, v.numpy(), v.shape[1:]) for k, v in kept.items()}
        with seeded(self.seed), torch.no_grad():
            replicated = {
                name: torch.stack([distribution.sample() for distribution in each]).numpy()
                for name, each in self.sites.items()
            }
        predictive = {k: self._variable(k, v, v.shape[1:]) for k, v in replicated.items()}
        observed = {k: self._variable(k, v.numpy(), v.shape) for k, v in self.observed.items()}
        groups = {
            "posterior": self._dataset(posterior, self.chains),
            "posterior_predictive": self._dataset(predictive, self.chains),
            "log_likelihood": self._dataset(self._log_likelihood(), self.chains),
            "sample_stats": self._sample_stats(),
            "observed_data": self._dataset(observed, None),
        }
        attrs = {
            "inference_library": "pyro_dynogp",
            "inference_library_version": __version__,
            "draws": self.draws.kind,
            "seed": self.seed,
        }
        return arviz_bridge.inference_data(groups, attrs)

    def _variable(self, name: str, values: np.ndarray, shape: Sequence[int]) -> Variable:
        known = {k: tuple(v) for k, v in self.dims.items()}
        attrs = {"units": self.units[name]} if name in self.units else {}
        return Variable(values, dimensions_for(name, shape, known), attrs)

    def _dataset(self, variables: Mapping[str, Variable], chains: int | None) -> xr.Dataset:
        labels: dict[str, Coordinate] = {
            dim: (dim, np.asarray(values), {}) for dim, values in self.coords.items()
        }
        return dataset_of(variables, labels, {}, chains=chains)

    def _log_likelihood(self) -> dict[str, Variable]:
        out = {}
        given = (
            f" Given latent trajectories {list(self.trajectories)}, which were fitted to the data."
        )
        for name, value in self.observed.items():
            integrated = is_integrated(self.sites[name][0])
            each = [
                integrated_density(distribution, value, "forecast").reshape(value.shape)
                if integrated
                else elementwise_density(distribution, value).numpy()
                for distribution in self.sites[name]
            ]
            values = np.stack(each)
            dims = self._variable(name, value.numpy(), value.shape).dims[: values.ndim - 1]
            kind = NOT_FOR_LOO if integrated else "Log-density of each element given the draw."
            kind += given if self.trajectories else ""
            out[name] = Variable(values, dims, {"units": "nat", "kind": kind})
        return out

    def _sample_stats(self) -> xr.Dataset:
        assert self.draws.log_p is not None
        found = {"lp": Variable(self.draws.log_p, (), {"units": "nat"})}
        attrs: dict[str, Any] = {}
        if self.draws.log_q is not None:
            found["log_q"] = Variable(self.draws.log_q, (), {"units": "nat"})
            attrs = pareto_attrs(self.draws)
        return dataset_of(found, {}, attrs, chains=self.chains)
