"""The study of naming: what counts, what it runs, and what it collects."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.discrepancy.result import KEPT
from pyro_dynogp.effects.base import OUTSIDE
from tests.benchmarks import __main__ as benchmarks
from tests.benchmarks import naming
from tests.benchmarks.kept_rows import read_rows
from tests.benchmarks.naming_cases import KEY, NULLS, Case, Choice, cases_of, choice_of, chosen_by
from tests.benchmarks.naming_table import (
    as_said,
    does_harm,
    is_right,
    names_of,
    right,
    says_outside,
    superfluous,
    tables,
    tied,
)
from tests.discrepancy.machines import KINDS, machine

ACCEPTED = {
    "saturation": ["saturation", "output nonlinearity"],
    "undeclared input": ["extra input"],
    "feedback": ["feedback"],
}


def row(*planted: str, named=(), channels=None, ties=None, **changes) -> dict:
    """A row of the study as `study` makes it."""
    made = {
        "group": ("null", "single", "two", "three")[len(planted)],
        "kind": "motor",
        "effects": ", ".join(planted),
        "strength": "strong" if planted else "none",
        "seed": 0,
        "split": "development",
        "oracle": False,
        "planted": list(planted),
        "accepted": {effect: ACCEPTED.get(effect, [effect]) for effect in planted},
        "true_channel": None,
        "named": list(named),
        "channels": list(channels or [None] * len(named)),
        "p_values": [0.01] * len(named),
        "ties": list(ties or [[] for _ in named]),
        "kept": [True] * len(named),
        "outcome": "effects added" if named else "nothing missing",
        "floor": 0.5,
        "before": {"rmse": 2.0, "coverage_95": 0.7},
        "after": {"rmse": 0.55, "coverage_95": 0.94},
        "seconds": {"fit": 2.0, "loop": 30.0},
    }
    return made | changes


def test_any_accepted_name_is_right_and_others_are_superfluous():
    clipped = row("saturation", named=["output nonlinearity", "drift"])
    assert right(clipped) == ["saturation"]
    assert superfluous(clipped) == ["drift"]
    assert not is_right(clipped)
    assert is_right(row("saturation", named=["saturation"]))
    # Two names of one effect are not too many; nothing named is not right.
    assert is_right(row("saturation", named=["saturation", "output nonlinearity"]))
    assert not is_right(row("saturation"))
    assert is_right(row())
    assert superfluous(row(named=["drift"])) == ["drift"]


def test_an_undeclared_input_is_right_by_its_channel():
    planted = {"named": ["extra input"], "true_channel": "wind"}
    assert is_right(row("undeclared input", channels=["wind"], **planted))
    decoy = row("undeclared input", channels=["moon"], **planted)
    assert right(decoy) == []
    assert superfluous(decoy) == ["extra input (moon)"]
    assert right(row("undeclared input", **planted)) == []


def test_a_tie_is_neither_right_nor_superfluous():
    tie = row("drift", named=["level shift"], ties=[["drift", OUTSIDE]])
    assert right(tie) == []
    assert tied(tie) == ["drift"]
    assert superfluous(tie) == []
    assert not is_right(tie)
    assert tied(row("drift", named=["drift"], ties=[["drift"]])) == []


def test_feedback_counts_where_the_report_ends_with_it():
    assert is_right(row("feedback", named=["feedback"]))
    assert names_of(row("feedback", named=["feedback"])) == [("feedback", None)]
    assert superfluous(row(named=["feedback"])) == ["feedback"]
    assert not is_right(row("feedback"))


def test_a_cause_outside_the_catalogue_is_left_open():
    outside = {"group": "outside", "planted": ["outside catalogue"]}
    assert says_outside(row(**outside, outcome="structure left, cause unknown"))
    assert not says_outside(row(**outside))
    assert is_right(row(**outside, named=["drift"], ties=[[OUTSIDE]]))
    assert not is_right(row(**outside, named=["drift"], outcome="effects added, structure left"))


def made_up_study() -> list[dict]:
    harmed = {"after": {"rmse": 2.2, "coverage_95": 0.5}}
    return [
        *(row(seed=k) for k in range(7)),
        row(seed=7, outcome="structure left, cause unknown"),
        row(named=["drift"], seed=8, peers={"bands": {"named": [], "channels": []}}),
        row("drift", named=["drift"], peers={"bands": {"named": ["drift"], "channels": [None]}}),
        row("drift", seed=1, error="ValueError: no", named=[]),
        row("drift", named=["level shift"], seed=2, kept=[False], outcome=KEPT, **harmed),
        row("drift", seed=1, oracle=True, named=["drift"]),
        row("drift", seed=2, oracle=True, named=["drift"]),
        row("drift", "saturation", named=["drift", "saturation"]),
        row("drift", "saturation", named=["saturation"], seed=1, **harmed),
        {**row("hysteresis"), "unmade": "noise out of range"},
    ]


def test_tables_of_a_made_up_study():
    text = tables(made_up_study())
    lines = text.splitlines()
    assert "16 cases, 1 of them failed, which count as not named; 1 more could not be" in text
    assert "| motor | 1 of 9 (11 %) | 0.3 to 48.2 % | 1 of 9 (11 %) |" in lines
    # One of three named, one failed, one wrong; errors over the floor are those to rely on.
    expected = "| drift | strong | 3 | 1 of 3 (33 %) | 1 to 91 % | 1 | 0 | 1 | 1 | 2.55 | 3.71 |"
    assert expected in lines
    expected = "| two | strong | 2 | 1 of 2 (50 %) | 2 of 2 (100 %) | 3 of 4 (75 %) | 0 | 0.00 |"
    assert expected in lines
    assert any(line.startswith("| all | 13 | 2 | 1 | 4.00 | 4.00 |") for line in lines)
    assert "| drift | 2 of 2 (100 %) | 0 of 2 (0 %) | 100 |" in lines
    expected = "| bands | 0 of 1 (0 %) | 1 of 1 (100 %) | 1 of 1 (100 %) | 1 of 1 (100 %) |"
    assert expected in lines
    expected = (
        "| closing the loop | 1 of 1 (100 %) | 1 of 1 (100 %) | 1 of 1 (100 %) | 1 of 1 (100 %) |"
    )
    assert expected in lines
    assert "| motor | 2 | strong | drift | level shift |  |" in lines
    assert "- 1 x ValueError: no" in lines
    assert "- 1 x not made: noise out of range" in lines


def test_harm_is_a_twentieth_more_error():
    assert does_harm(row(after={"rmse": 2.11}))
    assert not does_harm(row(after={"rmse": 2.09}))


def test_what_other_tools_say_is_counted_in_the_same_way():
    ours = row("undeclared input", named=["drift"], ties=[["extra input"]], true_channel="wind")
    theirs = as_said(ours, {"named": ["extra input"], "channels": ["wind"]})
    assert is_right(theirs)
    assert not is_right(ours)


def test_cases_are_balanced_by_seed():
    choice = Choice(seeds=range(2), strengths=["weak", "strong"])
    cases = cases_of(choice)
    assert len({case.key for case in cases}) == len(cases)
    planted = sum(len(effects) for effects in KINDS.values())
    single = [case for case in cases if case.group == "single"]
    assert len(single) == 2 * 2 * planted
    assert {case.seed for case in cases[: len(cases) // 2] if case.group == "single"} == {0}
    null = [case for case in cases if case.group == "null"]
    assert len({(case.kind, case.seed) for case in null}) == len(null) == 2 * NULLS * len(KINDS)
    two = [case for case in cases if case.group == "two"]
    assert len(two) == 2 * sum(len(effects) >= 2 for effects in KINDS.values())
    assert all(len(set(case.effects)) == 2 for case in two)
    assert all(set(case.effects) <= set(KINDS[case.kind]) for case in two)
    oracle = cases_of(Choice(seeds=range(2), strengths=["weak", "strong"], oracle=True))
    assert {case.key[:-1] for case in oracle} == {c.key[:-1] for c in cases if c.effects}
    assert cases_of(choice) == cases


def test_choices_from_words():
    kind = next(iter(KINDS))
    choice = chosen_by({"NAMING_SEEDS": "2-3", "NAMING_KINDS": kind, "NAMING_GROUPS": "null"})
    assert [case.seed for case in sorted(cases_of(choice), key=lambda c: c.seed)] == list(
        range(2 * NULLS, 4 * NULLS)
    )
    assert list(choice_of({"seeds": "7"}).seeds) == [7]
    with pytest.raises(ValueError, match=r"seeds: expected '3' or '0-4', got '3-1'"):
        choice_of({"seeds": "3-1"})
    with pytest.raises(ValueError, match=r"kinds: expected some of .* got \['no machine'\]"):
        choice_of({"kinds": "no machine"})


def test_an_interrupted_study_goes_on(tmp_path, monkeypatch):
    asked = []

    def study(case: Case) -> dict:
        asked.append(case.key)
        made = row(*case.effects, named=case.effects) | case.fields
        return made | ({"error": "RuntimeError: no luck"} if case.seed == 1 else {})

    circumstances = {"date": "2026-01-02", "commit": "abc1234", "reference_seconds": 0.6}
    monkeypatch.setattr(naming, "study", study)
    monkeypatch.setattr(naming, "here", lambda: circumstances)
    kind, effects = next((k, e) for k, e in KINDS.items() if len(e) > 1)
    choice = Choice(range(2), [kind], [effects[0]], ["strong"], ["single", "null"])
    options = {"workers": 1, "kept": tmp_path}
    text = naming.run(tmp_path, choice, seconds=-1.0, **options)
    assert text.startswith("0 of the 8 cases asked for are there.")
    assert not asked
    text = naming.run(tmp_path, choice, **options)
    assert len(asked) == 2 * (1 + NULLS)
    assert "- 2 x RuntimeError: no luck" in text
    assert set(read_rows(tmp_path / "naming.development.jsonl", KEY)) == set(asked)
    asked.clear()
    naming.run(tmp_path, choice, **options)
    assert not asked
    naming.run(tmp_path, choice, **options, again=True)
    assert len(asked) == 2


def effect_named(name: str, **changes) -> SimpleNamespace:
    return SimpleNamespace(**({"name": name, "p_value": 0.002, "ties": (), "kept": True} | changes))


def test_channels_are_those_of_accepted_attempts():
    one = machine(next(iter(KINDS)), 0)
    scores = {"rmse": 1.0, "mae": 0.8, "crps": 0.5, "coverage_50": 0.5, "coverage_95": 0.9}
    attempts = [
        SimpleNamespace(name="extra input", channel="a", decision="rejected"),
        SimpleNamespace(name="extra input", channel="b", decision="accepted"),
        SimpleNamespace(name="drift", channel="", decision="accepted"),
        SimpleNamespace(name="feedback", channel="u", decision="reported"),
    ]
    effects = [
        effect_named("extra input"),
        effect_named("drift", ties=("level shift",), kept=False),
    ]
    report = SimpleNamespace(
        effects=[*effects, effect_named("feedback")], attempts=attempts, before=scores,
        after=scores, outcome="effects added", headline="Effects added.", sealed=None,
    )  # fmt: skip
    found = naming.collect(one, report)
    assert found["channels"] == ["b", None, None]
    assert found["ties"] == [[], ["level shift"], []]
    assert found["kept"] == [True, False, True]
    quarter = one.record[3 * len(one.record) // 4 :]
    assert found["floor"] == pytest.approx(one.floor(quarter), rel=1e-12)
    assert json.loads(json.dumps(found)) == found


def test_the_floor_of_several_outputs_is_that_of_scores():
    """Errors of 1 and 3 at every sample: 2, as scores are averaged, and no root of 5."""
    signs = np.where(np.arange(20) % 2, 1.0, -1.0)
    outputs = np.column_stack([signs, 3.0 * signs])
    part = dgp.Record(np.arange(20.0), np.zeros(20), outputs)
    one = SimpleNamespace(record=part, noise_free=np.zeros((20, 2)))
    assert naming.floor_of(one, part[5:15]) == pytest.approx(2.0)


def test_a_case_from_end_to_end():
    """A machine without effect, its fit, its loop with defaults, and the other tools."""
    kind = "motor"
    case = Case("null", kind, (), "none", 0)
    found = naming.study(case, samples=320)
    assert json.loads(json.dumps(found)) == found
    assert "error" not in found
    assert found["samples"] == 320
    assert found["planted"] == []
    fit = dgp.fit(*_to_fit(kind), progress=False, workers=1)
    one = machine(kind, 0, samples=320)
    report = dgp.close_loop(fit, one.record, seed=0, workers=1, progress=False)
    assert found["named"] == [effect.name for effect in report.effects]
    assert found["before"]["rmse"] == float(report.before["rmse"])
    assert found["before"]["rmse"] > 0.8 * found["floor"]
    assert len(found["peers"]) == 10
    assert "1 cases, 0 of them failed" in tables([found])


def _to_fit(kind: str) -> tuple[dgp.Model, dgp.Record]:
    one = machine(kind, 0, samples=320)
    return one.model, one.record[: one.training]


def test_the_oracle_looks_for_what_is_planted(monkeypatch):
    kind, effect = next(
        (kind, effect) for kind, several in KINDS.items() for effect in several
        if effect == "undeclared input"
    )  # fmt: skip
    asked = {}

    def close_loop(fit, record, **options):
        asked.update(options)
        raise RuntimeError("enough")

    monkeypatch.setattr(dgp, "close_loop", close_loop)
    monkeypatch.setattr(dgp, "fit", lambda *_, **__: None)
    found = naming.oracle(Case("single", kind, (effect,), "strong", 0))
    assert found["error"] == "RuntimeError: enough"
    assert found["oracle"] is True
    assert [one.name for one in asked["effects"]] == found["accepted"][effect]
    assert asked["candidates"] == [found["true_channel"]]


def test_the_command_of_all_benchmarks_reads_options_of_the_study(tmp_path, capsys):
    given = ["--seeds", "3", "--kinds", "motor", "--groups", "single", "--strengths", "weak"]
    given += ["--effects", "dead zone", "--seconds", "-1", "--kept", str(tmp_path)]
    assert benchmarks.main(["naming", *given]) == 0
    assert capsys.readouterr().out.startswith("0 of the 1 cases asked for are there.")
