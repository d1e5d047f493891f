"""Bad input: one form of error and of warnings, and a table of what arguments have to be."""

from __future__ import annotations

import functools
import inspect
import math
import os
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any, ParamSpec, TypeVar

import numpy as np

Given = ParamSpec("Given")
Result = TypeVar("Result")


def invalid(argument: str, *, expected: str, got: str, advice: str = "") -> ValueError:
    """Build the ValueError that every public function raises on bad input.

    Args:
        argument: name of the argument as the caller wrote it.
        expected: what the argument has to be.
        got: what came instead.
        advice: what to do about it, a full sentence.

    Returns:
        The error, to be raised by the caller (so that the traceback ends there).
    """
    message = f"{argument}: expected {expected}, got {got}."
    return ValueError(f"{message} {advice}" if advice else message)


@dataclass(frozen=True)
class Rule:
    """What a value has to be.

    Attributes:
        expected: in words. plain: the value as plain Python, None where it is not what is expected.
    """

    expected: str
    plain: Callable[[object], Any]

    def check(self, argument: str, value: object) -> Any:
        """The value as plain Python.

        Raises:
            ValueError: where it is not what is expected.
        """
        found = self.plain(value)
        if found is None:
            got = repr(value) if len(repr(value)) < 200 else f"a {type(value).__name__}"
            raise invalid(argument, expected=self.expected, got=got)
        return found


def whole(least: int, most: float = math.inf) -> Rule:
    """A whole number between bounds; True and False are none."""

    def plain(value: object) -> int | None:
        number = isinstance(value, Integral) and not isinstance(value, bool)
        return int(value) if number and least <= value <= most else None  # type: ignore

    to = f">= {least}" if most == math.inf else f"from {least} to {most}"
    return Rule(f"a whole number {to}", plain)


def between(low: float, high: float, expected: str, *, with_low: bool = False) -> Rule:
    """A real number within open bounds, or `with_low` the lower one; not NaN, True or False."""

    def plain(value: Any) -> float | None:
        number = isinstance(value, Real) and not isinstance(value, bool)
        inside = number and (low < value < high or (with_low and value == low))
        return float(value) if inside else None

    return Rule(expected, plain)


def one_of(choices: Iterable[str]) -> Rule:
    """One of several names."""
    *most, last = names = list(choices)
    expected = f"{', '.join(map(repr, most))} or {last!r}"
    return Rule(
        expected, lambda value: value if isinstance(value, str) and value in names else None
    )


def verify_fields(value: object) -> None:
    """Check the fields of a dataclass that `RULES` names; None passes where it is the default.

    Raises:
        ValueError: as `verify`.
    """
    for field in fields(value):  # type: ignore[arg-type]
        given = getattr(value, field.name)
        if field.name in RULES and not (given is None and field.default is None):
            RULES[field.name].check(field.name, given)


def instance(argument: str, value: object, kind: type, advice: str = "") -> None:
    """Refuse what is not of a class.

    Raises:
        ValueError: see above.
    """
    if not isinstance(value, kind):
        expected = f"a {kind.__name__}"
        got = f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__
        raise invalid(argument, expected=expected, got=got, advice=advice)


SWITCH = Rule(
    "True or False", lambda value: bool(value) if isinstance(value, bool | np.bool_) else None
)
PATH = Rule("a path", lambda value: value if isinstance(value, str | os.PathLike) else None)
COUNT, NUMBER = whole(1), whole(0)
POSITIVE = between(0.0, math.inf, "a finite number > 0")
POSITIVE_OR_ZERO = between(0.0, math.inf, "a finite number >= 0", with_low=True)
SHARE = between(0.0, 1.0, "a number between 0 and 1")
# What an argument of each name has to be, wherever it is one; None is none given where that is the
# default.
RULES = {
    **dict.fromkeys(("draws", "samples", "particles", "chains", "warmup", "steps",
                     "horizon", "points", "workers", "max_rounds", "tries", "channels", "outputs",
                     "inducing", "pairs", "brownian", "count", "width", "longest"), COUNT),
    **dict.fromkeys(("restarts", "prior_samples", "refits", "channel", "inputs", "fed",
                     "hidden"), NUMBER),
    **dict.fromkeys(("progress", "forecasts", "process_noise", "feedthrough", "learn_locations",
                     "pathwise", "scaled", "real"), SWITCH),
    "seed": Rule("a whole number from 0 to 2**63 - 1", whole(0, 2**63 - 1).plain),
    "level": SHARE,
    "least_lengthscale": POSITIVE_OR_ZERO,
    **dict.fromkeys(("learning_rate", "init_scale", "joint_scale", "gain_scale", "step", "duration",
                     "degrees_of_freedom", "time_limit"), POSITIVE),
    **dict.fromkeys(("path", "checkpoint"), PATH),
    "integrators": Rule("0 or 1", whole(0, 1).plain),
    "name": Rule("text", lambda value: value if isinstance(value, str) else None),
    "noise": one_of(("shared", "independent")),
    "mean": one_of(("constant", "linear")),
    "priors": one_of(("default", "paper")),
    "folds": whole(2),
    "replicates": whole(2),
}  # fmt: skip


def verify(**arguments: Any) -> None:
    """Check arguments by the rules of their names; None is none given.

    Raises:
        ValueError: where one of them is not what its name asks for.
    """
    for name, value in arguments.items():
        if value is not None:
            RULES[name].check(name, value)


def checked(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """Check the arguments of a function that `RULES` names, before any work; a decorator.

    They come to the function as plain numbers. None passes where it is the default.
    """
    signature = inspect.signature(function)
    ruled = [p for p in signature.parameters.values() if p.name in RULES]

    @functools.wraps(function)
    def call(*args: Given.args, **kwargs: Given.kwargs) -> Result:
        bound = signature.bind(*args, **kwargs)
        given = bound.arguments
        for p in ruled:
            if p.name in given and not (given[p.name] is None and p.default is None):
                given[p.name] = RULES[p.name].check(p.name, given[p.name])
        return function(*bound.args, **bound.kwargs)

    return call


def warn(message: str) -> None:
    """Warn of the line that called the package, also through other libraries that it calls."""
    frame, level, caller = inspect.currentframe(), 1, 1
    while frame is not None:
        if str(frame.f_globals.get("__name__")).startswith("pyro_dynogp"):
            caller = level + 1
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=caller)
