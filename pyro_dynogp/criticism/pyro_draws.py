"""Posterior draws of any Pyro model: from a guide, from MCMC, or from tensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyro
import torch
from torch import Tensor

from pyro_dynogp.inference.posterior_draws import PosteriorDraws
from pyro_dynogp.inference.posteriors import Mixture, Sampled
from pyro_dynogp.layers.sites import Arguments, Program
from pyro_dynogp.support.errors import invalid

Nodes = dict[str, Any]


def draws_of_any(
    model: Program, posterior: Any, args: Arguments, count: int
) -> tuple[PosteriorDraws, int]:
    """Draws (S) of a posterior, without log_p, and the number of chains they make up.

    Draws from the global random state. `posterior` as in `from_pyro`; count: of draws of a guide.

    Raises:
        ValueError: where it is none of these, is empty, or draws differ in number or shape.
    """
    if isinstance(posterior, Sampled):  # what it holds, instead of some of it
        posterior = posterior.values
    if callable(getattr(posterior, "get_samples", None)):
        samples = {
            k: torch.as_tensor(v) for k, v in posterior.get_samples(group_by_chain=True).items()
        }
        return _flat(samples, dict.fromkeys(samples, 2), "MCMC")
    if isinstance(posterior, Mapping):
        samples = {k: torch.as_tensor(v) for k, v in posterior.items()}
        return _flat(samples, _leading(model, samples, args), "draws")
    if not callable(posterior):
        raise invalid(
            "posterior",
            expected="a guide, a mapping of draws by site, or a pyro.infer.MCMC that has run",
            got=type(posterior).__name__,
        )
    return _of_guide(posterior, args, count), 1


def _of_guide(guide: Program, args: Arguments, count: int) -> PosteriorDraws:
    drawn: list[dict[str, Tensor]] = []
    log_q = np.zeros(count)
    for s in range(count):
        trace = pyro.poutine.trace(guide).get_trace(*args)
        trace.compute_log_prob()
        sites = sample_nodes(trace, "posterior")
        log_q[s] = sum(float(node["log_prob_sum"]) for node in sites.values())
        drawn.append({k: v["value"] for k, v in latent_nodes(sites).items()})
    if not drawn[0]:
        raise invalid("posterior", expected="a guide that samples a site", got="no site")
    values = {name: torch.stack([one[name] for one in drawn]) for name in drawn[0]}
    if count > 1 and all(bool((v == v[:1]).all()) for v in values.values()):
        # A point has no density to compare with that of the posterior.
        return PosteriorDraws(values, None, None, np.zeros(count, dtype=int), "point estimate")
    group = np.zeros(count, dtype=int)
    if isinstance(guide, Mixture):
        group = guide.component(values).numpy()
    return PosteriorDraws(values, None, log_q, group, "guide")


def sample_nodes(trace: Any, argument: str) -> Nodes:
    """Sample sites of a trace, plates left out.

    Raises:
        ValueError: for a plate that holds part of its data only.
    """
    nodes = {
        name: node
        for name, node in trace.nodes.items()
        if node["type"] == "sample" and type(node["fn"]).__name__ != "_Subsample"
    }
    for name, node in nodes.items():
        for frame in node["cond_indep_stack"]:
            if frame.full_size not in (None, frame.size):
                raise invalid(
                    argument,
                    expected="plates over all of their data",
                    got=f"{int(frame.size)} of {int(frame.full_size)} in the plate "
                    f"{frame.name!r} of site {name!r}",
                    advice="Densities of a random part say nothing about the rest: call the model "
                    "without subsampling.",
                )
    return nodes


def latent_nodes(nodes: Nodes) -> Nodes:
    """Sites that are neither observed nor auxiliary."""
    return {
        name: node
        for name, node in nodes.items()
        if not node["is_observed"] and not node["infer"].get("is_auxiliary")
    }


def deterministic_nodes(nodes: Nodes) -> Nodes:
    """What `pyro.deterministic` names."""
    return {name: node for name, node in nodes.items() if node["infer"].get("_deterministic")}


def _leading(model: Program, samples: Mapping[str, Tensor], args: Arguments) -> dict[str, int]:
    """How many leading dimensions each site has: (S) or (chain, draw)."""
    trace = pyro.poutine.trace(model).get_trace(*args)
    sites = latent_nodes(sample_nodes(trace, "model"))
    own = {name: node["value"].dim() for name, node in sites.items()}
    return {name: value.dim() - own.get(name, value.dim() - 1) for name, value in samples.items()}


def _flat(
    samples: Mapping[str, Tensor], leading: Mapping[str, int], kind: str
) -> tuple[PosteriorDraws, int]:
    shapes = {tuple(v.shape[: leading[name]]) for name, v in samples.items()}
    if len(shapes) != 1 or len(next(iter(shapes))) not in (1, 2):
        raise invalid(
            "posterior",
            expected="draws (S, *shape), or (chain, draw, *shape), as many for each site",
            got=str({name: tuple(v.shape) for name, v in samples.items()}),
        )
    lead = next(iter(shapes))
    values = {k: v.flatten(0, 1) if len(lead) == 2 else v for k, v in samples.items()}
    count = int(np.prod(lead))
    if not count:
        raise invalid("posterior", expected="at least one draw", got="none")
    group = np.zeros(count, dtype=int)
    return PosteriorDraws(values, None, None, group, kind), lead[0] if len(lead) == 2 else 1
