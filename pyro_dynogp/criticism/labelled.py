"""Arrays with named dimensions and units, and the xarray datasets that they make up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from pyro_dynogp.data.record import Record
from pyro_dynogp.support.errors import invalid

# Labels of a dimension: (dimension, values, attributes), as xarray takes them.
Coordinate = tuple[str, np.ndarray, Mapping[str, str]]


@dataclass(frozen=True, eq=False)
class Variable:
    """One variable of a dataset.

    Attributes:
        values: (*shape), with a leading dimension of draws where the dataset is one of draws.
        dims: names of the dimensions of one draw.
        attrs: "units" and whatever else there is to say.
    """

    values: np.ndarray
    dims: tuple[str, ...]
    attrs: Mapping[str, str]


def dataset_of(
    variables: Mapping[str, Variable],
    coords: Mapping[str, Coordinate],
    attrs: Mapping[str, Any],
    *,
    chains: int | None = None,
) -> xr.Dataset:
    """Dataset of variables; those labels are kept whose dimension occurs.

    Args:
        variables: by name. coords: labels by name. attrs: of the dataset.
        chains: how many chains the leading dimension of every variable holds, one after the other,
            which become the dimensions chain and draw; None where variables are not draws.

    Raises:
        ValueError: where a variable has the name of a dimension, or another number of dimensions
            than names.
    """
    arrays: dict[str, Any] = {}
    used: set[str] = set()
    for name, variable in variables.items():
        values, dims = variable.values, variable.dims
        if chains is not None:
            values = values.reshape(chains, len(values) // chains, *values.shape[1:])
            dims = ("chain", "draw", *dims)
        if len(dims) != values.ndim:
            raise invalid(
                f"dims of {name!r}",
                expected=f"{values.ndim} names, for shape {values.shape}",
                got=str(list(dims)),
            )
        used.update(dims)
        arrays[name] = (dims, values, dict(variable.attrs))
    clash = sorted(set(arrays) & (used | set(coords)))
    if clash:
        raise invalid(
            "variables",
            expected="names that no dimension or label has",
            got=f"{clash}",
            advice="Give the layer or the site another name.",
        )
    labels: dict[str, Any] = {k: c for k, c in coords.items() if c[0] in used}
    for dim in used - set(labels):
        size = next(v.shape[d.index(dim)] for d, v, _ in arrays.values() if dim in d)
        labels[dim] = (dim, np.arange(size), {})
    return xr.Dataset(arrays, labels, dict(attrs))


def clock_of(record: Record, dim: str = "time") -> dict[str, Coordinate]:
    """Labels of time: UTC time stamps without zone where the record has them, else its numbers."""
    stamps = record.timestamps
    if stamps is not None:
        utc = stamps.tz_convert("UTC").tz_localize(None).to_numpy()
        return {dim: (dim, utc, {"time_zone": "UTC"})}
    return {dim: (dim, np.asarray(record.time), {"units": record.time_unit})}


def units_of(units: Sequence[str]) -> dict[str, str]:
    """Attribute of channels: their unit, or all of them in order; nothing if none is stated."""
    if not any(units):
        return {}
    same = len(set(units)) == 1
    return {"units": units[0] if same else ", ".join(unit or "1" for unit in units)}


def ratio_units(over: Sequence[str], under: Sequence[str]) -> dict[str, str]:
    """Attribute of gains: unit of each output over that of each input, outputs first."""
    if not any((*over, *under)):
        return {}
    return units_of([f"{a or '1'}/{b}" if b else a or "1" for a in over for b in under])
