"""Blocks of the documentation that are marked as slow, run with all others of their pages."""

from __future__ import annotations

import contextlib
import tempfile
import time
from pathlib import Path

import pyro

from tests import pages
from tests.benchmarks.markdown import table


def run(folder: Path) -> str:
    """Seconds of each page with such a block."""
    rows = []
    for path in pages.pages():
        if any(slow for _, slow in pages.blocks(path)):
            begin = time.perf_counter()
            with (
                tempfile.TemporaryDirectory() as empty,
                contextlib.chdir(empty),
                pyro.get_param_store().scope(),
            ):
                pages.run(path, {"__name__": "__main__"}, slow=True)
            rows.append([path.name, f"{time.perf_counter() - begin:.0f}"])
    return table(["page", "seconds"], rows)
