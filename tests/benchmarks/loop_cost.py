"""How long closing the loop takes: 2000 samples, five candidate channels, all processors."""

from __future__ import annotations

import itertools
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

import pyro_dynogp as dgp
from tests.benchmarks.markdown import table
from tests.benchmarks.planted import base_model
from tests.discrepancy.plants import Plant, plant

SAMPLES, CANDIDATES = 2000, 5
EFFECT = "extra input"


def made(kind: str) -> Plant:
    """A plant of which one candidate acts strongly; the others are decoys."""
    plants = (plant(EFFECT, "strong", number, samples=SAMPLES) for number in itertools.count())
    found = next(one for one in plants if one.base["kind"] == kind)
    rng = np.random.default_rng(0)
    more = CANDIDATES - len(found.record.extra)
    decoys = {
        f"decoy {k}": lfilter([0.2], [1.0, -0.95], rng.standard_normal(SAMPLES))
        for k in range(more)
    }
    extra = {**found.record.extra, **decoys}
    return replace(found, record=replace(found.record, extra=extra))


def run(folder: Path) -> str:
    """Seconds by stage, from a linear model and from a Wiener model."""
    del folder
    lines = []
    for kind in ("linear", "wiener"):
        one = made(kind)
        assert len(one.record.extra) == CANDIDATES
        model = base_model(one.base, one.record.n_inputs)
        begin = time.perf_counter()
        fit = dgp.fit(model, one.record[: SAMPLES // 2], progress=False)
        fitted = time.perf_counter() - begin
        begin = time.perf_counter()
        report = dgp.close_loop(fit, one.record, progress=False)
        seconds = time.perf_counter() - begin
        stages = "; ".join(f"{name} {value:.0f} s" for name, value in report.seconds.items())
        names = ", ".join(effect.name for effect in report.effects) or report.outcome
        lines.append([kind, f"{fitted:.0f} s", f"{seconds / 60.0:.1f} min", stages, names])
        print(lines[-1], flush=True)
    head = ["model to start from", "its fit", "the loop", "where the time went", "found"]
    return (
        f"{SAMPLES} samples, {CANDIDATES} candidate channels of which one acts, default settings "
        f"(four rounds at most).\n\n{table(head, lines)}"
    )
