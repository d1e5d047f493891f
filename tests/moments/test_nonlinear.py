"""How good Gaussian moments are where layers are not linear: brute force and particle filters.

Joint moments of the state and the function's output serve inside a cascade ("joint"); the exact
first two moments given each sample where the function is what is measured ("measured").

That the equations are right is checked to rounding elsewhere (test_smoothing, test_exactness). Here
the method's own error is measured; bounds are about 1.3 times what was measured, and wherever the
nonlinearity matters the error has to be well below that of linearising at the mean, which an
equation gone wrong would not achieve.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import norm

from pyro_dynogp.moments import filtering, smoothing
from pyro_dynogp.moments.problem import log_density
from tests.moments import oracles
from tests.moments.problems import element
from tests.moments.wiener import (
    Wiener,
    backward_draws,
    brute_force,
    particle_filter,
)


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def smoothed(w, measured):
    """Mean and sd of g given all outputs: ours, and of the linearised filter."""
    problem = w.problem(measured)
    values = element(problem)
    row = np.array([[*w.system.C[0], 0.0]])
    _, track, _, _ = filtering.run(problem.layout, values)
    mean, variance = smoothing.smooth(problem.layout, values, row, track)
    linear = oracles.run(problem.layout, values, oracles.linearised)
    linear_mean, _ = oracles.smooth(problem.layout, values, linear)
    ours = w.known + mean @ row[0], np.sqrt(variance[:, 0])
    return ours, w.known + linear_mean @ row[0], float(log_density(problem)), linear.log_density


@pytest.mark.parametrize(("name", "error"), [("mild", 1e-6), ("saturation", 2e-4),
                                             ("positive part", 0.02)])  # fmt: skip
def test_moments_of_one_sample(name, error):
    """Mean and variance of f(g) to quadrature accuracy (a kink costs most): by scipy's."""
    for seed in range(6):
        w = Wiener(name, 1, seed=seed, noise_sd=0.3)
        g = norm(w.known[0], np.sqrt(w.covariance[0, 0]))
        low, high = g.interval(1.0 - 1e-12)
        points = [0.0] if low < 0.0 < high else None
        first, second = (
            quad(lambda x, power=power, g=g, w=w: g.pdf(x) * w.f(x) ** power, low, high,
                 points=points, limit=200)[0]
            for power in (1, 2)
        )  # fmt: skip
        exact = norm(first, np.sqrt(second - first**2 + w.noise_sd**2))
        assert float(log_density(w.problem())) == pytest.approx(exact.logpdf(w.y[0]), abs=error)


# Bounds: error of the log-likelihood [nats, mean], of smoothed means [posterior sds, rms], of
# smoothed sds [logarithm, rms]. Measured: 0.03, 0.02, 0.024; 0.2, 0.11, 0.13; 0.15, 0.14, 0.09;
# then 0.0002, 0.001, 0.004; 0.004, 0.023, 0.04; 0.002, 0.021, 0.03.
@pytest.mark.parametrize(("name", "measured", "bounds"), [
    ("mild", False, (0.045, 0.03, 0.035)),
    ("saturation", False, (0.28, 0.15, 0.17)),
    ("positive part", False, (0.22, 0.18, 0.13)),
    ("mild", True, (0.0003, 0.0013, 0.005)),
    ("saturation", True, (0.0045, 0.03, 0.052)),
    ("positive part", True, (0.003, 0.028, 0.04)),
])  # fmt: skip
def test_short_records_by_brute_force(name, measured, bounds):
    likelihood, mean_errors, linear_errors, sd_errors = [], [], [], []
    for n, seeds in ((2, range(8)), (3, range(8)), (4, range(1))):
        for seed in seeds:
            w = Wiener(name, n, seed=seed)
            exact, mean, sd = brute_force(w.known, w.covariance, w.f, w.y, w.noise_sd**2)
            (ours, our_sd), linear, value, _ = smoothed(w, measured)
            likelihood.append(value - exact)
            mean_errors.extend((ours - mean) / sd)
            linear_errors.extend((linear - mean) / sd)
            sd_errors.extend(np.log(our_sd / sd))
    assert np.abs(likelihood).mean() < bounds[0]
    assert rms(mean_errors) < bounds[1]
    assert rms(sd_errors) < bounds[2]
    assert rms(mean_errors) < 0.6 * rms(linear_errors)


# Bounds: error of each derivative over its root mean square, and correlation with it.
@pytest.mark.parametrize(("name", "measured", "error", "correlation"), [
    ("mild", False, 0.18, 0.98),
    ("saturation", False, 0.7, 0.75),
    ("positive part", False, 0.5, 0.9),
    ("mild", True, 0.01, 0.999),
    ("saturation", True, 0.05, 0.99),
    ("positive part", True, 0.05, 0.99),
])  # fmt: skip
def test_gradient_follows_that_of_the_exact_likelihood(name, measured, error, correlation):
    """By noise variance, size of the known response, amplitude of f, variance of process noise."""
    exact, ours = [], []
    for seed in range(16):
        w = Wiener(name, 3, seed=seed)

        def likelihood(s, w=w):
            f = lambda g: s[2] * w.f(g)  # noqa: E731
            covariance, variance = s[3] * w.covariance, s[0] * w.noise_sd**2
            return brute_force(s[1] * w.known, covariance, f, w.y, variance, nodes=35)[0]

        h = 1e-4 * np.eye(4)
        exact.append([(likelihood(1.0 + e) - likelihood(1.0 - e)) / 2e-4 for e in h])
        p, s = w.problem(measured), torch.ones(4, dtype=torch.float64, requires_grad=True)
        scaled = replace(
            p,
            R=s[0] * p.R,
            offset=s[1] * p.offset,
            table_mean=s[2] * p.table_mean,
            Q=s[3] * p.Q,
            P0=s[3] * p.P0,
        )
        ours.append(torch.autograd.grad(log_density(scaled), s)[0].numpy())
    for a, b in zip(np.transpose(exact), np.transpose(ours), strict=True):
        assert rms(b - a) < error * rms(a)
        assert np.corrcoef(a, b)[0, 1] > correlation


