"""Left-out densities of the hook against fits that never saw the samples."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyro
import torch
from scipy.special import logsumexp
from scipy.stats import norm
from tqdm import tqdm

import pyro_dynogp as dgp
from pyro_dynogp.criticism.left_out import monte_carlo_error
from pyro_dynogp.criticism.posterior_draws import draws_of
from pyro_dynogp.criticism.subjects import FitSubject, observed_of
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.optima import posterior_of
from pyro_dynogp.inference.methods.svi import Schedule
from pyro_dynogp.inference.optimise.optimum import Optimum
from pyro_dynogp.inference.pareto import good_k, psis
from pyro_dynogp.inference.refit import optima_of, refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.architectures import Cascade
from pyro_dynogp.models.assembly import assemble
from pyro_dynogp.moments import filtering, smoothing
from pyro_dynogp.moments.problem import each
from tests.conftest import simulate_record

QUIET: dict[str, Any] = {"workers": 1, "progress": False}
# Records, and of how many samples one is left out by brute force: of each, in turn.
SIZES = {60: 1, 100: 1}
NOISE = 0.05
# Of the hook, and of each brute-force fit, whose draws are its own.
DRAWS, BRUTE_DRAWS, BRUTE_SEED = 1000, 1000, 9
Again = Callable[[Any, dgp.Record], Any]


@dataclass(frozen=True)
class Compared:
    """The hook beside brute force, sample by sample (N,).

    Attributes:
        model, target, reference: in words. hook, exact: log-densities [nats].
        error: stated Monte Carlo error of the hook's sum over all samples it scored.
        own_error: of the sum of brute force.
        naive: sum of the conditional leave-one-out, None for forecasts. note: what else was found.
    """

    model: str
    target: str
    reference: str
    hook: np.ndarray
    exact: np.ndarray
    error: float
    own_error: float
    naive: float | None
    note: str


def records(n: int) -> dict[str, dgp.Record]:
    """A resonant pair with process noise, read by a straight sensor and by one that saturates."""
    modes = dgp.Modes([-0.6 + 2.0j], [[0.8 + 0.3j]], [1.0], [[0.15]])
    hidden = simulate_record(modes, 1e-3, n=n, seed=5)
    g = hidden.outputs / hidden.outputs.std()
    noise = NOISE * np.random.default_rng([n, 5]).standard_normal((n, 1))
    return {
        "linear": hidden.with_outputs(g + noise),
        "Wiener": hidden.with_outputs(np.tanh(1.2 * g) + noise),
    }


def fitted(name: str, record: dgp.Record) -> Any:
    """The fit that everything starts from, fitted again once, as all others are."""
    if name == "linear":
        return dgp.fit(dgp.LinearDynamicGP(inputs=1, pairs=1), record, restarts=3, **QUIET)
    model = dgp.Wiener(inputs=1, pairs=1, inducing=6)
    # One start: how much each of several optima weighs is no matter of leaving data out.
    return refit(dgp.fit(model, record, restarts=1, steps=600, draws=50, **QUIET), record)


def at_the_optimum(fit: Any, record: dgp.Record) -> Any:
    """Inducing values and first states fitted to another record; all else where it was."""
    optima = [Optimum(0.0, dict(values), np.zeros(1), "") for values in optima_of(fit)]
    found = posterior_of(
        Problem(fit.model, fit.model.prepare(record)),
        optima,
        "map",
        Run(fit.seed, **QUIET),
        Schedule(60),
    )
    return replace(fit, records=(record,), posterior=found.guide, mode=found.mode)


def density_of(again: Any, whole: dgp.Record, i: int, kind: Any) -> tuple[float, float]:
    """Log-density of sample i of the whole record under a fit without it, and its error."""
    subject = FitSubject(again, (whole,), BRUTE_DRAWS, BRUTE_SEED)
    log_weights, k = psis(subject.draws.log_ratio)
    if k > good_k(BRUTE_DRAWS):  # as the hook does: draws as they are
        log_weights = np.full(len(log_weights), -np.log(len(log_weights)))
    density = subject.pointwise(kind)[:, [i]]
    found = logsumexp(log_weights + density[:, 0])
    return float(found), monte_carlo_error(log_weights[None], density, np.array([found]))


def leave_out(
    fit: Any, record: dgp.Record, chosen: Sequence[int], again: Again, kind: Any
) -> tuple[np.ndarray, float, int]:
    """Log-densities of chosen samples by brute force, the error of their sum, and moved fits.

    The last number counts the fits whose hyperparameters are not those of the old fit.
    """
    found, moved = [], 0
    for i in tqdm(chosen, desc=f"{type(fit.model).__name__} {len(record)} {kind}"):
        y = record.outputs.copy()
        y[i] = np.nan
        rest = record.with_outputs(y) if kind == "missing sample" else record[:i]
        other = again(fit, rest)
        hyper = [k for k in fit.mode if not (k.endswith("_values") or "_initial_state" in k)]
        moved += any(not torch.equal(other.mode[k], fit.mode[k]) for k in hyper)
        found.append(density_of(other, record, i, kind))
    values, errors = np.array(found).T
    return values, float(np.sqrt(np.sum(errors**2))), moved


def conditional(fit: Any, record: dgp.Record) -> np.ndarray:
    """The naive leave-one-out (n,): importance sampling from densities given the trajectory.

    Sample i is given the noise-free output at i, drawn from its posterior, which has seen y_i.
    """
    values = draws_of(fit, count=2000, seed=3).values
    some = fit.with_draws(values)
    y = record.tensors().observations
    observed = observed_of(some, record, 0)
    with pyro.validation_enabled(False), torch.no_grad():
        if isinstance(fit.model, Cascade):
            mean, variance, noise, scale = _smoothed(observed, y)
        else:
            sd = some.system.noise_sd
            given = observed.process.condition(y, sd)
            mean, variance = given.mean.numpy(), given.variance.numpy()
            noise, scale = np.square(sd.numpy())[:, None], 1.0
    seen = record.outputs[:, 0]
    if isinstance(fit.model, Cascade):
        seen = (seen - observed.shift.item()) / scale
    z = mean + np.sqrt(variance) * np.random.default_rng(4).standard_normal(mean.shape)
    density = norm.logpdf(seen, z, np.sqrt(noise)) - np.log(scale)
    log_weights = psis(-density.T)[0]
    return logsumexp(log_weights + density.T, axis=1)


def _smoothed(observed: Any, y: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Mean and variance (S, n) of the noise-free output given all samples, noise, scale."""
    scaled = ((y - observed.shift) / observed.scale).unsqueeze(-1)
    problem = assemble(observed.system, observed.grid, observed.inputs).with_outputs(scaled)
    layout = problem.layout
    elements, _ = problem.elements()

    def moments(b: int) -> np.ndarray:
        one = elements[b]
        _, track, _, _ = filtering.run(layout, one)
        mean, variance, _ = smoothing.leave_one_out(layout, one, track)
        gain = variance / (variance + one.R)
        return np.stack([mean + gain * (one.y - mean), (1.0 - gain) * variance, one.R + 0.0 * mean])

    found = np.stack(each(moments, len(elements)))[..., 0]
    return found[:, 0], found[:, 1], found[:, 2], float(observed.scale)


