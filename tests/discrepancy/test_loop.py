"""The loop from end to end, on small records with few effects to look for."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data.channels import Transformed
from pyro_dynogp.data.record import Record
from pyro_dynogp.models.variants import Model, with_channel
from pyro_dynogp.statistics.detecting import lasting
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import evidence
from pyro_dynogp.statistics.regression import with_past
from pyro_dynogp.statistics.settings import LoopSettings

FEW = (effects.ExtraInput(), effects.LevelShift(), effects.HeavyTails())
N = 480


def machine(seed: int = 0, weight: float = 0.0, **options: Any) -> dgp.Record:
    """One pole, noise of 5 %; `weight` times channel "heat" acts, "wind" does not."""
    rng = np.random.default_rng(seed)
    time = np.arange(N) * 0.5
    u = np.repeat(rng.standard_normal(N // 6), 6)
    heat, wind = (lfilter([0.5], [1, -0.85], rng.standard_normal(N)) for _ in range(2))
    y = lfilter([0, 0.3], [1, -0.7], u) + weight * lfilter([0, 0.4], [1, -0.6], heat)
    y = y + 0.05 * rng.standard_normal(N)
    settings = {"output_units": ("rpm",), "input_units": ("V",), **options}
    return dgp.Record(time, u, y, extra={"wind": wind, "heat": heat}, **settings)


def fitted(record: dgp.Record) -> dgp.Fit:
    model = dgp.LinearDynamicGP(inputs=1, pairs=1, process_noise=False)
    return dgp.fit(model, record[:240], restarts=2, workers=1, progress=False, method="map")


def close(fit: dgp.Fit, record: dgp.Record, **options: Any) -> Any:
    given = {"effects": FEW, "max_rounds": 1, "workers": 1, "progress": False, **options}
    return dgp.close_loop(fit, record, **given)


@pytest.fixture(scope="module")
def found() -> Any:
    record = machine(weight=0.3)
    return close(fitted(record), record)


def test_a_channel_that_acts_is_found_added_and_pays_on_the_sealed_block(found: Any) -> None:
    assert [one.name for one in found.effects] == ["extra input"]
    assert "'heat'" in found.effects[0].sentence
    assert "rpm" in found.effects[0].sentence
    assert found.outcome == "effects added"
    assert found.after["rmse"] < 0.06 < 2.0 * 0.06 < found.before["rmse"]  # the noise is 0.05
    assert found.elpd_gain > 2.0 * found.elpd_gain_error
    before, after = found.last_block_tests["extra input"]
    assert before < 0.01 < after
    assert found.fit.model.inputs == 2
    assert len(found.sealed) == 120
    assert "240 samples" in found.data


def test_the_report_can_be_kept_and_read(found: Any, tmp_path: Path) -> None:
    found.to_json(tmp_path / "report.json")
    plain = json.loads((tmp_path / "report.json").read_text())
    assert plain["effects"][0]["name"] == "extra input"
    assert plain["before"]["rmse"] == pytest.approx(found.before["rmse"])
    found.to_html(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "heat" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    found.fit.save(tmp_path / "fit.safetensors")
    again = dgp.load(tmp_path / "fit.safetensors")
    assert again.model.channels == found.fit.model.channels
    assert "extra input" in str(found)
    assert "   steady-state gain of heat [rpm]: " in str(found)


def test_units_and_the_order_of_channels_do_not_matter(found: Any) -> None:
    record = machine(weight=0.3)
    other = replace(
        record,
        outputs=1000.0 * record.outputs + 5.0,
        output_units=("mrpm",),
        extra={"heat": 60.0 * record.extra["heat"], "wind": record.extra["wind"]},
        extra_units={},
    )
    again = close(fitted(other), other)
    assert [one.name for one in again.effects] == ["extra input"]
    assert "'heat'" in again.effects[0].sentence
    assert again.effects[0].p_value == pytest.approx(found.effects[0].p_value, rel=1e-2)
    assert again.after["rmse"] == pytest.approx(1000.0 * found.after["rmse"], rel=1e-2)
    assert again.after["nrmse"] == pytest.approx(found.after["nrmse"], rel=1e-2)


def test_nothing_is_added_where_nothing_is_missing() -> None:
    record = machine(seed=5)
    report = close(fitted(record), record)
    assert report.effects == ()
    assert report.outcome == "nothing missing"
    assert report.before == report.after
    assert report.fit is report.base is report.extended


def test_every_test_is_listed_where_nothing_is_missing() -> None:
    """Two channels, a step, the tails of the noise, and whether there is any structure at all."""
    record = machine(seed=5)
    report = close(fitted(record), record)
    listed = {(one.effect, one.place.partition(" ")[0]) for one in report.tests}
    assert listed == {
        ("extra input", "heat"), ("extra input", "wind"), ("level shift", "time"),
        ("heavy tails", ""), ("any structure", ""),
    }  # fmt: skip
    assert len(report.tests) == len(listed)
    for one in report.tests:
        assert one.output == "y"
        assert one.round == 1
        assert one.decision == "not significant"
        assert 0.0 < one.p_value <= 1.0
        assert one.q_value > 0.025  # half of the level is what each of the two answers has
    assert report.last_block_tests == {}
    rows = report.to_dict()["tests"]
    assert len(rows) == 5
    assert set(rows[0]) == {
        "round", "effect", "output", "place", "p_value", "q_value", "decision"
    }  # fmt: skip


def test_tests_say_what_became_of_them(found: Any) -> None:
    first = [one for one in found.tests if one.round == 1]
    decisions = {(one.effect, one.place): one.decision for one in first}
    assert decisions["extra input", "heat"] == "accepted"
    assert {one.round for one in found.tests} == {1, 2}  # what the extended model leaves
    by_name = {(one.name, one.channel): one.decision for one in found.attempts if one.round == 1}
    for one in first:
        key = (one.effect, one.place if one.effect == "extra input" else "")
        assert by_name.get(key, one.decision) == one.decision
    kept = [one for one in found.to_dict()["attempts"] if one["decision"] == "accepted"]
    assert [(one["channel"], one["output"]) for one in kept] == [("heat", "y")]


def test_candidates_can_be_named(found: Any) -> None:
    record = machine(weight=0.3)
    fit = fitted(record)
    report = close(fit, record, candidates=["wind"], effects=FEW[:1])
    assert report.effects == ()
    assert report.outcome == "structure left, cause unknown"
    with pytest.raises(ValueError, match="extra channels"):
        close(fit, record, candidates=["sun"])
    with pytest.raises(ValueError, match="max_rounds"):
        close(fit, record, max_rounds=0)
    with pytest.raises(ValueError, match="level"):
        close(fit, record, level=2.0)


class SquaredInput(effects.Effect):
    """An effect of a user's own."""

    name = "squared input"
    family = "shapes"
    acts_on = "inputs"

    def detect(
        self, residuals: Residuals, settings: LoopSettings, seed: int = 0
    ) -> Sequence[Evidence]:
        u = residuals.inputs[:, 0] - residuals.inputs[:, 0].mean()
        result = lasting(residuals, [with_past(u**2)], None, settings, seed)
        return [evidence(self.name, result, {}, "The input acts squared, too.", None)]

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        return [with_channel(model, Transformed("u", "square", float(record.inputs.mean())))]


