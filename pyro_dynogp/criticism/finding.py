"""One thing that a check looked at, and numbers beside their limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        name: what. value: its number, NaN where there is none. good: None where it only informs.
        text: what it says, in words.
        limit: what the value is held against, None where it is not.
    """

    name: str
    value: float
    good: bool | None
    text: str
    limit: float | None = None

    @property
    def number(self) -> str:
        """The value, with so many digits that it differs from its limit."""
        if np.isnan(self.value):
            return ""
        if self.limit is None:
            return format(self.value, ".3g")
        return apart(self.value, self.limit)[0]


def apart(value: float, limit: float) -> tuple[str, str]:
    """Both numbers with two decimals, or as many more as it takes to tell them apart (up to 6)."""
    texts = "", ""
    for digits in range(2, 7):
        texts = f"{value:.{digits}f}", f"{limit:.{digits}f}"
        if texts[0] != texts[1]:
            break
    return texts
