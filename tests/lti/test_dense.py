"""The dense twin against numpy: it is the oracle of the O(n) algebra, so it has one of its own."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from tests.lti import oracles
from tests.lti.dense import DenseCovariance, signal_covariance
from tests.lti.oracles import NOISES, assert_close, random_system, tensor

CASES = [(None, None), (None, "known"), (2, None), (2, "known")]


def case(outputs, initial, noise, n=9):
    system = random_system(3, pairs=2, outputs=outputs, noise=noise)
    t = oracles.irregular_times(n)
    v = np.random.default_rng(1).uniform(0.1, 0.5, n * (outputs or 1))
    P0 = oracles.random_covariance(4) if initial else None
    S = oracles.covariance(system, t, t, P0, t[0])
    twin = DenseCovariance(system.modes, t, tensor(v), None if P0 is None else tensor(P0))
    return system, t, v, P0, S, twin


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize(("outputs", "initial"), CASES)
class TestAgainstNumpy:
    def test_matrix_and_its_uses(self, outputs, initial, noise):
        _, _, v, _, S, twin = case(outputs, initial, noise)
        K = S + np.diag(v)
        Y = np.random.default_rng(2).standard_normal((len(v), 3))
        root = np.linalg.cholesky(K)
        assert_close(twin.signal, S)
        assert_close(twin.matrix, K)
        assert_close(twin.root, root)
        assert_close(twin.log_determinant(), np.linalg.slogdet(K)[1])
        assert_close(twin.solve(tensor(Y)), np.linalg.solve(K, Y))
        assert_close(twin.matmul(tensor(Y)), K @ Y)
        assert_close(twin.signal_matmul(tensor(Y)), S @ Y)
        assert_close(twin.root_matmul(tensor(Y)), root @ Y)
        assert_close(twin.root_matmul(tensor(Y), transpose=True), root.T @ Y)
        assert_close(twin.root_solve(tensor(Y)), np.linalg.solve(root, Y))
        assert_close(twin.root_solve(tensor(Y), transpose=True), np.linalg.solve(root.T, Y))
        assert_close(twin.inverse_diagonal(), np.diag(np.linalg.inv(K)))
        assert_close(twin.signal_variance(), np.diag(S - S @ np.linalg.solve(K, S)))
        assert_close(twin.innovation_variance, np.diag(root) ** 2)
        expected = multivariate_normal(np.zeros(len(v)), K).logpdf(Y.T)
        assert_close(twin.log_prob(tensor(Y)), expected)

    def test_cross_covariance(self, outputs, initial, noise):
        system, t, _, P0, _, _ = case(outputs, initial, noise)
        other = np.array([t[0], t[0] + 0.01, t[4], t[-1] + 2.0])
        expected = oracles.covariance(system, other, t, P0, t[0])
        cov = signal_covariance(system.modes, other, t, None if P0 is None else tensor(P0))
        assert_close(cov, expected)

    def test_missing_rows_are_dropped(self, outputs, initial, noise):
        system, t, v, P0, S, _ = case(outputs, initial, noise)
        keep = np.ones(len(v), dtype=bool)
        keep[[0, 3, 4]] = False
        twin = DenseCovariance(
            system.modes,
            t,
            tensor(np.where(keep, v, np.inf)),
            None if P0 is None else tensor(P0),
        )
        K = (S + np.diag(v))[np.ix_(keep, keep)]
        y = np.random.default_rng(4).standard_normal((len(v), 1))
        alpha = np.zeros_like(y)
        alpha[keep] = np.linalg.solve(K, y[keep])
        inverse = np.zeros(len(v))
        inverse[keep] = np.diag(np.linalg.inv(K))
        cross = S[:, keep]
        assert_close(twin.solve(tensor(y)), alpha)
        assert_close(twin.inverse_diagonal(), inverse)
        assert_close(twin.log_determinant(), np.linalg.slogdet(K)[1])
        assert_close(twin.log_prob(tensor(y))[0], oracles.log_density(y[keep, 0], K))
        assert_close(twin.signal_variance(), np.diag(S - cross @ np.linalg.solve(K, cross.T)))
        assert torch.isinf(twin.innovation_variance).numpy().tolist() == (~keep).tolist()
