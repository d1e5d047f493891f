"""NUTS on a small Wiener model with its trajectory as a site, as reference for the other fits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyro
import torch
from pyro.infer.reparam import LocScaleReparam

import pyro_dynogp as dgp
from pyro_dynogp.inference.sampling import sample_posterior

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
    fits: dict[str, dgp.Fit] = {
        "collapsed, multivariate normal": dgp.fit(
            model, data, hyperparameters="multivariate normal", progress=False
        ),
        "collapsed, normal": dgp.fit(model, data, hyperparameters="normal", progress=False),
        "Gauss-Markov": dgp.fit(model, data, guide="gauss-markov", progress=False),
    }
    start = fits["collapsed, multivariate normal"]
    # The function's values along the path are all but given by the inducing values: as standard
    # normal numbers they are no burden to NUTS.
    explicit = pyro.poutine.reparam(
        start.model, config={"g": dgp.InnovationReparam(), "f": LocScaleReparam(0.0)}
    )
    smooth = torch.tensor(start.layers(data)["g"].mean[:, 0])
    values: dict[str, Any] = dict(start.mode)
    trace = pyro.poutine.trace(pyro.poutine.condition(explicit, data=values | {"g": smooth}))
    with torch.no_grad():
        nodes = trace.get_trace(data).nodes
    values |= {
        name: nodes[name]["value"].detach()
        for name in ("g_innovations", "f_decentered")
        if name in nodes and name not in values
    }
    chains = sample_posterior(
        explicit, data, values, chains=2, draws=300, warmup=300, seed=0, progress=True
    )
    exact = {k: v.flatten(0, 1) for k, v in chains.draws.items()}
    lines = [
        f"Wiener model, {SAMPLES} samples, one pair, {INDUCING} inducing values. Difference of "
        "posterior means in posterior sds of NUTS, and ratio of sds: worst entry of each site.",
        f"Largest R-hat {max(float(v.max()) for v in chains.r_hat.values()):.3f}, "
        f"{chains.divergences} divergences.",
        "",
        "| site | " + " | ".join(fits) + " |",
        "|---" * (len(fits) + 1) + "|",
    ]
    for name in start.draws:
        reference = exact[name]
        cells = []
        for fit in fits.values():
            draws = fit.draws[name]
            shift = ((draws.mean(0) - reference.mean(0)) / reference.std(0)).abs().max()
            ratio = draws.std(0) / reference.std(0)
            cells.append(f"{float(shift):.2f}; {float(ratio.min()):.2f}-{float(ratio.max()):.2f}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
