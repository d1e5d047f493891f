"""Cost of one training step of cascades on whole records, how it grows, and memory."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyro
import torch
from pyro.infer import SVI, TraceMeanField_ELBO
from pyro.optim import ClippedAdam

import pyro_dynogp as dgp
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.trajectory_guide import layer_guide, with_trajectories
from pyro_dynogp.models.architectures import Cascade

# Seconds of one epoch of the authors' code on two cores of such a machine: mini-batch times by
# number of mini-batches (10 samples; coupled drives 40), as measured beforehand.
AUTHORS = {
    "Wiener": 0.63 * 4,
    "Wiener-Hammerstein": 13.6 * 8,
    "coupled drives": 14.0,
    "electricity": 36.7 * 25,
}
PARTICLES = 10
# Lengths of records at which the growth of the cost is measured.
GROWTH = (1000, 10_000, 100_000, 1_000_000)


def models() -> dict[str, tuple[Cascade, int]]:
    """The architectures of the paper's Table 2 and the lengths of their records."""
    electricity = dgp.Cascade(
        22, (dgp.Dynamic(outputs=3, pairs=5), dgp.Static(outputs=3), dgp.Dynamic(pairs=5))
    )
    return {
        "Wiener": (dgp.Wiener(inputs=2, pairs=5), 1500),
        "Wiener-Hammerstein": (dgp.WienerHammerstein(inputs=1, pairs=5), 8192),
        "coupled drives": (dgp.Wiener(inputs=1, pairs=5), 400),
        "electricity": (electricity, 26304),
    }


def record(n: int, inputs: int) -> dgp.Record:
    """A record of the right size; its values play no part in the cost."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal((n, inputs))
    y = np.convolve(u[:, 0], np.exp(-np.arange(50) / 10), "full")[:n, None]
    return dgp.Record(np.arange(n) * 0.01, u, y + 0.1 * rng.standard_normal((n, 1)))


def values_of(model: Cascade, data: dgp.Record) -> dict[str, torch.Tensor]:
    """Moderate values of all parameters."""
    from pyro_dynogp.inference.starts.plans import Plan, starting_point

    return starting_point(model, model.prepare(data), Plan(None, None, False, 0))


def collapsed_step(model: Cascade, data: dgp.Record) -> Callable[[], object]:
    """Value and gradient of the collapsed log joint: one step of MAP, no particles needed."""
    target = model.scaled_to(data).collapsed
    potential = Potential(target, (target.prepare(data),), values_of(target, data))
    z = potential.pack(potential.at).numpy()
    return lambda: potential.value_and_gradient(z)


def sampled_step(model: Cascade, data: dgp.Record) -> Callable[[], object]:
    """One step of SVI with Gauss-Markov guides, ten vectorised particles."""
    target = with_trajectories(model.scaled_to(data))
    guide = layer_guide(target, "gauss-markov", values_of(target, data), len(data))
    loss = TraceMeanField_ELBO(
        num_particles=PARTICLES, vectorize_particles=True, max_plate_nesting=0
    )
    svi = SVI(target, guide.single_pass(), ClippedAdam({"lr": 1e-4}), loss)
    records = target.prepare(data)
    return lambda: svi.step(records)


def seconds(call: Callable[[], object], repeats: int = 3) -> float:
    """Best of some runs after one that compiles."""
    call()
    best = np.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - begin)
    return best


def measure(kind: str, name: str, n: int) -> tuple[float, float]:
    """Seconds a step and peak memory [GB], in a process of its own."""
    return apart(__name__, f"one({kind!r}, {name!r}, {n})")


def apart(module: str, call: str) -> tuple[float, float]:
    """A number that a call of a module gives, and its peak memory [GB], in a process of its own."""
    code = (
        f"import {module} as m; import resource; "
        f"print(m.{call}, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    value, memory = out.stdout.split()[-2:]
    return float(value), float(memory)


def one(kind: str, name: str, n: int) -> float:
    """Seconds a step, in this process."""
    model = models()[name][0]
    data = record(n, model.inputs)
    with pyro.get_param_store().scope(), pyro.validation_enabled(False):
        make = collapsed_step if kind == "collapsed" else sampled_step
        return seconds(make(model, data))


def run(folder: Path) -> str:
    """Steps of all architectures, and growth with n."""
    del folder
    lines = [
        "One step on the whole record [s] and peak memory [GB]; ratio to one epoch of the authors' "
        "code (figures measured beforehand on two cores).",
        "",
        "| problem | n | collapsed step | GB | times faster | SVI step, 10 particles | GB | "
        "times faster |",
        "|---" * 8 + "|",
    ]
    for name, (_, n) in models().items():
        cells = [name, str(n)]
        for kind in ("collapsed", "sampled"):
            time_, memory = measure(kind, name, n)
            cells += [f"{time_:.3g}", f"{memory:.1f}", f"{AUTHORS[name] / time_:.0f}"]
            print(name, kind, time_, memory, flush=True)
        lines.append("| " + " | ".join(cells) + " |")
    grown = {n: measure("collapsed", "Wiener", n) for n in GROWTH}
    slope = np.log(grown[100_000][0] / grown[10_000][0]) / np.log(10.0)
    lines += ["", "Collapsed Wiener step: " + "; ".join(
        f"n = {n}: {t:.3g} s, {g:.1f} GB" for n, (t, g) in grown.items()
    ) + f". Slope between 1e4 and 1e5 (log-log): {slope:.2f}."]  # fmt: skip
    return "\n".join(lines)
