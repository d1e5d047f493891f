"""Reverse mode of the O(n) algebra: numerical derivatives, and beyond a segment the dense twin."""

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from pyro_dynogp.lti.arithmetic import SEGMENT
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.semiseparable import SemiseparableCovariance
from tests.lti import oracles
from tests.lti.dense import DenseCovariance
from tests.lti.oracles import NOISES, assert_close, random_system, tensor

# Name, and the value of it that the derivative is taken of.
RESULTS = {
    "log_prob": lambda K, Y: K.log_prob(Y),
    "solve": lambda K, Y: K.solve(Y),
    "root_solve": lambda K, Y: K.root_solve(Y),
    "root_solve transposed": lambda K, Y: K.root_solve(Y, transpose=True),
    "root_matmul": lambda K, Y: K.root_matmul(Y),
    "root_matmul transposed": lambda K, Y: K.root_matmul(Y, transpose=True),
    "matmul": lambda K, Y: K.matmul(Y),
    "signal_matmul": lambda K, Y: K.signal_matmul(Y),
    "inverse_diagonal": lambda K, Y: K.inverse_diagonal(),
    "signal_variance": lambda K, Y: K.signal_variance(),
    "innovation_variance": lambda K, Y: K.innovation_variance,
    "log_determinant": lambda K, Y: K.log_determinant(),
}
OF_STATE = {
    "final_state": lambda K, Y: K.final_state(Y[..., 0]),
    "final_covariance": lambda K, Y: K.final_covariance,
}


def leaves(system, n, seed=0):
    """Poles, output gains, noise gains, noise variance, root of the initial covariance, data."""
    N = n * system.C.shape[0]
    rng = np.random.default_rng([seed, 17])
    arrays = (
        system.poles,
        system.c if system.several else system.c[0],
        system.L_modal,
        rng.uniform(0.1, 0.4, N),
        rng.standard_normal((len(system.A), len(system.A))) / 2,
        rng.standard_normal((N, 2)),
    )
    return [tensor(x).requires_grad_() for x in arrays]


def build(kind, noise, t, leaf, *, known=True, missing=()):
    poles, c, L, v, R, _ = leaf
    if len(missing):
        v = v.index_fill(0, torch.as_tensor(missing), torch.inf)
    modes = Modes(poles, output_gain=c, noise_gain=L, noise=noise)
    return kind(modes, t, v, R @ R.mT if known else None)


@pytest.mark.parametrize("name", RESULTS | OF_STATE)
def test_numerical_derivatives(name):
    system = random_system(0, pairs=2, outputs=2, brownian=1)
    t = np.array([0.0, 0.3, 0.8, 0.8, 1.1])  # steps of different length, a repeated time

    def f(*leaf):
        K = build(SemiseparableCovariance, "shared", t, leaf)
        return (RESULTS | OF_STATE)[name](K, leaf[-1])

    assert gradcheck(f, leaves(system, 5), check_undefined_grad=False, fast_mode=False)


@pytest.mark.parametrize("name", RESULTS)
@pytest.mark.parametrize(("outputs", "noise", "known"), [(None, "shared", True),
                                                         (2, "independent", False)])  # fmt: skip
def test_beyond_a_segment_against_the_dense_twin(name, outputs, noise, known):
    n = 150
    assert n * (outputs or 1) > 2 * SEGMENT  # adjoints restart from checkpoints
    system = random_system(1, outputs=outputs, noise=noise)
    t = oracles.irregular_times(n, 1, scale=0.1)
    leaf = leaves(system, n)
    used = leaf if known else [*leaf[:4], leaf[5]]
    weights = None
    grads = []
    for kind in (SemiseparableCovariance, DenseCovariance):
        value = RESULTS[name](build(kind, noise, t, leaf, known=known), leaf[-1])
        if weights is None:  # one functional, the same for both
            generator = torch.Generator().manual_seed(0)
            weights = torch.randn(value.shape, dtype=torch.float64, generator=generator)
        grads.append(torch.autograd.grad((weights * value).sum(), used, allow_unused=True))
    for ours, theirs in zip(*grads, strict=True):
        assert (ours is None) == (theirs is None) or not (ours if theirs is None else theirs).any()
        if theirs is not None and ours is not None:
            assert_close(ours, theirs, rtol=1e-9)


@pytest.mark.parametrize("name", ["log_prob", "solve", "inverse_diagonal", "signal_variance"])
def test_missing_rows(name):
    system = random_system(2, pairs=2)
    t, missing = oracles.irregular_times(12), [0, 5, 6, 11]
    leaf = leaves(system, 12)
    grads = []
    for kind in (SemiseparableCovariance, DenseCovariance):
        value = RESULTS[name](build(kind, "shared", t, leaf, missing=missing), leaf[-1])
        weights = torch.arange(1.0, value.numel() + 1, dtype=torch.float64).reshape(value.shape)
        grads.append(torch.autograd.grad((weights * value).sum(), leaf, allow_unused=True))
    for ours, theirs in zip(*grads, strict=True):
        if theirs is not None:
            assert_close(ours, theirs, rtol=1e-9)


def test_large_gap():
    # The propagator of the gap is zero to the last bit: it has a derivative of zero, not of NaN.
    system = random_system(3, pairs=2)
    t = np.array([0.0, 0.3, 0.5, 1e5, 1e5 + 0.25, 1e5 + 0.5])
    leaf = leaves(system, 6)
    grads = []
    for kind in (SemiseparableCovariance, DenseCovariance):
        value = build(kind, "shared", t, leaf).log_prob(leaf[-1]).sum()
        grads.append(torch.autograd.grad(value, leaf))
    for ours, theirs in zip(*grads, strict=True):
        assert_close(ours, theirs, rtol=1e-9)


@pytest.mark.parametrize("noise", NOISES)
def test_batch_sums_over_shared_arguments(noise):
    system = random_system(4, pairs=2, noise=noise)
    t = oracles.irregular_times(70)
    leaf = leaves(system, 70)
    Y = torch.randn(3, 70, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    K = build(SemiseparableCovariance, noise, t, leaf)
    shared = torch.autograd.grad(K.log_prob(Y).sum(), leaf[:5], retain_graph=True)
    apart = [torch.autograd.grad(K.log_prob(y).sum(), leaf[:5], retain_graph=True) for y in Y]
    for together, pieces in zip(shared, zip(*apart, strict=True), strict=True):
        assert_close(together, sum(pieces))


def test_every_parameter_reaches_the_density():
    system = random_system(5, pairs=2)
    leaf = leaves(system, 8)
    value = build(SemiseparableCovariance, "shared", oracles.irregular_times(8), leaf)
    for grad in torch.autograd.grad(value.log_prob(leaf[-1]).sum(), leaf):
        assert (grad.abs() > 1e-6).all()
