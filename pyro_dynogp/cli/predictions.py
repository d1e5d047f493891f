"""Commands that predict with a saved fit: simulate, forecast."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import click

from pyro_dynogp.cli.data import InvalidInput, record_for
from pyro_dynogp.cli.files import check_folder, saved_table, stamped
from pyro_dynogp.cli.models import loaded
from pyro_dynogp.cli.options import CLOCK, SAVED_FIT, Clock

if TYPE_CHECKING:
    from pyro_dynogp.data.record import Record
    from pyro_dynogp.prediction.prediction import Prediction

OUT = click.option(
    "--out", required=True, type=click.Path(dir_okay=False, path_type=Path), metavar="CSV",
    help="Write mean, standard deviation and 95 % interval here; - for standard output.",
)  # fmt: skip
NO_PROCESS_NOISE = click.option(
    "--no-process-noise", is_flag=True, help="Predict the deterministic system."
)
SAVED = click.argument("model", type=SAVED_FIT)


@click.command()
@SAVED
@click.argument("data")
@CLOCK
@OUT
@NO_PROCESS_NOISE
@click.option(
    "--horizon", type=click.IntRange(min=1), metavar="K",
    help="Predict K samples ahead from measured outputs instead.",
)  # fmt: skip
def simulate(
    model: Path,
    data: str,
    out: Path,
    no_process_noise: bool,
    horizon: int | None,
    **clock: Unpack[Clock],
) -> None:
    """Simulate the outputs of a saved MODEL from the inputs in DATA.

    DATA is a CSV file with the columns of the training record, taken to be in the same units, or
    the name of a data set (its test record). Outputs are read where there are any, and used with
    --horizon alone.

    \b
    Examples:
      pyro-dynogp simulate plant.safetensors next_week.csv --sampling-time 0.5 --out level.csv
      pyro-dynogp simulate plant.safetensors next_week.csv --sampling-time 0.5 --horizon 10 --out -
    """  # noqa: D301
    if horizon is not None and no_process_noise:
        raise InvalidInput("--no-process-noise: for simulations; leave it out with --horizon.")
    check_folder("--out", out)
    fitted = loaded(model)
    record, has_outputs = record_for(fitted, data, clock)
    if horizon is None:
        prediction = fitted.simulate(record, process_noise=not no_process_noise)
    elif has_outputs:
        prediction = fitted.predict(record, horizon=horizon)
    else:
        raise InvalidInput(
            f"--horizon: needs the measured outputs {list(fitted.scaling.output_names)} in {data}."
        )
    _write(prediction, record, out)


@click.command()
@SAVED
@click.argument("data")
@CLOCK
@OUT
@click.option(
    "--past", type=click.IntRange(min=1), metavar="N",
    help="Number of samples that are known. By default up to the last measured output.",
)  # fmt: skip
@click.option(
    "--ahead", type=click.IntRange(min=1), metavar="K",
    help="Forecast K samples after the last one; for models without inputs.",
)  # fmt: skip
@NO_PROCESS_NOISE
def forecast(
    model: Path,
    data: str,
    out: Path,
    past: int | None,
    ahead: int | None,
    no_process_noise: bool,
    **clock: Unpack[Clock],
) -> None:
    """Forecast the outputs of a saved MODEL after the measured ones in DATA.

    DATA is a CSV file with the columns of the training record: first rows with inputs and outputs,
    then rows whose inputs are known and whose outputs are empty. Where outputs of the later rows
    are measured, too (with --past, or a data set), the forecast is scored.

    \b
    Examples:
      pyro-dynogp forecast plant.safetensors plan.csv --time stamp --timezone UTC --out level.csv
      pyro-dynogp forecast plant.safetensors plant.csv --sampling-time 0.5 --past 800 --out -
    """  # noqa: D301
    import numpy as np

    check_folder("--out", out)
    if past is not None and ahead is not None:
        raise InvalidInput("--past, --ahead: give one of the two.")
    fitted = loaded(model)
    record, has_outputs = record_for(fitted, data, clock, whole=True)
    if not has_outputs:
        raise InvalidInput(
            f"{data}: needs measured outputs {list(fitted.scaling.output_names)} to forecast from."
        )
    if ahead is not None:
        before, after = record, _after(record, ahead)
    else:
        measured = np.flatnonzero(np.isfinite(record.outputs).any(axis=1))
        known = past if past is not None else int(measured[-1]) + 1 if len(measured) else 0
        if not 0 < known < len(record):
            advice = "leave the outputs of the rows to forecast empty, or give --past or --ahead"
            raise InvalidInput(
                f"{data}: {known} of {len(record)} samples are known, and none is left to forecast"
                f" or to begin from: {advice}."
            )
        before, after = record.split(known)
    prediction = fitted.forecast(before, after, process_noise=not no_process_noise)
    if np.isfinite(after.outputs).any(axis=0).all() and after.n_outputs:
        from pyro_dynogp.cli.demonstration import Result, score_table
        from pyro_dynogp.prediction.scores import scores

        table = score_table({"forecast": Result(prediction, scores(prediction, after))}, after)
        click.echo(table, err=str(out) == "-")
    _write(prediction, after, out)


def _after(record: Record, count: int) -> Record:
    """The times after a record without inputs, with outputs that are missing."""
    import dataclasses

    import numpy as np

    if record.n_inputs:
        raise InvalidInput(
            f"--ahead: the inputs {list(record.input_names)} of those samples have to be known: "
            "add rows with them and empty outputs to the file."
        )
    if not record.is_regular:
        raise InvalidInput("--ahead: the samples have no constant step; add rows with the times.")
    time = record.time[-1] + record.sampling_time * np.arange(1, count + 1)
    empty = np.full((count, record.n_outputs), np.nan)
    return dataclasses.replace(
        record, time=time, inputs=np.empty((count, 0)), outputs=empty, extra={}, extra_units={}
    )


def _write(prediction: Prediction, record: Record, out: Path) -> None:
    """Write a prediction as CSV, with time stamps where the record has them."""
    frame = stamped(prediction.to_frame(), record)
    if str(out) == "-":
        click.echo(frame.to_csv(), nl=False)
    else:
        saved_table(frame, out)
