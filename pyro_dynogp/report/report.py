"""What closing the loop came to, with its page."""

from __future__ import annotations

from pathlib import Path

from pyro_dynogp.discrepancy.result import LoopResult
from pyro_dynogp.report.html.page import page


class Report(LoopResult):
    """What closing the loop came to; the attributes are those of `LoopResult`."""

    def to_html(self, path: str | Path) -> None:
        """Write one self-contained page, figures inside."""
        Path(path).write_text(page(self), encoding="utf-8")
