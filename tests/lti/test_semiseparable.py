"""The O(n) algebra against its dense twin and against dense normal distributions."""

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given

from pyro_dynogp.lti.covariance import jitter_variance, observability, state_covariance
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.semiseparable import (
    NotPositiveDefiniteError,
    SemiseparableCovariance,
)
from tests.lti import oracles
from tests.lti.dense import DenseCovariance
from tests.lti.oracles import NOISES, assert_close, few, random_system, tensor


def build(system, t, v, P0=None):
    args = (system.modes, t, tensor(v), None if P0 is None else tensor(P0))
    return SemiseparableCovariance(*args), DenseCovariance(*args)


def random_rows(N, R=2, seed=0):
    return tensor(np.random.default_rng([seed, 5]).standard_normal((N, R)))


def agree(fast, dense, Y):
    for method in ("solve", "root_solve", "log_prob", "matmul", "signal_matmul", "root_matmul"):
        assert_close(getattr(fast, method)(Y), getattr(dense, method)(Y))
    for method in ("root_matmul", "root_solve"):
        ours, theirs = (getattr(K, method)(Y, transpose=True) for K in (fast, dense))
        assert_close(ours, theirs)
    for method in ("log_determinant", "inverse_diagonal", "signal_variance"):
        assert_close(getattr(fast, method)(), getattr(dense, method)())
    assert_close(fast.innovation_variance, dense.innovation_variance)


@few
@given(
    seed=st.integers(0, 1000),
    outputs=st.sampled_from([None, 1, 3]),
    noise=st.sampled_from(NOISES),
    known=st.booleans(),
)
def test_every_method(seed, outputs, noise, known):
    system = random_system(seed, outputs=outputs, noise=noise)
    n = 20
    t, N = oracles.irregular_times(n, seed), n * (outputs or 1)
    v = np.random.default_rng(seed).uniform(0.05, 0.5, N)
    fast, dense = build(system, t, v, oracles.random_covariance(6, seed) if known else None)
    Y = random_rows(N, seed=seed)
    agree(fast, dense, Y)
    root_diagonal = dense.root.diagonal().unsqueeze(-1)
    assert_close(fast.innovations(Y), root_diagonal * dense.root_solve(Y))


def posterior_of_state(system, t, v, y, P0):
    """Mean and covariance of the real state at the last time, in dense matrices."""
    P0 = system.stationary if P0 is None else P0
    S = oracles.covariance(system, t, t, P0, t[0])
    everything = oracles.System(  # the same system with the whole state as its output
        system.poles, system.B_modal, _state_rows(len(system.poles)), system.L_modal,
        np.zeros((2 * len(system.poles), 2)), system.noise, True,
    )  # fmt: skip
    J, n_y = 2 * len(system.poles), system.C.shape[0]
    states = oracles.covariance(everything, t, t[-1:], P0, t[0]).reshape(len(t), J, J)
    cross = np.concatenate([system.C @ block for block in states])  # Cov(y, z_end), (N, J)
    assert cross.shape == (len(t) * n_y, J)
    keep = np.isfinite(v)
    K = (S + np.diag(np.where(keep, v, 0.0)))[np.ix_(keep, keep)]
    gain = np.linalg.solve(K, cross[keep]).T
    return gain @ y[keep], states[-1] - gain @ cross[keep]


def _state_rows(P):
    """Output gains c with 2 Re sum c_j x_j = Re x_j, then Im x_j."""
    return np.concatenate([0.5 * np.eye(P), -0.5j * np.eye(P)])


@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("outputs", [None, 2])
def test_final_state(outputs, known, missing):
    system = random_system(5, pairs=2, outputs=outputs)
    t, N = oracles.irregular_times(10), 10 * (outputs or 1)
    v = np.random.default_rng(0).uniform(0.05, 0.5, N)
    y = np.random.default_rng(1).standard_normal(N)
    if missing:
        v[[2, 3, N - 1]] = np.inf
    P0 = oracles.random_covariance(4) if known else None
    fast, _ = build(system, t, v, P0)
    mean, covariance = posterior_of_state(system, t, v, y, P0)
    assert_close(fast.final_state(tensor(y)), mean[:2] + 1j * mean[2:])
    assert_close(fast.final_covariance, covariance)


