"""The site as it was built: `make docs` looks for dead links and for warnings in its tutorials."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from tests import pages

FOLLOWED = {"a", "area"}  # tags whose address is not loaded with the page


class Page(HTMLParser):
    """Addresses in a page, each with its tag, the places that have a name, and the text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: list[tuple[str, str]] = []
        self.places: set[str] = set()
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value}
        self.places |= {given[name] for name in ("id", "name") if name in given}
        if ("rel", "canonical") not in attrs:
            self.targets += [(tag, given[name]) for name in ("href", "src") if name in given]

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def faults(site: Path) -> Iterator[str]:
    """What is wrong with a site, a line each."""
    found = {path: Page(path.read_text()) for path in sorted(site.resolve().rglob("*.html"))}
    for path, page in found.items():
        for tag, target in page.targets:
            address = urlsplit(target)
            if address.scheme or address.netloc:
                if tag not in FOLLOWED and address.scheme != "data":
                    yield f"{path.name}: needs a network for {target}"
                continue
            if path.name == "404.html":
                continue  # its links begin at the root of a server
            there = (path.parent / unquote(address.path)).resolve() if address.path else path
            place = unquote(address.fragment)
            if not there.exists():
                yield f"{path.name}: dead link {target}"
            elif place and there in found and place not in found[there].places:
                yield f"{path.name}: no place {target}"
    for notebook in pages.NOTEBOOKS:
        page = found.get(site.resolve() / "tutorials" / f"{notebook.stem}.html", Page(""))
        if not any(tag == "img" and target.endswith(".png") for tag, target in page.targets):
            yield f"{notebook.stem}: a tutorial without pictures"
        for words in page.words:
            if "Warning:" in words:
                yield f"{notebook.stem}: {words.strip()}"


def main(site: str) -> int:
    """Print what is wrong; whether anything is."""
    wrong = list(faults(Path(site)))
    print("\n".join(wrong) or f"{site}: every link leads somewhere, the tutorials have no warnings")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
