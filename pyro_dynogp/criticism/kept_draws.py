"""What is computed once for a fit and kept with it: its draws, and the normal behind them."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted

Found = TypeVar("Found")
NAME = "_kept_draws"


class Kept(dict[Hashable, Any]):
    """Results by key. A pickle or a deep copy of it is empty: it stays with its one fit."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Kept, ()


def kept(fit: Fitted, key: Hashable, compute: Callable[[], Found]) -> Found:
    """What `compute` gives, computed the first time that this fit is asked for `key`.

    It lives in the fit's own dictionary, as a `cached_property` does: it goes when the fit goes,
    `dataclasses.replace` makes a fit without it, `Fit.save` writes fields alone, and other
    processes get a fit with nothing kept.

    Args:
        fit: the fit. key: of the result. compute: what to call without arguments.
    """
    results: Kept = fit.__dict__.setdefault(NAME, Kept())
    if key not in results:
        results[key] = compute()
    found: Found = results[key]
    return found