@few
@given(seed=st.integers(0, 1000), outputs=st.sampled_from([None, 2]), known=st.booleans())
def test_missing_rows_are_dropped(seed, outputs, known):
    system = random_system(seed, outputs=outputs)
    N = 15 * (outputs or 1)
    rng = np.random.default_rng(seed)
    v = rng.uniform(0.05, 0.5, N)
    v[rng.choice(N, 5, replace=False)] = np.inf
    t = oracles.irregular_times(15, seed)
    fast, dense = build(system, t, v, oracles.random_covariance(6, seed) if known else None)
    Y = random_rows(N, seed=seed)
    for method in ("solve", "root_solve", "signal_matmul"):
        Z = torch.where(fast.missing.unsqueeze(-1), 0.0, Y) if method == "root_solve" else Y
        assert_close(getattr(fast, method)(Z), getattr(dense, method)(Z))
    assert_close(fast.log_prob(Y), dense.log_prob(Y))
    for method in ("log_determinant", "inverse_diagonal", "signal_variance"):
        assert_close(getattr(fast, method)(), getattr(dense, method)())
    # What stands in a missing row is of no consequence.
    changed = Y + 1e3 * fast.missing.unsqueeze(-1)
    assert torch.equal(fast.solve(changed), fast.solve(Y))
    assert torch.equal(fast.log_prob(changed), fast.log_prob(Y))


def test_nothing_observed():
    system = random_system(1)
    fast, _ = build(system, np.arange(5.0), np.full(5, np.inf))
    assert_close(fast.signal_variance(), np.diag(oracles.covariance(system, *[np.arange(5.0)] * 2)))
    assert fast.log_prob(random_rows(5)).tolist() == [0.0, 0.0]
    assert_close(fast.final_covariance, system.stationary)


@pytest.mark.parametrize("outputs", [None, 2])
def test_batches(outputs):
    systems = [random_system(k, pairs=2, outputs=outputs) for k in range(2)]
    t, N = oracles.irregular_times(8), 8 * (outputs or 1)
    modes = Modes(
        np.stack([s.poles for s in systems])[:, None],
        None,
        np.stack([s.modes.output_gain for s in systems])[:, None],
        np.stack([s.L_modal for s in systems])[:, None],
    )
    v = np.random.default_rng(0).uniform(0.1, 0.4, (3, N))
    v[1, 2] = np.inf  # a pattern of missing rows of its own
    P0 = tensor(np.stack([oracles.random_covariance(4, k) for k in range(3)]))
    together = SemiseparableCovariance(modes, t, tensor(v), P0)
    Y = random_rows(N).expand(2, 3, N, 2)
    assert together.log_determinant().shape == (2, 3)
    for i, system in enumerate(systems):
        for k in range(3):
            alone = SemiseparableCovariance(system.modes, t, tensor(v[k]), P0[k])
            for method in ("solve", "log_prob", "signal_matmul", "innovations"):
                ours = getattr(together, method)(Y)[i, k]
                assert_close(ours, getattr(alone, method)(Y[i, k]))
            for method in ("log_determinant", "inverse_diagonal", "signal_variance"):
                assert_close(getattr(together, method)()[i, k], getattr(alone, method)())
            y = Y[..., 0]
            assert_close(together.final_state(y)[i, k], alone.final_state(y[i, k]))
            assert_close(together.final_covariance[i, k], alone.final_covariance)


@few
@given(shift=st.sampled_from([-512.0, 0.25, 4096.0]), seed=st.integers(0, 100))
def test_invariant_to_a_time_shift(shift, seed):
    system = random_system(seed)
    t = np.cumsum(np.random.default_rng(seed).integers(1, 80, 12)) / 64.0  # exact when shifted
    Y = random_rows(12, seed=seed)
    one, other = (SemiseparableCovariance(system.modes, x, 0.1) for x in (t, t + shift))
    assert torch.equal(one.log_prob(Y), other.log_prob(Y))


@few
@given(seed=st.integers(0, 100), outputs=st.sampled_from([None, 2]))
def test_time_runs_backwards_as_well(seed, outputs):
    # A stationary process read backwards has the transposed covariance: same density for one
    # output, and for several with the samples of S(-tau) = S(tau)'; the factorisations differ.
    system = random_system(seed, outputs=outputs)
    t = oracles.irregular_times(10, seed)
    N = 10 * (outputs or 1)
    S = oracles.covariance(system, t, t)
    order = np.arange(N).reshape(10, -1)[::-1].reshape(-1)
    y = np.random.default_rng(seed).standard_normal(N)
    expected = oracles.log_density(y[order], (S + 0.1 * np.eye(N))[np.ix_(order, order)])
    ours = SemiseparableCovariance(system.modes, t, 0.1).log_prob(tensor(y).unsqueeze(-1))
    assert_close(ours[0], expected)


