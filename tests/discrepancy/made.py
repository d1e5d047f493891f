"""Records with a known effect: arrays, no fitted model."""

import numpy as np
from scipy import stats
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp.models.delays import longest_delay, where_inputs_are_known
from pyro_dynogp.statistics.autoregression import fitted_filter
from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.settings import LoopSettings

SETTINGS = LoopSettings()
# Fewer replicates, for many series.
FEW = LoopSettings(replicates=19, fewest_replicates=19)


def coloured(rng, shape, pole):
    """Autoregressive noise along the first dimension, standard deviation about one."""
    return lfilter([np.sqrt(1 - pole**2)], [1, -pole], rng.standard_normal(shape), axis=0)


def lag(u, tau, step=0.1, gain=1.0):
    """First-order response of a held signal; time constant in the unit of the step."""
    a = np.exp(-step / tau)
    return gain * lfilter([0.0, 1.0 - a], [1.0, -a], u - u.mean(0), axis=0)


def residuals_of(
    output,
    mean,
    inputs,
    candidates=None,
    *,
    step=0.1,
    seed=0,
    names=None,
    time=None,
    drawn=0.02,
    poles=None,
):
    """What a detector gets; draws of the parameters differ in the gain of the mean."""
    rng = np.random.default_rng(seed + 1000)
    e = output - mean
    inside = fitted_filter(e, SETTINGS)
    innovations = np.concatenate([np.full(inside.order, np.nan), inside(e)])
    n = len(output)
    return Residuals(
        time=np.arange(n) * step if time is None else time,
        output=output,
        mean=mean,
        deviations=drawn * rng.standard_normal((20, 1)) * np.std(e) / np.std(mean) * mean,
        innovations=innovations / np.nanstd(innovations),
        poles=np.array([-2.0 + 1.0j]) if poles is None else poles,
        inputs=inputs,
        input_names=tuple("uvwxyz"[: inputs.shape[1]]) if names is None else names,
        candidates=candidates or {},
        held_out=np.arange(n) >= n // 10,
        output_name="speed",
        output_unit="rpm",
        time_unit="s",
        step=step,
    )


def null_record(seed, n=400, inputs=1):
    """Nothing lacks; noise is coloured, and so are inputs and a candidate."""
    rng = np.random.default_rng(seed)
    u = coloured(rng, (n, inputs), 0.9)
    mean = lag(u, 0.5).sum(1)
    output = mean + 0.3 * coloured(rng, n, 0.7)
    return residuals_of(output, mean, u, {"ambient": coloured(rng, n, 0.95)}, seed=seed)


def within_chance(hits, trials, probability):
    """Whether a number of hits is inside the central 99.9 % of the binomial distribution."""
    low, high = stats.binom.ppf([0.0005, 0.9995], trials, probability)
    return low <= hits <= high


def fitted_mode(model, record):
    """Posterior mode of a linear model, on the samples for which it knows its inputs."""
    known = where_inputs_are_known(record, longest_delay(model))
    return dgp.fit(model, known, method="map", restarts=3, workers=1, progress=False)
