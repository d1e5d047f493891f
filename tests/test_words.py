"""Pages, reports and messages use plain words: idioms of this project alone are not in them."""

from __future__ import annotations

import ast
import html
import re
from pathlib import Path

import pytest

import pyro_dynogp as dgp
from pyro_dynogp.report.html.page import page
from tests import pages
from tests.discrepancy import reports

# Idiom -> what to write in its place. They are regular expressions, whatever the case.
IDIOMS = {
    r"\bgo(es)? on\b|\bwent on\b|\bgoing on\b": "continues, is extrapolated",
    r"\b(is|are|was|were) (not )?told\b": "hidden from, given",
    r"\bwhat is known\b": "the data, the inputs",
    r"\bwho knows?\b": "a model with the true parameters",
    r"\b(know|knows|knew)\b": "has, includes, accounts for, is given",
    r"\bspeaks? (for|against)\b": "supports, is evidence for",
    r"\b(pays|paid)\b": "helps, is worth it",
    r"\bcloses\b": "searches, ends",
    r"\bcom(e|es|ing) back\b|\bcame back\b": "feeds back, returns",
    r"\b(goes|go|went) with\b": "depends on, is correlated with",
    r"\b(goes|go|went) together\b": "are correlated",
    r"\b(goes|go) the same way\b": "can be used like this, too",
    r"\bnothing (has seen|looked at|that was looked at)\b": "held-out, not used",
    r"\b(has|have|had) seen\b": "was fitted to, has used",
    r"\bnobody saw\b": "held-out",
    r"\bthe hook\b": "leave-one-out by `dgp.loo`",
    r"\bflatters?\b": "is optimistic",
    r"\bimitates?\b": "looks like",
    r"\bmakes? up for\b": "compensate for",
    r"\bbuys?\b|\bis bought\b|\bbought at the price\b": "improves, costs",
    r"\btold? (apart )?from\b|\btells? (\w+ )?apart\b": "distinguish",
    r"\bby way of\b": "with, through",
    r"\ball but\b": "almost, except for",
    r"\bin its turn\b|\bin their turn\b": "one after the other",
    r"\bthat there (is|are)[,.;]": "leave it out",
    r"\bwhatever (it|they) (does|do|is|are)\b": "any",
    r"\bsays? so\b": "states it",
    r"\bmended\b|\bmends\b": "fixed",
}
LONGEST = 40  # words of a sentence
# Pages of figures, which state each with its conditions.
EVIDENCE = {"measurements.md", "architecture.md", "planted.md", "paper.md"}


PACKAGE = Path(dgp.__file__).parent
SOURCES = sorted(PACKAGE.rglob("*.py"))


def idioms(parts):
    """Every idiom in some texts, with what to write in its place."""
    return [
        f"{match.group(0)!r} (write: {instead}) in: {part[:120]}"
        for part in parts
        for idiom, instead in IDIOMS.items()
        if (match := re.search(idiom, part, flags=re.IGNORECASE))
    ]


def shown(path):
    """All texts that a file of the package may show: its literals, and of commands their help."""
    tree = ast.parse(path.read_text())
    holders = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    nodes = [node for node in ast.walk(tree) if isinstance(node, holders)]
    docstrings = {id(n.body[0].value) for n in nodes if n.body and isinstance(n.body[0], ast.Expr)}
    if "cli" in path.parts:
        docstrings = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(v.value if isinstance(v, ast.Constant) else "..." for v in node.values)
        elif isinstance(node, ast.Constant) and id(node) not in docstrings:
            yield str(node.value)


@pytest.mark.parametrize("path", [*pages.pages(), *pages.NOTEBOOKS], ids=lambda path: path.stem)
def test_words_are_plain(path):
    found = idioms(pages.prose(path))
    assert not found, "\n".join(found)


@pytest.mark.parametrize("made", ["report", "nothing"])
def test_words_of_a_report_are_plain(made):
    """Its page, and what `print` shows of it."""
    report = getattr(reports, made)()
    text = re.sub(r"<(style|svg)\b.*?</\1>", " ", page(report), flags=re.DOTALL)
    parts = re.split(r"</?(?:p|h\d|li|td|th|div|figcaption|aside|section|dd|dt)\b[^>]*>", text)
    words = [" ".join(html.unescape(re.sub(r"<[^>]+>", " ", part)).split()) for part in parts]
    assert len(" ".join(words)) > 1000
    found = idioms([*words, *str(report).splitlines()])
    assert not found, "\n".join(found)


def test_words_of_messages_results_and_commands_are_plain():
    """All that `print` of results, errors, warnings and the shell are put together from."""
    found = {str(p.relative_to(PACKAGE)): hits for p in SOURCES if (hits := idioms(shown(p)))}
    assert not found, "\n".join(f"{name}: {hits}" for name, hits in found.items())


@pytest.mark.parametrize(
    "path", [p for p in pages.pages() if p.name not in EVIDENCE], ids=lambda path: path.stem
)
def test_sentences_are_short(path):
    for part in pages.prose(path):
        for sentence in re.split(r"(?<=[.:;!?])\s", part):
            assert part.startswith("|") or len(sentence.split()) <= LONGEST, sentence


def test_the_list_finds_what_it_names():
    """A sentence of private idioms, as the pages once had them, is refused by several rules."""
    text = "Bands do not know of it; the drift goes on, nothing has seen the end, and it pays."
    assert len(idioms([text])) == 5


def test_messages_and_help_are_looked_at(tmp_path):
    source = '"""It goes on."""\nx = f"it {1} goes on"\ndef f():\n    """It goes on."""\n'
    for folder, count in (("cli", 4), ("data", 2)):  # parts of an f-string count again
        (tmp_path / folder).mkdir()
        path = tmp_path / folder / "file.py"
        path.write_text(source)
        assert len([text for text in shown(path) if idioms([text])]) == count
