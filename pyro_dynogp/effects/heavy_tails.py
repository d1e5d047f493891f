"""Measurement noise with outliers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats
from scipy.optimize import minimize_scalar

from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Effect, number_of
from pyro_dynogp.layers.noise import StudentT
from pyro_dynogp.models.variants import Model, with_likelihood
from pyro_dynogp.statistics.autoregression import check_samples, fitted_filter
from pyro_dynogp.statistics.bootstrap import batches, tail_probability
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.serial import held_out_innovations, one_step_sd
from pyro_dynogp.statistics.settings import LoopSettings

# Degrees of freedom that are looked through; beyond the last a Student-t is normal.
LOWEST, HIGHEST = 1.0, 200.0


def heavy_tails(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """More outliers than normal noise has, in the held-out one-step errors.

    The statistic is their excess kurtosis, whitened once more, over its standard deviation under
    normal noise: locally the most powerful one against Student-t noise. Its null is simulated.

    Returns:
        where: degrees_of_freedom of the Student-t distribution of largest likelihood, outliers:
        count beyond what the largest of as many normal ones exceeds once in twenty records. gain
        is that of the Student-t over the normal distribution; size is the outliers' part of the
        one-step error [output].

    Source: kurtosis test as in D'Agostino & Pearson, Biometrika 60(3):613 (1973), by simulation.
    """
    r = residuals
    v = held_out_innovations(r, settings)
    w = fitted_filter(v, settings)(v)
    w = w[np.isfinite(w)]
    check_samples(len(w), settings, "innovations beside gaps")
    w = (w - w.mean()) / w.std()

    def drawn(generator: np.random.Generator, size: int) -> np.ndarray:
        return stats.kurtosis(generator.standard_normal((size, len(w))), axis=1)

    null = np.concatenate(list(batches(drawn, settings.replicates, seed)))
    statistic = float((stats.kurtosis(w) - null.mean()) / null.std())
    freedom, location, scale, gain = student_t(w)
    robust = 1.4826 * float(np.median(np.abs(w - np.median(w))))
    limit = float(stats.norm.isf(0.5 * settings.outlier / len(w)))
    far = np.abs(w - np.median(w)) > limit * robust
    probability = (np.arange(len(w)) + 0.5) / len(w)
    count = int(far.sum())
    return Evidence(
        effect="heavy tails",
        statistic=statistic,
        p_value=tail_probability((null - null.mean()) / null.std(), statistic, settings),
        gain=gain,
        size=one_step_sd(r, settings) * float(np.sqrt(np.square(w[far]).sum() / len(w))),
        where={"degrees_of_freedom": freedom, "outliers": float(count)},
        sentence=f"One-step errors of {r.output_name!r} have heavier tails than normal ones: "
        f"Student-t with {freedom:.2g} degrees of freedom; {count} of {len(w)} are outliers beyond "
        f"{limit:.1f} standard deviations.",
        curve=Curve(
            x=stats.norm.ppf(probability),
            y=np.sort(w),
            fitted=location + scale * stats.t.ppf(probability, freedom),
            x_label="normal quantile",
            y_label=f"one-step error of {r.output_name}, standardised",
        ),
    )


def student_t(w: np.ndarray) -> tuple[float, float, float, float]:
    """Student-t distribution of largest likelihood.

    Location and scale by expectation-maximisation (Lange, Little & Taylor, JASA 84(408):881, 1989)
    for each degrees of freedom.

    Args:
        w: (m,) standardised.

    Returns:
        Degrees of freedom, location, scale, and the gain over a normal distribution [nats].
    """

    def located(nu: float) -> tuple[float, float]:
        at, variance = float(np.median(w)), 0.5
        for _ in range(60):
            weights = (nu + 1.0) / (nu + (w - at) ** 2 / variance)
            at = float(weights @ w / weights.sum())
            variance, last = float(weights @ (w - at) ** 2 / len(w)), variance
            if abs(variance - last) < 1e-6 * last:
                break
        return at, float(np.sqrt(variance))

    def log_density(log_nu: float) -> float:
        nu = float(np.exp(log_nu))
        at, scale = located(nu)
        return float(stats.t.logpdf(w, nu, at, scale).sum())

    bounds = (np.log(LOWEST), np.log(HIGHEST))
    optimum = minimize_scalar(lambda x: -log_density(x), bounds=bounds, method="bounded")
    nu = float(np.exp(optimum.x))
    normal = float(stats.norm.logpdf(w, w.mean(), w.std()).sum())
    return nu, *located(nu), max(-float(optimum.fun) - normal, 0.0)


class HeavyTails(Effect):
    """Measurement noise with outliers."""

    name = "heavy tails"
    once = True
    score = "one step"
    family = "noise"
    acts_on = "noise"
    test = staticmethod(heavy_tails)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Student-t measurement noise."""
        nu = min(max(number_of(evidence, "degrees_of_freedom"), 2.2), 30.0)
        return [with_likelihood(model, StudentT(nu))]
