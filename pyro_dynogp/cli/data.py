"""What the commands read: data sets by name, CSV files, and complaints about them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pyro_dynogp.cli.options import LAYOUT, Clock, Columns

if TYPE_CHECKING:
    from pyro_dynogp.data.record import Record
    from pyro_dynogp.data.text_table import TextTable
    from pyro_dynogp.examples.datasets import Dataset
    from pyro_dynogp.fitting import Fit

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


def training_and_test(data: str, columns: Columns, train: int | None) -> Parts:
    """Read a CSV file or a data set, and split it.

    Args:
        data: file or name. columns: what its columns are.
        train: number of training samples; None for all of a file, or for the split of a data set.
    """
    inputs, outputs = columns["inputs"], columns["outputs"]
    if data in DATASETS:
        _refuse(data, columns)
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
    record = _with_units(_from_csv(path, inputs, outputs, columns), columns["units"])
    if train is None:
        return Parts((record,))
    before, after = record.split(train)
    return Parts((before,), after, follows=True)


def table_of(path: Path, options: Mapping[str, Any]) -> TextTable:
    """The columns of a file, as the options say that it is written."""
    from pyro_dynogp.data.text_layout import Layout
    from pyro_dynogp.data.text_table import read_table

    return read_table(path, Layout(**{name: options[name] for name in LAYOUT}))


def record_for(fitted: Fit, data: str, clock: Clock, *, whole: bool = False) -> tuple[Record, bool]:
    """Record with the channels of a fit, and whether its outputs were measured.

    Args:
        fitted: the fit, in whose units the columns of a file are taken to be.
        data: file or name of a data set. clock: options of `Record.from_csv` about time.
        whole: of a data set the whole record, not the test alone.
    """
    scaling = fitted.scaling
    if data in DATASETS:
        _refuse(data, clock)
        dataset = _selected(data, scaling.input_names, scaling.output_names)
        if whole and dataset.full is None:
            raise InvalidInput(f"{data}: is not one record to forecast a part of.")
        return (dataset.full or dataset.test) if whole else dataset.test, True
    path = existing(data)
    columns = table_of(path, clock).columns
    measured = all(name in columns for name in scaling.output_names)
    record = _from_csv(
        path,
        scaling.input_names,
        scaling.output_names if measured else (),
        {**clock, "time_unit": clock["time_unit"] or scaling.time_unit},
        input_units=scaling.input_units,
        output_units=scaling.output_units if measured else (),
    )
    return record, measured


def whole_record(
    data: str, columns: Columns, candidates: tuple[str, ...], fitted: Fit | None = None
) -> tuple[Record, tuple[str, ...]]:
    """Read a CSV file or a data set with the channels that a model does not use.

    Args:
        data: file or name. columns: what its columns are.
        candidates: columns to keep as extra channels; none named for all that hold numbers.
        fitted: a saved fit, whose channels and units the record is to have.

    Returns:
        The record, and the columns left out since they hold text or nothing.
    """
    if fitted is not None:
        columns = _as_fitted(fitted, data, columns)
    inputs, outputs = columns["inputs"], columns["outputs"]
    if twice := set(candidates) & {*inputs, *outputs}:
        raise InvalidInput(f"--candidates: {sorted(twice)} are inputs or outputs already.")
    if data in DATASETS:
        _refuse(data, columns)
        record = _selected(data, inputs, outputs).full
        if record is None:
            raise InvalidInput(f"{data}: is not one record, which closing the loop needs.")
        unknown = [name for name in candidates if name not in record.extra]
        if unknown:
            raise InvalidInput(f"--candidates: {unknown} not among {list(record.extra)}.")
        kept = {name: record.extra[name] for name in candidates or record.extra}
        known = {name: record.extra_units[name] for name in kept}
        return replace(record, extra=kept, extra_units=known), ()
    path = existing(data)
    if not outputs:
        raise InvalidInput(
            f"--output: name one output column or more; pyro-dynogp info {path} lists the columns."
        )
    used = (*inputs, *outputs, columns["time"])
    extra, left_out = (candidates, ()) if candidates else _numeric(path, used, columns)
    record = _from_csv(path, inputs, outputs, columns, extra=extra)
    return _with_units(record, columns["units"]), left_out


def _as_fitted(fitted: Fit, data: str, columns: Columns) -> Columns:
    """Options with the channels of a fit, which need not be named again."""
    scaling = fitted.scaling
    for option, own, given in (
        ("inputs", scaling.input_names, columns["inputs"]),
        ("outputs", scaling.output_names, columns["outputs"]),
    ):
        if given and set(given) != set(own):
            raise InvalidInput(
                f"--{option[:-1]}: the saved fit has the {option} {list(own)}, got {list(given)}."
            )
    changed: Columns = {**columns, "inputs": scaling.input_names, "outputs": scaling.output_names}
    if data in DATASETS:
        return changed
    units = (*scaling.input_units, *scaling.output_units)
    names = (*scaling.input_names, *scaling.output_names)
    own_units = tuple(f"{name}={unit}" for name, unit in zip(names, units, strict=True))
    return {
        **changed,
        "units": (*own_units, *columns["units"]),
        "time_unit": columns["time_unit"] or scaling.time_unit,
    }


def _numeric(
    path: Path, used: tuple[str | None, ...], options: Mapping[str, Any]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Other columns of a file: those that hold numbers, and those that hold text or nothing."""
    import numpy as np

    table = table_of(path, options)
    kept: list[str] = []
    left_out: list[str] = []
    for name in table.columns:
        if name in used:
            continue
        try:
            some = bool(np.isfinite(table.numbers(name)).any())
        except ValueError:  # a cell that is no number
            some = False
        (kept if some else left_out).append(name)
    return tuple(kept), tuple(left_out)


