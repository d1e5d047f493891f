"""`python -m tests.references [compare] [fits|loo|loops] [file]`: compute the cases into a file.

`compare` prints, for each case of a file, the largest relative difference from the stored values;
on one machine linear fits agree to the bit, and loops give the same names.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from tests.references.cases import GROUPS

HERE = Path(__file__).parent


def compute(groups: list[str], path: Path) -> None:
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


def difference(found: Any, stored: Any) -> float:
    """Largest difference over the largest stored number; infinite for other texts or shapes."""
    if isinstance(stored, dict):
        parts = [difference(found[k], v) for k, v in stored.items() if k != "seconds"]
        return max(parts, default=0.0)
    if isinstance(stored, str) or (stored and isinstance(stored, list) and
                                   isinstance(stored[0], str)):  # fmt: skip
        return 0.0 if found == stored else np.inf
    a, b = np.atleast_1d(found).astype(float), np.atleast_1d(stored).astype(float)
    if a.shape != b.shape:
        return np.inf
    return float(np.abs(a - b).max(initial=0.0) / max(np.abs(b).max(initial=0.0), 1e-300))


def compare(groups: list[str], path: Path) -> None:
    """Print how far the cases of a file are from the stored ones."""
    found, stored = json.loads(path.read_text()), json.loads((HERE / "values.json").read_text())
    for group in groups:
        for name, case in found.get(group, {}).items():
            worst = {k: difference(case[k], v) for k, v in stored[group][name].items()
                     if k != "seconds"}  # fmt: skip
            text = ", ".join(f"{k} {v:.1e}" for k, v in worst.items() if v > 0.0)
            print(f"{group}: {name}: {text or 'equal to the bit'}")


if __name__ == "__main__":
    given = sys.argv[1:]
    chosen = [g for g in given if g in GROUPS] or list(GROUPS)
    file = next((Path(g) for g in given if g not in (*GROUPS, "compare")), HERE / "values.json")
    (compare if "compare" in given else compute)(chosen, file)
