"""Why models cannot be fitted to a part of a record."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.channels import prepared
from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.held_out import without
from pyro_dynogp.models.variants import Model

# A signal that varies by no more than this share of its size is constant, as for a fit.
CONSTANT = 1e-12


class TimeLimitError(Exception):
    """The time limit has passed before a trial came to its end."""


def why_not(
    models: Sequence[Model], record: Record, folds: Sequence[np.ndarray], error: ValueError
) -> str:
    """Why none of several models could be fitted, in words of the data rather than of the refit.

    Args:
        models: variants of one effect. record: each is fitted to what a fold leaves of it.
        folds: (n,) each. error: of the first refit.
    """
    several = len(folds) > 1
    where = "training blocks" if several else "training block"
    reasons: list[str] = []
    for model, fold in itertools.product(models, folds):
        names = [name for channel in model.channels for name in channel.names]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            reasons.append(f"the model has {twice!r} already")
            continue
        training = without(record, fold)
        for place, channel in enumerate(model.channels):
            columns = channel.columns(prepared(training, model.channels[:place]))
            for name, x in zip(channel.names, columns.T, strict=True):
                if np.ptp(x) <= CONSTANT * np.abs(x).max():
                    reasons.append(f"{name!r} is constant on the {where}")
    # What else a refit refuses, without what its caller should do about it.
    return reasons[0] if reasons else str(error).partition(". ")[0].rstrip(".")