def test_an_effect_of_ones_own_is_looked_for() -> None:
    record = machine(seed=2)
    u = record.inputs[:, 0]
    bent = record.with_outputs(record.outputs[:, 0] + lfilter([0, 0.15], [1, -0.7], u**2))
    report = close(fitted(bent), bent, effects=(SquaredInput(),), max_rounds=2)
    assert [one.name for one in report.effects] == ["squared input"]
    assert report.after["rmse"] < 0.6 * report.before["rmse"]


def test_a_record_without_inputs() -> None:
    """Process noise is all that drives the model; what goes with inputs cannot be tested."""
    rng = np.random.default_rng(0)
    y = lfilter([1.0], [1.0, -1.6, 0.8], rng.standard_normal(N))
    y = y / y.std() + 0.05 * rng.standard_normal(N)
    y[270:] += 4.0
    record = dgp.Record(0.1 * np.arange(N), outputs=y)
    model = dgp.LinearDynamicGP(inputs=0, pairs=1)
    fit = dgp.fit(model, record[:240], restarts=2, workers=1, progress=False, method="map")
    looked_for = (effects.LevelShift(), effects.DeadTime(), effects.UnmodelledDynamics())
    report = close(fit, record, effects=looked_for)
    (found,) = report.effects
    assert found.name == "level shift"
    assert report.after["rmse"] < 0.7 * report.before["rmse"]
    (why,) = report.warnings
    assert why.startswith("Not tested for dead time, unmodelled dynamics: ")
    assert "no inputs" in why


def test_what_a_stuck_sensor_reports_is_no_effect() -> None:
    good = machine()
    y = good.outputs[:, 0].copy()
    y[340:400] = y[340]  # at the end of the block that is searched, and in the sealed one
    fit = fitted(good)
    found = close(fit, good.with_outputs(y))
    assert "'y' is stuck once, 60 samples in all" in found.warnings[0]
    assert found.outcome == "nothing missing"
    assert np.isnan(found.sealed.outputs[: 400 - len(found.known)]).all()
    # 80 of the 120 samples are scored: RMSEs of white errors over the one and the other differ by
    # sqrt(1 / 160 - 1 / 240) = 5 % (one standard deviation).
    assert found.before["rmse"] == pytest.approx(close(fit, good).before["rmse"], rel=0.15)
