"""Pages of the documentation: their blocks of Python, headings and links."""

from __future__ import annotations

import json
import re
import textwrap
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
README = ROOT / "README.md"
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
SLOW = "<!-- slow -->"

_FENCED = re.compile(r"^([ ]*)```(\w*)[^\n]*\n(.*?)^\1```[ ]*$", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def pages() -> list[Path]:
    """All pages of the documentation, README first."""
    return [README, *sorted(DOCS.rglob("*.md"))]


def blocks(path: Path) -> list[tuple[str, bool]]:
    """Python of a page in order, each block with whether it is marked as slow."""
    text = path.read_text()
    found = []
    for match in _FENCED.finditer(text):
        if match.group(2) == "python":
            slow = text[: match.start()].rstrip().endswith(SLOW)
            found.append((textwrap.dedent(match.group(3)), slow))
    return found


def run(path: Path, names: dict[str, object] | None = None, *, slow: bool = False) -> dict:
    """Run the blocks of a page in one namespace; those marked as slow if asked to."""
    names = {} if names is None else names
    for code, marked in blocks(path):
        if slow or not marked:
            exec(compile(code, str(path), "exec"), names)
    return names


def prose(path: Path) -> list[str]:
    """Paragraphs of a page or a notebook without code, formulas, links and tags."""
    text = path.read_text()
    if path.suffix == ".ipynb":
        cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"]
        text = "\n\n".join("".join(cell["source"]) for cell in cells)
    text = _FENCED.sub("", text)
    text = re.sub(r"\$\$.*?\$\$|\$[^$\n]+\$|`[^`]*`|<!--.*?-->|<[^>]+>", " ", text, flags=re.DOTALL)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    return [" ".join(part.split()) for part in re.split(r"\n\s*\n|\n(?=[|*#-])", text)]


def slug(heading: str) -> str:
    """The anchor that a site and a repository's viewer both make of a heading."""
    plain = re.sub(r"[`*]", "", heading.strip().lower())
    return re.sub(r"[\s]+", "-", re.sub(r"[^\w\s-]", "", plain)).strip("-")


def anchors(path: Path) -> set[str]:
    """Anchors of the headings of a page."""
    text = _FENCED.sub("", path.read_text())
    return {slug(heading) for heading in re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)}


def links(path: Path) -> list[str]:
    """Targets of links and pictures that are not addresses of the web."""
    text = re.sub(r"`[^`]*`", "", _FENCED.sub("", path.read_text()))
    return [t for t in _LINK.findall(text) if not re.match(r"[a-z]+:", t)]
