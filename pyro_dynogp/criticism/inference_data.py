"""A fit as ArviZ's InferenceData: draws, prior, predictions, densities and data under one roof."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pyro
import torch
import xarray as xr
from torch import Tensor

from pyro_dynogp.criticism import arviz_bridge
from pyro_dynogp.criticism.labelled import Coordinate, Variable, clock_of, dataset_of, units_of
from pyro_dynogp.criticism.physical import physical_quantities
from pyro_dynogp.criticism.posterior_draws import judged
from pyro_dynogp.criticism.site_dimensions import (
    dimensions_for,
    labels_of,
    site_dimensions,
    suffixes_of,
)
from pyro_dynogp.criticism.subjects import densities_at
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.records import one_record
from pyro_dynogp.inference.pareto import good_k, psis
from pyro_dynogp.inference.posterior_draws import PosteriorDraws
from pyro_dynogp.models.arrival import DELAY
from pyro_dynogp.models.output_process import OutputProcess
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.prediction.first_state import beginning
from pyro_dynogp.prediction.predict import forecast, simulate
from pyro_dynogp.support.parallel import seeded
from pyro_dynogp.support.version import __version__

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted

NOT_FOR_LOO = (
    "One-step-ahead densities p(y_i | outputs before y_i, draw), trajectories integrated out: they "
    "add up to the log-likelihood of the record. They are no likelihood terms that are independent "
    "given the draw: do not give them to az.loo or az.waic; dgp.loo says what it estimates."
)


def to_arviz(
    fit: Fitted,
    *,
    future: Record | None = None,
    samples: int = 200,
    prior_samples: int = 200,
    seed: int = 0,
) -> Any:
    """ArviZ's InferenceData of a fit; see `Fit.to_arviz`."""
    if future is not None:
        one_record(future, "Export one forecast at a time.", "future")
    export = _Export(fit, samples, seed)
    groups: dict[str, xr.Dataset] = {}
    if future is not None:  # first: this is where a record may be refused
        groups |= export.predictions(future)
    groups["posterior"] = export.posterior()
    groups["posterior_predictive"] = export.replicates(
        export.thinned, samples, "outputs from the inputs alone, jointly, at posterior draws"
    )
    groups["log_likelihood"] = export.log_likelihood()
    groups["sample_stats"] = export.sample_stats()
    attrs = export.attrs
    if fit.model.priors == "paper":
        attrs["prior"] = "left out: flat priors, whose draws exceed floating-point range"
    elif prior_samples:
        groups |= export.prior(prior_samples)
    return arviz_bridge.inference_data(groups | export.data(), attrs)


