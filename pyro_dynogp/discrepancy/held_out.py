"""How well fits predict data that they have not seen, and which data those are."""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

from pyro_dynogp.criticism.comparison import block_standard_error
from pyro_dynogp.criticism.densities import pointwise_log_density
from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.stretches import stretches
from pyro_dynogp.effects.base import Score
from pyro_dynogp.fitting import Fit
from pyro_dynogp.inference.bayes_factor import VERY_STRONG, log_bayes_factor
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.prediction.first_state import beginning
from pyro_dynogp.prediction.predict import forecast
from pyro_dynogp.statistics.settings import LoopSettings

# Errors of forecasts are noise alone up to so many of its standard deviations: parameters learnt
# from a few hundred samples add some percent, and so many errors tell their size to four.
NOISE_ALONE = 1.1
# Other dynamics are tried beside more than this: what an effect leaves that is not described is
# several times the noise, and parameters of a step or a cube, learnt from 500 samples of systems
# with friction, add up to half of it. They take most of the time.
LITTLE_ELSE = 1.5


def without(record: Record, fold: np.ndarray) -> Record:
    """The record with the outputs of a fold missing; cut where nothing is left to the end."""
    y = record.outputs.copy()
    y[fold] = np.nan
    there = np.flatnonzero(np.isfinite(y).any(1))
    return record.with_outputs(y)[: there[-1] + 1]


def held_out_density(fit: Fit, record: Record, fold: np.ndarray, score: Score) -> np.ndarray:
    """Log-densities (N,) of the measured outputs of a fold [nats].

    "one step": each given all outputs before it, of the mixture of the fit's draws; outputs of one
    time follow one another. What is wrong with the noise shows there. "forecast": each by itself,
    given the inputs and the outputs before its stretch of the fold, as a normal whose standard
    deviation is that of the forecast times the factor that suits the fold best. What is wrong
    between inputs and output shows there, while outputs of one step before make up for much of it;
    and what is asked is which structure is right, not which posterior mode is least sure of itself.
    """
    return scored(fit, record, fold, score)[0]


def scored(
    fit: Fit, record: Record, fold: np.ndarray, score: Score
) -> tuple[np.ndarray, np.ndarray]:
    """What `held_out_density` says, and errors (M, n_y) of forecasts of the fold's stretches."""
    prepared = fit.model.check(record)[0]
    there = ~prepared.missing
    error, sd = (x[fold] for x in forecast_errors(fit, prepared, fold))
    if score == "one step":
        density = one_step_density(fit, prepared)[fold]
    else:
        density = forecast_density(error, sd)
    return density[there[fold]], error


def forecast_density(error: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Log-densities (n, n_y) of errors under the sds times the factor that suits them best [nats].

    NaN where the errors are.
    """
    z = error / sd
    spread = np.sqrt(np.nanmean(z**2, axis=0))
    density: np.ndarray = -0.5 * ((z / spread) ** 2 + np.log(2.0 * np.pi)) - np.log(spread * sd)
    return density


def forecast_errors(fit: Fit, record: Record, fold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, n_y) of forecasts of every stretch of a fold from its past, and their sds.

    In units of the output, NaN outside the fold; errors are NaN where the output is missing, too.
    """
    prepared = fit.model.check(record)[0]
    error = np.full(prepared.outputs.shape, np.nan)
    sd = error.copy()
    for part in stretches(fold):
        found = forecast(fit, prepared[: part.start], prepared[part], seed=fit.seed, warns=False)
        error[part] = prepared.outputs[part] - found.mean
        sd[part] = found.sd
    return error, sd


def one_step_density(fit: Fit, record: Record) -> np.ndarray:
    """Log-density (n, n_y) of each output given the outputs before it, NaN where missing."""
    (along,) = fit.model.prepare(record)
    outputs = output_process(beginning(fit, along, predicting=True), along)
    each = pointwise_log_density(outputs, along.observations, "forecast")
    return logsumexp(each, axis=0) - np.log(len(each))


def certain(gains: np.ndarray, settings: LoopSettings) -> bool:
    """Whether gains (N,) of single samples are certainly more than nothing in all [nats]."""
    error = settings.standard_errors * block_standard_error(gains)[0]
    return bool(gains.sum() > max(settings.gain, error))


def are_noise(errors: np.ndarray, fit: Fit, most: float = NOISE_ALONE) -> bool:
    """Whether errors (M, n_y) of forecasts are at most so often the noise that a fit has learnt."""
    if fit.system.noise.constant_sd is None:  # its size varies
        return False
    rmse = np.sqrt(np.nanmean(np.square(errors), axis=0))
    return bool((rmse <= most * fit.noise_sd).all())


def is_more_probable(one: Fit, best: Fit, gain: np.ndarray, settings: LoopSettings) -> bool:
    """Whether there is very strong evidence for a variant in the data of both, learnt and held out.

    The density of the data held out adds to the evidence of those learnt from. Neither may speak
    against it: these with very strong evidence, those with certainty. A block is short.

    Args:
        gain: of its log-density on held-out data [nats].
    """
    factor = log_bayes_factor(one, best)
    against = factor < -VERY_STRONG or certain(-gain, settings)
    return factor + float(gain.sum()) > VERY_STRONG and not against
