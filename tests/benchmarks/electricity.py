"""The paper's electricity model: 22 inputs, layers of 3, 3 and 1 signals, 26 304 samples."""

from __future__ import annotations

import resource
import time
from pathlib import Path

import pyro_dynogp as dgp
from tests.benchmarks import cascade_cost
from tests.benchmarks.paper.experiments import EXPERIMENTS

MINUTES = 20.0


def run(folder: Path) -> str:
    """Train for about twenty minutes from one start; scores on the next six months."""
    train, tests, _ = EXPERIMENTS["electricity"].load(0)
    assert isinstance(train, dgp.Record)
    test = tests["test"]
    model = cascade_cost.models()["electricity"][0]
    step = cascade_cost.one("collapsed", "electricity", len(train))
    steps = max(20, int(60.0 * MINUTES / step))
    begin = time.perf_counter()
    fit = dgp.fit(model, train, method="map", restarts=1, steps=steps, progress=True)
    spent = time.perf_counter() - begin
    fit.save(folder / "electricity.safetensors")
    lines = [
        f"One start, {steps} steps of Adam at {step:.2f} s each and the linear fits before them: "
        f"{spent / 60:.1f} minutes; peak memory of this process "
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.1f} GB.",
        "",
        "| | RMSE [MW] | MAE [MW] | CRPS [MW] | 95 % coverage |",
        "|---|---|---|---|---|",
    ]
    for name, found in (
        ("six months ahead", dgp.scores(fit.forecast(train, test), test)),
        ("training, free run", dgp.scores(fit.simulate(train), train)),
    ):
        lines.append(
            f"| {name} | {found['rmse']:.0f} | {found['mae']:.0f} | {found['crps']:.0f} | "
            f"{found['coverage_95']:.3f} |"
        )
    return "\n".join(lines)
