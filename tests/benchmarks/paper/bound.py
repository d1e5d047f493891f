"""How well the simulated Wiener systems can be known at all: a Cramer-Rao bound.

Two sines drive them, so that all that a record says of the linear block is its response at two
frequencies, four numbers. To who knows everything else (the static function, the covariance of the
process noise, the measurement noise) the samples where the positive part is open are these four
numbers seen through Gaussian noise, and the variance of any unbiased estimate of them has a bound.
Who has to learn the function and the noise as well can do no better.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov, toeplitz

import pyro_dynogp as dgp
from pyro_dynogp.examples.simulators import discretise
from tests.benchmarks import wiener

# Of the inputs [rad/s].
FREQUENCIES = (3.0 * np.pi, 5.0 * np.pi)
STEP = 0.01


# A, B, C, L and the standard deviation of the measurement noise.
System = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]


def clean_error_bound(system: System) -> float:
    """Least RMSE against the clean output of the test, over the measurement noise's sd."""
    A, B, C, L, noise_sd = system
    time = STEP * np.arange(2500)
    g = response(A, B, C, np.sin(np.outer(time, FREQUENCIES)))
    basis = np.concatenate(
        [f(np.outer(time, FREQUENCIES)) for f in (np.sin, np.cos)], axis=1
    )  # fmt: skip
    stationary = solve_continuous_lyapunov(A, -L @ L.T)
    step, lag, covariance = expm(A * STEP), np.eye(len(A)), []
    for _ in range(wiener.TRAINING):
        covariance.append((C @ lag @ stationary @ C.T).item())
        lag = step @ lag
    seen = g[: wiener.TRAINING] > 0.0
    K = toeplitz(covariance)[np.ix_(seen, seen)] + noise_sd**2 * np.eye(seen.sum())
    Phi = basis[: wiener.TRAINING][seen]
    information = Phi.T @ np.linalg.solve(K, Phi)
    test = basis[wiener.TRAINING :]
    variance = np.einsum("ti,ij,tj->t", test, np.linalg.inv(information), test)
    return float(np.sqrt(np.mean((g[wiener.TRAINING :] > 0.0) * variance))) / noise_sd


def response(A: np.ndarray, B: np.ndarray, C: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Output (n,) of the linear block from rest, without process noise, inputs held."""
    step, held, _ = discretise(A, B, np.zeros((len(A), 1)), STEP)
    x, out = np.zeros(len(A)), []
    for row in u:
        x = step @ x + held @ row
        out.append((C @ x).item())
    return np.array(out)


def simulated(seed: int) -> System:
    """A system of our own simulator."""
    truth = dgp.datasets.load("wiener", seed=seed).truth
    assert truth is not None
    return truth.A, truth.B, truth.C, truth.L, truth.noise_sd


def published(seed: int) -> System:
    """The system of a published record where those are, else of our own simulator."""
    folder = os.environ.get(wiener.VARIABLE)
    if folder is None:
        return simulated(seed)
    arrays = np.load(Path(folder) / f"seed_{seed}.npz")
    v = arrays["a_v"].ravel()
    A = np.diag(arrays["a_d"].ravel()) - np.outer(v, v)
    C, L = arrays["C"].reshape(1, -1), arrays["L"].reshape(-1, 1)
    return A, arrays["B"][0], C, L, float(arrays["noise_std"])
