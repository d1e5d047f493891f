"""Simulation-based calibration of NUTS on the exact marginal model (Talts et al. 2018).

Parameters from the prior, data from the model, posterior draws from the data: the rank of the true
value among independent draws is uniform if sampler, likelihood and prior agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyro
from matplotlib.figure import Figure
from scipy import stats

import pyro_dynogp as dgp
from pyro_dynogp.inference.maximum import maximise
from pyro_dynogp.inference.sampling import sample_posterior
from pyro_dynogp.inference.starts import starting_values
from pyro_dynogp.parallel import child_seeds, parallel_map, seeded

KEPT = 19  # ranks 0..19: five bins of four, ten of two


@dataclass(frozen=True)
class _Task:
    seed: int
    samples: int
    draws: int
    warmup: int


def model_and_record(samples: int) -> tuple[dgp.LinearDynamicGP, dgp.Record]:
    """One pair with a scaling that does not depend on the data drawn from it."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal(samples // 5 + 1), 5)[:samples]
    time = np.arange(samples) * 0.1
    reference = dgp.Record(time=time, inputs=u, outputs=rng.standard_normal(samples))
    blank = dgp.Record(time=time, inputs=u)
    return dgp.LinearDynamicGP(inputs=1, pairs=1).scaled_to(reference), blank


def one_replicate(task: _Task) -> dict[str, int]:
    """Rank of every scalar parameter, and of the log-likelihood, among the kept draws."""
    model, blank = model_and_record(task.samples)
    with seeded(task.seed):
        trace = pyro.poutine.trace(model).get_trace(blank)
    truth = {
        name: node["value"]
        for name, node in trace.nodes.items()
        if node["type"] == "sample" and name != "y"
    }
    record = dgp.Record(
        time=blank.time, inputs=blank.inputs, outputs=trace.nodes["y"]["value"].numpy()
    )
    start = starting_values(model, (record,), count=1, seed=task.seed)
    optimum = maximise(model, record, start, steps=100, seed=task.seed, workers=1)[0]
    chains = sample_posterior(
        model,
        record,
        optimum.values,
        chains=1,
        draws=task.draws,
        warmup=task.warmup,
        seed=task.seed,
        workers=1,
    )
    kept = np.linspace(0, task.draws - 1, KEPT).round().astype(int)
    ranks: dict[str, int] = {}
    for name, value in truth.items():
        flat = chains.draws[name][0, kept].reshape(KEPT, -1).numpy()
        for i, true in enumerate(value.reshape(-1).numpy()):
            ranks[f"{name}[{i}]"] = int((flat[:, i] < true).sum())

    def likelihood(values: dict) -> float:
        conditioned = pyro.poutine.condition(model, data=values)
        run = pyro.poutine.trace(conditioned).get_trace(record)
        run.compute_log_prob()
        return float(run.nodes["y"]["log_prob_sum"])

    draws = [
        likelihood({k: v[0, index] for k, v in chains.draws.items()}) for index in kept
    ]
    ranks["log-likelihood"] = int((np.array(draws) < likelihood(truth)).sum())
    return ranks


def simulate_ranks(
    replicates: int,
    *,
    samples: int = 60,
    draws: int = 250,
    warmup: int = 200,
    seed: int = 0,
    workers: int | None = None,
    progress: bool = False,
) -> dict[str, np.ndarray]:
    """Ranks (replicates,) of every quantity."""
    tasks = [_Task(s, samples, draws, warmup) for s in child_seeds(seed, replicates)]
    found = parallel_map(
        one_replicate, tasks, workers=workers, progress=progress, description="calibration"
    )
    return {name: np.array([ranks[name] for ranks in found]) for name in found[0]}


def uniformity(ranks: np.ndarray, bins: int = 10) -> float:
    """p-value of the chi-square test that ranks 0..KEPT are uniform."""
    edges = np.linspace(-0.5, KEPT + 0.5, bins + 1)
    counts = np.histogram(ranks, edges)[0]
    return float(stats.chisquare(counts).pvalue)


def run(folder: Path, replicates: int = 200) -> str:
    """Two hundred replicates, a table of p-values and rank histograms."""
    ranks = simulate_ranks(replicates, progress=True)
    p_values = {name: uniformity(values) for name, values in ranks.items()}
    lowest = min(p_values.values())
    lines = [
        f"Simulation-based calibration of NUTS: one pair, 60 samples, {replicates} replicates, "
        f"ranks among {KEPT} draws, chi-square test with 10 bins.",
        "",
        "| quantity | p-value |",
        "|---|---|",
        *(f"| {name} | {p:.3f} |" for name, p in p_values.items()),
        "",
        f"Smallest p-value times the number of tests (Bonferroni): "
        f"{min(1.0, lowest * len(p_values)):.3f}.",
        "",
        "![ranks](calibration.png)",
    ]
    figure = Figure(figsize=(9, 6), layout="constrained")
    panels = figure.subplots(3, 4, sharex=True, sharey=True).ravel()
    expected = replicates / 10
    for axes, (name, values) in zip(panels, ranks.items(), strict=False):
        axes.hist(values, np.linspace(-0.5, KEPT + 0.5, 11), color="#4477aa")
        low, high = stats.binom.ppf([0.005, 0.995], replicates, 0.1)
        axes.axhspan(low, high, color="0.8", zorder=0)
        axes.axhline(expected, color="0.4", linewidth=0.8)
        axes.set_title(name, fontsize=9)
    for axes in panels[len(ranks) :]:
        axes.set_visible(False)
    figure.savefig(folder / "calibration.png", dpi=130)
    return "\n".join(lines)
