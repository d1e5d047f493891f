"""Predictions whose truth is known: a stationary Gaussian autoregression around a known mean."""

import numpy as np

import pyro_dynogp as dgp
from pyro_dynogp.prediction.prediction import Prediction


def series(rng, count, n, correlation):
    """Stationary first-order autoregressions (count, n) of variance one."""
    noise = rng.standard_normal((n, count))
    y = np.empty((n, count))
    y[0] = noise[0]
    for k in range(1, n):
        y[k] = correlation * y[k - 1] + np.sqrt(1 - correlation**2) * noise[k]
    return y.T


def mean_of(n):
    return 3.0 * np.sin(np.arange(n) / 7.0)


def predicted(
    n, *, correlation=0.0, samples=200, seed=0, scale=1.0, bias=0.0, draws=1, n_y=1,
    kind="simulation",
):  # fmt: skip
    """Prediction of mean + AR(1): right for scale 1 and bias 0.

    With several draws each has a level of its own, which all its joint samples share.
    """
    rng = np.random.default_rng([seed, 1])
    levels = np.linspace(-1.0, 1.0, draws) if draws > 1 else np.zeros(1)
    middle = np.repeat((mean_of(n) + bias)[:, None], n_y, axis=1)

    def sampler():
        parts = [
            middle[:, a] + scale * series(rng, samples, n, correlation)
            + rng.choice(levels, samples)[:, None]
            for a in range(n_y)
        ]  # fmt: skip
        return np.stack(parts, axis=-1)

    return Prediction(
        time=np.arange(n) * 0.5,
        output_names=("level", "flow")[:n_y],
        component_mean=middle + levels[:, None, None],
        component_variance=np.full((len(levels), n, n_y), 0.9 * scale**2),
        noise_variance=np.full((len(levels), n_y), 0.1 * scale**2),
        parts={},
        sampler=sampler,
        kind=kind,
    )


def measured(n, *, correlation=0.0, seed=0, n_y=1, levels=(0.0,)):
    """A record of the true process."""
    rng = np.random.default_rng([seed, 2])
    y = mean_of(n)[:, None] + series(rng, n_y, n, correlation).T + rng.choice(levels, n_y)
    return dgp.Record(
        np.arange(n) * 0.5, None, y, output_names=("level", "flow")[:n_y],
        output_units=("m", "m3/h")[:n_y],
    )  # fmt: skip
