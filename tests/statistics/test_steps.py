"""Steps at any instant against dense least squares."""

from __future__ import annotations

import numpy as np
import pytest

from pyro_dynogp.statistics.autoregression import Whitener
from pyro_dynogp.statistics.prewhitening import Projection, spanning
from pyro_dynogp.statistics.steps import instants, stairs, steps
from tests.discrepancy.made import SETTINGS

N = 160


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("order", [0, 1, 4])
def test_every_step_explains_what_least_squares_explain(order: int, gaps: bool) -> None:
    rng = np.random.default_rng(order)
    signals = np.column_stack([np.ones(N), np.cumsum(rng.standard_normal(N))])
    missing = np.zeros(N, dtype=bool)
    if gaps:
        missing[[3, 70, 71, 90]] = True
    nuisance = spanning(rng.standard_normal((N, 2)))
    under = Projection(Whitener(0.3 * rng.standard_normal(order)), nuisance, missing, SETTINGS)
    places = instants(N, 0.05)
    x = np.where(missing, np.nan, rng.standard_normal(N))
    gains, fit = steps(signals, places).prepare(under)(x)
    assert gains.shape == (2 * len(places),)
    w = under.filtered(np.column_stack([nuisance, x]))
    for j in rng.choice(len(gains), 12, replace=False):
        k, place = divmod(int(j), len(places))
        step = np.where(np.arange(N) >= places[place], signals[:, k], 0.0)
        columns = np.column_stack([w[:, :-1], under.filtered(step)])
        coefficients, *_ = np.linalg.lstsq(columns, w[:, -1], rcond=None)
        without, *_ = np.linalg.lstsq(w[:, :-1], w[:, -1], rcond=None)
        left = np.square(w[:, -1] - columns @ coefficients).sum()
        before = np.square(w[:, -1] - w[:, :-1] @ without).sum()
        assert gains[j] == pytest.approx(len(w) * np.log(before / left), rel=1e-8, abs=1e-10)
        own = coefficients[-1] * step
        np.testing.assert_allclose(fit(int(j))[0], own - own.mean(), atol=1e-9)


def test_instants_and_staircases_keep_to_the_record() -> None:
    np.testing.assert_array_equal(instants(200, 0.1), np.arange(20, 180))
    np.testing.assert_array_equal(instants(40, 0.01), np.arange(5, 35))
    signals = np.column_stack([np.ones(80), np.arange(80.0)])
    stair = stairs(signals)
    assert stair.shape == (80, 16)
    np.testing.assert_allclose(stair[:, :8].sum(1), signals[:, 0])
    np.testing.assert_allclose(stair[:, 8:].sum(1), signals[:, 1])
