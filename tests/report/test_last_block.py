"""What a report says of the last block."""

from __future__ import annotations

import pytest

from pyro_dynogp import LoopSettings
from pyro_dynogp.report.last_block import does_not_pay

BEFORE = {"rmse": 1.0, "crps": 0.5}


@pytest.mark.parametrize(
    ("after", "gain", "warned"),
    [
        ({"rmse": 0.5, "crps": 0.25}, 20.0, False),
        ({"rmse": 0.5, "crps": 0.25}, -5.0, False),  # within two standard errors
        ({"rmse": 0.5, "crps": 0.25}, -7.0, True),  # forecasts are better, the density is not
        ({"rmse": 1.02, "crps": 0.51}, 20.0, False),  # noise of another kind
        ({"rmse": 1.3, "crps": 0.4}, 20.0, False),  # one of the scores is better
        ({"rmse": 1.3, "crps": 0.7}, 20.0, True),
    ],
)
def test_what_does_not_pay_is_said(after: dict[str, float], gain: float, warned: bool) -> None:
    found = does_not_pay(BEFORE, after, gain, 3.0, LoopSettings())
    assert bool(found) is warned
    if warned:
        assert f"CRPS 0.5 -> {after['crps']:.3g}, elpd {gain:+.1f} +- 3.0 nats" in found[0]
