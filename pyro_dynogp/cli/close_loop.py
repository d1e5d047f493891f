"""The command that looks for what a model lacks, and adds it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import click

from pyro_dynogp.cli.data import InvalidInput, whole_record
from pyro_dynogp.cli.files import check_folder, saved
from pyro_dynogp.cli.models import MODELS, loaded, made
from pyro_dynogp.cli.options import CHANNELS, PAIRS, WORK, Columns, seed

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit


@click.command(name="close-loop")
@click.argument("data")
@CHANNELS
@click.option(
    "--candidates", multiple=True, metavar="NAME",
    help="Column that may act on the output although the model does not use it; repeatable. "
    "All other columns of numbers if not given.",
)  # fmt: skip
@click.option(
    "--model", "kind", default="linear", show_default=True, metavar="NAME|FILE",
    help=f"A model to fit to the first half: {', '.join(MODELS)}. Or a saved fit, of the beginning "
    "of DATA, whose channels need not be named again.",
)  # fmt: skip
@PAIRS
@click.option(
    "--restarts", type=click.IntRange(min=1), metavar="N",
    help="Number of points from which the optimum of the first fit is sought.",
)  # fmt: skip
@click.option(
    "--max-rounds", type=click.IntRange(min=1), default=4, show_default=True,
    help="Most effects that are added, one in each round.",
)  # fmt: skip
@click.option(
    "--time-limit", type=click.FloatRange(min=0.0, min_open=True), metavar="SECONDS",
    help="After this time no round and no refit of the search begins; the report says what was "
    "not tried. No limit if not given.",
)  # fmt: skip
@seed("report")
@click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), default=Path("close_loop_output"),
    show_default=True, metavar="FOLDER",
    help="Folder for the report and the extended model; made where it is missing.",
)  # fmt: skip
@WORK
def close_loop(
    data: str,
    candidates: tuple[str, ...],
    kind: str,
    pairs: int | None,
    restarts: int | None,
    max_rounds: int,
    time_limit: float | None,
    seed: int,
    out: Path,
    workers: int | None,
    quiet: bool,
    **columns: Unpack[Columns],
) -> None:
    """Find what a model of DATA lacks, add it, and report how much better it predicts.

    DATA is a CSV file or the name of a data set. A model is fitted to the first half of it; the
    next quarter is searched for effects, and the last quarter is opened once, for the report.
    Writes report.html (a page for people), report.json and model.safetensors: the extended model,
    or the model before where the extended one does worse on the last quarter.

    \b
    Examples:
      pyro-dynogp close-loop plant.csv --input valve --output level --sampling-time 0.5
      pyro-dynogp close-loop plant.csv --input valve --output level --time stamp \\
          --candidates ambient --candidates feed --pairs 3 --out report
      pyro-dynogp close-loop plant.csv --model plant.safetensors --sampling-time 0.5
    """  # noqa: D301
    import pyro_dynogp as dgp

    given = _saved(kind, pairs, restarts)
    record, left_out = whole_record(data, columns, candidates, given)
    settings = dgp.LoopSettings()
    fewest = 4 * settings.block_samples
    if len(record) < fewest:
        raise InvalidInput(f"{data}: has {len(record)} samples; {fewest} are needed.")
    out.mkdir(parents=True, exist_ok=True)
    check_folder("--out", out / "report.html")
    if left_out:
        click.echo(f"Left out, as they hold no numbers: {', '.join(left_out)}", err=True)
    fitted = given or dgp.fit(
        made(kind, record.n_inputs, record.n_outputs, pairs),
        record[: len(record) // 2],
        seed=seed,
        restarts=restarts,
        workers=workers,
        progress=not quiet,
    )
    # The candidates are the record's extra channels.
    report = dgp.close_loop(
        fitted,
        record,
        candidates=None,
        seed=seed,
        max_rounds=max_rounds,
        time_limit=time_limit,
        workers=workers,
        progress=not quiet,
    )
    click.echo(str(report))
    page = saved(report.to_html, out / "report.html")
    numbers = saved(report.to_json, out / "report.json")
    model = saved(report.fit.save, out / "model.safetensors")
    click.echo(f"\nReport: {page} (numbers: {numbers})")
    which = "the model before" if report.model_kept else "the extended model"
    which = which if report.extended is not report.base else "the model as given"
    click.echo(f"Model:  {model} ({which}; pyro_dynogp.load reads it)")


def _saved(kind: str, pairs: int | None, restarts: int | None) -> Fit | None:
    """The fit that a file holds; None where a model is named."""
    if kind in MODELS:
        return None
    if not Path(kind).is_file():
        raise InvalidInput(f"--model: {kind} is neither a file nor one of {', '.join(MODELS)}.")
    for name, value in (("--pairs", pairs), ("--restarts", restarts)):
        if value is not None:
            raise InvalidInput(f"{name}: for models that are fitted; leave it out with a file.")
    return loaded(Path(kind))
