"""Closing the loop on measured records whose effect nobody declares to the model.

Each case leaves something out that is known about the record, closes the loop with the same
defaults, and reports errors before and after on data that no step has seen.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Calendar
from pyro_dynogp.discrepancy.result import KEPT
from pyro_dynogp.examples import datasets

# Half-hours that are averaged, days of Melbourne's pleasant temperature [degC].
HALF_HOURS, COMFORT = 6, 18.0
HOME = "Australia/Melbourne"


@dataclass(frozen=True)
class Case:
    """A record, the model to start from, how much it is fitted to, and what it is not told."""

    record: dgp.Record
    model: dgp.LinearDynamicGP
    training: int
    missing: str


def drives(number: int) -> Case:
    """The sensor of the coupled drives reports the size of the speed alone."""
    full = datasets.load("coupled_drives", record=number).full
    assert full is not None
    # Without process noise, which would make up for the sensor.
    model = dgp.LinearDynamicGP(inputs=1, pairs=3, process_noise=False)
    return Case(full, model, 260, "the sensor reports the absolute speed")


def furnace() -> Case:
    """The gas of the furnace takes some samples to act on the carbon dioxide."""
    full = datasets.load("gas_furnace").full
    assert full is not None
    model = dgp.LinearDynamicGP(inputs=1, pairs=1)
    return Case(full, model, 148, "dead time (Box and Jenkins found 3 samples, 27 s)")


def demand(half_hours: int = HALF_HOURS) -> dgp.Record:
    """Victoria's electricity demand with degrees of heating and cooling, averaged.

    Extra channels: the public holidays, and decoys that are none (the holidays ten days late, the
    moon, a random walk).
    """
    full = datasets.load("vic_elec", test="2014").full
    assert full is not None
    n = len(full) // half_hours * half_hours

    def mean(x: np.ndarray) -> np.ndarray:
        return np.asarray(x[:n].reshape(-1, half_hours).mean(1))

    temperature, holiday = full.inputs[:, 0], full.extra["Holiday"]
    heating = mean(np.maximum(COMFORT - temperature, 0.0))
    cooling = mean(np.maximum(temperature - COMFORT, 0.0))
    hours = full.time[:n:half_hours] / 3600.0
    walk = np.random.default_rng(0).standard_normal(len(hours)).cumsum()
    flag = mean(holiday)
    return dgp.Record(
        full.time[:n:half_hours],
        np.column_stack([heating, cooling]),
        mean(full.outputs[:, 0])[:, None],
        input_names=("heating", "cooling"),
        input_units=("K", "K"),
        output_names=("demand",),
        output_units=("MW",),
        time_unit=full.time_unit,
        start=full.start,
        extra={
            "ten days later": np.roll(flag, 480 // half_hours),
            "moon": np.cos(2.0 * np.pi * hours / (24.0 * 29.53)),
            "walk": walk,
            "holiday": flag,
        },
        name="electricity demand of Victoria",
    )


def electricity(zone: str, missing: str, drop: Sequence[str] = ()) -> Case:
    """Calendar and temperature are known; 2012 is to fit, 2013 to search, 2014 to report on."""
    record = demand()
    for name in drop:
        record = record.with_extra_as_input(name)
    channels = (Calendar("hour of day by weekend", zone, 6), Calendar("time of year", zone, 4))
    direct = sum(len(one.names) for one in channels)
    model = dgp.LinearDynamicGP(
        inputs=record.n_inputs + direct, direct=direct, channels=channels, pairs=1
    )
    assert record.timestamps is not None
    training = int(np.searchsorted(record.timestamps, pd.Timestamp("2013-01-01", tz=HOME)))
    return Case(record, model, training, missing)


CASES: dict[str, Callable[[], Case]] = {
    "coupled drives 1": lambda: drives(1),
    "coupled drives 2": lambda: drives(2),
    "gas furnace": furnace,
    "electricity": lambda: electricity(HOME, "public holidays (in the extra channels)"),
    "electricity, clock in UTC": lambda: electricity(
        "UTC", "daylight saving: local time is not UTC + 10 h all year", ["holiday"]
    ),
}


def one(name: str, rounds: int = 3) -> dict[str, Any]:
    """Fit, close the loop, and what came of it."""
    case = CASES[name]()
    begin = time.perf_counter()
    fit = dgp.fit(case.model, case.record[: case.training], progress=False)
    fitted = time.perf_counter() - begin
    report = dgp.close_loop(fit, case.record, seed=0, max_rounds=rounds)
    return {
        "case": name,
        "missing": case.missing,
        "data": report.data,
        "effects": [[e.name, e.sentence, list(e.ties), e.p_value] for e in report.effects],
        "outcome": report.outcome,
        "before": dict(report.before),
        "after": dict(report.after),
        "gain": [report.elpd_gain, report.elpd_gain_error],
        "seconds": {"fit": fitted, **report.seconds},
        "attempts": [
            [a.round, a.name, a.evidence.p_value, a.decision, a.reason] for a in report.attempts
        ],
        "warnings": list(report.warnings),
    }


def _said(found: str, outcome: str) -> str:
    """What was found, or the outcome; both where the model before is kept."""
    return f"{found} ({outcome})" if outcome == KEPT else found or outcome


def run(folder: Path, names: Sequence[str] | None = None) -> str:
    """All cases, or some; each is also kept as JSON."""
    lines = [
        "| record | not told | found | RMSE before, after | CRPS | 95 % | elpd | minutes |",
        "|---|---|---|---|---|---|---|---|",
    ]
    folder.mkdir(parents=True, exist_ok=True)
    sentences = []
    for name in names or CASES:
        row = one(name)
        path = folder / f"measured {name.replace(',', '')}.json"
        path.write_text(json.dumps(row, indent=1))
        before, after = row["before"], row["after"]
        found = "; ".join(
            e[0] + (f" (or {', '.join(e[2])})" if e[2] else "") for e in row["effects"]
        )
        lines.append(
            f"| {name} | {row['missing']} | {_said(found, row['outcome'])} | "
            f"{before['rmse']:.4g}, {after['rmse']:.4g} | {before['crps']:.4g}, "
            f"{after['crps']:.4g} | {before['coverage_95']:.2f}, {after['coverage_95']:.2f} | "
            f"{row['gain'][0]:+.1f} ± {row['gain'][1]:.1f} | "
            f"{sum(row['seconds'].values()) / 60:.1f} |"
        )
        sentences += [f"- {name}: {e[1]}" for e in row["effects"]]
    return "\n".join([*lines, "", *sentences])
