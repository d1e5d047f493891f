"""How the cost of one pass over the training record grows with its length, for every method."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import pyro_dynogp as dgp
from tests.benchmarks import cascade_cost
from tests.benchmarks.markdown import table
from tests.benchmarks.paper.page import number
from tests.benchmarks.paper.peers import PEERS
from tests.benchmarks.paper.prediction import OURS, Task

LENGTHS = (500, 1000, 2000, 4000, 8000, 100_000)
# Peers learn for so long; a pass is timed within that. Above this length they are left out.
SECONDS, LONGEST_PEER = 30.0, 8000


def one(method: str, n: int) -> float:
    """Seconds of one pass: value and gradient of the log density, an iteration, or an epoch."""
    if method == OURS:
        return cascade_cost.one("collapsed", "Wiener", n)
    run = dgp.datasets.load("wiener", samples=n + 100, training_samples=n)
    assert isinstance(run.train, dgp.Record)
    task = Task(
        train=run.train,
        inputs=[run.test.inputs],
        follows=True,
        test_process_noise=False,
        noisy=(True,),
        architecture=(5, "static"),
        width=1,
        seconds=SECONDS,
    )
    return PEERS[method](task).step_seconds


def run(folder: Path) -> str:
    """Table of all methods and lengths, with the slope between the last two lengths."""
    del folder
    head = ["method", *(f"n = {n}" for n in LENGTHS), "grows as"]
    lines = []
    for method in (OURS, *(name for name in PEERS if name != "NARMAX")):
        lengths = [n for n in LENGTHS if method == OURS or n <= LONGEST_PEER]
        found = {n: cascade_cost.apart(__name__, f"one({method!r}, {n})") for n in lengths}
        a, b = lengths[-2:]
        slope = np.log(found[b][0] / found[a][0]) / np.log(b / a)
        cells = [f"{number(s)} s, {number(m)} GB" for s, m in found.values()]
        cells += [""] * (len(LENGTHS) - len(cells))
        lines.append([method, *cells, f"n^{slope:.2f}"])
        print(lines[-1], flush=True)
    return (
        "Wiener model, two inputs: one pass over the training record (value and gradient of the "
        "marginal density; an iteration of dynoNet and exact GP-NARX; an epoch of mini-batches of "
        "the deep GP) and peak memory. GP-NARX is exact up to 2500 samples, sparse above. NARMAX "
        f"has no iterations.\n\n{table(head, lines)}"
    )
