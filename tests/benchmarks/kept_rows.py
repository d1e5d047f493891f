"""Rows of a study, a line of JSON each, in a file that several processes add to."""

from __future__ import annotations

import json
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any


def read_rows(path: Path, names: Sequence[str]) -> dict[tuple[Hashable, ...], dict[str, Any]]:
    """Rows by the values of their names, the last of each; without a line that a kill cut short."""
    rows: dict[tuple[Hashable, ...], dict[str, Any]] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        rows[tuple(row[name] for name in names)] = row
    return rows


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """One write of one line, after a fresh start of line: safe beside other processes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write("\n" + json.dumps(row) + "\n")
