"""`dgp.loo` of models with functions against draws of all parameters that never saw the sample.

For some of the samples the posterior given all others is drawn again, with several times as many
particles and moves as a fit has. Environment variables: LOO_SAMPLES (60), LOO_EVERY (6, one in so
many samples is left out by brute force), LOO_TIMES (4, particles and moves over those of a fit).
"""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import logsumexp

import pyro_dynogp as dgp
from pyro_dynogp.criticism.left_out import monte_carlo_error
from pyro_dynogp.criticism.subjects import FitSubject
from pyro_dynogp.inference.function_sampling import sample_functions
from tests.benchmarks.brute_force import records
from tests.benchmarks.coverage import linear_record

QUIET: dict[str, Any] = {"workers": 1, "progress": False}


def fits(n: int) -> dict[str, dgp.Fit]:
    """Default fits to records of n samples."""
    bent = records(n)["Wiener"]
    back, _ = linear_record(5001, n, feedback=0.05)
    return {
        "Wiener": dgp.fit(dgp.Wiener(1, pairs=1, inducing=6), bent, **QUIET),
        "Wiener without process noise": dgp.fit(
            dgp.Wiener(1, pairs=1, inducing=6, process_noise=False), bent, **QUIET
        ),
        "feedback": dgp.fit(dgp.NonlinearFeedback(1), back, **QUIET),
    }


def draws_without(fit: dgp.Fit, i: int, times: int, seed: int) -> FitSubject:
    """Draws of the posterior of all parameters given all samples but one."""
    (record,) = fit.records
    y = record.outputs.copy()
    y[i] = np.nan
    prepared = tuple(fit.model.prepare((record.with_outputs(y),)))
    found, _ = sample_functions(
        fit.model.collapsed, prepared, [dict(fit.mode)], seed=seed, times=times
    )
    return FitSubject(fit, fit.records, 0, seed, drawn=found.draws)


def exact(
    fit: dgp.Fit, chosen: Sequence[int], times: int, seed: int = 9
) -> tuple[np.ndarray, float]:
    """Log-densities of chosen samples given all others, and the standard error of their sum."""
    found, errors = [], []
    for i in chosen:
        subject = draws_without(fit, i, times, seed)
        density = subject.pointwise("missing sample")[:, [i]]
        plain = np.full(len(density), -np.log(len(density)))
        one = float(logsumexp(plain + density[:, 0]))
        found.append(one)
        errors.append(
            monte_carlo_error(plain[None], density, np.array([one]), subject.draws.ancestor)
        )
    return np.array(found), float(np.sqrt(np.sum(np.square(errors))))


def run(folder: Path) -> str:
    """The table."""
    del folder
    n, every, times = (
        int(os.environ.get(name, usual))
        for name, usual in (("LOO_SAMPLES", 60), ("LOO_EVERY", 6), ("LOO_TIMES", 4))
    )
    lines = [
        "| model | samples | loo, all | loo, of these | brute force | difference | stated error, "
        "all | error of brute force | refits | not refitted | processor s, loo |",
        "|---" * 11 + "|",
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of high k: the table has what it comes to
        for name, fit in fits(n).items():
            begin = time.process_time()
            hook = dgp.loo(fit, target="missing sample", **QUIET)
            spent = time.process_time() - begin
            chosen = np.arange(every // 2, n, every)
            real, own_error = exact(fit, chosen.tolist(), times)
            ours = hook.loo_i.values[chosen]
            error, again, left = (
                hook[key] for key in ("monte_carlo_error", "refits", "not_refitted")
            )
            lines.append(
                f"| {name}, {n} | {len(chosen)} | {hook.elpd_loo:.2f} | {ours.sum():.2f} | "
                f"{real.sum():.2f} | {(ours - real).sum():+.2f} | "
                f"{error:.2f} | {own_error:.2f} | {again} | {left} | {spent:.1f} |"
            )
            print(lines[-1], flush=True)
    return "\n".join(lines)
