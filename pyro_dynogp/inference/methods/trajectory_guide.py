"""Guides of layers for models whose trajectories stay sample sites, and where they start."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from pyro_dynogp.guides.families import (
    Family,
    FullRank,
    GaussMarkov,
    InducingTimes,
    MeanField,
    SameAsPrior,
)
from pyro_dynogp.guides.layer_guide import LayerGuide
from pyro_dynogp.layers.noise import Gaussian
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.wiring import Dynamic
from pyro_dynogp.support.errors import invalid

Values = dict[str, Tensor]
GuideChoice = str | Mapping[str, Any] | Callable[..., Any]
# Inducing times of a trajectory, as a share of its samples and at most.
INDUCING_SHARE, INDUCING_MOST = 0.5, 400
# First standard deviation of pseudo-observations (layers have unit scale).
PSEUDO_SD = 0.3


def with_trajectories(model: Model) -> Model:
    """The model that a guide of layers fits: a linear Gaussian last layer is integrated exactly."""
    exact = isinstance(model.layers[-1], Dynamic) and model.likelihood == Gaussian()
    return replace(model, integrate="last" if exact else "none")


def layer_guide(model: Model, choice: Any, values: Mapping[str, Tensor], n: int) -> LayerGuide:
    """Guide for a cascade with its trajectories as sites.

    Trajectories: Gauss-Markov sites or inducing times; whitened inducing values: a multivariate
    normal for each static layer; values of a last static layer and residuals of functions: as the
    model has them; everything else: mean field. A mapping overrides single sites.

    Raises:
        ValueError: for an unknown name.
    """
    kinds: dict[str, Family] = {
        "gauss-markov": GaussMarkov(init_sd=PSEUDO_SD),
        "inducing times": InducingTimes(
            count=min(n, INDUCING_MOST, max(2, int(INDUCING_SHARE * n))), init_scale=0.1
        ),
    }
    chosen: Mapping[str, Family] = {} if isinstance(choice, str) else choice
    kind = choice if isinstance(choice, str) else "gauss-markov"
    if kind not in kinds:
        raise invalid(
            "guide",
            expected=f"'collapsed', one of {sorted(kinds)}, a mapping of sites to families, or a "
            "Pyro function",
            got=repr(choice),
        )
    statics = {place.name for place in model.wires if not isinstance(place.layer, Dynamic)}

    def family(name: str, prior: Any) -> Family:
        base, _, number = name.rpartition("_")
        layer = base if number.isdigit() else name
        if any(layer == place.name for place in model.wires if isinstance(place.layer, Dynamic)):
            return kinds[kind]
        if layer in statics or (name.endswith("_residual") and base in statics):
            return SameAsPrior()
        if name.endswith("_values") and base in statics:
            return FullRank(init_scale=0.03)
        return MeanField(init_scale=0.03)

    return LayerGuide(model, chosen, family, values=values)


def starting_trajectories(
    model: Model, records: Sequence[PreparedRecord], values: Values
) -> Values:
    """First trajectories of the dynamic layers: smoothed by the moment-matching filter."""
    out: Values = {}
    for index, record in enumerate(records):
        suffix = "" if len(records) == 1 else f"_{index}"
        with torch.no_grad():
            system = model.collapsed.system(values, record.scaling)
            system = model.begin(system, model.states_of(values, suffix))
            outputs = output_process(system, record)
            found = outputs.smooth(record.observations)
        for place in model.wires:
            integrated = place.last and model.integrate == "last"
            if isinstance(place.layer, Dynamic) and not integrated:
                path = torch.tensor(found[place.name].mean[0])
                out[place.name + suffix] = path if place.layer.outputs > 1 else path[:, 0]
    return out


def parameter_sites(model: Model, records: Sequence[PreparedRecord]) -> list[str]:
    """Names of the sites that the collapsed model has."""
    sites = model.collapsed.all_sites(records[0].scaling, len(records))
    return [site.name for site in sites]
