"""Forecasts of data held out whose errors are far more than the noise that a fit has learnt."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pyro_dynogp.data.channels import count_direct
from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.held_out import LITTLE_ELSE, forecast_errors

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit


def forecast_misses(fit: Fit, record: Record, held_out: np.ndarray) -> str:
    """In words, that forecasts of held-out data miss by far more than the noise; empty if not.

    One step ahead process noise explains what a model lacks, and residual tests see little of it.
    Forecasts of a motor with a dead zone missed by 5 times the noise, the most certain test had a
    false discovery rate of 0.25, and a function of its input was worth 37 nats of evidence.

    Args:
        fit: to what is not held out. record: along which. held_out: (n,) True where it is.
    """
    noise = fit.system.noise
    if not held_out.any() or noise.constant_sd is None:  # its size varies
        return ""
    prepared = fit.model.check(record)[0]
    if prepared.n_inputs == count_direct(fit.model.channels):  # noise alone drives it
        return ""
    errors = forecast_errors(fit, record, held_out)[0][held_out]
    with np.errstate(over="ignore"):  # a run that leaves the range misses, whatever its size
        rmse = np.sqrt(np.nanmean(np.square(errors), axis=0))
    far = ~(rmse <= LITTLE_ELSE * fit.noise_sd)
    if not far.any():
        return ""
    said = ", ".join(
        f"{name!r} {error:.3g} for {sd:.3g}"
        for name, error, sd, there in zip(
            record.output_names, rmse, fit.noise_sd, far, strict=True
        )
        if there
    )  # fmt: skip
    return f"Forecasts of the block that was searched miss by far more than the noise ({said})."
