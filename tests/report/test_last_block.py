"""What a report says of the last block, and which fit it gives."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

import pyro_dynogp as dgp
from pyro_dynogp import LoopSettings, effects
from pyro_dynogp.discrepancy.context import Left, SearchContext
from pyro_dynogp.discrepancy.result import KEPT
from pyro_dynogp.models.variants import has_process_noise
from pyro_dynogp.report import last_block
from pyro_dynogp.report.last_block import Compared, _outcome, without_harm
from tests.discrepancy.test_loop import close, fitted, machine

BEFORE = {"rmse": 1.0, "crps": 0.5}


@pytest.mark.parametrize(
    ("after", "gain", "harm"),
    [
        ({"rmse": 0.5, "crps": 0.25}, 20.0, False),
        ({"rmse": 0.5, "crps": 0.25}, -5.0, False),
        ({"rmse": 0.5, "crps": 0.25}, -5.9, False),  # within two standard errors
        ({"rmse": 0.5, "crps": 0.25}, -6.1, False),  # forecasts are better, the density is not
        ({"rmse": 0.5, "crps": 0.51}, -6.1, True),  # by one score alone
        ({"rmse": 1.02, "crps": 0.51}, 20.0, False),  # noise of another kind
        ({"rmse": 1.04, "crps": 0.52}, 20.0, False),
        ({"rmse": 1.06, "crps": 0.53}, 20.0, True),
        ({"rmse": 1.3, "crps": 0.4}, 20.0, False),  # one of the scores is better
        ({"rmse": 0.9, "crps": 0.7}, 20.0, False),
        ({"rmse": 0.97, "crps": 0.57}, 20.0, True),  # by less than the other one is worse
        ({"rmse": 1.06, "crps": 0.49}, 20.0, True),
        ({"rmse": 1.06, "crps": 0.47}, 20.0, False),
        ({"rmse": 1.3, "crps": 0.7}, 20.0, True),
    ],
)
def test_harm_is_said(after: dict[str, float], gain: float, harm: bool) -> None:
    found = Compared(BEFORE, after, gain, 3.0, LoopSettings())
    assert found.does_harm is harm
    change = f"CRPS 0.5 -> {after['crps']:.3g}, elpd {gain:+.1f} +- 3.0 nats"
    assert change in found.harm
    assert "Rely on the model before" in found.harm
    assert found.left_out(["drift"]).startswith("Drift would do harm on the last block (RMSE 1")
    assert change in found.left_out(["drift", "CO2"])
    assert "the model before it." in found.left_out(["drift"])
    assert "the model before them." in found.left_out(["drift", "CO2"])


@pytest.mark.parametrize(
    ("after", "gain", "said"),
    [
        ({"rmse": 0.5, "crps": 0.25}, -6.1, True),
        ({"rmse": 0.5, "crps": 0.25}, -5.9, False),
        ({"rmse": 0.5, "crps": 0.51}, -6.1, False),
    ],
)
def test_scores_that_disagree_are_said(after: dict[str, float], gain: float, said: bool) -> None:
    found = Compared(BEFORE, after, gain, 3.0, LoopSettings()).disagreement
    assert bool(found) is said
    assert not said or "one step ahead report.base" in found[0]


@pytest.mark.parametrize(
    ("after", "said"),
    [
        ({"rmse": 0.9, "crps": 0.7}, "for bands report.base"),
        ({"rmse": 1.3, "crps": 0.4}, "unless large errors cost most"),
        ({"rmse": 0.97, "crps": 0.57}, ""),  # that is harm
        ({"rmse": 0.9, "crps": 0.52}, ""),
        ({"rmse": 0.5, "crps": 0.25}, ""),
    ],
)
def test_rmse_and_crps_that_disagree_are_said(after: dict[str, float], said: str) -> None:
    found = Compared(BEFORE, after, 20.0, 3.0, LoopSettings()).disagreement
    assert len(found) == bool(said)
    assert not said or said in found[0]
    assert not said or f"RMSE 1 -> {after['rmse']}" in found[0]


def test_a_fit_that_is_not_kept_is_not_advised() -> None:
    """Density is lost for certain while RMSE and CRPS disagree: the model before is kept."""
    found = Compared(BEFORE, {"rmse": 0.9, "crps": 0.7}, -20.0, 3.0, LoopSettings())
    assert found.does_harm
    assert not found.disagreement


def test_two_models_that_are_the_same_do_no_harm() -> None:
    assert not Compared(BEFORE, BEFORE, 0.0, 0.0, LoopSettings()).does_harm


@pytest.mark.parametrize(
    ("errors", "kept"),
    [
        ([1.0], 0),
        ([1.0, 0.5], 1),
        ([1.0, 1.06], 0),
        ([1.0, 0.5, 0.4], 2),
        ([1.0, 0.5, 0.52], 2),  # within a twentieth
        ([1.0, 0.5, 0.53], 1),
        ([1.0, 0.5, 2.0], 1),
        ([1.0, 2.0, 0.5], 2),  # both together are worth it
        ([1.0, 1.2, 1.3], 0),
        ([1.0, 1.2, 1.1], 0),
        ([1.0, 0.5, 0.7, 0.6], 1),  # better than one before is not enough
        ([1.0, 0.5, 0.7, 0.4], 3),
    ],
)
def test_the_last_effects_stay_only_where_they_do_no_harm(errors: list[float], kept: int) -> None:
    def compared(after: int, before: int) -> Compared:
        scores = [{"rmse": errors[k], "crps": errors[k]} for k in (before, after)]
        return Compared(*scores, 0.0, 1.0, LoopSettings())

    assert without_harm(len(errors) - 1, compared) == kept


@pytest.mark.parametrize(
    ("accepted", "left", "early", "harm", "outcome"),
    [
        (True, False, False, False, "effects added"),
        (True, True, False, False, "effects added, structure left"),
        (True, True, False, True, KEPT),
        (True, False, True, True, KEPT),
        (True, False, True, False, "effects added, search ended early"),
        (False, False, True, False, "search ended early"),
        (False, True, True, False, "search ended early"),
        (False, True, False, False, "structure left, cause unknown"),
        (False, False, False, False, "nothing missing"),
    ],
)
def test_outcomes(accepted: bool, left: bool, early: bool, harm: bool, outcome: str) -> None:
    course: Any = SimpleNamespace(accepted=accepted, early=early)
    assert _outcome(course, ["structure"] * left, harm=harm) == outcome


def turned(**options: Any) -> dgp.Record:
    """A line in time that turns back where the last block begins."""
    record = machine(seed=3, **options)
    path = [min(k, 720 - k) / 240 for k in range(len(record))]
    return record.with_outputs(record.outputs[:, 0] + path)


@pytest.fixture(scope="module")
def kept() -> Any:
    record = turned()
    return close(fitted(record), record, effects=(effects.Drift(),))


def page_of(report: Any, folder: Any) -> tuple[str, str]:
    """The page of a report, and its headline."""
    report.to_html(folder / "report.html")
    page = (folder / "report.html").read_text(encoding="utf-8")
    return page, page.partition("<h1>")[2].partition("</h1>")[0]


def test_where_effects_do_harm_the_model_before_is_the_fit(kept: Any, tmp_path: Any) -> None:
    assert [one.name for one in kept.effects] == ["drift"]
    assert kept.after["rmse"] > 1.05 * kept.before["rmse"]
    assert kept.outcome == "effects named, model kept"
    assert kept.model_kept
    assert kept.fit is kept.base
    assert kept.extended is not kept.base
    assert kept.extended.model.channels
    assert not kept.fit.model.channels
    assert kept.effects[0].parameters  # those of the extended fit
    first, *others = str(kept).splitlines()
    assert first.startswith("Effects named, model kept: ")
    assert "Rely on the model before (report.fit)" in first
    assert any("What was added does harm on the last block" in line for line in others)
    assert kept.to_dict()["model_kept"] is True
    page, headline = page_of(kept, tmp_path)
    assert headline.startswith("One effect was named, but the model is kept as it was")
    assert "Rely on the model before" in page


def test_without_harm_the_extended_model_is_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    record = machine(weight=0.3)
    report = close(fitted(record), record)
    assert report.outcome == "effects added"
    assert report.fit is report.extended is not report.base
    assert str(report).startswith("Effects added.\n")
    monkeypatch.setattr(last_block.Compared, "does_harm", True)
    again = close(fitted(record), record)
    assert again.fit is again.base
    assert again.after == report.after  # the numbers stay as measured
    assert again.outcome == KEPT


def test_of_two_effects_the_one_that_does_harm_is_left_out(tmp_path: Any) -> None:
    record = turned(weight=0.6)
    both = (effects.ExtraInput(), effects.Drift())
    report = close(fitted(record), record, effects=both, max_rounds=2)
    first, drift = report.effects
    assert [first.name, drift.name] == ["extra input", "drift"]
    assert [first.kept, drift.kept] == [True, False]
    assert drift.parameters  # of the model that has it
    assert report.left_out == ("drift",)
    assert report.fit is report.extended is not report.base
    assert not report.model_kept
    assert report.after == first.last_block
    assert report.after["rmse"] < 0.9 * report.before["rmse"]
    assert drift.last_block["rmse"] > 1.05 * report.after["rmse"]
    assert [type(one).__name__ for one in report.fit.model.channels] == ["Recorded"]
    assert report.headline.endswith(
        "; drift named, but left out: with it the model does worse on the last block."
    )
    assert report.warnings[0].startswith("Drift would do harm on the last block")
    said = report.said_of_last_block(drift)
    assert said.endswith("; left out of report.fit")
    assert f"   {said}" in str(report).splitlines()
    assert "left out" not in report.said_of_last_block(first)
    page, headline = page_of(report, tmp_path)
    assert headline.startswith("One effect was missing from the model and added: extra in")
    assert "drift named too, but left out" in headline
    assert said in page
    assert report.to_dict()["effects"][1]["kept"] is False


@pytest.fixture
def hiding(monkeypatch: pytest.MonkeyPatch) -> dgp.Record:
    """A linear plant, of whose model the search is told that its process noise hides something."""
    monkeypatch.setattr(
        SearchContext, "hiding", lambda self, fit, plain: "" if fit is plain else "hides"
    )
    return machine(seed=2)


def noisy(record: dgp.Record) -> dgp.Fit:
    model = dgp.LinearDynamicGP(inputs=1, pairs=1)
    return dgp.fit(model, record[:240], restarts=2, workers=1, progress=False, method="map")


def test_where_nothing_is_missing_but_noise_costs_forecasts_it_is_left_out(
    hiding: dgp.Record, tmp_path: Any
) -> None:
    report = close(noisy(hiding), hiding)
    assert not report.effects
    assert report.noise_dropped
    assert report.outcome == "nothing missing"
    assert has_process_noise(report.base.model)
    assert not has_process_noise(report.fit.model)
    assert report.fit is report.extended
    assert report.before != report.after
    assert report.headline.endswith("without its process noise, and is now without it.")
    assert report.warnings[0].startswith("Without process noise the last block is forecast so")
    assert report.to_dict()["noise_dropped"] is True
    page, headline = page_of(report, tmp_path)
    assert headline.startswith("No effect was found that the model lacks; ")
    assert "of the forecast goes from" in page


def test_where_the_last_block_is_worse_without_noise_the_model_keeps_it(
    hiding: dgp.Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(last_block.Compared, "does_harm", True)
    report = close(noisy(hiding), hiding)
    assert not report.noise_dropped
    assert report.outcome == "nothing missing"
    assert report.fit is report.base is report.extended
    assert report.before == report.after
    assert report.headline == "Nothing missing."
    assert "report.fit is the model as it was given." in report.warnings[0]


@pytest.mark.parametrize("harm", [False, True])
def test_what_is_left_is_said_of_the_model_that_the_report_gives(
    hiding: dgp.Record, monkeypatch: pytest.MonkeyPatch, harm: bool
) -> None:
    """Without its noise the model leaves something, with it nothing."""
    monkeypatch.setattr(last_block.Compared, "does_harm", harm)
    looked_at: list[dgp.Fit] = []
    look = SearchContext.look

    def looking(self: SearchContext, fit: dgp.Fit, *args: Any) -> Any:
        looked_at.append(fit)
        return look(self, fit, *args)

    def left(self: SearchContext, looked: Any) -> Left:
        noisy = has_process_noise(looked_at[-1].model)
        return Left(p_values=(1.0,)) if noisy else Left(("something",))

    monkeypatch.setattr(SearchContext, "look", looking)
    monkeypatch.setattr(SearchContext, "left", left)
    report = close(noisy(hiding), hiding)
    assert report.noise_dropped is not harm
    assert report.left == (() if harm else ("something",))
    assert report.outcome == ("nothing missing" if harm else "structure left, cause unknown")
