"""The log joint density of data and sites: of the library's own models directly, else by a trace.

Pyro's tracing of a model takes longer than the compiled recursions do for a thousand samples. A
`Model` lists its sites and makes a system of their values, so that its density is the sum of the
priors and of the densities of the outputs, without a trace; any other Pyro function is traced.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import pyro
import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal

from pyro_dynogp.layers.sites import Arguments, Program, Site, Values
from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError
from pyro_dynogp.models.limits import at_limits, log_probability_scale
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.output_process import OutputProcess
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.prepared import PreparedRecord, Records
from pyro_dynogp.support.errors import invalid

# Samples times draws that are evaluated at once.
AT_ONCE = 4_000_000
# Name of a latent site, its prior, its value without gradient.
Latent = tuple[str, Distribution, Tensor]


class LogJoint(Protocol):
    """Log p(y, values) [nats] as a function of constrained values of every site."""

    def __call__(self, values: Values, count: int | None) -> Tensor:
        """Density () at values (*shape), or (count,) at values (count, *shape) of every site.

        Args:
            values: of every latent site. count: how many of each; None for one, without dimension.
        """

    def latent(self, values: Values) -> tuple[list[Latent], int]:
        """Every latent site, in the order of the model, and how many numbers are observed.

        Raises:
            ValueError: where a latent site has no value.
        """


class Traced:
    """Density of any Pyro function at what it is called with, by a trace for each evaluation."""

    def __init__(self, model: Program, args: Arguments) -> None:
        self.model, self.args = model, args

    def trace(self, values: Values) -> Any:
        """Trace of the model conditioned on values."""
        conditioned = pyro.poutine.condition(self.model, data=dict(values))
        return pyro.poutine.trace(conditioned).get_trace(*self.args)

    def latent(self, values: Values) -> tuple[list[Latent], int]:
        """See `LogJoint`."""
        nodes = [n for n in self.trace(values).nodes.values() if n["type"] == "sample"]
        _refuse_unset([node["name"] for node in nodes if not node["is_observed"]])
        found = [(n["name"], n["fn"], n["value"].detach()) for n in nodes if n["name"] in values]
        observed = [node["value"] for node in nodes if node["name"] not in values]
        return found, sum(y.numel() for y in observed if torch.is_tensor(y))

    def __call__(self, values: Values, count: int | None) -> Tensor:
        """See `LogJoint`."""
        trace = self.trace(values)
        trace.compute_log_prob()
        total: Tensor = trace.log_prob_sum() if count is None else log_prob_by_draw(trace, count)
        return total


def log_prob_by_draw(trace: Any, count: int) -> Tensor:
    """Log-density (S,) of all sites of a trace, run at S draws at once and scored.

    A site that no draw changes has one density for all of them.
    """
    total = torch.zeros(count, dtype=torch.float64)
    for node in trace.nodes.values():
        if node["type"] != "sample" or type(node["fn"]).__name__ == "_Subsample":
            continue
        log_prob = node["log_prob"]
        several = log_prob.dim() > 0 and log_prob.shape[0] == count
        total = total + (log_prob.reshape(count, -1).sum(1) if several else log_prob.sum())
    return total


class Priors:
    """Log prior density of all sites of a model together: all normal ones as one vector."""

    def __init__(self, sites: Sequence[Site]) -> None:
        normal = [site for site in sites if isinstance(_base(site), Normal)]
        self._names = [(site.name, len(site.shape)) for site in normal]
        self._others = [site for site in sites if not isinstance(_base(site), Normal)]
        if normal:
            loc, scale = (
                torch.cat([getattr(_base(site), name).reshape(-1) for site in normal])
                for name in ("loc", "scale")
            )
            self._normal = Normal(loc, scale, validate_args=False)

    def log_prob(self, values: Values) -> Tensor:
        """Density () or (k,) of values (*shape) or (k, *shape) of every site."""
        parts = [site.prior.log_prob(values[site.name]) for site in self._others]
        if self._names:
            some = [values[name] for name, _ in self._names]
            ends = [x.dim() - dims for x, (_, dims) in zip(some, self._names, strict=True)]
            flat = [x.reshape(*x.shape[:end], -1) for x, end in zip(some, ends, strict=True)]
            parts.append(self._normal.log_prob(torch.cat(flat, -1)).sum(-1))
        return torch.stack(parts).sum(0)


def _base(site: Site) -> Any:
    """Distribution of single entries of a site."""
    prior = site.prior
    return prior.base_dist if isinstance(prior, Independent) else prior


class Direct:
    """Density of a `Model` whose trajectories are integrated out, given records with outputs.

    Equal to that of its trace to rounding. What does not change between evaluations (the prepared
    records, priors) is made once.

    Attributes:
        records: prepared for the model. sites: in the order in which the model samples them, but
            those that are fixed.
        fixed: values (*shape) of sites that do not vary; their priors count.
        observations: y of each record [output]. constant: log prior density of fixed sites.
    """

    def __init__(self, model: Model, records: Records, fixed: Values | None = None) -> None:
        self.model = model
        self.records = model.begun(model.prepare(records))
        self.fixed = {name: value.detach() for name, value in (fixed or {}).items()}
        sites = model.all_sites(self.records[0].scaling, len(self.records))
        self.sites = [site for site in sites if site.name not in self.fixed]
        self.prior = Priors(self.sites)
        held = [site for site in sites if site.name in self.fixed]
        nothing = torch.zeros((), dtype=torch.float64)
        self.constant = Priors(held).log_prob(self.fixed).to(nothing) if held else nothing
        self.observations = [record.observations for record in self.records]
        self._at_limits = [at_limits(model.layers, each.record) for each in self.records]

    def latent(self, values: Values) -> tuple[list[Latent], int]:
        """See `LogJoint`."""
        _refuse_unset([site.name for site in self.sites if site.name not in values])
        found = [(site.name, site.prior, values[site.name].detach()) for site in self.sites]
        return found, sum(y.numel() for y in self.observations)

    def outputs(self, values: Values) -> list[OutputProcess]:
        """Distribution of the outputs of each record at values (*b, *shape) of `sites`."""
        model, found = self.model, []
        if self.fixed:
            site = self.sites[0]
            lead = values[site.name].shape[: values[site.name].dim() - len(site.shape)]
            held = {name: x.expand(lead + x.shape) for name, x in self.fixed.items()}
            values = {**values, **held}
        system = model.system(values, self.records[0].scaling)
        for index, record in enumerate(self.records):
            suffix = "" if len(self.records) == 1 else f"_{index}"
            here = model.begin(system, model.states_of(values, suffix))
            found.append(output_process(here, record))
        return found

    def __call__(self, values: Values, count: int | None) -> Tensor:
        """See `LogJoint`."""
        return self.prior.log_prob(values) + self.likelihood(values)

    def likelihood(self, values: Values) -> Tensor:
        """Log-density () or (k,) of outputs and fixed sites at values (*shape) or (k, *shape)."""
        total = self.constant
        each = zip(self.outputs(values), self.observations, self._at_limits, strict=True)
        for outputs, y, at in each:
            total = total + outputs.log_prob(y)
            if at.any():
                total = total + log_probability_scale(at, outputs)
        return total


def _refuse_unset(names: Sequence[str]) -> None:
    if names:
        raise invalid("values", expected=f"a value for every latent site, {names} too", got="none")


def density_of(model: Program, args: Arguments, fixed: Values | None = None) -> Direct | Traced:
    """The density of a model given what it is called with: directly where that is possible.

    fixed: values of sites that do not vary.
    """
    if isinstance(model, Model) and model.integrate == "all" and len(args) == 1:
        (given,) = args
        records: Any = given if isinstance(given, Sequence) else (given,)
        measured = [x.record if isinstance(x, PreparedRecord) else x for x in records]
        if all(record.n_outputs for record in measured):
            return Direct(model, records, fixed)
    return Traced(pyro.poutine.condition(model, data=dict(fixed)) if fixed else model, args)


def log_joint_of(
    model: Program, args: Arguments, values: Values, samples: int = 1000
) -> np.ndarray:
    """Log-density (S,) of a Pyro model at S draws of its latent sites, those of the data included.

    Draws go through the model together where it broadcasts, in portions of bounded memory.
    """
    count = len(next(iter(values.values())))
    portion = max(1, AT_ONCE // max(samples, 1))
    parts = []
    for first in range(0, count, portion):
        some = {name: x[first : first + portion] for name, x in values.items()}
        parts.append(_portion(model, args, some))
    return np.concatenate(parts)


def _portion(model: Program, args: Arguments, values: Values) -> np.ndarray:
    count = len(next(iter(values.values())))
    try:
        with torch.no_grad(), pyro.validation_enabled(False):
            trace = Traced(model, args).trace(values)
            trace.compute_log_prob()
    except (NotPositiveDefiniteError, torch.linalg.LinAlgError, ValueError) as error:
        # Pyro wraps what a distribution raises in a ValueError.
        singular = (NotPositiveDefiniteError, torch.linalg.LinAlgError)
        if not isinstance(error, singular) and not isinstance(error.__cause__, singular):
            raise
        if count == 1:  # this draw: the density cannot be evaluated there
            return np.array([-np.inf])
        each = [_portion(model, args, {k: v[i : i + 1] for k, v in values.items()}) for i in
                range(count)]  # fmt: skip
        return np.concatenate(each)
    for name, node in trace.nodes.items():
        latent = node["type"] == "sample" and not node["is_observed"] and name not in values
        if latent and type(node["fn"]).__name__ != "_Subsample":
            raise invalid("values", expected=f"draws of every site, {name!r} too", got="none of it")
    total = log_prob_by_draw(trace, count).numpy()
    return np.where(np.isfinite(total), total, -np.inf)