@dataclass(frozen=True, eq=False)
class _Export:
    """A fit with the names and labels of everything in it.

    Attributes:
        fit: the fit. samples: number of replicates and of predictions. seed: for all draws.
    """

    fit: Fitted
    samples: int
    seed: int

    @cached_property
    def dims(self) -> dict[str, tuple[str, ...]]:
        return site_dimensions(self.fit.model, self.fit.scaling, self.fit.records)

    @cached_property
    def labels(self) -> dict[str, Coordinate]:
        return labels_of(self.fit.model, self.fit.scaling, self.fit.records)

    @property
    def count(self) -> int:
        """S."""
        return self.fit.n_draws

    @property
    def chains(self) -> int:
        return int(self.fit.diagnostics["chains"]) if self.fit.method == "nuts" else 1

    @property
    def attrs(self) -> dict[str, Any]:
        fit = self.fit
        return {
            "inference_library": "pyro_dynogp",
            "inference_library_version": __version__,
            "method": fit.method,
            "seed": fit.seed,
            "record_fingerprints": " ".join(fit.training),
            "model": repr(replace(fit.model, scaling=None)),
        }

    @property
    def thinned(self) -> Fitted:
        """At most `samples` draws, spread evenly over all of them."""
        return self.fit.thinned(self.samples)

    def posterior(self) -> xr.Dataset:
        """Every latent site, trajectories too, and what follows from them in physical units."""
        fit = self.fit
        sites = self._sites({**fit.draws, **fit.trajectories})
        derived = physical_quantities(fit.model, fit.scaling, fit.system, self.count)
        return dataset_of(sites | derived, self.labels, {}, chains=self.chains)

    def prior(self, count: int) -> dict[str, xr.Dataset]:
        """Draws of the parameters from the prior, and outputs from the inputs alone at them."""
        values, system = prior_draws(self.fit, count, self.seed)
        fit = self.fit
        derived = physical_quantities(fit.model, fit.scaling, system, count)
        note = "outputs from the inputs alone, jointly, at prior draws"
        return {
            "prior": dataset_of(self._sites(values) | derived, self.labels, {}, chains=1),
            "prior_predictive": self.replicates(fit.with_draws(values), count, note),
        }

    def _sites(self, values: Mapping[str, Tensor]) -> dict[str, Variable]:
        return {
            name: Variable(
                value.numpy(),
                dimensions_for(name, value.shape[1:], self.dims),
                {"units": self.fit.scaling.time_unit if name == DELAY else "scaled"},
            )
            for name, value in values.items()
        }

    def _outputs(self, suffix: str, values: np.ndarray) -> Variable:
        units = units_of(self.fit.scaling.output_units)
        return Variable(values, (f"time{suffix}", "output"), units)

    def replicates(self, fit: Fitted, samples: int, note: str) -> xr.Dataset:
        """Joint samples of the outputs of each training record from its inputs alone."""
        drawn = {}
        for suffix, record in zip(suffixes_of(fit.records), fit.records, strict=True):
            found = simulate(fit, record, samples=samples, seed=self.seed)
            drawn[f"y{suffix}"] = self._outputs(suffix, found.samples)
        return dataset_of(drawn, self.labels, {"kind": note}, chains=1)

    def predictions(self, future: Record) -> dict[str, xr.Dataset]:
        """Forecast of a later record, which has a clock of its own."""
        past = self.fit.records[-1]
        found = forecast(self.thinned, past, future, samples=self.samples, seed=self.seed)
        labels = self.labels | clock_of(future)
        y = {"y": self._outputs("", found.samples)}
        note = {"kind": "forecast after the last training record, from its state and the inputs"}
        out = {"predictions": dataset_of(y, labels, note, chains=1)}
        if future.n_inputs:
            inputs = {"u": _inputs_of(future, "")}
            out["predictions_constant_data"] = dataset_of(inputs, labels, {})
        return out

    def log_likelihood(self) -> xr.Dataset:
        """One-step-ahead density of each output of each training record at each draw [nats]."""
        found = {}
        missing = 0
        for suffix, record in zip(suffixes_of(self.fit.records), self.fit.records, strict=True):
            values = one_step_densities(self.fit, record)
            found[f"y{suffix}"] = Variable(values, (f"time{suffix}", "output"), {"units": "nat"})
            missing += int(record.missing.sum())
        attrs = {
            "kind": NOT_FOR_LOO,
            "missing_outputs": missing,
            "missing": f"NaN at {missing} missing outputs, which have no density",
        }
        return dataset_of(found, self.labels, attrs, chains=self.chains)

    def sample_stats(self) -> xr.Dataset:
        """Densities of the draws, and how well they describe the posterior."""
        draws = exported_draws(self.fit)
        assert draws.log_p is not None
        joint = {"long_name": "log p(y, values), of constrained values", "units": "nat"}
        found = {"lp": Variable(draws.log_p, (), joint)}
        attrs: dict[str, Any] = {
            name.replace(" ", "_"): value for name, value in self.fit.diagnostics.items()
        }
        if draws.log_q is not None:
            own = {"long_name": "log density of the variational posterior", "units": "nat"}
            found["log_q"] = Variable(draws.log_q, (), own)
            attrs |= pareto_attrs(draws)
        return dataset_of(found, {}, attrs, chains=self.chains)

    def data(self) -> dict[str, xr.Dataset]:
        """What was measured, and what was given."""
        records = self.fit.records
        observed, given = {}, {}
        for suffix, record in zip(suffixes_of(records), records, strict=True):
            observed[f"y{suffix}"] = self._outputs(suffix, record.outputs)
            if record.n_inputs:
                given[f"u{suffix}"] = _inputs_of(record, suffix)
        svi = self.fit.method == "svi"
        what = "ELBO" if svi else "log p(y, values) of the best start"
        given["elbo" if svi else "log_joint"] = Variable(
            np.asarray(self.fit.elbo), ("step",), {"units": "nat", "long_name": f"{what} by step"}
        )
        return {
            "observed_data": dataset_of(observed, self.labels, {}),
            "constant_data": dataset_of(given, self.labels, {}),
        }


def pareto_attrs(draws: PosteriorDraws) -> dict[str, Any]:
    """Pareto shape of the importance ratios of the draws, and from where on it is too large."""
    _, k = psis(draws.log_ratio)
    return {
        "pareto_k": float(k),
        "pareto_k_good_below": float(good_k(len(draws))),
    }


def exported_draws(fit: Fitted) -> PosteriorDraws:
    """The draws that a fit holds, with their densities; no density for MAP and NUTS draws."""
    return judged(fit, fit.posterior.rated(fit.draws), fit.method)


def prior_draws(fit: Fitted, count: int, seed: int) -> tuple[dict[str, Tensor], Any]:
    """Draws (S, *shape) of the sites of a fit from the prior of its model, and the system there.

    Args:
        fit: says the model and the scaling. count: S. seed: for the draws.
    """
    model = fit.model.collapsed
    with (
        seeded(seed),
        torch.no_grad(),
        pyro.poutine.block(),
        pyro.poutine.trace() as tracer,
        pyro.plate("draws", count, dim=-1),
    ):
        system = model.sample_system(fit.scaling)
        for suffix in suffixes_of(fit.records):
            model.sample_states(suffix)
    return {name: tracer.trace.nodes[name]["value"] for name in fit.draws}, system


def one_step_densities(fit: Fitted, record: Record) -> np.ndarray:
    """Log-density (S, n, n_y) [nats] of each output given those before it, at each draw."""
    (along,) = fit.model.prepare(record)

    def observed(some: Fitted) -> OutputProcess:
        return output_process(beginning(some, along), along)

    return densities_at(fit, fit.draws, along, observed, "forecast")


def _inputs_of(record: Record, suffix: str) -> Variable:
    return Variable(record.inputs, (f"time{suffix}", "input"), units_of(record.input_units))