def particles(w, count, seed=0):
    rng = np.random.default_rng(seed)
    F, Q = w.transition
    root, C, variance = np.linalg.cholesky(Q), w.system.C[0], w.noise_sd**2
    x0 = rng.standard_normal((count, 2)) @ np.linalg.cholesky(w.system.stationary).T

    def log_likelihood(x, k):
        r = w.y[k] - w.f(w.known[k] + x @ C)
        return -0.5 * (r**2 / variance + np.log(2 * np.pi * variance))

    def advance(x, k):
        return x @ F.T + rng.standard_normal(x.shape) @ root.T

    return particle_filter(rng, count, x0, log_likelihood, advance, w.n)


# Bounds: log-likelihood per sample [nats], filtered means and smoothed means [posterior sds, rms],
# sds [log, rms]. Joint: 0.002, 0.02, 0.06, 0.06; 0.06, 0.11, 0.22, 0.17; 0.002, 0.15, 0.19, 0.1.
# Measured: below 0.001 per sample, smoothed means 0.06 to 0.09.
# Drawn paths alone leave 0.06 in smoothed means and 0.04 in sds.
@pytest.mark.parametrize(("name", "seed", "measured", "bounds"), [
    ("mild", 0, False, (0.01, 0.03, 0.09, 0.08)),
    ("saturation", 1, False, (0.08, 0.15, 0.29, 0.23)),
    ("positive part", 1, False, (0.01, 0.2, 0.25, 0.14)),
    ("mild", 0, True, (0.001, 0.03, 0.09, 0.08)),
    ("saturation", 1, True, (0.001, 0.03, 0.12, 0.08)),
    ("positive part", 1, True, (0.001, 0.03, 0.09, 0.08)),
])  # fmt: skip
def test_long_record_by_particles(name, seed, measured, bounds):
    w = Wiener(name, 60, seed=seed)
    runs = [particles(w, 10_000, seed=s) for s in range(3)]
    exact, error = (f([total for total, _ in runs]) for f in (np.mean, np.std))
    (ours, our_sd), linear, value, linear_value = smoothed(w, measured)
    assert abs(value - exact) < bounds[0] * w.n + 2.0 * error
    # Filtered: a weighted mean over all particles.
    C, kept = w.system.C[0], runs[0][1]
    mean = np.array([x @ C @ weight for x, weight in kept])
    sd = np.sqrt(np.array([(x @ C) ** 2 @ weight for x, weight in kept]) - mean**2)
    if not measured:
        problem = w.problem()
        plain = oracles.run(problem.layout, element(problem))
        filtered = np.array([C @ m[:2] for m, _ in plain.after])
        filtered_sd = np.sqrt([C @ P[:2, :2] @ C for _, P in plain.after])
        assert rms((filtered - mean) / sd) < bounds[1]
        assert rms(np.log(filtered_sd / sd)) < bounds[3]
    # Smoothed: trajectories drawn backwards through fewer particles.
    rng = np.random.default_rng(0)
    fewer = [(x[rng.choice(len(x), 1500, p=weight)], np.ones(1500)) for x, weight in kept]
    fewer[-1] = (fewer[-1][0], np.full(1500, 1.0 / 1500))
    path = backward_draws(rng, fewer, *w.transition, 300) @ C
    mean, sd = w.known + path.mean(1), path.std(1)
    assert rms((ours - mean) / sd) < bounds[2]
    assert rms(np.log(our_sd / sd)) < bounds[3]
    if name != "mild":
        assert abs(value - exact) < 0.75 * abs(linear_value - exact)
        assert rms((ours - mean) / sd) < 0.75 * rms((linear - mean) / sd)


# Measured: root mean square 0.03, 0.14, 0.20; what the filter's own likelihood with and without the
# sample gives is off by as much (0.04, 0.21, 0.19), at n times the cost.
@pytest.mark.parametrize(("name", "measured", "error"), [
    ("mild", False, 0.04),
    ("saturation", False, 0.18),
    ("positive part", False, 0.26),
    ("mild", True, 0.001),
    ("saturation", True, 0.024),
    ("positive part", True, 0.021),
])  # fmt: skip
def test_leave_one_out_density_by_brute_force(name, measured, error):
    ours, exact, forward = [], [], []
    for seed in range(6):
        w = Wiener(name, 4, seed=seed)
        problem = w.problem(measured)
        values = element(problem)
        _, track, _, _ = filtering.run(problem.layout, values)
        found = smoothing.leave_one_out(problem.layout, values, track)
        ours.append(found[2][:, 0])
        noise = w.noise_sd**2
        whole = brute_force(w.known, w.covariance, w.f, w.y, noise, nodes=27)[0]
        for t in range(w.n):
            k = np.delete(np.arange(w.n), t)
            rest = brute_force(w.known[k], w.covariance[np.ix_(k, k)], w.f, w.y[k], noise, nodes=35)
            exact.append(whole - rest[0])
            y = problem.y.clone()
            y[t] = torch.nan
            forward.append(float(log_density(problem) - log_density(replace(problem, y=y))))
    off = np.ravel(ours) - exact
    assert rms(off) < error
    if not measured:  # with exact moments both are near enough
        assert rms(off) < 1.1 * rms(np.array(forward) - exact)
