"""Models by name, and what a saved fit says about its bands."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pyro_dynogp.cli.data import InvalidInput

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit

# Names of models, and the functions that make them.
MODELS = {
    "linear": "LinearDynamicGP",
    "wiener": "Wiener",
    "hammerstein": "Hammerstein",
    "wiener-hammerstein": "WienerHammerstein",
    "hammerstein-wiener": "HammersteinWiener",
    "feedback": "NonlinearFeedback",
}
KINDS = (
    "linear dynamics; then a static function; after one; between two of them; dynamics between two "
    "static functions; a static function of the output that acts back on the dynamics."
)


def made(kind: str, inputs: int, outputs: int, pairs: int | None) -> Any:
    """A model by name; with its own number of pairs where None is given."""
    import pyro_dynogp as dgp

    given = {} if pairs is None else {"pairs": pairs}
    if kind not in ("linear", "wiener", "feedback") and inputs == 0:
        raise InvalidInput(f"--model {kind}: needs inputs; name one with --input.")
    return getattr(dgp, MODELS[kind])(inputs=inputs, outputs=outputs, **given)


def loaded(path: Path) -> Fit:
    """A saved fit; notes on the error stream say what its bands leave out."""
    from pyro_dynogp import load
    from pyro_dynogp.inference.stability import warnings_of

    fitted = load(path)
    for sentence in warnings_of(fitted):
        click.echo(f"Note: {sentence}", err=True)
    tell_method(fitted)
    return fitted


def tell_method(fitted: Fit) -> None:
    """Tell of a fit at the mode that its bands are too narrow."""
    if fitted.method == "map":
        click.echo(
            "Note: this fit has its parameters at the mode: bands leave out how uncertain they "
            "are, and are too narrow where the record is short (--method default counts it).",
            err=True,
        )
