"""Guides for models of trajectories: a variational family for each latent site."""

from pyro_dynogp.guides.families import (
    Family,
    FullRank,
    GaussMarkov,
    InducingTimes,
    MeanField,
    Point,
    SameAsPrior,
    default_family,
)
from pyro_dynogp.guides.layer_guide import LayerGuide

__all__ = [
    "Family",
    "FullRank",
    "GaussMarkov",
    "InducingTimes",
    "LayerGuide",
    "MeanField",
    "Point",
    "SameAsPrior",
    "default_family",
]
