"""A last block whose bands hold too little is said where the outcome is read."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pyro_dynogp.criticism.leave_future_out import Stretch
from pyro_dynogp.report import last_block_bands
from pyro_dynogp.report.last_block_bands import said_of_bands
from tests.discrepancy.test_loop import close, fitted, machine


@pytest.mark.parametrize(
    ("level", "outcome"), [(0.0, "nothing missing"), (0.3, "structure left, cause unknown")]
)
def test_what_changes_in_the_last_block_alone_is_left(
    level: float, outcome: str, tmp_path: Path
) -> None:
    """No test of the search can see it: the level is six standard deviations higher there."""
    record = machine(seed=1)
    late = np.arange(len(record)) >= 240 + (len(record) - 240) // 2
    report = close(fitted(record), record.with_outputs(record.outputs + level * late[:, None]))
    assert report.outcome == outcome
    assert [one.startswith("Forecasts of the last block do not hold") for one in report.left] == (
        [True] if level else []
    )
    assert (report.before["coverage_95"] < 0.5) is bool(level)
    report.to_html(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert ("Do not rely on its bands" in page) is bool(level)
    assert ("The model leaves structure in the data" in page) is bool(level)


@pytest.mark.parametrize(
    ("inside", "low", "linear", "said"),
    [
        (79, 3, True, True),  # (1 + 3) / 401 is below 1 %
        (79, 4, True, False),
        (80, 0, True, False),  # as many as asked
        (79, 400, False, True),  # of models with functions the share alone
        (80, 400, False, False),
    ],
)
def test_share_and_chance(
    monkeypatch: pytest.MonkeyPatch, inside: int, low: int, linear: bool, said: bool
) -> None:
    stretch = Stretch(inside, 100, np.where(np.arange(400) < low, 70, 95))
    monkeypatch.setattr(last_block_bands, "stretch_of", lambda *given: stretch)
    fit: Any = SimpleNamespace(model=SimpleNamespace(is_linear=linear))
    record: Any = None
    found = said_of_bands(fit, record, record, inside / 100, seed=0)
    assert len(found) == said
    assert not said or "has 79% of its samples" in found[0]
    assert not said or ("by chance: p = 0.01" in found[0]) is linear
