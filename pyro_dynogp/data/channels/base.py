"""What a channel is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import held
from pyro_dynogp.support.errors import invalid


@dataclass(frozen=True)
class Quantity:
    """What a number of a channel is.

    Attributes:
        name: in words. unit: "time", that of the clock, or "channel", that of the channel.
        low: its lower bound. inside: whether it is a time within the record.
    """

    name: str
    unit: Literal["time", "channel"]
    low: float = -np.inf
    inside: bool = False


@dataclass(frozen=True)
class Channel:
    """Columns computed from a record.

    A subclass is a frozen dataclass of plain values with `_names` and `_columns`.

    Attributes:
        direct: whether the columns act on the output at once, past dynamics and nonlinearities.
        replacing: whether they stand for the input that is the field `channel`.
        numbers: fields that data are to say, with what they are.
    """

    direct: ClassVar[bool] = False
    replacing: ClassVar[bool] = False
    numbers: ClassVar[Mapping[str, Quantity]] = {}

    @property
    def replaces(self) -> str:
        """Name of the input that goes; "" for none."""
        return str(getattr(self, "channel")) if self.replacing else ""  # noqa: B009

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the K columns."""
        return self._names()

    def units(self, record: Record) -> tuple[str, ...]:
        """Units of the columns."""
        return self._units(record)

    def columns(self, record: Record) -> np.ndarray:
        """(n, K) float64.

        Raises:
            ValueError: where the record lacks what the channel is made from.
        """
        columns = self._columns(record)
        return columns[:, None] if columns.ndim == 1 else columns

    def _names(self) -> tuple[str, ...]:
        raise NotImplementedError

    def _units(self, record: Record) -> tuple[str, ...]:
        return ("",) * len(self.names)

    def _columns(self, record: Record) -> np.ndarray:
        raise NotImplementedError


def signal_of(record: Record, name: str) -> np.ndarray:
    """An input or an extra channel (n,), gaps filled by the value before (the first one after).

    Raises:
        ValueError: where there is none of that name, or nothing but gaps.
    """
    if name in record.input_names:
        return record.inputs[:, record.input_names.index(name)]
    if name not in record.extra:
        known = [*record.input_names, *record.extra]
        raise invalid("record", expected=f"a channel {name!r}", got=f"channels {known}")
    x = record.extra[name]
    if not np.isfinite(x).any():
        raise invalid(f"channel {name!r}", expected="numbers", got="missing samples alone")
    return held(x)


def unit_of(record: Record, name: str) -> str:
    """Unit of an input or of an extra channel."""
    if name in record.input_names:
        return record.input_units[record.input_names.index(name)]
    return record.extra_units.get(name, "")
