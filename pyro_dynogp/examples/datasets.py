"""Measured records that ship with the package, and simulated ones, with their test protocols.

`data/README.md` beside the files tells where each comes from and what its columns are.

Examples:
    >>> furnace = dgp.datasets.load("gas_furnace")
    >>> len(furnace.train), furnace.full.input_names
    (148, ('InputGasRate',))
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any

from pyro_dynogp.data.record import Record
from pyro_dynogp.examples.simulators import Simulation, Truth, simulate_lti, simulate_wiener
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.shown import shown

_DAISY = "B. De Moor (ed.), DaISy: Database for the Identification of Systems, KU Leuven"
_DRIVES = (
    "T. Wigren and M. Schoukens, Coupled electric drives data set and reference models, "
    "Technical report 2017-024, Uppsala University, 2017"
)
_STUDY = "dynoGP: Deep Gaussian Processes for dynamic system identification"
_CIRCUIT_FILE = "WH_EstimationExample.csv"


@shown
@dataclass(repr=False, frozen=True, kw_only=True)
class Dataset:
    """A data set with its test protocol.

    Attributes:
        name: name that `load` knows.
        train: record (or records) to learn from.
        test: record to test on.
        source: citation.
        protocol: what is trained and tested on, in a sentence.
        skip: number of first test samples that may set the initial state and are not counted.
        full: the whole record, where train and test are parts of one.
        truth: the system behind simulated data.
    """

    name: str
    train: Record | tuple[Record, ...]
    test: Record
    source: str
    protocol: str
    skip: int = 0
    full: Record | None = None
    truth: Truth | None = None


def names() -> tuple[str, ...]:
    """List the names that `load` knows."""
    return tuple(_LOADERS)


def load(name: str, **options: Any) -> Dataset:
    """Load a data set by its name; see `names`.

    Args:
        name: one of

            - "coupled_drives" (record=1 or 2; default 2) and "coupled_drives_prbs" (record=1, 2
              or 3): two electric drives, belt and pulley.
            - "gas_furnace": gas rate and carbon dioxide, series J of Box and Jenkins.
            - "heat_exchanger": steam heat exchanger.
            - "robot_arm": flexible arm.
            - "actuator": hydraulic actuator of a crane.
            - "vic_elec" (test="paper" or "2014"): electricity demand of Victoria, Australia.
            - "wh_process_noise" (test="multisine" or "swept sine"; path=folder of the original
              file, for all ten training records): Wiener-Hammerstein circuit with process noise.
            - "lti", "wiener" (seed=0 and the options of the simulator): simulated.
        **options: as named above.

    Returns:
        The data set.

    Raises:
        ValueError: an unknown name or option, or a value that an option does not have.
        FileNotFoundError: the original file is not in `path`.
    """
    if not isinstance(name, str) or name not in _LOADERS:
        raise invalid("name", expected=f"one of {list(_LOADERS)}", got=repr(name))
    known = list(inspect.signature(_LOADERS[name]).parameters)
    for option in options:
        if option not in known:
            raise invalid(
                "options", expected=f"for {name!r} among {known}" if known else "none",
                got=repr(option),
            )  # fmt: skip
    return _LOADERS[name](**options)


def _read(file: str, inputs: list[str], output: str, **options: Any) -> Record:
    source = resources.files(__package__).joinpath("records", f"{file}.csv.xz")
    with resources.as_file(source) as path:
        return Record.from_csv(path, inputs, output=output, **options)


def _one_of(option: str, value: Any, allowed: tuple[Any, ...]) -> None:
    if isinstance(value, bool) or value not in allowed:
        raise invalid(option, expected=f"one of {list(allowed)}", got=repr(value))


def _parts(name: str, record: Record, k: int, source: str, skip: int = 0) -> Dataset:
    train, test = record.split(k)
    return Dataset(
        name=name, train=train, test=test, source=source, skip=skip, full=record,
        protocol=f"Train on the first {k} samples, test on the last {len(test)}.",
    )  # fmt: skip


def _coupled_drives(record: int = 2) -> Dataset:
    _one_of("record", record, (1, 2))
    return _drives("coupled_drives", "coupled_drives_uniform", f"1{record}")


def _coupled_drives_prbs(record: int = 1) -> Dataset:
    _one_of("record", record, (1, 2, 3))
    return _drives("coupled_drives_prbs", "coupled_drives_prbs", str(record))


def _drives(name: str, file: str, k: str) -> Dataset:
    data = _read(
        file, [f"u{k}"], f"z{k}", extra=None, sampling_time=0.02, input_units=["V"],
        name=f"{name} {k}",
    )  # fmt: skip
    return _parts(name, _renamed(data, y="z"), 400, _DRIVES, skip=4)


def _gas_furnace() -> Dataset:
    data = _read(
        "gas_furnace", ["InputGasRate"], "CO2", sampling_time=9.0, output_units=["%"],
        name="gas_furnace",
    )  # fmt: skip
    source = "G. E. P. Box and G. M. Jenkins, Time Series Analysis: Forecasting and Control, 1970"
    return _parts("gas_furnace", data, 148, f"{source}, series J")


def _heat_exchanger() -> Dataset:
    data = _read("heat_exchanger", ["q"], "th", time="time", name="heat_exchanger")
    source = (
        "S. Bittanti and L. Piroddi, Nonlinear identification and control of a heat exchanger: a "
        f"neural network approach, Journal of the Franklin Institute, 1996; {_DAISY}"
    )
    return _parts("heat_exchanger", data, 2000, source)


def _robot_arm() -> Dataset:
    data = _read("robot_arm", ["u"], "y", sampling_time=1.0, time_unit="sample", name="robot_arm")
    return _parts("robot_arm", data, 512, _DAISY)


def _actuator() -> Dataset:
    data = _read("actuator", ["u"], "p", sampling_time=1.0, time_unit="sample", name="actuator")
    source = (
        "J. Sjöberg et al., Nonlinear black-box modeling in system identification: a unified "
        "overview, Automatica 31, 1995"
    )
    return _parts("actuator", data, 512, source)


def _vic_elec(test: str = "paper") -> Dataset:
    _one_of("test", test, ("paper", "2014"))
    full = _read(
        "vic_elec", ["Temperature"], "Demand", time="Time", timezone="Australia/Melbourne",
        input_units=["degC"], output_units=["MW"], name="vic_elec",
    )  # fmt: skip
    paper, year_2014 = full.split(35040)
    train, second_half = paper.split(35040 - 48 * 182)
    protocol = f"Train on the first {len(train)} half-hours (January 2012 to early July 2013), "
    if test == "paper":
        protocol += f"test on the {len(second_half)} that follow, to 30 December 2013."
    else:
        protocol += f"test on the {len(year_2014)} from 31 December 2013 to the end of 2014."
    source = (
        "Australian Energy Market Operator (demand) and Bureau of Meteorology (temperature), "
        "through the R package tsibbledata"
    )
    chosen = second_half if test == "paper" else year_2014
    return Dataset(
        name="vic_elec", train=train, test=chosen, source=source, protocol=protocol, full=full
    )


def _wh_process_noise(test: str = "multisine", path: str | PathLike[str] | None = None) -> Dataset:
    _one_of("test", test, ("multisine", "swept sine"))
    step = 1 / 78125
    units: dict[str, Any] = {"input_units": ["V"], "output_units": ["V"]}
    train: Record | tuple[Record, ...]
    if path is None:
        train = _read(
            "wh_process_noise_train", ["u"], "y", sampling_time=step, extra_units={"r": "V"},
            name="wh_process_noise 0", **units,
        )  # fmt: skip
    else:
        train = _ten_realisations(Path(path), step, units)
    k = ("multisine", "swept sine").index(test)
    recorded = _read(
        "wh_process_noise_test", [f"u_{k}"], f"y_{k}", extra=[f"r_{k}"], sampling_time=step,
        extra_units={f"r_{k}": "V"}, name=f"wh_process_noise {test}", **units,
    )  # fmt: skip
    count = "realisation 0" if isinstance(train, Record) else f"all {len(train)} realisations"
    return Dataset(
        name="wh_process_noise", train=train, test=_renamed(recorded),
        source="M. Schoukens and J. P. Noël, Three benchmarks addressing open challenges in "
        "nonlinear system identification, IFAC-PapersOnLine 50, 2017",
        protocol=f"Train on {count} (process noise), test on the {test} record (no process noise).",
    )  # fmt: skip


def _ten_realisations(folder: Path, step: float, units: dict[str, Any]) -> tuple[Record, ...]:
    file = folder / _CIRCUIT_FILE
    if not file.is_file():
        raise FileNotFoundError(
            f"path: expected a folder with {_CIRCUIT_FILE}, got {folder} without it. The package "
            "holds realisation 0 alone (leave path out); the file with all ten comes with the "
            "Wiener-Hammerstein process noise benchmark of nonlinearbenchmark.org."
        )
    whole = Record.from_csv(file, sampling_time=step, name="wh_process_noise")
    return tuple(
        _renamed(
            Record(
                whole.time, whole.extra[f"u_{k}"], whole.extra[f"y_{k}"],
                input_names=[f"u_{k}"], output_names=[f"y_{k}"],
                extra={f"r_{k}": whole.extra[f"r_{k}"]}, extra_units={f"r_{k}": "V"},
                name=f"wh_process_noise {k}", **units,
            )
        )
        for k in range(10)
    )  # fmt: skip


def _renamed(record: Record, u: str = "u", y: str = "y") -> Record:
    """Name the channels alike in all experiments on a system, so that they go together."""
    return dataclasses.replace(
        record, input_names=(u,), output_names=(y,),
        extra={key.split("_")[0]: values for key, values in record.extra.items()},
        extra_units={key.split("_")[0]: unit for key, unit in record.extra_units.items()},
    )  # fmt: skip


def _simulated(name: str, simulator: Callable[..., Simulation], options: dict[str, Any]) -> Dataset:
    run = simulator(**options)
    return Dataset(
        name=name, train=run.train, test=run.test,
        source=f"Simulated by pyro_dynogp, after the study in: {_STUDY}",
        protocol=f"Train on the first {len(run.train)} samples, test on the {len(run.test)} that "
        "follow, where no process noise acts.",
        full=run.full, truth=run.truth,
    )  # fmt: skip


def _simulation_loader(name: str, simulator: Callable[..., Simulation]) -> Callable[..., Dataset]:
    def loader(**options: Any) -> Dataset:
        return _simulated(name, simulator, options)

    loader.__signature__ = inspect.signature(simulator)  # type: ignore[attr-defined]
    return loader


_LOADERS: dict[str, Callable[..., Dataset]] = {
    "coupled_drives": _coupled_drives,
    "coupled_drives_prbs": _coupled_drives_prbs,
    "gas_furnace": _gas_furnace,
    "heat_exchanger": _heat_exchanger,
    "robot_arm": _robot_arm,
    "actuator": _actuator,
    "vic_elec": _vic_elec,
    "wh_process_noise": _wh_process_noise,
    "lti": _simulation_loader("lti", simulate_lti),
    "wiener": _simulation_loader("wiener", simulate_wiener),
}