def compare(name: str, n: int, every: int) -> list[Compared]:
    """One model on one record: missing samples, each or every so many, and forecasts."""
    record = records(n)[name]
    fit = fitted(name, record)
    cascade = isinstance(fit.model, Cascade)
    ways: dict[str, Again] = {"all parameters": refit}
    if cascade:
        ways = {"inducing values and first states": at_the_optimum, **ways}
    naive = conditional(fit, record)
    found = []
    targets: tuple[tuple[Any, int], ...] = (("missing sample", 0), ("forecast", n // 2))
    for target, first in targets:
        scored = dgp.loo(fit, target=target, draws=DRAWS, begin=n // 2, **QUIET)
        chosen = np.arange(first, n, every)
        hook = scored.loo_i.values[chosen - first]
        for reference, again in ways.items():
            # Refits of the hook forget the old optimum: for forecasts it has only one meaning.
            if target == "forecast" and again is not refit:
                continue
            exact, own_error, moved = leave_out(fit, record, chosen.tolist(), again, target)
            note = f"{scored['refits']}"
            if cascade and again is refit:
                note += f"; hyperparameters moved in {moved} of {len(chosen)} fits"
            found.append(
                Compared(
                    model=f"{name}, {n} samples",
                    target=target,
                    reference=reference,
                    hook=hook,
                    exact=exact,
                    error=scored["monte_carlo_error"],
                    own_error=own_error,
                    naive=float(naive[chosen].sum()) if target == "missing sample" else None,
                    note=note,
                )
            )
            print(_line(found[-1]), flush=True)
    return found


def _line(one: Compared) -> str:
    difference = one.hook - one.exact
    naive = "" if one.naive is None else f"{one.naive:.1f} ({one.naive - one.exact.sum():+.1f})"
    return (
        f"| {one.model} | {one.target} ({len(one.hook)}) | {one.reference} | "
        f"{one.hook.sum():.2f} | {one.exact.sum():.2f} | {difference.sum():+.2f} | "
        f"{one.error:.2f} | {one.own_error:.2f} | {np.sqrt(np.mean(difference**2)):.3f} | "
        f"{np.abs(difference).max():.2f} | {naive} | {one.note} |"
    )


def run(folder: Path, sizes: Mapping[int, int] = SIZES) -> str:
    """Linear and Wiener model on short records; half an hour on one processor."""
    del folder
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = [
            one
            for name in ("linear", "Wiener")
            for n, every in sizes.items()
            for one in compare(name, n, every)
        ]
    return "\n".join(
        [
            "Sum over samples of the log-density of each when it is left out: by the hook, and by "
            "one fit for each sample, from the optimum, with draws of its own. A Wiener model "
            "keeps poles, gains, noise and lengthscales at the optimum: the hook then states what "
            "fitting its inducing values and first states again gives, and where Pareto's k makes "
            "it fit again, what fitting all parameters gives. Stated error: of the hook's sum over "
            "all samples that it scored. Naive: importance sampling from densities given the "
            "trajectory, which has seen the sample.",
            "",
            "| model | target (samples) | fitted again | hook | brute force | difference | "
            "stated error | error of brute force | rms by sample | largest | "
            "naive (less brute force) | refits by the hook |",
            "|---" * 12 + "|",
            *(_line(one) for one in found),
        ]
    )
