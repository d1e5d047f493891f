"""What closing the loop came to, with its page."""

from __future__ import annotations

from pathlib import Path

from pyro_dynogp.discrepancy.result import LoopResult
from pyro_dynogp.report.html.page import page
from pyro_dynogp.support.errors import PATH
from pyro_dynogp.support.writing import write_text


class Report(LoopResult):
    """What closing the loop came to; the attributes are those of `LoopResult`."""

    def to_html(self, path: str | Path) -> None:
        """Write one self-contained page, figures inside.

        Raises:
            ValueError: where the file cannot be written; what was there before is there.
        """
        PATH.check("path", path)
        write_text(path, page(self), "The report")
