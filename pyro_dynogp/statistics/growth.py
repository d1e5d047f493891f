"""Whether records grow as those of an unstable plant do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

ORDER = 8  # of the autoregression


def least_stable_pole(
    inputs: Sequence[np.ndarray], output: Sequence[np.ndarray]
) -> tuple[float, float] | None:
    """Log |z| [1/step] of the largest pole of an autoregression with inputs, and standard error.

    Of y_k = sum_i a_i y_(k-i) + sum_i b_i' u_(k-i) + c + e_k; positive for an unstable one.
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
    return float(np.log(np.abs(z))), float(error)
