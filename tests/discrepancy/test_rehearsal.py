"""Whether what an effect adds goes on as it has begun: drifts are put to the test twice."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data.channels import Ramp, RampOfGain
from pyro_dynogp.discrepancy import rehearsal
from pyro_dynogp.discrepancy.rehearsal import held_errors, is_worse, last_half, lasting
from pyro_dynogp.discrepancy.trials import Trial, run
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.variants import with_channel
from pyro_dynogp.statistics.evidence import Evidence
from pyro_dynogp.statistics.settings import LoopSettings
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.test_loop import N, fitted, machine

KNOWN, A = 360, 240
RUN = Run(0, workers=1)


@pytest.mark.parametrize(("ratio", "worse"), [(0.5, False), (1.04, False), (1.06, True)])
def test_worse_is_by_more_than_five_percent_in_the_root_mean_square(ratio, worse):
    held = np.resize([1.0, -2.0, np.nan], (90, 1)) * [1.0, 1000.0]  # outputs in any unit
    assert is_worse(ratio * held, held, SETTINGS) is worse
    assert is_worse(ratio * held, held, LoopSettings(worse=1.2 * ratio)) is False


def test_the_later_half_is_of_what_was_measured():
    record = machine()
    assert np.flatnonzero(last_half(record))[0] == N // 2
    y = record.outputs.copy()
    y[:160] = np.nan
    assert np.flatnonzero(last_half(record.with_outputs(y)))[0] == 320


def with_level(added: np.ndarray) -> dgp.Record:
    record = machine(seed=3)
    return record.with_outputs(record.outputs[:, 0] + added)


def test_the_base_is_held_at_the_level_before_each_stretch():
    """Two steps: the errors of what is held are the noise, those of a forecast are the steps."""
    steps = 1.0 * (np.arange(N) >= 250) - 3.0 * (np.arange(N) >= 330)
    record = with_level(steps)[:KNOWN]
    fit = fitted(machine(seed=3))
    fold = np.zeros(KNOWN, dtype=bool)
    fold[280:300] = fold[345:] = True
    error = held_errors(fit, record, fold, SETTINGS)[:, 0]
    assert np.isnan(error[~fold]).all()
    # Noise of 0.05, less that of a mean of ten.
    assert np.sqrt(np.mean(error[fold] ** 2)) == pytest.approx(0.05 * np.sqrt(1.1), rel=0.3)
    left = record.outputs[:, 0] - fit.simulate(record, seed=0).mean[:, 0]
    for first, part in ((280, slice(280, 300)), (345, slice(345, KNOWN))):
        np.testing.assert_allclose(error[part], left[part] - left[first - 10 : first].mean())
    # Over many samples the level before the steps comes in.
    long = held_errors(fit, record, fold, LoopSettings(level_samples=200))[:, 0]
    assert np.abs(np.mean(long[280:300])) > 0.5


def variants(record: dgp.Record, base: dgp.Fit) -> tuple[Any, ...]:
    where = {"form": "additive", "channel": ""}
    evidence = Evidence("drift", 1.0, 1e-9, 1.0, 1.0, where)
    return tuple(effects.Drift().extend(replace(base.model, scaling=None), evidence, record))


def tried(added: np.ndarray) -> tuple[list[bool], bool]:
    """Whether the line and the path last, and whether the line is kept."""
    record = with_level(added)[:KNOWN]
    base = fitted(record)
    models = variants(record, base)
    fold = np.arange(KNOWN) >= A
    fits = [refit(base, record[:A], model=model, run=RUN) for model in models]
    found = lasting(fits, base, record, fold, RUN, SETTINGS)
    kept = run(Trial(models, record, (fold,), base, 0, SETTINGS, "forecast", compared="held out"))
    assert not kept.failure
    return [any(fit is one for one in found) for fit in fits], bool(kept.model.channels)


def test_a_line_lasts_and_is_kept():
    (line, _), kept = tried(np.arange(N) / N)
    assert line
    assert kept


@pytest.mark.parametrize("until", [A // 2, A])
def test_a_line_that_ends_in_either_rehearsal_is_not_kept(until):
    """Held at its last level it is forecast better there, whatever the other stretch says."""
    (line, _), kept = tried(np.minimum(np.arange(N), until) / 120.0)
    assert not line
    assert not kept


def test_a_first_half_that_cannot_be_fitted_says_nothing(monkeypatch):
    record = with_level(np.arange(N) / N)[:KNOWN]
    base = fitted(record)
    fits = [refit(base, record[:A], model=variants(record, base)[0], run=RUN)]

    def refused(*given: Any, **options: Any) -> Any:
        raise ValueError("the input never moves")

    monkeypatch.setattr(rehearsal, "refit", refused)
    assert lasting(fits, base, record, np.arange(KNOWN) >= A, RUN, SETTINGS) == fits


def test_a_path_that_has_not_begun_in_the_first_half_says_nothing_and_others_are_rehearsed():
    """The level rises in the second half of the training data alone, and stays."""
    record = with_level(np.interp(np.arange(N), [A // 2 + 9, A - 20], [0.0, 1.0]))[:KNOWN]
    base = fitted(record)
    own = replace(base.model, scaling=None)
    late = with_channel(own, Ramp(float(record.time[A // 2 + 9]), float(record.time[A - 20])))
    fits = [refit(base, record[:A], model=m, run=RUN) for m in (variants(record, base)[0], late)]
    assert lasting(fits, base, record, np.arange(KNOWN) >= A, RUN, SETTINGS) == fits[1:]


def test_a_gain_that_falls_and_stays_is_a_path():
    """A line goes on falling."""
    rng = np.random.default_rng(6)
    u = np.repeat(rng.standard_normal(N // 6), 6) + 1.0
    gain = np.interp(np.arange(N), [0, 80, 200], [1.0, 0.9, 0.5])
    y = lfilter([0, 0.3], [1, -0.7], gain * u) + 0.02 * rng.standard_normal(N)
    record = dgp.Record(np.arange(N) * 0.5, u, y)
    report = dgp.close_loop(
        fitted(record), record, effects=(effects.Drift(), effects.LevelShift()), workers=1,
        progress=False,
    )  # fmt: skip
    assert [one.name for one in report.effects] == ["drift"]
    channels = report.fit.model.channels
    assert {type(one) for one in channels} == {RampOfGain, Ramp}
    gains = [one for one in channels if isinstance(one, RampOfGain)]
    fallen = {k: v for k, v in report.effects[0].parameters.items() if "times ramp" in k}
    assert len(fallen) == len(gains) == 4
    # Each has a standard deviation of 0.01 to 0.02.
    assert sum(mean for mean, _ in fallen.values()) == pytest.approx(-0.5, abs=0.03)
    assert report.before["rmse"] > 3.0 * report.after["rmse"]
    assert report.after["rmse"] < 1.15 * 0.02  # the noise


def test_variants_that_begin_after_the_training_data_are_passed_over():
    record = with_level(np.arange(N) / N)[:KNOWN]
    base = fitted(record)
    line = variants(record, base)[0]
    later = with_channel(replace(base.model, scaling=None), Ramp(float(record.time[A]), 175.0))
    fold = np.arange(KNOWN) >= A
    trial = Trial((later, line), record, (fold,), base, 0, SETTINGS, compared="rehearsed")
    assert run(trial).model == line
    alone = run(replace(trial, models=(later,)))
    assert alone.failure == "'ramp 120 to 175' is constant on the training block"
