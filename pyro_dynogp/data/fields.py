"""The fields of a Record, checked before it becomes one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypedDict

from pyro_dynogp.data.checks import (
    Array,
    Names,
    as_channels,
    as_texts,
    check_finite,
    check_unique,
    frozen,
    read_clock,
)
from pyro_dynogp.support.errors import instance, invalid
from pyro_dynogp.support.frozen import FrozenMapping


class RecordFields(TypedDict):
    """The arguments of `Record`, as they are given."""

    time: Any
    inputs: Any
    outputs: Any
    input_names: Names
    output_names: Names
    input_units: Names
    output_units: Names
    time_unit: str
    extra: Mapping[str, Any]
    extra_units: Mapping[str, str]
    name: str
    start: Any


def checked(fields: RecordFields) -> dict[str, Any]:
    """What a Record keeps under each of its names.

    Raises:
        ValueError: as `Record`.
    """
    time_unit, extra_units = fields["time_unit"], fields["extra_units"]
    if not isinstance(time_unit, str):
        raise invalid("time_unit", expected='text such as "s" or "h"', got=repr(time_unit))
    for name in ("extra", "extra_units"):
        instance(name, fields[name], Mapping)
    clock, origin = read_clock(fields["time"], fields["start"], time_unit)
    n = len(clock)
    u = as_channels("inputs", fields["inputs"], n)
    y = as_channels("outputs", fields["outputs"], n)
    u_names = as_texts("input_names", fields["input_names"], u.shape[1], default="u")
    y_names = as_texts("output_names", fields["output_names"], y.shape[1], default="y")
    check_finite("inputs", u, u_names, missing_allowed=False)
    check_finite("outputs", y, y_names, missing_allowed=True)
    kept: dict[str, Array] = {}
    for key, value in fields["extra"].items():
        kept[key] = as_channels(f"extra[{key!r}]", value, n, columns=1)[:, 0]
        check_finite(f"extra[{key!r}]", kept[key][:, None], (key,), missing_allowed=True)
    check_unique((*u_names, *y_names, *as_texts("extra", tuple(kept), len(kept))))
    unknown = sorted(set(extra_units) - set(kept))
    if unknown:
        raise invalid("extra_units", expected=f"names of extra {list(kept)}", got=f"{unknown}")
    return {
        "time": frozen(clock),
        "inputs": frozen(u),
        "outputs": frozen(y),
        "input_names": u_names,
        "output_names": y_names,
        "input_units": as_texts("input_units", fields["input_units"], len(u_names), unique=False),
        "output_units": as_texts(
            "output_units", fields["output_units"], len(y_names), unique=False
        ),
        "time_unit": time_unit,
        "extra": FrozenMapping({k: frozen(v) for k, v in kept.items()}),
        "extra_units": FrozenMapping({k: extra_units.get(k, "") for k in kept}),
        "name": str(fields["name"]),
        "start": origin,
    }
