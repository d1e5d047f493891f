"""Residuals that tests of several effects share."""

import dataclasses

import numpy as np
import pandas as pd
from scipy.signal import lfilter

from pyro_dynogp.effects.calendar import calendar
from pyro_dynogp.effects.extra_input import extra_input
from tests.discrepancy.made import coloured, lag
from tests.discrepancy.series import residuals

MELBOURNE = "Australia/Melbourne"


def step_inputs(seed, inputs=2):
    """Inputs that step, what they give, noise, and a generator."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal((400 // 5, inputs)), 5, axis=0)
    parts = np.column_stack([lag(u[:, j], 0.5 + 0.3 * j) for j in range(inputs)])
    return rng, u, parts, 0.15 * coloured(rng, 400, 0.7)


def two_paths(seed, noise=0.1):
    """Two inputs that step, what each gives, noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal((500 // 10, 2)), 10, axis=0)
    return u, lag(u[:, 0], 0.5), lag(u[:, 1], 0.8), noise * coloured(rng, 500, 0.7)


def first_extra(residuals, settings, seed=0):
    return extra_input(residuals, settings, seed=seed)[0]


def with_noise(r, x):
    """The same record with one-step errors x (n,)."""
    return dataclasses.replace(r, output=r.mean + x, innovations=x / x.std())


def growing_with_input(seed, n=400):
    r = residuals(seed, n, pole=0.0, inputs=2)
    u = r.inputs[:, 1] / r.inputs[:, 1].std()
    return with_noise(r, r.residual * np.exp(0.5 * u))


def closed_loop(seed, n=400):
    """A controller that answers one sample later; the model is right."""
    generator = np.random.default_rng(seed)
    e = 0.6 * lfilter([1.0], [1.0, -0.8], generator.standard_normal(n))
    reference = lfilter([1.0], [1.0, -0.9], generator.standard_normal(n))
    u, mean = np.zeros(n), np.zeros(n)
    for t in range(1, n):
        mean[t] = 0.7 * mean[t - 1] + 0.3 * u[t - 1]
        u[t] = 0.5 * (reference[t] - mean[t - 1] - e[t - 1])
    r = residuals(seed, n, inputs=2)
    inputs = np.column_stack([r.inputs[:, 0], u])
    return dataclasses.replace(r, inputs=inputs, mean=mean, output=mean + e)


def stamps(n, freq="h"):
    return pd.date_range("2023-03-18", periods=n, freq=freq, tz="UTC")


def of_the_week(residuals, settings, **options):
    """The calendar's first piece of evidence, in place of a detector of one."""
    return calendar(residuals, settings, **options)[0]


def trend(t, mean, u):
    return 1.5 * (2.0 * t / t[-1] - 1.0)


def step_at_150(t, mean, u):
    return 2.0 * (t >= 150.0)


def sine(t, mean, u):
    return 0.9 * np.sin(2.0 * np.pi * t / 13.3 + 1.0)


def gain_drift(t, mean, u):
    return 0.5 * np.cos(np.pi * t / t[-1]) * mean


def daylight_saving(seed, n=600):
    """Demand by local time; the model's clock is standard time. Summer ends in sample 352."""
    clock = stamps(n)
    standard = (np.asarray(clock.hour) + 10) % 24
    local = np.asarray(clock.tz_convert(MELBOURNE).hour)
    profile = 2.0 * np.exp(-0.5 * ((np.arange(24) - 18) / 3.0) ** 2)
    r = residuals(seed, n, step=1.0, stamps=clock)
    return dataclasses.replace(
        r,
        mean=r.mean + profile[standard],
        output=r.mean + profile[local] + 0.5 * r.residual,
        inputs=np.column_stack([r.inputs, standard]),
        input_names=("temperature", "hour"),
    )