def test_large_gaps_forget_everything():
    # exp(lambda d) underflows to zero in the gap: two records without a common sample.
    system = random_system(2)
    t = np.cumsum(np.random.default_rng(0).integers(1, 80, 8)) / 64.0  # exact when shifted
    far = np.concatenate([t, t + 2.0**20])
    y = random_rows(16, 1)
    whole = SemiseparableCovariance(system.modes, far, 0.1)
    halves = [SemiseparableCovariance(system.modes, x, 0.1) for x in (t, t)]
    expected = halves[0].log_prob(y[:8]) + halves[1].log_prob(y[8:])
    assert_close(whole.log_prob(y), expected)
    assert_close(whole.solve(y)[8:], halves[1].solve(y[8:]))
    assert_close(whole.inverse_diagonal()[:8], halves[0].inverse_diagonal())


def test_repeated_times_with_noise():
    system = random_system(3)
    t = np.array([0.0, 0.4, 0.4, 0.4, 1.0])
    fast, dense = build(system, t, np.full(5, 0.1))
    agree(fast, dense, random_rows(5))


def test_root_squares_to_the_covariance():
    system = random_system(4, outputs=2)
    t = oracles.irregular_times(7)
    K = SemiseparableCovariance(system.modes, t, 0.3)
    eye = torch.eye(14, dtype=torch.float64)
    expected = oracles.covariance(system, t, t) + 0.3 * np.eye(14)
    assert_close(K.root_matmul(K.root_matmul(eye, transpose=True)), expected)
    assert_close(K.root_solve(K.root_solve(eye), transpose=True), np.linalg.inv(expected))


def test_variance_given_the_past():
    system = random_system(6)
    t = oracles.irregular_times(6)
    S = oracles.covariance(system, t, t)
    K = S + 0.2 * np.eye(6)
    expected = [
        S[k, k] - S[k, :k] @ np.linalg.solve(K[:k, :k], S[:k, k]) if k else S[0, 0]
        for k in range(6)
    ]
    ours = SemiseparableCovariance(system.modes, t, 0.2)
    assert_close(ours.signal_variance_given_past, np.array(expected))


def test_observability_and_jitter():
    system = random_system(7, outputs=2)
    t = oracles.irregular_times(4)
    rows = oracles.covariance(system, t, t[:1], np.eye(6), t[0])  # C exp(A t) C'
    assert_close(observability(system.modes, tensor(t)) @ tensor(system.C).mT, rows)
    assert state_covariance(system.modes).shape == (6, 6)
    variance = np.diag(system.C @ system.stationary @ system.C.T)
    assert_close(jitter_variance(system.modes, None, 1e-6), np.array([1e-6 * variance.max()]))
    P0 = oracles.random_covariance(6)
    start = np.diag(system.C @ P0 @ system.C.T)
    assert_close(
        jitter_variance(system.modes, tensor(P0), 1e-6),
        np.array([1e-6 * (variance.max() + start.max())]),
    )


class TestErrors:
    def test_noise_variance(self):
        modes = random_system(0).modes
        with pytest.raises(ValueError, match=r"noise_variance.*4.*\(3,\)"):
            SemiseparableCovariance(modes, np.arange(4.0), np.ones(3))
        with pytest.raises(ValueError, match=r"noise_variance.*>= 0.*-1"):
            SemiseparableCovariance(modes, np.arange(4.0), -1.0)
        with pytest.raises(ValueError, match="noise_variance"):
            SemiseparableCovariance(modes, np.arange(4.0), float("nan"))

    def test_initial_covariance_of_a_wrong_shape(self):
        with pytest.raises(ValueError, match="initial_covariance"):
            SemiseparableCovariance(random_system(0).modes, [0.0, 1.0], 0.1, torch.eye(4)).solve(
                torch.zeros(2, 1)
            )

    @pytest.mark.parametrize("method", ["matmul", "root_matmul"])
    def test_products_refuse_missing_rows(self, method):
        v = np.array([0.1, np.inf, 0.1])
        K = SemiseparableCovariance(random_system(0).modes, np.arange(3.0), v)
        with pytest.raises(ValueError, match=f"noise_variance.*{method}.*missing"):
            getattr(K, method)(torch.zeros(3, 1, dtype=torch.float64))

    def test_singular(self):
        K = SemiseparableCovariance(random_system(0).modes, [0.0, 1.0, 1.0], 0.0)
        with pytest.raises(NotPositiveDefiniteError, match=r"row 2.*repeated times"):
            K.log_determinant()

    def test_no_process_noise_and_no_measurement_noise(self):
        modes = random_system(0).modes.without_process_noise()
        with pytest.raises(NotPositiveDefiniteError, match="row 0"):
            SemiseparableCovariance(modes, [0.0, 1.0], 0.0).log_determinant()
