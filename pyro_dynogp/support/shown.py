"""How results show themselves: a line that fits a prompt, a table in a notebook."""

from __future__ import annotations

import dataclasses
import html
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

Class = TypeVar("Class", bound=type)
LONGEST = 60  # characters of one value
MOST = 4  # names or items that are shown


def short(value: Any) -> str:
    """A value in a few characters: arrays by their shape, mappings by their names."""
    shape = getattr(value, "shape", None)
    if isinstance(value, str):
        return repr(value if len(value) <= LONGEST else value[: LONGEST - 3] + "...")
    if isinstance(value, float | int | np.number | np.bool_ | None):
        return f"{value:.6g}" if isinstance(value, float) else str(value)
    if shape is not None and not isinstance(value, type):
        return f"<{type(value).__name__} {tuple(shape)}>"
    if isinstance(value, Mapping):
        return "{" + _few([str(name) for name in value]) + "}"
    if isinstance(value, Sequence):
        shown = _few([short(item) for item in value[: MOST + 1]], len(value))
        return f"({shown})" if len(shown) <= 2 * LONGEST else f"({len(value)} items)"
    if callable(value) and not dataclasses.is_dataclass(value):
        return f"<{getattr(value, '__name__', type(value).__name__)}>"
    text = repr(value)
    return text if len(text) <= 2 * LONGEST and "\n" not in text else f"<{type(value).__name__}>"


def _few(names: Sequence[str], count: int | None = None) -> str:
    count = len(names) if count is None else count
    rest = [f"... {count} in all"] if count > MOST else []
    return ", ".join([*names[:MOST], *rest])


def shown(cls: Class) -> Class:
    """Give a dataclass a short repr, and a notebook its text or a table; a decorator.

    What the class defines itself stays.
    """
    made: dict[str, Callable[[Any], str]] = {"__repr__": _line, "_repr_html_": _page}
    for name, method in made.items():
        own = cls.__dict__.get(name)

        if own is None:
            setattr(cls, name, method)
    return cls


def _line(self: Any) -> str:
    """The class and its fields, short."""
    fields = [f for f in dataclasses.fields(self) if f.repr and not f.name.startswith("_")]
    inner = ", ".join(f"{f.name}={short(getattr(self, f.name))}" for f in fields)
    return f"{type(self).__name__}({inner})"


def _page(self: Any) -> str:
    """The text where the class has one, else a table of the fields."""
    if type(self).__str__ is not object.__str__:
        return preformatted(str(self))
    fields = [f.name for f in dataclasses.fields(self) if f.repr and not f.name.startswith("_")]
    rows = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
        f"<td style='text-align:left'>{html.escape(short(getattr(self, name)))}</td></tr>"
        for name in fields
    )
    title = html.escape(type(self).__name__)
    return f"<table><caption>{title}</caption><tbody>{rows}</tbody></table>"


def preformatted(text: str) -> str:
    """Text as HTML that keeps its lines."""
    return f"<pre>{html.escape(text)}</pre>"
