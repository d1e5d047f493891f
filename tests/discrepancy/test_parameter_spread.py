"""Uncertainty of parameters where what a model leaves of its training data is coloured."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.linalg import toeplitz
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp.criticism.posterior_draws import laplace
from pyro_dynogp.discrepancy import parameter_spread as module
from pyro_dynogp.discrepancy.parameter_spread import normal_near, root_beside_colour
from pyro_dynogp.statistics.autoregression import Whitener
from tests.discrepancy.made import SETTINGS

N, D = 4000, 3


def local(rng: np.random.Generator, pole: float, prior: np.ndarray | None = None) -> Any:
    """Slow derivatives of errors, and errors of variance one with a pole."""
    J = lfilter([1.0], [1.0, -0.9], rng.standard_normal((D, N)))
    of_variance = 0.1 * rng.standard_normal((D, N))
    e = np.sqrt(1.0 - pole**2) * lfilter([1.0], [1.0, -pole], rng.standard_normal(N))
    fisher = J @ J.T + of_variance @ of_variance.T
    return SimpleNamespace(
        fisher=fisher, prior=np.eye(D) if prior is None else prior,
        level=np.stack([e, e]), slopes=np.stack([J, of_variance]),
    )  # fmt: skip


@pytest.mark.parametrize("pole", [0.8, -0.5])
def test_covariance_is_that_of_dense_algebra(monkeypatch: pytest.MonkeyPatch, pole: float) -> None:
    """By the covariance matrix of all errors; the filter is the true one."""
    rng = np.random.default_rng(1)
    here = local(rng, pole, np.diag([1.0, 50.0, 1e4]))
    monkeypatch.setattr(module, "fitted_filter", lambda *_: Whitener(np.array([pole])))
    root = root_beside_colour(here, np.zeros(N), SETTINGS)
    assert np.allclose(root, np.tril(root))
    J, V = here.slopes
    w = here.level[0][1:] - pole * here.level[0][:-1]
    variance = np.square(w).mean() * N / (N - D - 1) / (1.0 - pole**2)
    M = variance * J @ toeplitz(pole ** np.arange(N)) @ J.T + V @ V.T
    H = np.linalg.inv(here.fisher + here.prior)
    expected = H @ (M + here.prior) @ H
    # The filter begins at rest beyond the last sample: some of 4000 count otherwise. Elements off
    # the diagonal are small differences.
    np.testing.assert_allclose(root @ root.T, expected, rtol=0.01, atol=0.01 * expected.max())


@pytest.mark.parametrize("pole", [0.0, 0.8])
def test_estimates_scatter_as_it_says(pole: float) -> None:
    """Least squares of 400 records, with the filter that each has."""
    rng = np.random.default_rng(2)
    moves, said = [], []
    here = local(rng, 0.0, 1e-9 * np.eye(D))
    for _ in range(400):
        e = np.sqrt(1.0 - pole**2) * lfilter([1.0], [1.0, -pole], rng.standard_normal(N))
        moves.append(np.linalg.solve(here.fisher, here.slopes[0] @ e))
        if len(said) < 5:
            one = SimpleNamespace(**{**vars(here), "level": np.stack([e, e])})
            root = root_beside_colour(one, np.zeros(N), SETTINGS)
            said.append(np.diag(root @ root.T))
    found = np.var(moves, axis=0)
    # 400 records tell a variance to 7 %, of which these are four; a filter of 4000 samples with a
    # pole of 0.8 tells the size of slow noise to some percent, and variances add a hundredth.
    np.testing.assert_allclose(np.mean(said, axis=0), found, rtol=0.3)
    white = np.diag(np.linalg.inv(here.fisher))
    assert (np.mean(said, axis=0) > 3.0 * white).all() == (pole > 0.0)


def test_outputs_have_colours_of_their_own_and_few_errors_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(3)
    here = local(rng, 0.0)
    outputs = np.tile([0, 1], N // 2)
    white, slow = rng.standard_normal(N // 2), rng.standard_normal(N // 2)
    slow = lfilter([1.0], [1.0, -0.9], slow)
    here.level[0][::2], here.level[0][1::2] = white, slow

    def known(errors: np.ndarray, settings: Any) -> Whitener:
        """The true filter of each."""
        return Whitener(np.array([0.9]) if errors[0] == slow[0] else np.zeros(0))

    monkeypatch.setattr(module, "fitted_filter", known)
    J, degrees = here.slopes[0], (N // 2) / (N // 2 - D)
    both = root_beside_colour(here, outputs, SETTINGS)
    M = degrees * np.square(white).mean() * J[:, ::2] @ J[:, ::2].T
    G = lfilter([1.0], [1.0, -0.9], J[:, 1::2][:, ::-1])
    driving = slow[1:] - 0.9 * slow[:-1]  # a sample of the past fewer
    of_slow = np.square(driving).mean() * (N // 2) / (N // 2 - D)
    M = M + of_slow * G @ G.T + here.slopes[1] @ here.slopes[1].T
    H = np.linalg.inv(here.fisher + here.prior)
    expected = H @ (M + here.prior) @ H
    np.testing.assert_allclose(both @ both.T, expected, rtol=1e-8)
    few = SETTINGS.measured_samples - 1
    alone = np.arange(N) // few  # each "output" has too few errors
    plain = np.linalg.inv(here.fisher + here.prior)
    root = root_beside_colour(here, alone, SETTINGS)
    np.testing.assert_allclose(root @ root.T, plain, rtol=1e-8)


def plant(pole: float) -> dgp.Fit:
    """A pole, fitted without process noise to a record whose noise has a pole."""
    rng, n = np.random.default_rng(4), 400
    u = np.repeat(rng.standard_normal(n // 10), 10)
    y = lfilter([0.0, 0.3], [1.0, -1.6, 0.9], u)
    y += 0.05 * np.sqrt(1.0 - pole**2) * lfilter([1.0], [1.0, -pole], rng.standard_normal(n))
    model = dgp.LinearDynamicGP(1, pairs=1, process_noise=False)
    record = dgp.Record(np.arange(float(n)), u, y)
    return dgp.fit(model, record, method="map", restarts=2, workers=1, progress=False)


@pytest.mark.parametrize(("pole", "low", "high"), [(0.0, (0.7, 1.0), (0.9, 1.4)),
                                                   (0.95, (0.2, 0.6), (3.0, 20.0))])  # fmt: skip
def test_beside_white_errors_it_is_laplaces(
    pole: float, low: tuple[float, float], high: tuple[float, float]
) -> None:
    """Slow noise tells little of what slow inputs do, and more of what quick ones do."""
    fit = plant(pole)
    near, normal = normal_near(fit, SETTINGS), laplace(fit, fit.mode)
    ratio = torch.linalg.svdvals(torch.linalg.solve(normal.scale_tril[0], near.scale_tril[0]))
    assert low[0] < ratio.min() < low[1]
    assert high[0] < ratio.max() < high[1]
    tenth = normal_near(fit, SETTINGS, 0.1).scale_tril
    torch.testing.assert_close(tenth, 0.1 * near.scale_tril)


def test_errors_of_two_outputs_of_two_records_are_told_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng, n = np.random.default_rng(5), 60
    records = []
    for _ in range(2):
        y = rng.standard_normal((n, 2))
        y[rng.random((n, 2)) < 0.2] = np.nan
        records.append(dgp.Record(np.arange(float(n)), rng.standard_normal(n), y))
    model = dgp.LinearDynamicGP(1, pairs=1, outputs=2, process_noise=False)
    fit = dgp.fit(model, records, method="map", restarts=1, workers=1, progress=False)
    seen: list[np.ndarray] = []

    def noted(here: Any, outputs: np.ndarray, settings: Any) -> np.ndarray:
        assert here.level.shape[1] == len(outputs)
        seen.append(outputs)
        return root_beside_colour(here, outputs, settings)

    monkeypatch.setattr(module, "root_beside_colour", noted)
    normal_near(fit, SETTINGS)
    expected = [np.tile([0, 1], n)[np.isfinite(one.outputs).reshape(-1)] for one in records]
    np.testing.assert_array_equal(seen[0], np.concatenate(expected))


def test_without_derivatives_of_errors_it_is_laplaces(monkeypatch: pytest.MonkeyPatch) -> None:
    fit = plant(0.0)
    monkeypatch.setattr(module, "innovations_of", lambda potential: None)
    near = normal_near(fit, SETTINGS)
    torch.testing.assert_close(near.scale_tril, laplace(fit, fit.mode).scale_tril)
