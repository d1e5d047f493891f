"""NUTS on a small Wiener model, as reference for the other fits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyro
import torch

import pyro_dynogp as dgp

SAMPLES, INDUCING = 200, 8


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


def run(folder: Path) -> str:
    """Posterior means and sds of all fits, in units of those of NUTS."""
    del folder
    data = record()
    model = dgp.Wiener(inputs=1, pairs=1, inducing=INDUCING)
    exact = dgp.fit(model, data, method="nuts", chains=4, draws=500, warmup=300, seed=0)
    fits: dict[str, dgp.Fit] = {
        "optima with their weights (default)": dgp.fit(model, data, progress=False),
        "multivariate normal": dgp.fit(
            model, data, hyperparameters="multivariate normal", progress=False
        ),
        "normal": dgp.fit(model, data, hyperparameters="normal", progress=False),
        "Gauss-Markov": dgp.fit(model, data, guide="gauss-markov", progress=False),
    }
    r_hat = {k: v for k, v in exact.diagnostics.items() if k.startswith("r_hat")}
    worst = max(r_hat, key=lambda name: r_hat[name])
    lines = [
        f"Wiener model, {SAMPLES} samples, one pair, {INDUCING} inducing values, trajectories "
        "integrated out (Gauss-Markov: sites). Difference of posterior means in posterior sds of "
        "NUTS, and ratio of sds: worst entry of each site.",
        f"NUTS: largest R-hat {r_hat[worst]:.3f} ({worst.removeprefix('r_hat ')}), "
        f"{exact.diagnostics['divergences']:.0f} divergences.",
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
