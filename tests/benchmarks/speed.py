"""Cost of the log marginal likelihood and its gradient, beside what others offer for the same."""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import gpytorch
import numpy as np
import pyro.distributions as dist
import torch
from matplotlib.figure import Figure
from statsmodels.tsa.statespace.mlemodel import MLEModel

from pyro_dynogp import LTIKernel, LTIParameters, LTIProcess, Modes
from pyro_dynogp.lti.views import discrete_state_space
from tests.lti.dense import DenseCovariance

STEP = 0.05
NOISE_SD = 0.3


def system(pairs: int = 10) -> Modes:
    """Random stable system, the same for everyone."""
    rng = np.random.default_rng(0)
    poles = -np.exp(rng.uniform(-1.5, 1.0, pairs)) + 1j * np.exp(rng.uniform(-1.0, 2.5, pairs))
    c = rng.normal(size=pairs) + 1j * rng.normal(size=pairs)
    L = rng.normal(size=(pairs, 1)) + 1j * rng.normal(size=(pairs, 1))
    return Modes(poles, None, c, L)


def data(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(1)
    return torch.arange(n, dtype=torch.float64) * STEP, torch.as_tensor(rng.normal(size=n))


def leaves(modes: Modes) -> list[torch.Tensor]:
    return [
        x.clone().requires_grad_()
        for x in (modes.poles, modes.C[0], modes.L, torch.tensor(NOISE_SD).double())
    ]


def ours(n: int) -> Callable[[], float]:
    modes, (t, y) = system(), data(n)

    def call() -> float:
        poles, c, L, sd = leaves(modes)
        value = LTIProcess(Modes(poles, None, c, L), t).observed(sd).log_prob(y)
        value.backward()
        return float(value.detach())

    return call


def ours_value(n: int) -> Callable[[], float]:
    """Log-likelihood alone, as statsmodels has it."""
    modes, (t, y) = system(), data(n)

    def call() -> float:
        with torch.no_grad():
            return float(LTIProcess(modes, t).observed(NOISE_SD).log_prob(y))

    return call


def dense_torch(n: int) -> Callable[[], float]:
    modes, (t, y) = system(), data(n)

    def call() -> float:
        poles, c, L, sd = leaves(modes)
        K = DenseCovariance(Modes(poles, None, c, L), t, sd.square().expand(n))
        value = K.log_prob(y.unsqueeze(-1)).sum()
        value.backward()
        return float(value.detach())

    return call


def gpytorch_exact(n: int) -> Callable[[], float]:
    t, y = data(n)
    system_ = LTIParameters(system())
    likelihood = gpytorch.likelihoods.GaussianLikelihood().double()
    likelihood.noise = NOISE_SD**2

    class Exact(gpytorch.models.ExactGP):
        def __init__(self) -> None:
            super().__init__(t.unsqueeze(-1), y, likelihood)
            self.mean_module = gpytorch.means.ZeroMean()
            self.covar_module = LTIKernel(system_)

        def forward(self, x: torch.Tensor) -> gpytorch.distributions.MultivariateNormal:
            return gpytorch.distributions.MultivariateNormal(
                self.mean_module(x), self.covar_module(x)
            )

    model = Exact().train()
    mll = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)

    def call() -> float:
        model.zero_grad()
        # Cholesky, as GPyTorch does by default up to 800 samples: the exact figure.
        with gpytorch.settings.fast_computations(False, False, False):
            value = mll(model(t.unsqueeze(-1)), y) * n
            value.backward()
        return float(value.detach())

    return call


def statsmodels_filter(n: int) -> Callable[[], float]:
    """Log-likelihood alone: statsmodels has numerical gradients only."""
    modes, (_, y) = system(), data(n)
    discrete = discrete_state_space(modes, STEP)
    J = 2 * modes.pairs
    model = MLEModel(y.numpy(), k_states=J, k_posdef=J)
    model["design"] = discrete.C.numpy()
    model["transition"] = discrete.A.numpy()
    model["selection"] = np.eye(J)
    model["state_cov"] = discrete.Q.numpy()
    model["obs_cov"] = np.array([[NOISE_SD**2]])
    model.initialize_known(np.zeros(J), discrete.stationary.numpy())

    def call() -> float:
        return float(model.ssm.loglike())

    return call


