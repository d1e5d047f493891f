"""Cost of left-out densities of a linear fit, with its draws, and of scores."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import pyro_dynogp as dgp
from pyro_dynogp.prediction.mixture_score import mixture_scores
from tests.conftest import simulate_record

PAIRS, SIZES, DRAWS = 10, (1_000, 10_000, 100_000), 16


def run(folder: Path) -> str:
    """Seconds on one thread, of a fit to the first thousand samples."""
    del folder
    torch.set_num_threads(1)
    modes = dgp.Modes([-0.5 + 2.0j], [[1.0 + 0.3j]], [1.0], [[0.2 + 0.1j]])
    record = simulate_record(modes, 0.1, n=max(SIZES), seed=1)
    model = dgp.LinearDynamicGP(inputs=1, pairs=PAIRS)
    start = dgp.fit(model, record[:1000], restarts=2, steps=60, workers=1, progress=False)
    # Draws are made up: what is timed does not depend on how they came about.
    noise = {k: 0.001 * torch.randn(DRAWS, *v.shape).double() for k, v in start.mode.items()}
    draws = {k: v * (1.0 + noise[k]) for k, v in start.mode.items()}
    rows = []
    for n in SIZES:
        fit = replace(start, records=(record[:n],))
        several = fit.with_draws(draws)
        cells = []
        for one, options in ((fit, {"parameters": "mode"}), (several, {})):
            for target in ("missing sample", "forecast"):
                if one is several and target == "forecast":
                    continue
                begin = time.perf_counter()
                dgp.loo(one, target=target, refits=0, workers=1, progress=False, **options)
                cells.append(f"{time.perf_counter() - begin:.2f}")
        rows.append(f"| {n} | " + " | ".join(cells) + " |")
    return "\n".join(
        [
            f"Linear model of {PAIRS} pairs, one thread [s].",
            "",
            f"| n | mode, missing sample | mode, forecast | {DRAWS} draws, missing sample |",
            "|---|---|---|---|",
            *rows,
            "",
            *posteriors(),
            "",
            *mixtures(),
        ]
    )


def posteriors() -> list[str]:
    """`loo` with the draws that it needs, 1000 of them, processor seconds."""
    modes = dgp.Modes(
        [-0.5 + 2.0j, -0.2 + 0.7j], [[1.0 + 0.3j], [0.3 - 0.5j]], [1.0, 0.6 + 0.2j],
        [[0.2 + 0.1j], [0.1 + 0.05j]],
    )  # fmt: skip
    lines = ["Draws and all, two pairs for two [s of one core].", "",
             "| n | target | seconds | elpd | its Monte Carlo error | refits |",
             "|---|---|---|---|---|---|"]  # fmt: skip
    for n in (300, 800):
        record = simulate_record(modes, 0.1, n=n, seed=1)
        fit = dgp.fit(dgp.LinearDynamicGP(inputs=1, pairs=2), record, workers=1, progress=False)
        for target in ("missing sample", "forecast"):
            begin = time.process_time()
            found = dgp.loo(replace(fit), target=target, workers=1, progress=False)
            cells = f"{time.process_time() - begin:.1f} | {found.elpd_loo:.1f}"
            cells += f" | {found['monte_carlo_error']:.2f} | {found['refits']}"
            lines.append(f"| {n} | {target} | {cells} |")
    return lines


def mixtures() -> list[str]:
    """CRPS, log-density and level of samples under mixtures of 200 components."""
    rng = np.random.default_rng(0)
    lines = ["Scores of mixtures of 200 components [s of one core].", "", "| n | seconds |",
             "|---|---|"]  # fmt: skip
    for n in (1_000, 10_000, 100_000):
        mean, sd = rng.standard_normal((200, n)), np.exp(0.1 * rng.standard_normal((200, n)))
        begin = time.process_time()
        mixture_scores(rng.standard_normal(n), mean, sd, np.full(200, 1.0 / 200))
        lines.append(f"| {n} | {time.process_time() - begin:.3f} |")
    return lines
