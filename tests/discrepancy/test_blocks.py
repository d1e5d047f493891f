"""Which part of the data is for what."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.discrepancy.blocks import blocks_of
from pyro_dynogp.prediction.records import joined
from tests.discrepancy.made import SETTINGS


def record(n: int, begin: int = 0) -> dgp.Record:
    index = np.arange(begin, begin + n)
    return dgp.Record(
        index * 0.1, np.sin(index), np.cos(index * 1.0), extra={"w": np.sin(3.0 * index)}
    )


def fitted_to(*records: dgp.Record) -> Any:
    return SimpleNamespace(records=records)


def test_the_continuation_of_the_training_record_is_halved() -> None:
    whole = record(600)
    for given in (whole, whole[400:]):
        found = blocks_of(fitted_to(whole[:400]), given, None, SETTINGS)
        assert len(found.known) == 500
        assert found.held_out.sum() == 100
        assert not found.held_out[:400].any()
        np.testing.assert_allclose(found.known.time, whole.time[:500])
        np.testing.assert_array_equal(found.known.extra["w"], whole.extra["w"][:500])
        np.testing.assert_array_equal(found.sealed.outputs, whole.outputs[500:])
        assert not found.refit
        assert "400 samples" in found.sentence


def test_the_training_record_itself_is_cut_anew() -> None:
    whole = record(400)
    found = blocks_of(fitted_to(whole), whole, None, SETTINGS)
    assert (len(found.known), int(found.held_out.sum()), len(found.sealed)) == (300, 100, 100)
    assert found.refit


def test_other_outputs_than_those_of_the_fit_are_fitted_again() -> None:
    whole = record(600)
    other = whole.with_outputs(whole.outputs + 1.0)
    assert blocks_of(fitted_to(whole[:400]), other, None, SETTINGS).refit


def test_channels_of_another_record_become_candidates() -> None:
    whole = record(600)
    other = dgp.Record(whole.time, np.ones((600, 1)), None, input_names=("holiday",))
    found = blocks_of(fitted_to(whole[:400]), whole, other, SETTINGS)
    assert set(found.known.extra) == {"w", "holiday"}
    with pytest.raises(ValueError, match="candidates"):
        blocks_of(fitted_to(whole[:400]), whole, other[:50], SETTINGS)


def test_what_cannot_be_cut_is_refused() -> None:
    whole = record(600)
    with pytest.raises(ValueError, match="one training record"):
        blocks_of(fitted_to(whole[:100], whole[100:200]), whole, None, SETTINGS)
    with pytest.raises(ValueError, match="at least 120 samples"):
        blocks_of(fitted_to(whole[:100]), whole[:150], None, SETTINGS)
    with pytest.raises(ValueError, match="before the training record"):
        blocks_of(fitted_to(whole[100:400]), whole, None, SETTINGS)
    with pytest.raises(ValueError, match=r"outputs \['y'\] that were fitted, got \[\]"):
        blocks_of(fitted_to(whole[:400]), whole.select(outputs=[]), None, SETTINGS)
    stamped = replace_clock(whole)
    with pytest.raises(ValueError, match="same kind of clock"):
        blocks_of(fitted_to(whole[:400]), stamped, None, SETTINGS)


def replace_clock(one: dgp.Record) -> dgp.Record:
    return replace(one, start="2020-01-01T00:00Z")


def test_a_record_on_another_clock_is_put_on_that_of_the_training_record() -> None:
    first = replace_clock(record(400))
    later = replace(record(200), start=first.start + np.timedelta64(40, "s"))
    found = blocks_of(fitted_to(first), later, None, SETTINGS)
    np.testing.assert_allclose(np.diff(found.known.time), 0.1)


def test_joined_records_are_the_record_they_were() -> None:
    whole = record(50)
    again = joined(whole[:20], whole[20:])
    assert again == whole


def noisy(stuck: slice) -> dgp.Record:
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((2, 600))
    y[stuck] = 0.5
    return dgp.Record(np.arange(600) * 0.1, u, y)


@pytest.mark.parametrize("stuck", [slice(450, 490), slice(490, 520), slice(520, 550)])
def test_what_a_stuck_sensor_reports_is_missing_from_all_parts(stuck: slice) -> None:
    whole = noisy(stuck)
    found = blocks_of(fitted_to(whole[:400]), whole, None, SETTINGS)
    missing = np.concatenate([found.known.missing[:, 0], found.sealed.missing[:, 0]])
    assert list(np.flatnonzero(missing)) == list(range(600))[stuck]
    assert not found.refit
    assert [one.sentence.endswith("count as missing.") for one in found.faults] == [True]


def test_a_fit_to_a_stuck_sensor_is_made_again() -> None:
    whole = noisy(slice(100, 150))
    assert blocks_of(fitted_to(whole[:400]), whole, None, SETTINGS).refit


def test_too_few_measured_samples_are_refused() -> None:
    whole = record(600)
    y = whole.outputs.copy()
    y[510:] = np.nan
    with pytest.raises(ValueError, match="reported on, got 10 of 100"):
        blocks_of(fitted_to(whole[:400]), whole.with_outputs(y), None, SETTINGS)
