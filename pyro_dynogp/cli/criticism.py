"""Commands that judge saved fits: check, compare."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pyro_dynogp.cli.data import InvalidInput
from pyro_dynogp.cli.options import SAVED_FIT, WORK, seed


@click.command()
@click.argument("model", type=SAVED_FIT)
@click.option(
    "--twin", type=click.IntRange(min=20), metavar="N",
    help="Also fit the first N samples by Hamiltonian Monte Carlo and compare (minutes).",
)  # fmt: skip
@click.option("--no-forecasts", is_flag=True, help="Do not refit to parts of the record.")
@seed("findings")
@WORK
def check(
    model: Path, twin: int | None, no_forecasts: bool, seed: int, workers: int | None, quiet: bool
) -> None:
    """Check a saved MODEL: its posterior, its bands, and forecasts of its training record.

    Exit code 0 also where a check fails: the last line names what to look at.

    \b
    Examples:
      pyro-dynogp check plant.safetensors
      pyro-dynogp check plant.safetensors --twin 120
    """  # noqa: D301
    import pyro_dynogp as dgp

    found = dgp.check(
        dgp.load(model), twin=twin or False, forecasts=not no_forecasts, seed=seed,
        workers=workers, progress=not quiet,
    )  # fmt: skip
    click.echo(str(found))


@click.command()
@click.argument("models", nargs=-1, required=True, type=SAVED_FIT)
@click.option(
    "--target", type=click.Choice(["missing sample", "forecast", "new record"]),
    default="forecast", show_default=True,
    help="What the models are for: filling gaps; the samples after those known; other records.",
)  # fmt: skip
@click.option(
    "--horizon", type=click.IntRange(min=1), metavar="K",
    help="Samples ahead, with --target forecast [1].",
)  # fmt: skip
@seed("table")
@WORK
def compare(
    models: tuple[Path, ...],
    target: Any,
    horizon: int | None,
    seed: int,
    workers: int | None,
    quiet: bool,
) -> None:
    """Compare two or more saved MODELS of the same data by what they predict of it.

    Prints the table of expected log predictive densities (elpd), best first, and a sentence.

    \b
    Examples:
      pyro-dynogp compare linear.safetensors wiener.safetensors
      pyro-dynogp compare linear.safetensors wiener.safetensors --target "new record"
    """  # noqa: D301
    if len(models) < 2:
        raise InvalidInput("MODELS: name two saved fits or more.")
    stems = [path.stem for path in models]
    names = stems if len(set(stems)) == len(stems) else [str(path) for path in models]
    if len(set(names)) < len(names):
        raise InvalidInput("MODELS: each saved fit once.")
    if horizon is not None and target != "forecast":
        raise InvalidInput("--horizon: for --target forecast; leave it out.")
    import pyro_dynogp as dgp

    options: dict[str, Any] = {} if horizon is None else {"horizon": horizon}
    fits = {name: dgp.load(path) for name, path in zip(names, models, strict=True)}
    found = dgp.compare(
        fits, target=target, seed=seed, workers=workers, progress=not quiet, **options
    )
    click.echo(str(found))
