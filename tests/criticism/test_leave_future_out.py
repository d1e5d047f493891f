"""Whether forecasts hold, from within the training record."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp.criticism import leave_future_out
from pyro_dynogp.criticism.leave_future_out import Stretch, _finding, forecast_findings

QUIET = {"workers": 1, "progress": False}
FIRST = dgp.LinearDynamicGP(1, pairs=1)


def machine(seed, n=200, slope=0.0):
    """First order, noise of 5 %, on a base line that rises."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 5), 5)
    a = np.exp(-0.1)
    y = lfilter([0.0, 1.0 - a], [1.0, -a], u) + slope * 0.1 * np.arange(n)
    return dgp.Record(time=0.1 * np.arange(n), inputs=u,
                      outputs=y + 0.05 * rng.standard_normal(n))  # fmt: skip


def test_a_trend_speaks_against_forecasts_though_one_step_ahead_all_is_well():
    found = dgp.check(dgp.fit(FIRST, machine(0, slope=0.05), **QUIET))
    assert found["one-step calibration"].good
    assert found["forecasts"].good is False
    assert found["forecasts"].value < 0.8
    assert "forecasts" in found.verdict
    assert "close_loop" in found["forecasts"].text


def test_right_models_raise_an_alarm_seldom():
    """At most 1 of 12: the share and the chance have to agree."""
    bad = 0
    for seed in range(12):
        fit = dgp.fit(FIRST, machine(seed, 150), method="map", **QUIET)
        bad += forecast_findings(fit)[0].good is False
    assert bad <= 1


def test_a_model_with_a_function():
    fit = dgp.fit(dgp.Wiener(1, pairs=1, inducing=4), machine(1, 80), method="map", restarts=1,
                  steps=20, **QUIET)  # fmt: skip
    (found,) = forecast_findings(fit)
    assert 0.0 <= found.value <= 1.0
    assert "by chance" not in found.text


def test_several_records_are_cut_at_the_same_shares(monkeypatch):
    fit = dgp.fit(FIRST, [machine(1, 100), machine(2, 60)], method="map", **QUIET)
    lengths = []

    def noted(fit, records, *, run):
        lengths.append([len(record) for record in records])
        return refit(fit, records, run=run)

    refit = leave_future_out.refit
    monkeypatch.setattr(leave_future_out, "refit", noted)
    (found,) = forecast_findings(fit)
    assert lengths == [[60, 36], [80, 48]]
    assert found.text.count("%") >= 5  # four stretches


def test_where_it_is_not_looked_at():
    short = dgp.fit(FIRST, machine(1, 55), method="map", **QUIET)
    (found,) = forecast_findings(short)
    assert found.good is None
    assert "60 samples or more are needed, there are 55" in found.text
    chains = SimpleNamespace(records=[machine(1)], collapsed=True, method="nuts")
    assert forecast_findings(chains)[0].good is None
    assert "forecasts" not in [one.name for one in dgp.check(short, forecasts=False).findings]


def test_a_part_that_cannot_be_fitted_is_said(monkeypatch):
    def refuse(*given, **options):
        raise ValueError("record: expected more.")

    fit = dgp.fit(FIRST, machine(3, 100), method="map", **QUIET)
    monkeypatch.setattr(leave_future_out, "refit", refuse)
    (found,) = forecast_findings(fit)
    assert found.good is None
    assert "the first 60 % cannot be fitted alone (record: expected more.)" in found.text


def test_bars_are_shown_where_they_are_wanted(capfd):
    fit = dgp.fit(FIRST, machine(1, 60), method="map", **QUIET)
    shown, quiet = dgp.check(fit, workers=1), dgp.check(fit, **QUIET)
    assert str(shown) == str(quiet)
    bars = capfd.readouterr().err
    assert "posterior: 100%" in bars
    assert "forecasts: 100%" in bars
    assert bars.count("\n") == 2  # none of the quiet one


@pytest.mark.parametrize(
    ("inside", "low", "known", "good"),
    [
        (79, 0, True, False),
        (80, 0, True, True),  # as many as asked
        (79, 19, True, False),  # (1 + 19) / 401 is below 5 %
        (79, 20, True, True),
        (79, 400, False, False),  # the share alone
        (80, 400, False, True),
    ],
)
def test_share_and_chance(inside, low, known, good):
    chance = np.where(np.arange(400) < low, 70, 95)
    found = _finding([Stretch(inside, 100, chance)], known)
    assert found.good is good
    assert found.value == pytest.approx(inside / 100)
    assert ("by chance" in found.text) is known


def test_stretches_count_together():
    chance = np.full(400, 50)
    found = _finding([Stretch(60, 100, chance), Stretch(95, 100, chance)], True)
    assert found.value == pytest.approx(0.775)
    assert "60 % and 95 %" in found.text
    assert found.good is True  # 100 inside of 200 is as probable
