"""NUTS on a small Wiener model, as reference for the other fits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyro
import torch
from pyro.ops.stats import split_gelman_rubin

import pyro_dynogp as dgp
from pyro_dynogp.criticism.posterior_draws import log_joint
from pyro_dynogp.criticism.subjects import FitSubject

SAMPLES, INDUCING = 200, 8
CHAINS, DRAWS, WARMUP = 4, 400, 200
# R-hat above which chains do not agree.
MIXED = 1.05


def record() -> dgp.Record:
    """One resonant pair, tanh, five per cent noise."""
    rng = np.random.default_rng(3)
    t = np.arange(SAMPLES) * 0.1
    u = rng.standard_normal((SAMPLES, 1)).cumsum(0)
    u = (u - u.mean()) / u.std() + 0.5 * rng.standard_normal((SAMPLES, 1))
    modes = dgp.Modes(
        poles=np.array([-0.6 + 1.5j]),
        input_gain=np.array([[0.4 - 0.9j]]),
        output_gain=np.array([1.0]),
        noise_gain=np.array([[0.08 + 0.05j]]),
    )
    with pyro.poutine.block(), torch.random.fork_rng():
        torch.manual_seed(0)
        g = dgp.LTIProcess(modes, t, u).sample().numpy()
    y = np.tanh(1.2 * g) + 0.05 * rng.standard_normal(SAMPLES)
    return dgp.Record(t, u, y[:, None])


def mixing(exact: dgp.Fit) -> tuple[float, float]:
    """R-hat: largest of the one-step log densities of all samples, and of the log joint density."""
    draws = FitSubject(exact, exact.records, CHAINS * DRAWS, 0)
    one_step = torch.as_tensor(draws.pointwise("forecast")).reshape(CHAINS, DRAWS, -1)
    joint = torch.as_tensor(log_joint(exact, exact.draws)).reshape(CHAINS, DRAWS)
    return float(split_gelman_rubin(one_step).max()), float(split_gelman_rubin(joint))


def run(folder: Path) -> str:
    """Posterior means and sds of all fits, in units of those of NUTS."""
    del folder
    data = record()
    model = dgp.Wiener(inputs=1, pairs=1, inducing=INDUCING)
    exact = dgp.fit(model, data, method="nuts", chains=CHAINS, draws=DRAWS, warmup=WARMUP, seed=0)
    fits: dict[str, dgp.Fit] = {
        "optima with their weights (default)": dgp.fit(model, data, progress=False),
        "multivariate normal": dgp.fit(
            model, data, hyperparameters="multivariate normal", progress=False
        ),
        "normal": dgp.fit(model, data, hyperparameters="normal", progress=False),
        "Gauss-Markov": dgp.fit(model, data, guide="gauss-markov", progress=False),
    }
    predictive, joint = mixing(exact)
    sites = {
        k.removeprefix("r_hat "): v for k, v in exact.diagnostics.items() if k.startswith("r_hat")
    }
    apart = ", ".join(f"{name} {v:.2f}" for name, v in sites.items() if v > MIXED)
    lines = [
        f"Wiener model, {SAMPLES} samples, one pair, {INDUCING} inducing values, trajectories "
        "integrated out (Gauss-Markov: sites). Difference of posterior means in posterior sds of "
        "NUTS, and ratio of sds: worst entry of each site.",
        f"NUTS: {CHAINS} chains of {DRAWS} draws, {exact.diagnostics['divergences']:.0f} "
        f"divergences. R-hat of the log joint density {joint:.3f}, of one-step log densities up "
        f"to {predictive:.3f}; sites above {MIXED}: {apart or 'none'}.",
        "",
        "| site | " + " | ".join(fits) + " |",
        "|---" * (len(fits) + 1) + "|",
    ]
    for name in exact.draws:
        reference = exact.draws[name]
        cells = []
        for fit in fits.values():
            draws = fit.draws[name]
            shift = ((draws.mean(0) - reference.mean(0)) / reference.std(0)).abs().max()
            ratio = draws.std(0) / reference.std(0)
            cells.append(f"{float(shift):.2f}; {float(ratio.min()):.2f}-{float(ratio.max()):.2f}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "Means and sds of the one-step predictions: rms difference of means in sds of NUTS, and "
        "ratio of sds.",
        "",
        "| fit | mean | sd |",
        "|---|---|---|",
    ]
    by_nuts = exact.predict(data)
    for label, fit in fits.items():
        own = fit.predict(data)
        off = float(np.sqrt(np.mean(((own.mean - by_nuts.mean) / by_nuts.sd) ** 2)))
        lines.append(f"| {label} | {off:.3f} | {float(np.mean(own.sd / by_nuts.sd)):.3f} |")
    return "\n".join(lines)
