"""Simulation-based calibration of NUTS on the exact marginal model.

Parameters from the prior, data from the model, posterior draws from the data: the rank of the
true value among the draws is uniform if sampler, likelihood and prior agree (Talts et al.
2018). The true value is itself a draw from the posterior. Put at a random place of a chain that
runs from it both ways, with a fixed kernel, its rank is uniform exactly, however slowly the
chain mixes (Besag and Clifford 1989): no warm-up, no thinning to independence, no excuse for a
histogram that is not flat.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyro
import torch
from matplotlib.figure import Figure
from pyro.infer import MCMC, NUTS
from scipy import stats

import pyro_dynogp as dgp
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.laplace import laplace
from pyro_dynogp.inference.optimise.maximum import maximise
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.poles import starting_values
from pyro_dynogp.support.parallel import child_seeds, parallel_map, seeded

KEPT = 19  # ranks 0..19: ten bins of two


@dataclass(frozen=True)
class _Task:
    seed: int
    samples: int
    thin: int


def model_and_record(samples: int) -> tuple[dgp.LinearDynamicGP, dgp.Record]:
    """One pair with a scaling that does not depend on the data drawn from it."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal(samples // 5 + 1), 5)[:samples]
    time = np.arange(samples) * 0.1
    reference = dgp.Record(time=time, inputs=u, outputs=rng.standard_normal(samples))
    blank = dgp.Record(time=time, inputs=u)
    return dgp.LinearDynamicGP(inputs=1, pairs=1).scaled_to(reference), blank


def _chain(energy: Any, start: torch.Tensor, length: int) -> torch.Tensor:
    """States (length, d) of NUTS with a fixed step from a start; nothing adapts."""
    kernel = NUTS(
        potential_fn=energy,
        step_size=0.35,
        adapt_step_size=False,
        adapt_mass_matrix=False,
        max_tree_depth=4,
    )
    mcmc = MCMC(
        kernel,
        num_samples=length,
        warmup_steps=0,
        initial_params={"x": start},
        disable_progbar=True,
    )
    mcmc.run()
    return mcmc.get_samples()["x"]


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
        y = trace.nodes["y"]["value"].numpy()
        record = dgp.Record(time=blank.time, inputs=blank.inputs, outputs=y)
        # Coordinates from the data alone, not from the truth: the kernel must not know it.
        records = model.prepare(record)
        start = starting_values(model, records, count=1, seed=task.seed)
        optimum = maximise(model, records, start, Run(task.seed, workers=1), steps=60)[0]
        potential = Potential(model, (records,), truth)
        centre, root = laplace(potential, optimum.values)
        middle, scale = torch.as_tensor(centre), torch.as_tensor(root)

        def energy(parameters: dict[str, torch.Tensor]) -> torch.Tensor:
            x = parameters["x"]
            try:
                with pyro.validation_enabled(False):
                    return potential.energy(middle + scale @ x, jacobian=True)
            except ValueError:
                return np.nan * x.sum()

        x0 = torch.linalg.solve_triangular(
            scale, (potential.pack(truth) - middle).unsqueeze(-1), upper=False
        ).squeeze(-1)
        before = int(np.random.randint(KEPT + 1))  # noqa: NPY002 (seeded above)
        kept = [
            _chain(energy, x0, count * task.thin)[task.thin - 1 :: task.thin]
            for count in (before, KEPT - before)
            if count
        ]
        draws = potential.unpack(middle + torch.cat(kept) @ scale.mT)
    ranks: dict[str, int] = {}
    for name, value in truth.items():
        flat = draws[name].reshape(KEPT, -1).numpy()
        for i, true in enumerate(value.reshape(-1).numpy()):
            ranks[f"{name}[{i}]"] = _rank(flat[:, i], float(true), task.seed + i)

    def likelihood(values: dict[str, torch.Tensor]) -> float:
        conditioned = pyro.poutine.condition(model, data=values)
        run = pyro.poutine.trace(conditioned).get_trace(record)
        run.compute_log_prob()
        return float(run.nodes["y"]["log_prob_sum"])

    levels = [likelihood({k: v[i] for k, v in draws.items()}) for i in range(KEPT)]
    ranks["log-likelihood"] = _rank(np.array(levels), likelihood(truth), task.seed)
    return ranks


def _rank(draws: np.ndarray, true: float, seed: int) -> int:
    """Rank of the truth, ties (a chain that did not move) broken at random."""
    close = np.isclose(draws, true, rtol=1e-9, atol=0.0)
    ties = int(close.sum())
    below = int((draws[~close] < true).sum())
    return below + int(np.random.default_rng(seed).integers(ties + 1))


def simulate_ranks(
    replicates: int,
    *,
    samples: int = 60,
    thin: int = 2,
    seed: int = 0,
    workers: int | None = None,
    progress: bool = False,
) -> dict[str, np.ndarray]:
    """Ranks (replicates,) of every quantity."""
    tasks = [_Task(s, samples, thin) for s in child_seeds(seed, replicates)]
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
    for axes, (name, values) in zip(panels, ranks.items(), strict=False):
        axes.hist(values, np.linspace(-0.5, KEPT + 0.5, 11), color="#4477aa")
        low, high = stats.binom.ppf([0.005, 0.995], replicates, 0.1)
        axes.axhspan(low, high, color="0.8", zorder=0)
        axes.axhline(replicates / 10, color="0.4", linewidth=0.8)
        axes.set_title(name, fontsize=9)
    for axes in panels[len(ranks) :]:
        axes.set_visible(False)
    figure.savefig(folder / "calibration.png", dpi=130)
    return "\n".join(lines)
