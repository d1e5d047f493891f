"""Hooks of mkdocs: pages of the site that are files outside of this folder."""

from __future__ import annotations

import html
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
# Page of the site -> file of the repository.
OUTSIDE = {
    "index.md": "README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changes.md": "CHANGELOG.md",
}
# Pages whose tables need the whole width; the navigation beside the first page is empty.
WIDE = ("comparison.md", "deep_models.md", "planted.md", "paper.md")
HOME = "index.md"
# What pandas writes around its tables; the theme would leave such tables too wide for a phone.
FRAME = re.compile(r'<style scoped>.*?</style>|(?<=<table) border="1" class="dataframe"', re.DOTALL)
TUTORIALS = ROOT / "build" / "tutorials"


def on_files(files: Files, config) -> Files:
    """Add README, CONTRIBUTING, CHANGELOG, and the notebooks as nbconvert has executed them."""
    for page, source in OUTSIDE.items():
        content = for_site((ROOT / source).read_text())
        files.append(File.generated(config, page, content=content))
    for path in sorted(p for p in TUTORIALS.rglob("*") if p.is_file()):
        page = f"tutorials/{path.relative_to(TUTORIALS).as_posix()}"
        files.append(File.generated(config, page, abs_src_path=str(path)))
    return files


def for_site(text: str) -> str:
    """Links of a file at the root of the repository, as the site has them."""
    text = re.sub(r"\]\(docs/", "](", text)
    for page, source in OUTSIDE.items():
        text = re.sub(rf"\]\({re.escape(source)}(#[^)]*)?\)", rf"]({page}\1)", text)
    return text


def on_page_markdown(markdown: str, page, **_: object) -> str:
    """Links from pages of this folder to files outside of it; room for wide tables and code."""
    if page.file.src_uri in WIDE:
        page.meta["hide"] = ["navigation", "toc"]
    elif page.file.src_uri == HOME:
        page.meta["hide"] = ["navigation"]
    for name, source in OUTSIDE.items():
        markdown = re.sub(rf"\]\(((?:\.\./)*)\.\./{re.escape(source)}\)", rf"](\1{name})", markdown)
    return markdown


def on_page_content(content: str, **_: object) -> str:
    """Formulas as MathML, which browsers show without a script or a network; plain tables."""

    def formula(match: re.Match[str]) -> str:
        tag, text = match[1], html.unescape(match[2]).strip()
        display = "block" if tag == "div" else "inline"
        return f'<{tag} class="formula">{convert(text[2:-2], display=display)}</{tag}>'

    content = FRAME.sub("", content)
    return re.sub(r'<(div|span) class="arithmatex">(.*?)</\1>', formula, content, flags=re.DOTALL)
