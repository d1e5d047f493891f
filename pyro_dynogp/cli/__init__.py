"""Command line: fit, simulate, forecast, check, compare, close-loop, and what helps with them.

Torch and Pyro are imported inside the commands, so that ``--help`` need not wait for them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Unpack

import click

from pyro_dynogp.cli.close_loop import close_loop
from pyro_dynogp.cli.compilation import compile_now
from pyro_dynogp.cli.criticism import check, compare
from pyro_dynogp.cli.data import InvalidInput, training_and_test
from pyro_dynogp.cli.example import example
from pyro_dynogp.cli.files import check_folder, saved
from pyro_dynogp.cli.messages import in_flags, notes
from pyro_dynogp.cli.models import KINDS, MODELS, made, tell_method
from pyro_dynogp.cli.options import CHANNELS, PAIRS, READING, WORK, Modelled, seed
from pyro_dynogp.cli.predictions import forecast, simulate


class _Group(click.Group):
    """Turns the package's own complaints about input into one line; all else keeps its trace."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            with notes():
                return super().invoke(ctx)
        except ValueError as error:
            if not _from_package(error):
                raise
            raise InvalidInput(in_flags(str(error))) from error
        except OSError as error:
            if error.filename is None and not _from_package(error):
                raise
            where = "" if error.filename is None else f"{error.filename}: "
            raise InvalidInput(f"{where}{error.strerror}.") from error


def _from_package(error: BaseException) -> bool:
    """Whether the error was raised by this package, not by a library that it called."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    module = "" if trace is None else str(trace.tb_frame.f_globals.get("__name__", ""))
    return module == "pyro_dynogp" or module.startswith("pyro_dynogp.")


_PLAIN = {"context_settings": {"help_option_names": ["-h", "--help"], "max_content_width": 100}}


@click.group(cls=_Group, name="pyro-dynogp", **_PLAIN)
@click.version_option(package_name="pyro-dynogp")
def main() -> None:
    """Bayesian identification of dynamic systems from measured inputs and outputs.

    \b
    Examples:
      pyro-dynogp demo
      pyro-dynogp example gas_furnace
      pyro-dynogp info plant.csv
      pyro-dynogp fit plant.csv --input valve --output level --sampling-time 0.5 \\
          --train 800 --save plant.safetensors --figures figures
      pyro-dynogp simulate plant.safetensors next_week.csv --sampling-time 0.5 --out level.csv
      pyro-dynogp check plant.safetensors
      pyro-dynogp close-loop plant.csv --input valve --output level --sampling-time 0.5

    Exit codes: 0 done, 1 unexpected error, 2 input that has to be put right.
    """  # noqa: D301 (\b is click's mark of a paragraph that keeps its lines)


@main.command()
@click.option(
    "--output",
    "directory",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("demo_output"),
    show_default=True,
    help="Folder for the figures, the scores and the fitted model; made where it is missing.",
)
@click.option("--quiet", is_flag=True, help="No progress bars.")
def demo(directory: Path, quiet: bool) -> None:
    """Identify the coupled electric drives, a record that ships with the package.

    \b
    Examples:
      pyro-dynogp demo
      pyro-dynogp demo --output drives
    """  # noqa: D301
    from pyro_dynogp.cli.demonstration import run_demo

    directory.mkdir(parents=True, exist_ok=True)
    check_folder("--output", directory / "report.html")
    run_demo(directory, progress=not quiet)


@main.command()
@click.argument("subject", metavar="[DATASET_OR_FILE]", required=False)
@READING
def info(subject: str | None, **layout: Any) -> None:
    """Tell versions and shipped data sets, or about one data set, CSV file or saved fit.

    \b
    Examples:
      pyro-dynogp info
      pyro-dynogp info gas_furnace
      pyro-dynogp info plant.csv
      pyro-dynogp info plant.safetensors
    """  # noqa: D301
    from pyro_dynogp.cli.describe import tell

    tell(subject, layout)


@main.command()
@click.argument("data")
@CHANNELS
@click.option(
    "--train", type=click.IntRange(min=2), metavar="N", help="Train on the first N samples alone."
)
@click.option(
    "--model", "kind", type=click.Choice(list(MODELS)), default="linear", show_default=True,
    help=f"In this order: {KINDS}",
)  # fmt: skip
@PAIRS
@click.option(
    "--method", type=click.Choice(["default", "map", "svi", "nuts"]), default="default",
    show_default=True,
    help="Draws of all parameters by importance sampling; posterior mode alone (fast, bands too "
    "narrow); variational posterior; Hamiltonian Monte Carlo.",
)  # fmt: skip
@click.option(
    "--restarts", type=click.IntRange(min=1), metavar="N",
    help="Number of points from which the optimum is sought [the model's default].",
)  # fmt: skip
@click.option("--steps", type=click.IntRange(min=1), metavar="N", help="Most iterations.")
@seed("fit")
@click.option(
    "--save", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE",
    help="Write the fit here (.safetensors).",
)  # fmt: skip
@click.option(
    "--figures", type=click.Path(file_okay=False, path_type=Path), metavar="DIR",
    help="Write figures into this folder; made where it is missing.",
)  # fmt: skip
@WORK
def fit(
    data: str,
    train: int | None,
    method: str,
    restarts: int | None,
    steps: int | None,
    seed: int,
    save: Path | None,
    figures: Path | None,
    workers: int | None,
    quiet: bool,
    **columns: Unpack[Modelled],
) -> None:
    """Fit a model to DATA, a CSV file or the name of a data set.

    Prints the fit, and the scores of predictions of the samples that training left out (those
    after --train; a data set has its own test samples).

    \b
    Examples:
      pyro-dynogp fit plant.csv --input valve --input pump --output level \\
          --time stamp --timezone Europe/Vienna --train 800 --save plant.safetensors
      pyro-dynogp fit gas_furnace --pairs 3 --figures figures
      pyro-dynogp fit coupled_drives --model wiener --pairs 2 --save drives.safetensors
    """  # noqa: D301
    import pyro_dynogp as dgp
    from pyro_dynogp.cli import demonstration as report

    if save is not None:
        check_folder("--save", save)
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
        check_folder("--figures", figures / "record.png")
    parts = training_and_test(data, columns, train)
    first, test = parts.train[0], parts.test
    model = made(columns["kind"], first.n_inputs, first.n_outputs, columns["pairs"])
    fitted = dgp.fit(
        model,
        first if len(parts.train) == 1 else parts.train,
        method=None if method == "default" else method,
        seed=seed,
        restarts=restarts,
        steps=steps,
        workers=workers,
        progress=not quiet,
    )
    click.echo(fitted.summary())
    tell_method(fitted)
    if save is not None:
        click.echo(f"saved to {saved(fitted.save, save)}")
    results = None
    if test is not None:
        past = first if parts.follows else None
        results = report.evaluate(fitted, test, past=past, skip=parts.skip)
        left_out = f" (the first {parts.skip} are not counted)" if parts.skip else ""
        click.echo(f"\nScores on {len(test)} samples{left_out}:")
        click.echo(report.score_table(results, test))
    if figures is not None:
        written = report.write_figures(
            fitted, figures, train=first, test=test, results=results, skip=parts.skip
        )
        click.echo(f"{len(written)} figures in {figures}")


for _command in (
    simulate, forecast, check, compare, close_loop, example, compile_now
):  # fmt: skip
    main.add_command(_command)
