"""Whether records grow as those of an unstable plant do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

# Order of the autoregression. The pole has to multiply its state by exp(GROWTH) within the record,
# and to lie SURE standard errors beyond the boundary of stability.
ORDER, GROWTH, SURE = 8, 3.0, 3.0


@dataclass(frozen=True)
class Growth:
    """The least stable pole of an autoregression with inputs, by least squares.

    Attributes:
        rate: log |z| of its pole z, positive for an unstable one [1/step]. error: standard error.
        steps: length of the longest record.
    """

    rate: float
    error: float
    steps: int

    @property
    def unstable(self) -> bool:
        """Whether the pole is unstable beyond doubt, and matters within the record."""
        return self.rate * self.steps > GROWTH and self.rate > SURE * self.error


def growth(inputs: Sequence[np.ndarray], output: Sequence[np.ndarray]) -> Growth | None:
    """The least stable pole of y_k = sum_i a_i y_(k-i) + sum_i b_i' u_(k-i) + c + e_k.

    Least squares of one-step errors finds poles of plants in closed loops, stable or not (Ljung
    1999, System Identification, 13.4). None where too few rows are complete.

    Args:
        inputs: (n, n_u) of each record, equal steps. output: (n,), NaN where missing.
    """
    y, X = [], []
    for u, one in zip(inputs, output, strict=True):
        lagged = [one[ORDER - k : len(one) - k, None] for k in range(1, ORDER + 1)]
        lagged += [u[ORDER - k : len(u) - k] for k in range(ORDER + 1)]
        if len(one) > ORDER:
            X.append(np.concatenate([*lagged, np.ones((len(one) - ORDER, 1))], axis=1))
            y.append(one[ORDER:])
    if not X:
        return None
    rows, target = np.concatenate(X), np.concatenate(y)
    complete = np.isfinite(rows).all(1) & np.isfinite(target)
    rows, target = rows[complete], target[complete]
    free = len(rows) - rows.shape[1]
    if free < rows.shape[1]:
        return None
    estimate, *_ = np.linalg.lstsq(rows, target, rcond=None)
    a = np.concatenate([[1.0], -estimate[:ORDER]])
    variance = np.sum((target - rows @ estimate) ** 2) / free
    covariance = variance * np.linalg.pinv(rows.T @ rows)[:ORDER, :ORDER]
    poles = np.roots(a)
    z = poles[np.argmax(np.abs(poles))]
    slope = z ** (ORDER - np.arange(1, ORDER + 1)) / np.polyval(np.polyder(a), z) / z
    error = np.sqrt(slope.real @ covariance @ slope.real)
    return Growth(float(np.log(np.abs(z))), float(error), max(len(one) for one in output))
