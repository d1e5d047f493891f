"""Any Pyro model with a guide, or with draws of its posterior, made ready for criticism."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyro
import torch
from torch import Tensor

from pyro_dynogp.criticism.pyro_draws import (
    Nodes,
    deterministic_nodes,
    draws_of_any,
    latent_nodes,
    sample_nodes,
)
from pyro_dynogp.criticism.pyro_posterior import PyroPosterior
from pyro_dynogp.criticism.site_densities import is_masked, is_trajectory
from pyro_dynogp.inference.isolation import isolated
from pyro_dynogp.layers.sites import Arguments, Program
from pyro_dynogp.support.errors import instance, invalid
from pyro_dynogp.support.parallel import seeded

__all__ = ["PyroPosterior", "from_pyro"]


@isolated
def from_pyro(
    model: Program,
    posterior: Any,
    *args: object,
    observed: Mapping[str, Any] | None = None,
    draws: int = 400,
    coords: Mapping[str, Any] | None = None,
    dims: Mapping[str, Sequence[str]] | None = None,
    units: Mapping[str, str] | None = None,
    seed: int = 0,
) -> PyroPosterior:
    """Any Pyro model with its posterior, ready for criticism.

    The model runs once for each draw, so that it need not broadcast. Parameter store and random
    state are left as they were.

    Args:
        model: a Pyro model, all its plates over all of their data.
        posterior: a guide whose parameters are trained (a function, or an AutoGuide); or draws by
            site, (S, *shape) or (chain, draw, *shape); or a `pyro.infer.MCMC` that has run.
            Auxiliary sites of a guide count in log_q, and are no draws.
        *args: of model and guide.
        observed: values by site, for a model that is not given its data by `args`.
        draws: S of a guide; of others all there are.
        coords: labels by dimension. dims: names of the dimensions of one value by site.
        units: by site. seed: for draws and replicates.

    Raises:
        ValueError: on subsampled plates, sites without a draw, draws without a site, a model that
            observes nothing, or trajectories with a mask (mark missing samples by NaN).

    Examples:
        >>> def model(y):
        ...     mu = pyro.sample("mu", dist.Normal(torch.tensor(0.0).double(), 1.0))
        ...     pyro.sample("y", dist.Normal(mu, 1.0).expand(y.shape).to_event(1), obs=y)
        >>> draws = {"mu": torch.randn(20, dtype=torch.float64)}
        >>> posterior = dgp.from_pyro(model, draws, torch.ones(5, dtype=torch.float64))
        >>> sorted(posterior.observed)
        ['y']
    """
    if not callable(model):
        raise invalid("model", expected="a Pyro model", got=type(model).__name__)
    for name, given in (
        ("observed", observed),
        ("coords", coords),
        ("dims", dims),
        ("units", units),
    ):
        if given is not None:
            instance(name, given, Mapping)
    if observed is not None:
        data = {name: torch.as_tensor(value) for name, value in observed.items()}
        model = pyro.poutine.condition(model, data=data)
    store = pyro.get_param_store()
    with (
        store.scope(store.get_state()),
        seeded(seed),
        torch.no_grad(),
        pyro.poutine.block(),
    ):
        found, chains = draws_of_any(model, posterior, args, draws)
        each = [_at(model, args, found.values, s) for s in range(len(found))]
    first = each[0]
    seen = _observed(first)
    for name in seen:
        if not all(_same(first[name]["value"], nodes[name]["value"]) for nodes in each):
            raise invalid(
                f"site {name!r}",
                expected="data that are the same for every draw",
                got="values that depend on latent sites",
                advice="Put what is subtracted from the data into the distribution's mean.",
            )
    log_p = [sum(float(node["log_prob_sum"]) for node in nodes.values()) for nodes in each]
    return PyroPosterior(
        draws=replace(found, log_p=np.array(log_p)),
        observed={name: first[name]["value"].detach() for name in seen},
        sites={name: tuple(_scored(nodes[name]) for nodes in each) for name in seen},
        derived={
            name: torch.stack([nodes[name]["value"] for nodes in each])
            for name in deterministic_nodes(first)
        },
        trajectories=tuple(k for k in found.values if is_trajectory(first[k]["fn"])),
        chains=chains,
        coords=dict(coords or {}),
        dims=dict(dims or {}),
        units=dict(units or {}),
        seed=seed,
    )


def _at(model: Program, args: Arguments, values: Mapping[str, Tensor], s: int) -> Nodes:
    """Sample sites of the model at one draw, with their densities."""
    known = pyro.poutine.Trace()
    for name, value in values.items():
        known.add_node(name, name=name, type="sample", is_observed=False, value=value[s], infer={})
    trace = pyro.poutine.trace(pyro.poutine.replay(model, trace=known)).get_trace(*args)
    trace.compute_log_prob()
    nodes = sample_nodes(trace, "model")
    latent = latent_nodes(nodes)
    strange = sorted(set(values) - set(latent))
    if strange:
        raise invalid(
            "posterior",
            expected=f"draws of the latent sites {sorted(latent)}",
            got=f"{strange} too",
            advice='Leave them out, or mark them by infer={"is_auxiliary": True} in the guide.',
        )
    without = sorted(set(latent) - set(values))
    if without:
        raise invalid(
            "posterior",
            expected=f"draws of every latent site, {without} too",
            got="none of these",
            advice="Or call the model with its data, where it is these that were measured.",
        )
    return nodes


def _observed(nodes: Nodes) -> list[str]:
    """Names of the sites that carry data."""
    derived = deterministic_nodes(nodes)
    names = [
        name
        for name, node in nodes.items()
        if node["is_observed"] and name not in derived and type(node["fn"]).__name__ != "Unit"
    ]
    if not names:
        raise invalid(
            "model",
            expected="an observed site",
            got="none",
            advice="Call it with its data, or give observed={site: value}.",
        )
    for name in names:
        if is_trajectory(nodes[name]["fn"]) and is_masked(_scored(nodes[name])):
            raise invalid(
                f"site {name!r}",
                expected="a trajectory without a mask",
                got="a masked one",
                advice="Mark missing samples by NaN.",
            )
    return names


def _same(a: Tensor, b: Tensor) -> bool:
    """Equal, gaps included."""
    return a.shape == b.shape and bool(((a == b) | (torch.isnan(a) & torch.isnan(b))).all())


def _scored(node: Any) -> Any:
    """Distribution of an observed site, with what `pyro.poutine.mask` leaves out masked."""
    return node["fn"] if node["mask"] is None else node["fn"].mask(node["mask"])
