"""Cost of the exact linear likelihood: value, value and gradient, innovations.

Microseconds of processor time a sample and point, best of some runs, on one core:

    python -m tests.benchmarks.kernels [--n 500 4000] [--pairs 2 5 10] [--batch 1 4 32]

Run it in the folder of another version of the package to have its figures beside these.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable

import numpy as np
import torch

from pyro_dynogp import LTIProcess, Modes
from pyro_dynogp.lti.grid import TimeGrid, time_grid

STEP = 0.0625  # sums of it are exact: all steps are the same to the last bit


def leaves(batch: int, pairs: int, seed: int = 0) -> list[torch.Tensor]:
    """Poles, output gains, noise gains and standard deviation of noise of each point."""
    rng = np.random.default_rng(seed)
    shape = (batch, pairs)
    poles = -np.exp(rng.uniform(-1.5, 1.0, shape)) + 1j * np.exp(rng.uniform(-1.0, 2.5, shape))
    c = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    L = rng.normal(size=(*shape, 1)) + 1j * rng.normal(size=(*shape, 1))
    sd = np.full(batch, 0.3)
    return [torch.as_tensor(x).requires_grad_() for x in (poles, c, L, sd)]


def times(n: int, equal: bool) -> TimeGrid:
    if equal:
        return time_grid(np.arange(n) * STEP)
    steps = np.random.default_rng(2).uniform(0.5 * STEP, 1.5 * STEP, n)
    return time_grid(np.cumsum(steps))


def log_density(leaf: list[torch.Tensor], t: TimeGrid, y: torch.Tensor) -> torch.Tensor:
    poles, c, L, sd = leaf
    return LTIProcess(Modes(poles, None, c, L), t).observed(sd).log_prob(y)


def calls(n: int, equal: bool, pairs: int, batch: int) -> dict[str, Callable[[], object]]:
    """What is measured, by its name."""
    leaf, t = leaves(batch, pairs), times(n, equal)
    y = torch.as_tensor(np.random.default_rng(1).normal(size=n)).expand(batch, n)
    fixed = [x.detach() for x in leaf]

    def innovations() -> object:
        observed = LTIProcess(Modes(fixed[0], None, *fixed[1:3]), t).observed(fixed[3])
        K = observed.covariance(observed.noise_rows[..., :1].expand(batch, n))
        if hasattr(observed, "noise"):
            K = observed.covariance(observed.noise)
        return K.innovations((y - observed.mean).unsqueeze(-1)), K.innovation_variance

    return {
        "value": lambda: log_density(fixed, t, y),
        "value and gradient": lambda: torch.autograd.grad(log_density(leaf, t, y).sum(), leaf),
        "innovations": innovations,
    }


def best(call: Callable[[], object], seconds: float = 1.0) -> float:
    """Least processor time of a call [s], tried again for some seconds."""
    call()
    taken: list[float] = []
    while not taken or (sum(taken) < seconds and len(taken) < 30):
        start = time.process_time()
        call()
        taken.append(time.process_time() - start)
    return min(taken)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, nargs="+", default=[500, 4000, 50_000])
    parser.add_argument("--pairs", type=int, nargs="+", default=[2, 5, 10])
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 4, 32])
    given = parser.parse_args()
    torch.set_num_threads(1)
    print("| n | steps | pairs | points | value | value and gradient | innovations |")
    print("|---|---|---|---|---|---|---|")
    for n in given.n:
        for equal in (True, False):
            for pairs in given.pairs:
                for batch in given.batch:
                    cells = []
                    for call in calls(n, equal, pairs, batch).values():
                        cells.append(f"{1e6 * best(call) / (n * batch):.4f}")
                    steps = "equal" if equal else "irregular"
                    row = [str(n), steps, str(pairs), str(batch), *cells]
                    print(f"| {' | '.join(row)} |", flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\nlargest memory of the process {peak:.0f} MB")


if __name__ == "__main__":
    main()
