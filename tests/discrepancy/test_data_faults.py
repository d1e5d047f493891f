"""Faults of the data: found where they are planted, and not where a record is only unusual."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp.discrepancy.data_faults import data_spikes, faults, without_stuck
from tests.discrepancy.made import SETTINGS

from .series import residuals


def record(seed: int = 0, n: int = 500, **fields: np.ndarray) -> dgp.Record:
    """An input that changes at every sample, an output with a memory, one more channel."""
    rng = np.random.default_rng(seed)
    u, w = rng.standard_normal((2, n))
    y = 10.0 + lfilter([0.0, 0.3], [1.0, -0.9], u) + 0.05 * rng.standard_normal(n)
    given = {"time": 0.5 * np.arange(n), "inputs": u, "outputs": y, **fields}
    return dgp.Record(**given, output_names=["speed"], extra={"wind": w})


def stuck(one: dgp.Record, candidates: tuple[str, ...] = ()) -> list[int]:
    return [int(k) for f in faults(one, candidates) if f.kind == "stuck" for k in f.samples]


def test_clean_records_have_none() -> None:
    assert not any(faults(record(seed), ["wind"]) for seed in range(20))
    assert not any(data_spikes(residuals(seed, 500), SETTINGS) for seed in range(20))


def test_each_is_found() -> None:
    y = record().outputs[:, 0].copy()
    y[100:112] = y[100]
    y[200:205] = np.nan
    y[300:320] = y[20:40]
    found = {f.kind: f for f in faults(record(outputs=y))}
    assert set(found) == {"stuck", "gap", "duplicate"}
    assert list(found["stuck"].samples) == list(range(100, 112))
    assert list(found["gap"].samples) == list(range(200, 205))
    assert list(found["duplicate"].samples) == list(range(300, 320))
    assert "12 samples in all, longest for 6 s from 50 s" in found["stuck"].sentence


def test_spike() -> None:
    r = residuals(0, 500)
    y = r.output.copy()
    y[400] += 30.0
    fault = data_spikes(replace(r, output=y), SETTINGS)
    assert fault is not None
    assert list(fault.samples) == [400]
    assert "has 1 spike of one sample" in fault.sentence
    y[300] += 40.0
    several = data_spikes(replace(r, output=y, output_unit=""), SETTINGS)
    assert several is not None
    assert "has 2 spikes of one sample" in several.sentence
    assert "  " not in several.sentence


def test_coarse_sensor_is_not_stuck() -> None:
    assert not faults(record(outputs=np.round(record().outputs, 1)))


@pytest.mark.parametrize("share", [0.8, 0.97, 0.99])
def test_limit_is_not_stuck_also_where_it_is_reached_once(share: float) -> None:
    for seed in range(10):
        y = record(seed, n=2000).outputs
        y = lfilter([0.02], [1.0, -0.98], y[:, 0])  # slow, so that it stays at the limit for long
        assert not stuck(record(seed, n=2000, outputs=np.minimum(y, np.quantile(y, share))))


def test_sensor_that_falls_to_the_end_of_its_range_is_stuck() -> None:
    y = record().outputs[:, 0].copy()
    y[300:330] = 0.0
    y[400:420] = 0.0
    assert stuck(record(outputs=y)) == [*range(300, 330), *range(400, 420)]


def test_output_may_rest_while_the_inputs_do() -> None:
    u, y = record().inputs[:, 0].copy(), record().outputs[:, 0].copy()
    u[:40], y[:40] = 0.0, 10.0
    assert not stuck(record(inputs=u, outputs=y))
    u[20] = 1.0
    assert stuck(record(inputs=u, outputs=y)) == list(range(40))


def test_stuck_candidate_and_skipped_rows() -> None:
    one = record()
    w = one.extra["wind"].copy()
    w[50:70] = w[50]
    late = one.time + 3.0 * (np.arange(len(one)) > 100)
    one = replace(one, time=late, extra={"wind": w})
    found = faults(one, ["wind"])
    assert [(f.kind, f.channel) for f in found] == [("gap", ""), ("stuck", "wind")]
    assert without_stuck(one, found) == one  # candidates are told of, not changed


def test_what_is_stuck_counts_as_missing_and_nothing_else() -> None:
    y = np.column_stack([record(0).outputs[:, 0], record(1).outputs[:, 0]])
    y[100:130, 1] = y[100, 1]
    two = dgp.Record(record().time, record().inputs, y, output_names=["speed", "force"])
    expected = y.copy()
    expected[100:130, 1] = np.nan
    np.testing.assert_array_equal(without_stuck(two, faults(two)).outputs, expected)
