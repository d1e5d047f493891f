"""Whether bands hold on the last block: what changes there, no test before it has seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pyro_dynogp.criticism.leave_future_out import HOLDS, held_by, stretch_of
from pyro_dynogp.data.record import Record

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit

# Probability of as few samples in their bands from which that is no chance. It comes on top of the
# tests of the search: of 60 right linear models two had less than 80 %, with 0.02 and 0.027.
CHANCE = 0.01


def said_of_bands(
    fit: Fit, past: Record, sealed: Record, share: float, *, seed: int
) -> tuple[str, ...]:
    """In words, that forecasts of the last block do not hold; nothing where they do.

    As in `check`: less than 80 % of the samples are in their 95 % interval, and joint samples of
    the forecast hardly ever have as few.

    Args:
        fit: that the report relies on. past: blocks A and B. sealed: block C.
        share: of its samples inside the 95 % interval. seed: of joint samples.
    """
    if share >= HOLDS:
        return ()
    linear = fit.model.is_linear
    held = held_by([stretch_of(fit, past, sealed, seed)], linear, CHANCE)
    if held.right:
        return ()
    chance = f" (as few by chance: p = {held.p_value:.2g})" if linear else ""
    return (
        f"Forecasts of the last block do not hold: the 95 % interval has {held.share:.0%} of its "
        f"samples{chance}. Something acts there that the blocks before do not show, or that the "
        f"model took for noise. Do not rely on its bands.",
    )
