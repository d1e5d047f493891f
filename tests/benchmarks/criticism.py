"""Cost of left-out densities of a linear fit on long records."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import torch

import pyro_dynogp as dgp
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
        ]
    )