def _from_csv(
    path: Path,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    clock: Clock,
    extra: tuple[str, ...] = (),
    **units: Any,
) -> Record:
    from pyro_dynogp.data.record import Record

    stated: Mapping[str, Any] = clock
    # The reader complains likewise, but in terms of Python arguments.
    if (clock["time"] is None) == (clock["sampling_time"] is None):
        raise InvalidInput("--time COLUMN or --sampling-time S: give one of the two.")
    return Record.from_csv(
        path, inputs, outputs, extra=extra, time=clock["time"],
        sampling_time=clock["sampling_time"], timezone=clock["timezone"],
        time_unit=clock["time_unit"], **units, **{name: stated[name] for name in LAYOUT},
    )  # fmt: skip


def _with_units(record: Record, stated: tuple[str, ...]) -> Record:
    """A record with units as stated, NAME=UNIT, in place of those of the file's row of units."""
    units: dict[str, str] = {}
    for pair in stated:
        name, mark, unit = pair.partition("=")
        if not mark or name not in (*record.input_names, *record.output_names, *record.extra):
            raise InvalidInput(
                f"--unit: expected NAME=UNIT with the name of a column that is read, got {pair!r}."
            )
        units[name] = unit

    def of(names: tuple[str, ...], own: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(units.get(name, unit) for name, unit in zip(names, own, strict=True))

    return replace(
        record,
        input_units=of(record.input_names, record.input_units),
        output_units=of(record.output_names, record.output_units),
        extra_units={name: units.get(name, unit) for name, unit in record.extra_units.items()},
    )


def _refuse(data: str, options: Clock | Columns) -> None:
    """Refuse what only a file needs."""
    for name in ("time", "sampling_time", "timezone", "time_unit", "units", *LAYOUT):
        if options.get(name):
            option = "unit" if name == "units" else name.replace("_", "-")
            raise InvalidInput(
                f"--{option}: for CSV files; the data set {data} has its own clock and units."
            )


def _selected(name: str, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> Dataset:
    """Data set with the given channels, or with its own where none are given."""
    from pyro_dynogp.examples import datasets

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
