"""The method object that a short name and loose options stand for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from pyro_dynogp.inference.methods.base import Method
from pyro_dynogp.inference.methods.importance import Importance
from pyro_dynogp.inference.methods.mode import Mode
from pyro_dynogp.inference.methods.nuts import Nuts
from pyro_dynogp.inference.methods.optima import Normal
from pyro_dynogp.inference.methods.trajectories import Trajectories
from pyro_dynogp.models.model import Model
from pyro_dynogp.support.errors import invalid

Kind = type[Importance | Mode | Normal | Nuts | Trajectories]
CLASSES: Mapping[str, Kind] = {
    "importance": Importance,
    "map": Mode,
    "svi": Normal,
    "nuts": Nuts,
}
# Loose options whose field of a method object has another name.
FIELDS = {"hyperparameters": "family"}


def method_of(
    method: str | Method | None, model: Model, options: Mapping[str, Any] | None = None
) -> Method:
    """The method object that a short name and loose options stand for.

    Args:
        method: "importance", "map", "svi", "nuts", an object, or None for what suits the model:
            "svi" with a guide, and of models with static layers with an option that `Importance`
            does not have, else "importance".
        model: that is to be fitted.
        options: of the method by name; None as a value is an option that is not given, and so is
            ``guide="collapsed"``.

    Raises:
        ValueError: on an unknown method, or an option that the method does not have.
        TypeError: on an option that no method has.
    """
    given = {
        name: value
        for name, value in (options or {}).items()
        if value is not None and not (name == "guide" and isinstance(value, str)
                                      and value == "collapsed")
    }  # fmt: skip
    known = {name for kind in (*CLASSES.values(), Trajectories) for name in _options(kind)}
    for name in given:
        if name not in known:
            raise TypeError(f"fit() has no argument {name!r}.")
    if method is not None and not isinstance(method, str):
        if given:
            raise invalid(
                next(iter(given)),
                expected="no loose option beside a method object",
                got=repr(next(iter(given.values()))),
                advice=f"Give it to {type(method).__name__}(...).",
            )
        if isinstance(method, type) or not all(hasattr(method, x) for x in ("check", "__call__")):
            raise invalid("method", expected="'map', 'svi', 'nuts' or a method", got=repr(method))
        return method
    if method is None:
        of_svi = set(_options(Normal)) - set(_options(Importance))
        named = model.has_function and not of_svi.isdisjoint(given)
        method = "svi" if "guide" in given or named else "importance"
    if method not in CLASSES:
        raise invalid("method", expected="'importance', 'map', 'svi' or 'nuts'", got=repr(method))
    kind = CLASSES[method]
    if "guide" in given:
        if method != "svi":
            raise invalid("method", expected="'svi' with this guide", got=repr(method))
        kind = Trajectories
    takes = _options(kind)
    for name, value in given.items():
        if name not in takes:
            takers = [c.__name__ for c in (*CLASSES.values(), Trajectories) if name in _options(c)]
            raise invalid(
                name,
                expected=f"nothing with {kind.__name__}, which does not use it",
                got=repr(value),
                advice=f"{' and '.join(takers)} {'takes' if len(takers) == 1 else 'take'} it.",
            )
    return kind(**{takes[name]: value for name, value in given.items()})


def _options(kind: Kind) -> dict[str, str]:
    """The field of a method by the name of the loose option."""
    names = {field: option for option, field in FIELDS.items()}
    return {names.get(f.name, f.name): f.name for f in fields(kind)}
