"""Variants of an effect are compared on the samples that all of them have."""

from dataclasses import dataclass

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Delayed
from pyro_dynogp.discrepancy import leading_variant
from pyro_dynogp.discrepancy.leading_variant import leading
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.delays import longest_delay
from pyro_dynogp.models.variants import with_channel

N, STEP, REACH = 200, 0.5, 1.2
PLAIN = dgp.LinearDynamicGP(1, pairs=1)
RECORD = dgp.Record(
    STEP * np.arange(N), np.sin(np.arange(N)), np.cos(np.arange(N)), input_names=["u"]
)


@dataclass(frozen=True)
class Made:
    """What stands for a fit."""

    model: dgp.Model


def later(samples):
    return with_channel(PLAIN, Delayed("u", STEP * samples))


def raced(monkeypatch, order):
    """Delays [samples] and measured samples of each race, where variants come in this order."""
    races = []

    def race(base, models, record, run):
        delays = [longest_delay(model) / STEP for model in models]
        races.append((delays, int((~np.isnan(record.outputs)).sum())))
        found = sorted(models, key=lambda model: order.index(longest_delay(model) / STEP))
        return [Made(model) for model in found], []

    monkeypatch.setattr(leading_variant, "race", race)
    return races


@pytest.mark.parametrize(
    ("order", "expected", "longest"),
    [
        ([4, 10, 2, 50, 20], [([2, 4, 10, 20, 50], N - 60), ([4, 10, 2], N - 12)], 12.0),
        ([4, 50, 2, 10, 20], [([2, 4, 10, 20, 50], N - 60)], 60.0),  # the longest is among them
    ],
)
def test_the_leading_ones_are_compared_again_on_what_their_delays_leave(
    monkeypatch, order, expected, longest
):
    races = raced(monkeypatch, order)
    models = [later(k) for k in (2, 4, 10, 20, 50)]
    best, same, most = leading(None, models, [], RECORD, REACH, Run(workers=1))
    assert races == expected
    assert best.model == later(4)
    assert int((~np.isnan(same.outputs)).sum()) == expected[-1][1]
    assert most == pytest.approx(longest * STEP)


def test_delays_that_are_to_come_count_at_first(monkeypatch):
    races = raced(monkeypatch, [5])
    leading(None, [later(5)], [later(40)], RECORD, REACH, Run(workers=1))
    assert races == [([5], N - 48), ([5], N - 6)]


def test_without_delays_there_is_one_comparison(monkeypatch):
    races = raced(monkeypatch, [0])
    _, same, longest = leading(None, [PLAIN], [PLAIN], RECORD, REACH, Run(workers=1))
    assert races == [([0], N)]
    assert same is RECORD
    assert longest == 0.0


def test_where_no_variant_can_be_fitted_the_first_reason_is_raised(monkeypatch):
    problems = [ValueError("this"), ValueError("that")]
    monkeypatch.setattr(leading_variant, "race", lambda *given: ([], problems))
    with pytest.raises(ValueError, match="this"):
        leading(None, [PLAIN], [], RECORD, REACH, Run(workers=1))
