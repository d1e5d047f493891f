"""Effects of noise on one-step errors: heavy tails, and a size that depends on something.

Serial structure is in `serial_effects`.
"""

from __future__ import annotations

import numpy as np
from scipy import stats
from scipy.optimize import minimize_scalar

from pyro_dynogp.data.signals import held
from pyro_dynogp.statistics.autoregression import fitted_filter
from pyro_dynogp.statistics.bootstrap import columns_score, replicates, sieve, spanning
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.responses import filtered
from pyro_dynogp.statistics.scan import tail_probability
from pyro_dynogp.statistics.serial import (
    feedback,
    held_out_innovations,
    one_step_sd,
    process_noise,
)
from pyro_dynogp.support.errors import invalid

__all__ = ["feedback", "heavy_tails", "heteroscedastic_noise", "process_noise"]

REPLICATES = 400
# Degrees of freedom that are looked through; beyond the last a Student-t is normal.
LOWEST, HIGHEST = 1.0, 200.0
# Slow responses that may drive the size of the noise [steps].
MEMORY = (4.0, 16.0)


def heavy_tails(residuals: Residuals, *, seed: int = 0) -> Evidence:
    """More outliers than normal noise has, in the held-out one-step errors.

    The statistic is their excess kurtosis, whitened once more, over its standard deviation under
    normal noise: locally the most powerful one against Student-t noise. Its null is simulated.

    Args:
        residuals: of one output (n,). seed: of the simulated null.

    Returns:
        where: degrees_of_freedom of the Student-t distribution of largest likelihood, outliers:
        count beyond what the largest of as many normal ones exceeds once in twenty records. gain
        is that of the Student-t over the normal distribution; size is the outliers' part of the
        one-step error [output].

    Raises:
        ValueError: where fewer than 30 held-out samples are measured.

    Source: kurtosis test as in D'Agostino & Pearson, Biometrika 60(3):613 (1973), by simulation.
    """
    r = residuals
    v = held_out_innovations(r)
    w = fitted_filter(v)(v)
    w = w[np.isfinite(w)]
    if len(w) < 30:
        raise invalid("residuals", expected="30 innovations beside gaps", got=str(len(w)))
    w = (w - w.mean()) / w.std()
    # As many as a batch holds: their memory grows with the record.
    null = stats.kurtosis(
        np.random.default_rng(seed).standard_normal((REPLICATES, len(w)), dtype=np.float32), axis=1
    )
    statistic = float((stats.kurtosis(w) - null.mean()) / null.std())
    freedom, location, scale, gain = student_t(w)
    robust = 1.4826 * float(np.median(np.abs(w - np.median(w))))
    limit = float(stats.norm.isf(0.025 / len(w)))
    far = np.abs(w - np.median(w)) > limit * robust
    probability = (np.arange(len(w)) + 0.5) / len(w)
    count = int(far.sum())
    return Evidence(
        effect="heavy tails",
        statistic=statistic,
        p_value=tail_probability((null - null.mean()) / null.std(), statistic),
        gain=gain,
        size=one_step_sd(r) * float(np.sqrt(np.square(w[far]).sum() / len(w))),
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
    found = minimize_scalar(lambda x: -log_density(x), bounds=bounds, method="bounded")
    nu = float(np.exp(found.x))
    normal = float(stats.norm.logpdf(w, w.mean(), w.std()).sum())
    return nu, *located(nu), max(-float(found.fun) - normal, 0.0)


def heteroscedastic_noise(residuals: Residuals, *, seed: int = 0) -> Evidence:
    """Noise whose size depends on an input, on the mean or on time.

    The size of the held-out one-step errors is regressed on each driver d: d and |d - median|,
    as they are or through a first-order response; on time by slow cosines. The absolute value
    stands for the size: under normal noise it has 88 % of the efficiency of the square, the
    logarithm of the square 40 %, and outliers do not carry it. Sizes that only cluster in time, as
    in autoregressive conditional heteroscedasticity, are the colour of the size, and no driver.

    Args:
        residuals: of one output (n,). seed: of the replicates.

    Returns:
        where: driver (an input's name, "mean" or "time"). size: standard deviation over the record
        of the one-step error's standard deviation [output].

    Raises:
        ValueError: where fewer than 30 held-out samples are measured.

    Source: Glejser, JASA 64(325):316 (1969); efficiencies: Davidian & Carroll, JASA 82(400):1079
    (1987). The null: `sieve`.
    """
    r = residuals
    v = held_out_innovations(r)
    y = np.abs(v - np.nanmean(v))
    names, variants = list[str](), list[np.ndarray]()
    for name, driver in [*zip(r.input_names, r.inputs.T, strict=True), ("mean", r.mean)]:
        d = held(driver)
        if not np.std(d) > 0:
            continue
        both = np.column_stack([d, np.abs(d - np.median(d))])
        slow = filtered(both, r.step, r.time, -1.0 / (r.step * np.array(MEMORY)), lags=0)
        variants += list(np.moveaxis(slow, 2, 0))
        names += [name] * slow.shape[2]
    t = (r.time - r.time[0]) / (r.time[-1] - r.time[0])
    cosines = np.cos(np.pi * t[:, None] * np.arange(1, 5))
    variants += [cosines[:, :1], cosines[:, :2], cosines]
    names += ["time"] * 3
    columns = np.column_stack(variants)
    columns = columns - columns.mean(0)
    ends = np.cumsum([v.shape[1] for v in variants])
    found = sieve(
        y,
        columns_score(
            columns,
            [np.arange(b - v.shape[1], b) for v, b in zip(variants, ends, strict=True)],
            spanning(columns[:, :0]),
            ~np.isfinite(y),
        ),
        np.array([v.shape[1] for v in variants]),
        first=columns if columns.shape[1] < np.isfinite(y).sum() // 5 else cosines,
        replicates=replicates(len(r), columns.shape[1]),
        seed=seed,
    )
    name = names[found.best]
    average = float(np.nanmean(y))
    level = np.maximum(average + found.fitted, 0.05 * average)
    low, high = np.quantile(level[np.isfinite(y)], [0.05, 0.95])
    unit = one_step_sd(r) / average
    shown = r.time if name == "time" else variants[found.best][:, 0]
    label = name if name == "time" else f"{name}, as it acts"
    what = "the mean" if name == "mean" else name if name == "time" else repr(name)
    return Evidence(
        effect="heteroscedastic noise",
        statistic=found.statistic,
        p_value=found.p_value,
        gain=found.gain,
        size=unit * found.size,
        where={"driver": name},
        sentence=f"The noise of {r.output_name!r} depends on {what}: its standard deviation varies "
        f"by a factor of {high / low:.2g} (5 to 95 % of the samples).",
        curve=_by_level(shown, unit * y, unit * level, label, r),
    )


def _by_level(
    x: np.ndarray, y: np.ndarray, fitted: np.ndarray, label: str, r: Residuals, bins: int = 20
) -> Curve:
    """Size of the noise, averaged in bins of equal count of what drives it."""
    known = np.flatnonzero(np.isfinite(y))
    parts = np.array_split(known[np.argsort(x[known], kind="stable")], bins)
    parts = [p for p in parts if len(p)]
    return Curve(
        x=np.array([x[p].mean() for p in parts]),
        y=np.array([y[p].mean() for p in parts]),
        fitted=np.array([fitted[p].mean() for p in parts]),
        x_label=label,
        y_label=f"standard deviation of the noise of {r.output_name} [{r.output_unit}]",
    )
