"""The page of a report: everything said and escaped, nothing from outside, figures inside."""

import base64
import html
import re
from html.parser import HTMLParser

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Delayed, Recorded, Step, Trend
from pyro_dynogp.discrepancy.result import KEPT
from pyro_dynogp.models.description import Part, describe
from pyro_dynogp.models.variants import with_channel, with_likelihood, with_output_function
from pyro_dynogp.report.html.diagram import diagram, marks
from pyro_dynogp.report.html.html import number, plus_minus, probability
from pyro_dynogp.report.html.page import _headline, page
from pyro_dynogp.report.html.scores import change_of_elpd, change_of_error, change_of_share
from tests.discrepancy import reports

VOID = {"img", "meta", "br"}
EVIL = '<b>$x$ & "it\'s$"</b>'
NAN = float("nan")


class Parsed(HTMLParser):
    """Tags must balance; text and attributes are kept."""

    def __init__(self, source):
        super().__init__()
        self.open, self.words, self.tags = [], [], []
        self.feed(source)
        self.close()
        assert self.open == []
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.words.append(data)

    def all(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


def checked(report):
    """Page of a report, with what holds for every page."""
    source = page(report)
    found = Parsed(source)
    assert source.startswith("<!DOCTYPE html>")
    assert found.all("html") == [{"lang": "en"}]
    assert {"charset": "utf-8"} in found.all("meta")
    assert not {"script", "link", "iframe"} & {tag for tag, _ in found.tags}
    without_figures = re.sub(r"base64,[A-Za-z0-9+/=]+", "", source)
    assert "http" not in without_figures
    assert not re.search(r"\b(nan|NaN|None|inf)\b", without_figures)
    for image in found.all("img"):
        assert len(image["alt"]) > 20
        kind, data = image["src"].split(",")
        assert kind == "data:image/svg+xml;base64"
        svg = base64.b64decode(data).decode()
        Parsed(svg[svg.index("<svg") :])
        assert "href" not in re.sub(r'href="#[^"]*"', "", svg)
    for drawing in found.all("svg"):
        assert drawing["role"] == "img"
        assert drawing["aria-label"]
    return source, found


@pytest.fixture(scope="module")
def made():
    return reports.report()


@pytest.fixture(scope="module")
def checked_page(made):
    return checked(made)


@pytest.fixture(scope="module")
def found(checked_page):
    return checked_page[1]


def test_everything_is_said(made, found):
    words = found.text
    assert "Two effects were missing from the model and added: extra input and dead time." in words
    for one in made.effects:
        assert one.sentence in words
        assert one.block in words
    for one in made.attempts:
        assert one.reason in words
    for sentence in (*made.warnings, made.data, *made.seconds, *made.last_block_tests):
        assert sentence in words
    assert "84.3 ± 12.7 nats" in words
    assert "gain of ambient [m/°C] 0.0121 ± 0.0009" in words
    assert "Size (root mean square) 0.310 m" in words
    assert "below 0.0001" in words


def test_every_test_of_the_search_is_on_the_page(made, found):
    words = found.text.partition("Every test of the search")[2]
    assert "3 tests of the residuals in all." in words
    assert "Extra input level ambient 1 below 0.0001 0.00040 accepted" in words
    assert "Level shift level time 31.5 1 0.31 1.0 not significant" in words
    assert "Any structure level – 2 0.74 0.74 not significant" in words


def test_attempts_name_their_channel(found):
    assert "Drift, ambient What the test for drift says." in found.text


def test_a_model_that_is_kept_is_the_headline():
    _, found = checked(reports.report(outcome=KEPT))
    assert (
        "Two effects were named, but the model is kept as it was, as it does worse with them on "
        "the sealed data: extra input and dead time." in found.text
    )
    assert "Rely on the model before, not on the extended one." in found.text
    assert "added: extra input" not in found.text


def test_a_search_that_ended_early_says_so():
    made = reports.report(outcome="effects added, search ended early")
    assert _headline(made).endswith("extra input and dead time; the search ended early.")
    assert _headline(reports.nothing(outcome="search ended early")) == "Search ended early."


def test_figures(made, found):
    assert len(found.all("img")) == 4
    alts = [image["alt"] for image in found.all("img")]
    assert "residual [m] against ambient [°C], 25 points" in alts[0]
    assert "additional delay [s]" in alts[1]
    assert f"{made.before['rmse']:.3f} m before, {made.after['rmse']:.3f} m after" in alts[2]
    assert alts[3].startswith("Residuals of level over time")


def test_ties(found):
    assert "These data cannot tell this effect from “drift” and “calendar”." in found.text
    assert f"To distinguish them: {reports.EXPERIMENT}" in found.text
    assert found.text.count("Tie.") == 1


def test_scores_and_tests_in_words(made, found):
    words = found.text
    before, after = made.before["rmse"], made.after["rmse"]
    assert (
        f"{before:.4f} m {after:.4f} m better: {100 - 100 * after / before:.1f} % smaller" in words
    )
    assert "74.0 % 94.0 % better: nearer to 95 %" in words
    assert "61.2 ± 9.8 nats better: more than two standard errors" in words
    assert "Of 5 tests, 3 failed before and 2 after." in words
    assert "0.00040 0.41 failed, now passes" in words
    assert "0.20 0.040 passed, now fails" in words
    assert "0.010 0.020 fails as before" in words


def test_models(found):
    before, after = found.all("svg")
    assert before["aria-label"].startswith("Model before: Inputs: valve [V] (changed) → Dynamics")
    assert "Extra input: ambient [°C] (new) → Dynamics: 3 pairs" in after["aria-label"]


def test_names_of_users_files():
    source, found = checked(reports.with_names(EVIL, "<V>", "$ & $"))
    assert found.text.count(EVIL) >= 20
    assert html.escape(EVIL) in source
    assert EVIL not in source
    assert not found.all("b")
    assert "2024-03-30 00:00:00+01:00" in found.text


def test_nothing_missing():
    _, found = checked(reports.nothing())
    assert "No effect was found that the model lacks." in found.text
    assert "Nothing was added: the model is the one that was given." in found.text
    assert "The model is as it was given." in found.text
    assert len(found.all("svg")) == 1
    assert len(found.all("img")) == 2
    for word in ("Before", "After", "better", "Tie", "Warnings"):
        assert word not in found.text
    assert "calendar 0.60 passes" in found.text


def test_what_was_not_computed():
    bare = reports.effect(
        p_value=NAN, q_value=NAN, gain=NAN, gain_error=NAN, curve=None, ties=(), block="",
        parameters={},
    )  # fmt: skip
    _, found = checked(
        reports.report(
            effects=(bare,), outcome="effects added, structure left", before={"rmse": NAN},
            after={}, elpd_gain=NAN, elpd_gain_error=NAN, attempts=(), last_block_tests={},
            tests=(), seconds={}, warnings=(),
        )
    )  # fmt: skip
    assert "extra input; structure of unknown cause is left." in found.text
    assert "There is no picture of this evidence." in found.text
    assert "– – not computed" in found.text
    assert "No effect was considered." in found.text


def test_structure_left_and_outcomes_of_ones_own():
    _, found = checked(reports.nothing(outcome="structure left, cause unknown", warnings=("W.",)))
    assert "leaves structure in the data that no effect in the catalogue explains." in found.text
    assert "Warnings W." in found.text
    assert "What is left Structure" not in found.text
    _, found = checked(reports.report(left=("Structure is left: a < b.",)))
    assert "What is left Structure is left: a < b." in found.text
    assert _headline(reports.nothing(outcome="out of time")) == "Out of time."


def test_a_long_record_makes_no_large_page():
    source, found = checked(reports.report(400_000))
    assert len(source) < 2e6
    assert "400 of the 100000 samples, from the middle" in found.text
    assert len(found.all("img")) == 5


def test_several_outputs():
    _, found = checked(reports.report(outputs=2))
    assert "Closing the loop: level and level1 of record “plant”" in found.text


def test_the_same_report_gives_the_same_page(made, checked_page, tmp_path):
    made.to_html(tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == checked_page[0]


# Pieces


@pytest.mark.parametrize(
    ("x", "shown"),
    [(0.0, "0"), (1234.4, "1234"), (0.01234, "0.0123"), (-2.5, "−2.50"), (NAN, "–"), (None, "–"),
     (np.inf, "–"), (1.234e-7, "1.23 × 10⁻⁷"), (2e9, "2.00 × 10⁹")],
)  # fmt: skip
def test_number(x, shown):
    assert number(x) == shown


def test_plus_minus_and_probability():
    assert plus_minus(1234.5, 12.34, "m") == "1234 ± 12 m"
    assert plus_minus(0.0, 0.0) == "0 ± 0"
    assert plus_minus(2.0, NAN, "m") == "2.00 m"
    assert plus_minus(NAN, 1.0) == "–"
    assert plus_minus(2e-6, 1e-7) == "2.00 × 10⁻⁶ ± 1.0 × 10⁻⁷"
    assert [probability(p) for p in (0.0, 0.5, 0.0123, NAN)] == [
        "below 0.0001",
        "0.50",
        "0.012",
        "–",
    ]


def test_words_of_changes():
    assert str(change_of_error(2.0, 3.0)) == "worse: 50 % larger"
    assert str(change_of_error(2.0, 2.001)) == "about the same"
    assert str(change_of_error(0.0, 0.0)) == "about the same"
    assert str(change_of_error(0.0, 1.0)) == "worse"
    assert str(change_of_share(0.94, 0.80, 0.95)) == "worse: further from 95 %"
    assert str(change_of_share(0.94, 0.955, 0.95)) == "about the same"
    assert str(change_of_elpd(-9.0, 2.0)) == "worse: more than two standard errors"
    assert str(change_of_elpd(3.0, 2.0)) == "no clear difference: within two standard errors"


def test_marks():
    before = (Part("inputs", "1 input"), Part("dynamics", "linear", "3 pairs"), Part("noise", "n"))
    after = (before[0], Part("recorded", "recorded", "c"), Part("dynamics", "linear", "4 pairs"),
             Part("noise", "Student-t", "4"))  # fmt: skip
    assert marks(before, after) == ["", "new", "changed", "changed"]
    same = Part("a", "a", "1")
    assert marks((same, same), (same, same, same)) == ["", "", "new"]
    assert marks(before, before) == [""] * 3


def test_diagram_of_many_parts():
    parts = [Part("part", f"Part {k}", "a_long_name" * 5) for k in range(12)]
    drawn = Parsed(diagram(parts, [""] * 12, "Model"))
    boxes = drawn.all("rect")
    assert len(boxes) == 12
    assert len(drawn.all("polyline")) == 11
    wide, tall = (float(x) for x in drawn.all("svg")[0]["viewbox"].split()[2:])
    for box in boxes:
        assert float(box["x"]) + float(box["width"]) <= wide
        assert float(box["y"]) + float(box["height"]) <= tall
    assert diagram([], [], "Model").startswith("<svg")


def test_parts_that_join_have_a_plus_sign():
    channels = (Recorded("c"), Delayed("u", 0.5), Trend(0.0, 1.0))
    model = dgp.Wiener(1)
    for channel in channels:
        model = with_channel(model, channel)
    parts = describe(model)
    assert [part.joins for part in parts] == [False, True, False, False, False, True, True]
    drawn = Parsed(diagram(parts, [""] * 7, "Model"))
    assert len(drawn.all("path")) == 3
    # The last parts begin a second row, to which a line leads as well.
    assert len(drawn.all("polyline")) == 4
    assert "linear dynamics 5 pairs of poles, process noise" in drawn.text


def test_lines_of_a_model():
    model = with_channel(dgp.LinearDynamicGP(2, pairs=1, process_noise=False), Step(2.5))
    model = with_likelihood(with_output_function(model, (None, 0.61)), dgp.StudentT(4.0))
    assert [str(part) for part in describe(model)] == [
        "2 inputs",
        "linear dynamics, 1 pair of poles, no process noise",
        "static function, 32 inducing values, stops at 0.61",
        "plus step: at 2.5",
        "Student-t noise, 4 degrees of freedom",
    ]
