"""The command that writes a shipped record as a CSV file, to try the others on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pyro_dynogp.cli.data import DATASETS
from pyro_dynogp.cli.files import check_folder, saved_table, stamped

if TYPE_CHECKING:
    from pyro_dynogp.data.record import Record


@click.command()
@click.argument("name", type=click.Choice(list(DATASETS)), metavar="NAME")
@click.option(
    "--out", type=click.Path(dir_okay=False, path_type=Path), metavar="CSV",
    help="File to write [NAME.csv in this folder]. Several records get numbers.",
)  # fmt: skip
def example(name: str, out: Path | None) -> None:
    """Write the shipped data set NAME as a CSV file, and tell how to fit it.

    \b
    Examples:
      pyro-dynogp example gas_furnace
      pyro-dynogp example heat_exchanger --out exchanger.csv
    """  # noqa: D301
    path = Path(f"{name}.csv") if out is None else out
    check_folder("--out", path)
    from pyro_dynogp.examples import datasets

    data = datasets.load(name)
    if data.full is not None:
        _write(data.full, path)
    else:
        trains = data.train if isinstance(data.train, tuple) else (data.train,)
        labels = [f"train{i + 1}" for i in range(len(trains))] if len(trains) > 1 else ["train"]
        for label, record in zip((*labels, "test"), (*trains, data.test), strict=True):
            written = path.with_name(f"{path.stem}_{label}{path.suffix}")
            _write(record, written)


def _write(record: Record, path: Path) -> None:
    """Write all channels of a record over its time stamps or times, and print a command for it."""
    saved_table(stamped(record.to_frame(), record), path)
    flags = ["--time time"]
    if record.timestamps is not None:
        # Offsets change with daylight saving; the zone is what they are offsets of.
        flags.append(f"--timezone {record.timestamps.tz}")
    elif record.time_unit != "s":
        flags.append(f"--time-unit {record.time_unit}")
    for role in ("input", "output"):
        names, units = getattr(record, f"{role}_names"), getattr(record, f"{role}_units")
        flags += [f'--{role} "{n}"' for n in names]
        flags += [f'--unit "{n}={u}"' for n, u in zip(names, units, strict=True) if u]
    click.echo(f"  pyro-dynogp fit {path} " + " ".join(flags))
