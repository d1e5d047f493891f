"""The model's own paths from each input to the output, read off its simulated mean.

A detector that sends a changed input (dead zone, play, a power) through the model's own dynamics
needs one column where a bank of filters needs many, and so sees smaller effects.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.regression import with_past
from pyro_dynogp.statistics.responses import filtered, responses, standardised, time_constants
from pyro_dynogp.support.errors import invalid

# Inputs beyond which gains are looked at in the mean as a whole only.
INPUTS = 4
# Order of the difference equation whose poles are tried, and columns beyond which fewer are used.
ORDER, COLUMNS = 6, 240


@dataclass(frozen=True, eq=False)
class Paths:
    """Linear paths from the inputs to the mean.

    Attributes:
        rates: (P,) of the filters [1 / time unit]. lags: steps.
        weights: (n_u, K) of the filters of `filtered` [output / input].
        shares: (n, n_u) what each input contributes to the mean [output]; with one input the mean
            itself, whatever the model is.
    """

    time: np.ndarray
    step: float
    rates: np.ndarray
    lags: int
    weights: np.ndarray
    shares: np.ndarray

    def __call__(self, j: int, signals: np.ndarray) -> np.ndarray:
        """Signals (n, m) in the place of input j: what the mean would be, (n, m) [output]."""
        columns = filtered(signals, self.step, self.time, self.rates, self.lags)
        return columns @ self.weights[j]


def check_inputs(residuals: Residuals) -> None:
    """Whether the model has an input with dynamics.

    Raises:
        ValueError: where it has none.
    """
    if not residuals.inputs.shape[1]:
        raise invalid("residuals", expected="an input that acts on the mean", got="no inputs")


def paths(residuals: Residuals) -> Paths:
    """Least squares of the mean on filters of the inputs; the mean has no noise.

    The filters' rates are time constants on a grid and the poles of a difference equation fitted
    to mean and inputs, which are those of the model where it is linear.

    Raises:
        ValueError: where the model has no input with dynamics.
    """
    check_inputs(residuals)
    r = residuals
    n, n_u = r.inputs.shape
    budget = min(COLUMNS, n // 4) // n_u
    constants, lags = int(np.clip(budget - 4, 2, 8)), 2 if budget > 8 else 0
    rates = (-1.0 / time_constants(r.step, r.time, constants)).astype(complex)
    if budget >= constants + 3 + ORDER:
        rates = np.concatenate([rates, _poles(r)])
    columns = filtered(r.inputs, r.step, r.time, rates, lags)
    K = columns.shape[2]
    flat = columns.reshape(n, -1)
    size = np.where((size := flat.std(0)) > 0, size, 1.0)
    mean = r.mean - r.mean.mean()
    scaled = flat / size
    weights = np.linalg.lstsq(scaled - scaled.mean(0), mean, rcond=1e-7)[0] / size
    weights = weights.reshape(n_u, K)
    shares = np.einsum("njk,jk->nj", columns, weights) if n_u != 1 else mean[:, None]
    return Paths(r.time, r.step, rates, lags, weights, shares)


def contributions(residuals: Residuals) -> tuple[list[str], np.ndarray]:
    """What gains act on: the mean as a whole, and what each of a few inputs contributes to it.

    Returns:
        Names of the output and of the inputs, and the deviation of each from its average (n, K)
        [output]; nothing where the mean is constant.
    """
    r = residuals
    names, signals = [r.output_name], [r.mean - r.mean.mean()]
    if not signals[0].std() > 0:
        return [], np.zeros((len(r), 0))
    if 2 <= len(r.input_names) <= INPUTS:
        shares = paths(r).shares
        names += r.input_names
        signals += list((shares - shares.mean(0)).T)
    return names, np.column_stack(signals)


def _poles(residuals: Residuals) -> np.ndarray:
    """Stable poles of m_t = sum_i a_i m_(t-i) + sum_ij b_ij u_j,(t-i), as continuous rates.

    Steps are taken as equal: where they are not, the poles are guesses among others. Of a
    conjugate pair one is kept.
    """
    r = residuals
    n = len(r)
    signals = standardised(np.column_stack([r.mean, np.nan_to_num(r.inputs)]))
    past = np.column_stack([signals[ORDER - i : n - i] for i in range(1, ORDER + 1)])
    past = np.column_stack([past, signals[ORDER:, 1:]])
    a = np.linalg.lstsq(past, signals[ORDER:, 0], rcond=1e-9)[0][: ORDER * signals.shape[1]]
    poles = np.roots(np.concatenate([[1.0], -a[:: signals.shape[1]]]))
    # A pole that has decayed within a step is a lag, and those exist already.
    kept = poles[(np.abs(poles) < 0.9999) & (np.abs(poles) > 0.02) & (poles.imag >= 0)]
    kept = kept[(kept.imag > 0) | (kept.real > 0)]
    return np.log(kept.astype(complex)) / r.step


def several_valued(residuals: Residuals) -> list[int]:
    """Places of the inputs that take more than two values."""
    return [j for j, u in enumerate(residuals.inputs.T) if len(np.unique(u[np.isfinite(u)])) > 2]


def looked_at(residuals: Residuals) -> int:
    """Number of samples that are held out and measured."""
    return int((residuals.held_out & np.isfinite(residuals.output)).sum())


def input_columns(residuals: Residuals) -> np.ndarray:
    """The mean and responses of the inputs, (n, 1 + n_u K): what no other effect may claim.

    No more than about an eighth of as many columns as samples are looked at.
    """
    n_u = residuals.inputs.shape[1]
    each = looked_at(residuals) // (8 * max(n_u, 1))
    constants = int(np.clip(each - 2, 1, 6))
    bank = responses(
        residuals.inputs,
        residuals.step,
        residuals.time,
        constants=constants,
        lags=1 if each >= 4 else 0,
    )
    return np.column_stack([with_past(residuals.mean), bank])


def linear_responses(residuals: Residuals, path: Paths) -> np.ndarray:
    """What is linear in the inputs, with the model's own dynamics and with others."""
    return np.column_stack([input_columns(residuals), with_past(standardised(path.shares))])
