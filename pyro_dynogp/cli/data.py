"""What the commands read: data sets by name, CSV files, and complaints about them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from pyro_dynogp.data.record import Record
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
    from pyro_dynogp.data.text_table import read_table

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


def whole_record(
    data: str,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    units: tuple[str, ...],
    clock: dict[str, Any],
    candidates: tuple[str, ...],
) -> tuple[Record, tuple[str, ...]]:
    """Read a CSV file or a data set with the channels that a model does not use.

    Args:
        data: file or name. inputs: names of columns. outputs: names of columns.
        units: NAME=UNIT of columns. clock: options of `Record.from_csv` about time.
        candidates: columns to keep as extra channels; none named for all that hold numbers.

    Returns:
        The record, and the columns left out since they hold text or nothing.
    """
    if twice := set(candidates) & {*inputs, *outputs}:
        raise InvalidInput(f"--candidates: {sorted(twice)} are inputs or outputs already.")
    if data in DATASETS:
        _refuse(data, clock | {"unit": units})
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
    used = (*inputs, *outputs, clock["time"])
    extra, left_out = (candidates, ()) if candidates else _numeric(path, used)
    known = _units(units, (*inputs, *outputs, *extra))
    record = _from_csv(
        path,
        inputs,
        outputs,
        clock,
        extra=extra,
        input_units=[known.get(name, "") for name in inputs],
        output_units=[known.get(name, "") for name in outputs],
        extra_units={name: known.get(name, "") for name in extra},
    )
    return record, left_out


def _numeric(path: Path, used: tuple[str | None, ...]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Other columns of a file: those that hold numbers, and those that hold text or nothing."""
    import numpy as np

    from pyro_dynogp.data.text_table import read_table

    table = read_table(path, None, None, None, None, "utf-8-sig")
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
    clock: dict[str, Any],
    extra: tuple[str, ...] = (),
    **units: Any,
) -> Record:
    from pyro_dynogp.data.record import Record

    # The reader complains likewise, but in terms of Python arguments.
    if (clock["time"] is None) == (clock["sampling_time"] is None):
        raise InvalidInput("--time COLUMN or --sampling-time S: give one of the two.")
    clock = clock | {"time_unit": clock["time_unit"] or "s"}
    return Record.from_csv(path, inputs, outputs, extra=extra, **clock, **units)


def _units(pairs: tuple[str, ...], names: tuple[str, ...]) -> dict[str, str]:
    units = {}
    for pair in pairs:
        name, mark, unit = pair.partition("=")
        if not mark or name not in names:
            raise InvalidInput(
                f"--unit: expected NAME=UNIT with the name of a column that is read, got {pair!r}."
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
