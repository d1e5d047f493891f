"""Smoother, predictions, innovations and last state of nonlinear cascades, against dense textbook
forms of the same equations (Rauch-Tung-Striebel, joint updates)."""

from functools import lru_cache

import numpy as np
import pytest

from pyro_dynogp.moments import filtering, smoothing
from pyro_dynogp.moments.filtering import SEGMENT
from tests.lti.oracles import assert_close
from tests.moments import oracles
from tests.moments.problems import LINE, WIDE, Block, element, random_problem

CASES = {
    "no static layer": {"blocks": (), "n_y": 2},
    "table": {"blocks": (LINE,)},
    "tables in series": {"blocks": (LINE, WIDE, LINE), "n_y": 2},
    "radial": {"blocks": (Block("rbf", 2, 2),), "n_y": 2},
    "radial, then table": {"blocks": (Block("matern32", 3, 2), LINE), "n_y": 3},
    "one sample": {"blocks": (LINE,), "n": 1},
    "just a segment": {"blocks": (LINE, LINE), "n": SEGMENT},
    "a sample beyond a segment": {"blocks": (Block("matern52", 2, 1),), "n": SEGMENT + 1},
    "three segments": {"blocks": (LINE, Block("rbf", 2, 2)), "n": 2 * SEGMENT + 7, "n_y": 2},
}


@lru_cache
def filtered(name):
    problem = random_problem(**CASES[name], seed=len(name))
    values = element(problem)
    return problem.layout, values, oracles.run(problem.layout, values)


@pytest.mark.parametrize("name", CASES)
def test_smoothed_moments(name):
    layout, values, plain = filtered(name)
    A = values.G.shape[1]
    rows = np.concatenate([np.eye(A), np.random.default_rng(0).standard_normal((2, A))])
    _, track, _, _ = filtering.run(layout, values)
    mean, variance = smoothing.smooth(layout, values, rows, track)
    exact_mean, exact = oracles.smooth(layout, values, plain)
    assert_close(mean, exact_mean, rtol=1e-8)
    assert_close(variance, np.einsum("ra,nab,rb->nr", rows, exact, rows), rtol=1e-8)


@pytest.mark.parametrize("name", CASES)
def test_last_state(name):
    layout, values, plain = filtered(name)
    _, track, m, P = filtering.run(layout, values)
    assert_close(m, plain.after[-1][0], rtol=1e-9)
    assert_close(P, plain.after[-1][1], rtol=1e-9)
    N = len(values.m0)
    for place, (kept_mean, kept) in enumerate(zip(track.means, track.covariances, strict=True)):
        before_mean, before = plain.before[place * SEGMENT]
        assert_close(kept_mean, before_mean[:N], rtol=1e-9)
        assert_close(kept, before[:N, :N], rtol=1e-9)


@pytest.mark.parametrize("horizon", [1, 3])
@pytest.mark.parametrize("name", CASES)
def test_predictions(name, horizon):
    layout, values, plain = filtered(name)
    mean, variance, _ = smoothing.predict_ahead(layout, values, horizon)
    exact_mean, exact = oracles.ahead(layout, values, plain, horizon)
    assert_close(mean, exact_mean, rtol=1e-9)
    assert_close(variance, exact, rtol=1e-8)


def test_a_horizon_beyond_the_record_predicts_from_the_first_state():
    layout, values, plain = filtered("table")
    n = len(layout.step)
    mean, variance, _ = smoothing.predict_ahead(layout, values, n + 5)
    exact_mean, exact = oracles.ahead(layout, values, plain, n + 5)
    assert_close(mean, exact_mean, rtol=1e-9)
    assert_close(variance, exact, rtol=1e-8)


@pytest.mark.parametrize("name", CASES)
def test_innovations(name):
    """Whitened by their variances they give the log-density: no other factorisation is needed."""
    layout, values, plain = filtered(name)
    innovation, variance, _ = smoothing.innovate(layout, values)
    gone = np.isnan(values.y)
    assert np.array_equal(np.isnan(innovation), gone)
    assert np.array_equal(np.isnan(variance), gone)
    r, S = innovation[~gone], variance[~gone]
    total = -0.5 * (r**2 / S + np.log(2 * np.pi * S)).sum()
    assert total == pytest.approx(plain.log_density, rel=1e-9)
    for time, (m, P) in enumerate(plain.before):
        if not gone[time, 0]:  # the first output of a sample is not yet helped by the others
            h = values.H[0]
            expected = values.y[time, 0] - h @ m - values.y_offset[time, 0]
            assert innovation[time, 0] == pytest.approx(expected, rel=1e-8, abs=1e-10)
            assert variance[time, 0] == pytest.approx(h @ P @ h + values.R[time, 0], rel=1e-9)


def test_smoothing_narrows_and_needs_no_process_noise():
    """A covariance that is singular, as without process noise, is no special case."""
    layout, values, _ = filtered("table")
    flat = values._replace(Q=np.zeros_like(values.Q), P0=np.outer(*[np.arange(1.0, 5.0)] * 2) / 20)
    rows = np.eye(values.G.shape[1])
    _, track, _, _ = filtering.run(layout, flat)
    mean, variance = smoothing.smooth(layout, flat, rows, track)
    filtered_variance = np.array([np.diag(P) for _, P in oracles.run(layout, flat).after])
    assert np.isfinite(mean).all()
    assert (variance >= 0.0).all()
    assert (variance <= filtered_variance + 1e-9).all()
    # Rank one: with a little more of every state the plain smoother is defined, and near.
    eased = flat._replace(P0=flat.P0 + 1e-7 * np.eye(4), Q=flat.Q + 1e-7 * np.eye(4))
    plain = oracles.smooth(layout, eased, oracles.run(layout, eased))
    assert_close(mean, plain[0], rtol=1e-4)
