"""Compiled innovations and their gradients: dense algebra, bits of each point, gains that rest."""

import warnings

import numpy as np
import pytest
import torch

from pyro_dynogp.lti import innovation_layout, innovation_passes
from pyro_dynogp.lti.covariance import state_covariance
from pyro_dynogp.lti.grid import time_grid
from pyro_dynogp.lti.innovation_layout import SEGMENT
from pyro_dynogp.lti.innovations import innovations
from pyro_dynogp.lti.lanes import WIDTH
from pyro_dynogp.lti.modes import Modes
from tests.lti import oracles
from tests.lti.dense import DenseCovariance
from tests.lti.oracles import assert_close, random_system, tensor

EQUAL = 0.0625 * np.arange(400)


class Case:
    """Points with all that enters, as leaves: poles, c, L, noise, residual, root of P0."""

    def __init__(self, t, points=1, *, pairs=2, outputs=None, varying=False, known=True, seed=0):
        systems = [random_system(seed + k, pairs=pairs, outputs=outputs) for k in range(points)]
        rng = np.random.default_rng([seed, 19])
        self.grid, n_y = time_grid(t), outputs or 1
        rows = len(t) if varying else 1
        arrays = [
            np.stack([s.poles for s in systems]),
            np.stack([s.c if outputs else s.c[0] for s in systems]),
            np.stack([s.L_modal for s in systems]),
            rng.uniform(0.1, 0.4, (points, rows, n_y)),
            rng.standard_normal((points, len(t) * n_y)),
            rng.standard_normal((points, 2 * pairs, 2 * pairs)) / 3,
        ]
        self.leaves = [tensor(x).requires_grad_() for x in arrays[: 6 if known else 5]]
        self.known = known
        self.missing = None

    def miss(self, share, seed=0):
        shape = self.leaves[4].shape
        self.missing = tensor(np.random.default_rng([seed, 23]).uniform(size=shape) < share)
        return self

    def ours(self, points=slice(None)):
        poles, c, L, v, r, *R = (x[points] for x in self.leaves)
        modes = Modes(poles, output_gain=c, noise_gain=L)
        explained = state_covariance(modes) - R[0] @ R[0].mT if R else None
        missing = None if self.missing is None else self.missing[points]
        return innovations(modes, self.grid, v, r, missing=missing, explained=explained)

    def dense(self):
        """The same, point by point."""
        found = []
        for k in range(len(self.leaves[0])):
            poles, c, L, v, r, *R = (x[k] for x in self.leaves)
            v = v.expand(len(self.grid), v.shape[-1]).flatten()
            if self.missing is not None:
                v = v.masked_fill(self.missing[k], torch.inf)
                r = r.masked_fill(self.missing[k], 0.0)
            P0 = R[0] @ R[0].mT if R else None
            K = DenseCovariance(Modes(poles, output_gain=c, noise_gain=L), self.grid, v, P0)
            d = K.innovation_variance
            found.append((K.root_solve(r.unsqueeze(-1)).squeeze(-1), d))
        u, d = (torch.stack(x) for x in zip(*found, strict=True))
        there = torch.isfinite(d)
        return torch.where(there, u * torch.where(there, d, 1.0).sqrt(), 0.0), d

    def gradients(self, z, d, seed=0):
        """Gradients of a functional of innovations and variances, missing rows left out."""
        there = torch.isfinite(d)
        generator = torch.Generator().manual_seed(seed)
        a, b = (torch.randn(z.shape, dtype=z.dtype, generator=generator) for _ in range(2))
        terms = a * torch.where(there, z, 0.0) + b * torch.where(there, d, 1.0).log()
        return torch.autograd.grad(terms.sum(), self.leaves, retain_graph=True)


def settled_segments(monkeypatch):
    """Filled with whether each segment of each point was settled, as innovations are computed."""
    kept = []
    plain = innovation_layout.keep
    monkeypatch.setattr(innovation_layout, "keep", lambda *a: kept.append(plain(*a)) or kept[-1])
    return kept


@pytest.mark.parametrize("missing", [0.0, 0.15])
@pytest.mark.parametrize(
    "options",
    [
        {"pairs": 1, "known": False},
        {"pairs": 3, "points": WIDTH + 1},
        {"outputs": 2, "points": 2, "varying": True},
        {"outputs": 3, "known": False},
    ],
)
def test_dense_algebra(options, missing):
    case = Case(oracles.irregular_times(2 * SEGMENT + 7), **options).miss(missing)
    z, d = case.ours()
    z0, d0 = case.dense()
    there = torch.isfinite(d0)
    assert (torch.isfinite(d) == there).all()
    assert_close(torch.where(there, z, 0.0), z0)
    assert_close(d[there], d0[there])
    ours, theirs = case.gradients(z, d), case.gradients(z0, d0)
    for x, y in zip(ours, theirs, strict=True):
        assert_close(x, y, rtol=1e-9)


