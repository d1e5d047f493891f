"""Which stretches are held out where something happens at one instant."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pyro_dynogp.discrepancy.stretches import interleaved, latest, numbered, shared, stretches
from tests.discrepancy.made import SETTINGS


def test_folds_have_data_on_either_side_of_every_instant() -> None:
    first, second = interleaved(240, SETTINGS.folds)
    assert not (first & second).any()
    assert not (first | second)[:20].any()  # the past of the first forecast
    assert [part.stop - part.start for part in stretches(first)] == [20] * 6
    assert stretches(np.array([True, False, True, True])) == [slice(0, 1), slice(2, 4)]


@pytest.mark.parametrize("begin", [0, 15, 100, 181, 199, 200, 219, 220, 231, 238])
def test_something_late_is_fitted_to_and_held_out_in_both_folds(begin: int) -> None:
    folds = interleaved(240, SETTINGS.folds, begin)
    for fold in folds:
        assert fold[begin:].any()
        assert not fold[begin:].all()
    if 0 < begin < 200:  # two blocks of 20 lie after it as it is
        for one, other in zip(folds, interleaved(240, SETTINGS.folds), strict=True):
            np.testing.assert_array_equal(one, other)
    lengths = np.bincount(numbered(240, SETTINGS.folds, begin))
    assert lengths.max() <= 20
    assert lengths.min() >= 1


def test_half_of_the_block_that_is_searched_can_be_fitted_to() -> None:
    held_out = np.arange(480) >= 240
    some = shared(held_out, SETTINGS.stretches)
    assert some.sum() == 120
    assert some[-1]
    assert not some[:240].any()
    assert not some[240]


@pytest.mark.parametrize("begin", [240, 330, 450, 470, 477])
def test_so_can_half_of_what_is_after_an_instant(begin: int) -> None:
    some = shared(np.arange(480) >= 240, SETTINGS.stretches, begin)
    assert some[-1]
    assert not some[:240].any()
    assert 0 < some[begin:].sum() < 480 - begin


def test_the_latest_of_several_instants_counts() -> None:
    record: Any = SimpleNamespace(time=10.0 + 0.5 * np.arange(20))

    def at(value: float | None) -> Any:
        return SimpleNamespace(where={} if value is None else {"time": value})

    assert latest([at(12.0), at(11.0), at(None)], record) == 4
    assert latest([at(None)], record) == 0
    assert latest([], record) == 0
