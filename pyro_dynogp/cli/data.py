"""What the commands read: data sets by name, CSV files, and complaints about them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from pyro_dynogp.datasets import Dataset
    from pyro_dynogp.inference.result import Fit
    from pyro_dynogp.record import Record

# One line for each shipped data set; `pyro-dynogp info NAME` tells the rest.
DATASETS = {
    "coupled_drives": "two electric drives, belt and pulley; random input; speed is rectified",
    "coupled_drives_prbs": "the same machine with binary inputs",
    "gas_furnace": "gas rate and carbon dioxide (series J of Box and Jenkins)",
    "heat_exchanger": "steam heat exchanger: flow and outlet temperature",
    "robot_arm": "flexible arm: torque and acceleration",
    "actuator": "hydraulic actuator of a crane: valve position and oil pressure",
    "vic_elec": "electricity demand and temperature of Victoria, Australia, half-hourly",
    "wh_process_noise": "Wiener-Hammerstein electronic circuit with process noise",
    "lti": "simulated linear system, for checks with a known truth",
    "wiener": "simulated linear system behind a positive part",
}


class InvalidInput(click.ClickException):
    """Input that a user can put right: one line, exit code 2."""

    exit_code = 2


@dataclass(frozen=True)
class Parts:
    """What a fit is trained and tested on.

    Attributes:
        train: training records. test: None where all samples are trained on.
        skip: number of first test samples that are not scored.
        follows: whether the test comes right after the (one) training record.
    """

    train: tuple[Record, ...]
    test: Record | None = None
    skip: int = 0
    follows: bool = False


def existing(subject: str) -> Path:
    """Path of a file that exists, or a complaint that names the data sets."""
    path = Path(subject)
    if not path.is_file():
        raise InvalidInput(
            f"{subject}: neither a file nor a data set; the data sets are {', '.join(DATASETS)}."
        )
    return path


def training_and_test(
    data: str,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    units: tuple[str, ...],
    clock: dict[str, Any],
    train: int | None,
) -> Parts:
    """Read a CSV file or a data set, and split it.

    Args:
        data: file or name. inputs: names of columns. outputs: names of columns.
        units: NAME=UNIT of these columns. clock: options of `Record.from_csv` about time.
        train: number of training samples; None for all of a file, or for the split of a data set.
    """
    if data in DATASETS:
        _refuse(data, clock | {"unit": units})
        dataset = _selected(data, inputs, outputs)
        if train is None:
            first = dataset.train
            several = first if isinstance(first, tuple) else (first,)
            return Parts(several, dataset.test, dataset.skip, dataset.full is not None)
        if dataset.full is None:
            raise InvalidInput(f"--train: {data} is not one record to split; leave it out.")
        before, after = dataset.full.split(train)
        return Parts((before,), after, dataset.skip, follows=True)
    path = existing(data)
    if not outputs:
        raise InvalidInput(
            f"--output: name one output column or more; pyro-dynogp info {path} lists the columns."
        )
    known = _units(units, (*inputs, *outputs))
    record = _from_csv(
        path,
        inputs,
        outputs,
        clock,
        input_units=[known.get(name, "") for name in inputs],
        output_units=[known.get(name, "") for name in outputs],
    )
    if train is None:
        return Parts((record,))
    before, after = record.split(train)
    return Parts((before,), after, follows=True)


def record_for(fitted: Fit, data: str, clock: dict[str, Any]) -> tuple[Record, bool]:
    """Record with the channels of a fit, and whether its outputs were measured.

    Args:
        fitted: the fit, in whose units the columns of a file are taken to be.
        data: file or name of a data set. clock: options of `Record.from_csv` about time.
    """
    from pyro_dynogp._text_table import read_table

    scaling = fitted.scaling
    if data in DATASETS:
        _refuse(data, clock)
        return _selected(data, scaling.input_names, scaling.output_names).test, True
    path = existing(data)
    columns = read_table(path, None, None, None, None, "utf-8-sig").columns
    measured = all(name in columns for name in scaling.output_names)
    record = _from_csv(
        path,
        scaling.input_names,
        scaling.output_names if measured else (),
        clock | {"time_unit": clock["time_unit"] or scaling.time_unit},
        input_units=scaling.input_units,
        output_units=scaling.output_units if measured else (),
    )
    return record, measured


def _from_csv(
    path: Path,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    clock: dict[str, Any],
    **units: Any,
) -> Record:
    from pyro_dynogp.record import Record

    # The reader complains likewise, but in terms of Python arguments.
    if (clock["time"] is None) == (clock["sampling_time"] is None):
        raise InvalidInput("--time COLUMN or --sampling-time S: give one of the two.")
    clock = clock | {"time_unit": clock["time_unit"] or "s"}
    return Record.from_csv(path, inputs, outputs, extra=None, **clock, **units)


def _units(pairs: tuple[str, ...], names: tuple[str, ...]) -> dict[str, str]:
    units = {}
    for pair in pairs:
        name, mark, unit = pair.partition("=")
        if not mark or name not in names:
            raise InvalidInput(
                f"--unit: expected NAME=UNIT with the name of an input or output, got {pair!r}."
            )
        units[name] = unit
    return units


def _refuse(data: str, options: dict[str, Any]) -> None:
    """Refuse what only a file needs."""
    for name in ("time", "sampling_time", "timezone", "time_unit", "unit"):
        if options.get(name):
            raise InvalidInput(
                f"--{name.replace('_', '-')}: for CSV files; the data set {data} has its own clock "
                "and units."
            )


def _selected(name: str, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> Dataset:
    """Data set with the given channels, or with its own where none are given."""
    from pyro_dynogp import datasets

    def chosen(record: Record) -> Record:
        return record.select(inputs=inputs or None, outputs=outputs or None)

    data = datasets.load(name)
    train = data.train
    return replace(
        data,
        train=tuple(map(chosen, train)) if isinstance(train, tuple) else chosen(train),
        test=chosen(data.test),
        full=None if data.full is None else chosen(data.full),
    )