@pytest.mark.parametrize("change", ["one step", "all later steps"])
@pytest.mark.parametrize("outputs", [None, 2])
def test_gains_rest_and_results_are_those_of_no_rest(outputs, change, monkeypatch):
    """Gaps fall in some points alone, the step changes for all: each falls back by itself."""
    steps = np.full(3200, 0.0625)
    changes = 47 * SEGMENT  # between two segments of equal steps
    steps[changes : changes + 1 if change == "one step" else None] = 0.125
    t = np.cumsum(steps)
    case = Case(t, 3, outputs=outputs)
    n_y = outputs or 1
    case.missing = torch.zeros(3, len(t) * n_y, dtype=torch.bool)
    case.missing[0, 1000 * n_y] = True
    kept = settled_segments(monkeypatch)
    z, d = case.ours()
    gradients = case.gradients(z, d)
    settled = kept[-1].settled
    assert settled[1:, 1000 // SEGMENT].all()
    assert not settled[0, 1000 // SEGMENT]
    assert not settled[:, changes // SEGMENT].any()
    assert settled[:, -1].all()
    monkeypatch.setattr(innovation_passes, "SETTLED", -1.0)
    v = case.leaves[3]
    case.leaves[3] = v.detach().expand(3, len(t), n_y).contiguous().requires_grad_()
    z0, d0 = case.ours()
    assert not kept[-1].settled.any()
    there = torch.isfinite(d0)
    assert_close(z, z0, rtol=1e-12)
    assert_close(d[there], d0[there], rtol=1e-12)
    unsettled = list(case.gradients(z0, d0))
    unsettled[3] = unsettled[3].sum(1, keepdim=True)
    for x, y in zip(gradients, unsettled, strict=True):
        assert_close(x, y, rtol=1e-9)


def test_noise_that_varies_never_rests(monkeypatch):
    kept = settled_segments(monkeypatch)
    case = Case(EQUAL, varying=True)
    case.gradients(*case.ours())
    assert not kept[-1].settled.any()


def test_points_do_not_change_each_other():
    """Value and gradient of a point are the same bits alone and among others."""
    # No initial covariance: torch multiplies small matrices differently in large batches.
    case = Case(EQUAL, WIDTH + 2, known=False)
    case.missing = torch.zeros(WIDTH + 2, len(EQUAL), dtype=torch.bool)
    case.missing[1, 300:310] = True  # its gain rests before, those of others do not
    whole = case.ours()
    gradients = case.gradients(*whole)
    for k in (0, 1, WIDTH + 1):
        alone = case.ours(slice(k, k + 1))
        for x, y in zip(whole, alone, strict=True):
            assert torch.equal(x[k], y[0])
        generator = torch.Generator().manual_seed(0)
        a, b = (torch.randn(whole[0].shape, dtype=torch.float64, generator=generator) for _ in "zd")
        z, d = alone
        there = torch.isfinite(d)
        terms = a[k] * torch.where(there, z, 0.0) + b[k] * torch.where(there, d, 1.0).log()
        for x, y in zip(gradients, torch.autograd.grad(terms.sum(), case.leaves), strict=True):
            assert torch.equal(x[k], y[k])


def test_shared_residuals_and_batches_add_up():
    case = Case(EQUAL[:50], 4)
    poles, c, L, v, r, _ = case.leaves
    modes = Modes(poles.reshape(2, 2, 2), None, c.reshape(2, 2, 2), L.reshape(2, 2, 2, 2))
    shared = r[0].detach().requires_grad_()
    z, d = innovations(modes, case.grid, v.reshape(2, 2, 1, 1), shared)
    assert z.shape == d.shape == (2, 2, 50)
    z1, _ = innovations(Modes(poles, None, c, L), case.grid, v, shared.expand(4, 50))
    assert torch.equal(z.reshape(4, 50), z1)
    (together,) = torch.autograd.grad(z.square().sum(), shared)
    (apart,) = torch.autograd.grad(z1.square().sum(), shared)
    assert_close(together, apart, rtol=1e-13)


def test_covariances_out_of_range_are_nan_without_a_warning():
    one = torch.ones(1, dtype=torch.complex128)
    modes = Modes(tensor([-0.5 + 2.0j]), None, one, one.unsqueeze(-1))
    q = torch.full((1, 1), torch.inf, dtype=torch.complex128)
    noise, residual = torch.ones(1, 1).double(), torch.ones(len(EQUAL)).double()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, d = innovations(modes, time_grid(EQUAL), noise, residual, output_covariances=q)
    assert torch.isnan(d).all()
