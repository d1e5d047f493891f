"""Guides for models of trajectories: a variational family for each latent site.

Examples:
    >>> sorted(dgp.guides.__all__)[:3]
    ['Family', 'FullRank', 'GaussMarkov']
"""

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
