"""Pages of the documentation: blocks run, links resolve, the navigation is whole."""

from __future__ import annotations

import os
from pathlib import Path

import matplotlib
import pyro
import pytest
import yaml

import pyro_dynogp as dgp
from tests import pages

# Pages whose blocks another test runs, and checks: that of structures.md, effects.md, README.
ELSEWHERE = {"README.md", "structures.md", "effects.md"}
WITH_BLOCKS = [p for p in pages.pages() if p.name not in ELSEWHERE and pages.blocks(p)]


@pytest.mark.parametrize("path", WITH_BLOCKS, ids=lambda path: path.stem)
def test_blocks_run(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pyro.set_rng_seed(0)
    with matplotlib.rc_context(), pyro.get_param_store().scope():
        pages.run(path)


OF_THE_ROOT = [pages.ROOT / "CONTRIBUTING.md", pages.ROOT / "CHANGELOG.md"]


@pytest.mark.parametrize("path", [*pages.pages(), *OF_THE_ROOT], ids=lambda path: path.stem)
def test_links_resolve(path):
    for target in pages.links(path):
        file, _, anchor = target.partition("#")
        there = (path.parent / file).resolve() if file else path
        if there.parent == pages.DOCS / "tutorials":  # notebooks, executed for the site alone
            there, anchor = pages.ROOT / "notebooks" / f"{there.stem}.ipynb", ""
        assert there.exists(), f"{path.name}: {target}"
        if anchor and not anchor.startswith("pyro_dynogp."):
            assert anchor in pages.anchors(there), f"{path.name}: {target}"


class _Loader(yaml.SafeLoader):
    """Reads mkdocs.yml; tags that name Python objects are text."""


_Loader.add_multi_constructor("tag:yaml.org,2002:python/name:", lambda *_: "")


def navigation() -> list[str]:
    """Paths of the pages in the navigation, relative to docs/."""

    def flat(entry) -> list[str]:
        if isinstance(entry, str):
            return [entry]
        return [x for e in (entry if isinstance(entry, list) else entry.values()) for x in flat(e)]

    return flat(yaml.load((pages.ROOT / "mkdocs.yml").read_text(), _Loader)["nav"])


def test_the_navigation_is_whole():
    named = navigation()
    assert len(named) == len(set(named))
    markdown = {str(p.relative_to(pages.DOCS)) for p in pages.pages()[1:]}
    tutorials = {f"tutorials/{p.stem}.md" for p in (pages.ROOT / "notebooks").glob("*.ipynb")}
    outside = {"index.md", "contributing.md", "changes.md"}  # files of the root, see docs/hooks.py
    assert set(named) == markdown | tutorials | outside


def test_every_public_name_has_an_entry_in_the_reference():
    text = "\n".join(p.read_text() for p in (pages.DOCS / "reference").glob("*.md"))
    entries = [line.removeprefix("::: ") for line in text.splitlines() if line.startswith("::: ")]
    assert len(entries) == len(set(entries))
    functions = {f"pyro_dynogp.{home}.{name}" for name, home in dgp.HOMES.items()}
    modules = {f"pyro_dynogp.{home}" for home in dgp.MODULES.values()}
    assert functions | modules <= set(entries)


def test_paths_of_the_machine_are_in_no_page():
    for path in pages.pages():
        assert os.sep + "tmp" + os.sep not in path.read_text(), path.name
        assert str(Path.home()) + os.sep not in path.read_text(), path.name
