"""`python -m tests.references [fits|loo|loops] [file]`: compute the cases into a file of JSON."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from tests.references.cases import GROUPS

HERE = Path(__file__).parent


def main(groups: list[str], path: Path) -> None:
    """Compute what is missing of some groups; the file is written after every case."""
    found = json.loads(path.read_text()) if path.exists() else {}
    for group in groups:
        kept = found.setdefault(group, {})
        for name, case in GROUPS[group].items():
            if name in kept:
                continue
            begin = time.perf_counter()
            kept[name] = case()
            print(f"{group}: {name}: {time.perf_counter() - begin:.1f} s", flush=True)
            path.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(
        [g for g in given if g in GROUPS] or list(GROUPS),
        Path(next((g for g in given if g not in GROUPS), HERE / "values.json")),
    )
