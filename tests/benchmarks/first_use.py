"""What a user waits for at first: first fits with nothing compiled, and with all compiled ahead."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks.markdown import table

COMPILE = """
from pyro_dynogp.prediction.compilation import compile_kernels
compile_kernels(progress=False)
"""
FIT = """
import numpy as np
import pyro_dynogp as dgp
rng = np.random.default_rng(0)
u = rng.standard_normal(300)
y = np.convolve(u, np.exp(-np.arange(30) / 5.0))[:300] + 0.1 * rng.standard_normal(300)
record = dgp.Record(time=0.1 * np.arange(300), inputs=u, outputs=y)
fit = dgp.fit(dgp.{model}, record[:250], workers=1, progress=False, **{options})
fit.forecast(record[:250], record[250:])
"""
FITS = {
    "linear, 2 pairs, default": FIT.format(model="LinearDynamicGP(1, pairs=2)", options={}),
    "Wiener, 1 pair, one start of 20 steps": FIT.format(
        model="Wiener(1, pairs=1)", options={"restarts": 1, "steps": 20}
    ),
}


def seconds(script: str, folder: str) -> tuple[float, float]:
    """Wall and processor seconds of a new process with its machine code in `folder`."""
    before, began = os.times(), time.perf_counter()
    environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
    subprocess.run([sys.executable, "-c", script], env=environment, check=True)
    wall, after = time.perf_counter() - began, os.times()
    used = after.children_user + after.children_system
    return wall, used - before.children_user - before.children_system


def run(folder: Path) -> str:
    """Seconds of first fits, import included, in new processes."""
    rows = []
    with tempfile.TemporaryDirectory() as ahead:
        wall, used = seconds(COMPILE, ahead)
        for name, script in FITS.items():
            with tempfile.TemporaryDirectory() as empty:
                cold = seconds(script, empty)
            warm = seconds(script, ahead)
            rows.append([name, *(f"{x:.1f}" for x in (*cold, *warm))])
    head = ["first fit, 250 samples", "wall [s]", "processor [s]", "compiled: wall", "processor"]
    return f"`pyro-dynogp compile`: {wall:.0f} s wall, {used:.0f} s of processors.\n\n" + table(
        head, rows
    )
