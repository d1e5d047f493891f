"""The study of planted effects collects and tabulates what reports say: made-up reports."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.discrepancy.result import KEPT
from tests.benchmarks import planted
from tests.benchmarks.kept_rows import read_rows
from tests.benchmarks.planted import KEY, Case, cases_of, channel_of, collect
from tests.benchmarks.planted_table import (
    NOTHING,
    confusion,
    confusion_picture,
    interval,
    is_found,
    is_right,
    is_wider,
    relied_on,
    tables,
    top_name,
)
from tests.discrepancy.plants import EFFECTS, OUTSIDE, plant


def row(effect, *named, strength="strong", replicate=0, **changes):
    made = {
        "effect": effect,
        "strength": "none" if effect == NOTHING else strength,
        "replicate": replicate,
        "split": "development",
        "base": "linear",
        "named": list(named),
        "p_values": [0.01] * len(named),
        "sentences": [""] * len(named),
        "channels": [None] * len(named),
        "ties": [],
        "reported": [],
        "true_channel": None,
        "outcome": "effects added" if named else "nothing missing",
        "floor": 0.5,
        "before": {"rmse": 2.0, "coverage_95": 0.7},
        "after": {"rmse": 0.55, "coverage_95": 0.94},
    }
    return made | changes


def effect_named(name, sentence=""):
    return SimpleNamespace(name=name, sentence=sentence, p_value=0.002, ties=("drift",), block="")


def report_of(*effects, **changes):
    scores = {"rmse": 1.0, "mae": 0.8, "crps": 0.5, "coverage_95": 0.9, "other": 3.0}
    return SimpleNamespace(
        effects=effects, outcome="effects added", before=scores, after=scores, fit=None, **changes
    )


def test_cases_are_balanced_and_end_where_they_should():
    cases = cases_of(2)
    assert len(cases) == len({case.key for case in cases}) == 2 * 3 * (len(EFFECTS) + 1)
    assert {c.replicate for c in cases if c.effect is None} == set(range(6))
    assert {c.replicate for c in cases[: len(cases) // 2] if c.effect} == {0}
    chosen = cases_of(1, ["drift", None], "final")
    assert {c.effect for c in chosen} == {"drift", None}
    assert {c.split for c in chosen} == {"final"}


def test_collect_compares_a_report_with_the_truth():
    made = plant("extra input", "strong", 0, samples=400)
    true = made.truth["channel"]
    other = next(name for name in made.record.extra if name != true)
    effects = (
        effect_named("extra input", f"{true} acts on y with a time constant of 3 s."),
        effect_named("extra input", f"Channel '{other}', delayed by 2 s."),
        effect_named("drift", f"{true}0 has nothing to do with it."),
    )
    attempts = [
        SimpleNamespace(name="feedback", decision="reported"),
        SimpleNamespace(name="drift", decision="rejected"),
    ]
    sealed = made.record[320:]
    case = Case("extra input", "strong", 0)
    found = collect(case, made, report_of(*effects, sealed=sealed, attempts=attempts))
    assert found["channels"] == [true, other, None]
    assert found["reported"] == ["feedback"]
    assert found["ties"] == ["drift"]
    assert found["floor"] == made.floor(sealed)
    assert set(found["before"]) == {"rmse", "mae", "crps", "coverage_95"}
    assert json.loads(json.dumps(found)) == found
    assert top_name(found) == "extra input"
    # Without a sealed block the last quarter of the record is what nobody has seen.
    bare = collect(case, made, report_of())
    assert bare["floor"] == made.floor(made.record[300:])
    assert top_name(bare) == NOTHING


def test_channels_are_whole_words():
    assert channel_of(effect_named("extra input", "w10 acts."), ["w1", "w10"]) == "w10"
    assert channel_of(effect_named("extra input", "no channel"), ["w1"]) is None


def test_a_decoy_is_no_extra_input():
    right = row("extra input", "extra input", channels=["w2"], true_channel="w2")
    decoy = row("extra input", "extra input", channels=["w1"], true_channel="w2")
    assert is_right(right)
    assert not is_right(decoy)
    assert top_name(decoy) == "decoy"
    null = row(NOTHING, "extra input", channels=["w1"])
    assert top_name(null) == "decoy"
    assert "A decoy channel accepted in 66.7 % (2 of 3;" in tables([right, decoy, null])


def test_what_counts_as_right():
    assert is_right(row("feedback", reported=["feedback"]))
    assert not is_right(row("feedback", "drift", reported=["feedback"]))
    assert is_found(row("feedback", "drift", reported=["feedback"]))
    assert is_found(row("drift", "level shift", ties=["drift"]))
    assert is_right(row(NOTHING))
    assert is_right(row(OUTSIDE, outcome="structure left, cause unknown"))
    assert not is_right(row(OUTSIDE, "drift", outcome="effects added, structure left"))
    assert not is_right(row(OUTSIDE))
    assert is_wider(row("saturation", "output nonlinearity"))
    assert not is_right(row("saturation", "output nonlinearity"))


def test_interval_is_that_of_clopper_and_pearson():
    low, high = interval(0, 60)
    assert low == 0
    assert high == pytest.approx(1 - 0.025 ** (1 / 60))
    low, high = interval(5, 20)
    assert (low, high) == pytest.approx((0.0866, 0.4910), abs=1e-4)
    assert interval(0, 0) == (0.0, 1.0)


def made_up_study():
    rows = [row("drift", "drift", replicate=i) for i in range(3)]
    rows += [row("drift", "level shift", strength="weak"), row("drift", strength="weak")]
    rows += [row(NOTHING, replicate=i) for i in range(19)]
    rows += [row(NOTHING, "dead time", replicate=19, outcome="effects added, structure left")]
    rows += [row(OUTSIDE, outcome="structure left, cause unknown")]
    rows += [{"effect": "drift", "strength": "weak", "replicate": 7, "error": "ValueError: no"}]
    return rows


def test_tables_of_a_made_up_study():
    rows = made_up_study()
    counts = confusion(rows)
    assert list(counts) == ["drift", OUTSIDE, NOTHING]
    assert counts["drift"] == {"drift": 3, "level shift": 1, NOTHING: 1}
    assert counts[OUTSIDE] == {"cause unknown": 1}
    text = tables(rows)
    assert "27 plants, 1 of them failed" in text
    assert "an effect accepted in 5.0 % (1 of 20; 0.1 to 24.9 %)" in text
    assert "named first in 60.0 % (3 of 5;" in text
    assert "| drift | strong | 3 | 1.00 | 1.00 | 0.00 | 4.000 | 1.100 | 1.100 | 0.940 |" in text
    assert "| drift | weak | 2 | 0.00 | 0.00 | 0.00 | 4.000 | 1.100 | - | 0.940 |" in text
    assert "| outside catalogue | strong | structure left, cause unknown | nothing | 1 |" in text
    assert "- 1 x ValueError: no" in text


def test_errors_after_are_those_of_the_fit_to_rely_on():
    """Where effects do harm the report gives the model before."""
    kept = row("drift", "drift", outcome=KEPT)
    assert is_right(kept)
    assert relied_on(kept) == kept["before"]
    assert relied_on(row("drift", "drift")) == row("drift", "drift")["after"]
    text = tables([kept])
    assert "| drift | strong | 1 | 1.00 | 1.00 | 0.00 | 4.000 | 4.000 | 4.000 |" in text
    assert "The model before was kept in 100.0 % (1 of 1;" in text
    assert "The model before was kept" not in tables([row("drift", "drift")])


def test_picture(tmp_path):
    confusion_picture(made_up_study(), tmp_path / "confusion.png")
    assert (tmp_path / "confusion.png").stat().st_size > 10_000


def test_an_interrupted_study_goes_on(tmp_path, monkeypatch):
    asked = []

    def study(case):
        asked.append(case.key)
        if case.key == ("drift", "weak", 0, "development"):
            raise RuntimeError("no luck")
        return row(case.effect or NOTHING, strength=case.strength, replicate=case.replicate)

    circumstances = {"date": "2026-01-02", "commit": "abc1234", "reference_seconds": 0.6}
    monkeypatch.setattr(planted, "study", study)
    monkeypatch.setattr(planted, "here", lambda: circumstances)
    text = planted.run(tmp_path, replicates=1, effects=["drift", None], workers=1, kept=tmp_path)
    assert len(asked) == 6
    assert "RuntimeError: no luck" in text
    assert "Runs: 5 on 2026-01-02 with commit abc1234" in text
    path = tmp_path / "planted.development.jsonl"
    with path.open("a") as file:  # a kill in the middle of a line
        file.write('{"effect": "drift", "strength"')
    assert len(read_rows(path, KEY)) == 6
    asked.clear()
    planted.run(tmp_path, replicates=2, effects=["drift", None], workers=1, kept=tmp_path)
    assert ("drift", "weak", 0, "development") in asked  # what failed is tried again
    assert len(asked) == 1 + 6
    asked.clear()
    planted.run(tmp_path, replicates=1, effects=["drift", None], workers=1, kept=tmp_path)
    assert asked == [("drift", "weak", 0, "development")]


def test_a_case_from_end_to_end_with_a_search_that_finds_nothing(monkeypatch):
    """The study's calls fit the package: model, fit, record; the search is a stand-in."""

    def close_loop(fit, record, candidates=None, seed=0, max_rounds=1):
        train = fit.records[0]
        assert len(record) == 2 * len(train)
        error = fit.simulate(record[300:]).mean[:, 0] - record.outputs[300:, 0]
        scores = {"rmse": float(np.sqrt(np.mean(error**2)))}
        return SimpleNamespace(
            effects=(), outcome="nothing missing", before=scores, after=scores, fit=fit
        )

    monkeypatch.setattr(dgp, "close_loop", close_loop, raising=False)
    small = (
        n
        for n, made in ((n, plant(None, "weak", n, samples=400)) for n in range(40))
        if (made.base["kind"], made.base["pairs"], made.record.n_inputs) == ("linear", 1, 1)
    )
    found = planted.study(Case(None, "none", next(small)), samples=400)
    assert found["effect"] == NOTHING
    assert is_right(found)
    assert np.isfinite(found["before"]["rmse"] / found["floor"])
    assert set(found["seconds"]) == {"fit", "loop"}