def pyro_hmm(n: int) -> Callable[[], float]:
    modes, (_, y) = system(), data(n)

    def call() -> float:
        poles, c, L, sd = leaves(modes)
        discrete = discrete_state_space(Modes(poles, None, c, L), STEP)
        J = 2 * modes.pairs
        zero = torch.zeros(J, dtype=torch.float64)
        Q = discrete.Q + 1e-9 * torch.eye(J, dtype=torch.float64)
        hmm = dist.GaussianHMM(
            dist.MultivariateNormal(zero, discrete.stationary),
            discrete.A.mT.expand(n, J, J),
            dist.MultivariateNormal(zero, Q),
            discrete.C.mT,
            dist.Normal(torch.zeros(1).double(), sd.reshape(1)).to_event(1),
        )
        value = hmm.log_prob(y.unsqueeze(-1))
        value.backward()
        return float(value.detach())

    return call


METHODS: dict[str, tuple[Callable[[int], Callable[[], float]], int]] = {
    "pyro_dynogp": (ours, 1_000_000),
    "pyro_dynogp (value only)": (ours_value, 1_000_000),
    "statsmodels (value only)": (statsmodels_filter, 100_000),
    "Pyro GaussianHMM": (pyro_hmm, 10_000),
    "dense torch": (dense_torch, 4_000),
    "GPyTorch ExactGP": (gpytorch_exact, 4_000),
}
SIZES = (1_000, 4_000, 10_000, 100_000, 1_000_000)


def seconds(call: Callable[[], float]) -> tuple[float, float]:
    """Best of up to five runs within ten seconds, and the value computed."""
    value, best, spent = call(), np.inf, 0.0  # the first run compiles
    for _ in range(5):
        begin = time.perf_counter()
        value = call()
        best = min(best, time.perf_counter() - begin)
        spent += time.perf_counter() - begin
        if spent > 10.0:
            break
    return best, value


def peak_gigabytes(n: int) -> float:
    """Peak memory of a process of its own that evaluates value and gradient once."""
    code = f"from tests.benchmarks.speed import ours; ours({n})(); " \
           "import resource; print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"  # fmt: skip
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    return float(out.split()[-1]) / 1e6


def run(folder: Path) -> str:
    """Time every method at every size it can take."""
    torch.set_num_threads(1)
    # First, while this process is small: a child's peak starts at its parent's.
    memory = peak_gigabytes(1_000_000)
    times: dict[str, dict[int, float]] = {name: {} for name in METHODS}
    values: dict[int, dict[str, float]] = {n: {} for n in SIZES}
    for name, (make, largest) in METHODS.items():
        for n in SIZES:
            if n <= largest:
                times[name][n], values[n][name] = seconds(make(n))
                print(f"{name:28s} n = {n:8d}  {times[name][n]:10.4f} s", flush=True)
    lines = [
        "Log marginal likelihood and its gradient with respect to poles, gains and noise, 10 pairs "
        "(20 states), one thread, float64, best of up to five runs [s].",
        "",
        "| method | " + " | ".join(f"n = {n}" for n in SIZES) + " |",
        "|---" * (len(SIZES) + 1) + "|",
    ]
    for name in METHODS:
        cells = [f"{times[name][n]:.4g}" if n in times[name] else "-" for n in SIZES]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    mine = times["pyro_dynogp"]
    slope = np.log(mine[1_000_000] / mine[10_000]) / np.log(100)
    lines += ["", f"Slope of our cost over n between 1e4 and 1e6 (log-log): {slope:.3f}."]
    for name in list(METHODS)[1:]:
        shared = max(times[name])
        ratio = times[name][shared] / mine[shared]
        gap = abs(values[shared][name] - values[shared]["pyro_dynogp"])
        lines.append(
            f"{name}: {ratio:.3g} times our time of value and gradient at n = {shared}; "
            f"log-likelihoods differ by {gap:.2g} nats."
        )
    lines.append(f"Peak memory of our value and gradient at n = 1e6: "
                 f"{memory:.2f} GB.")  # fmt: skip
    lines.append("\n![cost over n](speed.png)")
    _figure(times).savefig(folder / "speed.png", dpi=130)
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    lines.append(f"\n(Peak memory of the whole comparison: {own:.1f} GB.)")
    return "\n\n".join(lines[:1]) + "\n" + "\n".join(lines[1:])


def _figure(times: dict[str, dict[int, float]]) -> Figure:
    figure = Figure(figsize=(6.5, 4.2), layout="constrained")
    axes = figure.subplots()
    for (name, series), marker in zip(times.items(), "oXs^Dv", strict=True):
        axes.loglog(list(series), list(series.values()), marker=marker, label=name)
    axes.set_xlabel("number of samples n")
    axes.set_ylabel("time of likelihood and gradient [s]")
    axes.grid(True, which="major", alpha=0.3)
    axes.legend(frameon=False)
    return figure
