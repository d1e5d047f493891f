"""Late held inputs against simulations on a grid fifty times finer."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.signals import delayed as of_record
from pyro_dynogp.lti.delay import CLOSE, GONE, NEAR, delayed, equivalent_inputs, moved_share
from pyro_dynogp.lti.response import mean_response

FINER = 50
RNG = np.random.default_rng(0)
EVEN = np.arange(40) * FINER
UNEVEN = np.concatenate([[0], np.cumsum(RNG.integers(FINER // 2, 2 * FINER, 39))])
U = RNG.normal(size=40) + 3.0
SYSTEM = dgp.Modes([-0.3 + 0.5j, -1.2 + 0.1j], [[0.3 - 0.2j], [0.4 + 0.5j]], [1.0, 1.0])
DELAYS = (0.0, 0.14, 1.0, 2.4, 2.5, 7.9, 100.0)


def fine(system: dgp.Modes, at: np.ndarray, delay: float) -> np.ndarray:
    """Response at instants `at`, counted in fine steps, to the input held and then delayed."""
    every = np.arange(at[-1] + 1)
    place = np.searchsorted(at, every - round(delay * FINER), side="right") - 1
    u = U[np.maximum(place, 0)]
    return mean_response(system, every / FINER, u[:, None]).output.numpy()[at]


def real(x: torch.Tensor) -> np.ndarray:
    return x.detach().numpy()


@pytest.mark.parametrize("at", [EVEN, UNEVEN], ids=["even", "uneven"])
@pytest.mark.parametrize("delay", DELAYS)
def test_the_mean_over_a_step_is_that_of_the_channel(at, delay):
    time = torch.tensor(at / FINER)
    found = delayed(torch.tensor(U), time, torch.tensor([delay, 3.3], dtype=torch.float64))
    np.testing.assert_allclose(real(found)[0], of_record(U, at / FINER, delay), atol=1e-12)


def test_gradients_by_the_delay():
    time, u = torch.tensor(UNEVEN / FINER), torch.tensor(U)
    poles = SYSTEM.poles.clone().requires_grad_()
    delays = torch.tensor([0.3, 2.2, 7.1], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d: delayed(u, time, d), delays)
    assert torch.autograd.gradcheck(lambda p, d: equivalent_inputs(p, u, time, d), (poles, delays))
    shares = torch.tensor([0.2, 0.7], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(moved_share, (poles, shares))


@pytest.mark.parametrize("at", [EVEN, UNEVEN], ids=["even", "uneven"])
@pytest.mark.parametrize("delay", DELAYS)
def test_equivalent_inputs_are_exact(at, delay):
    time = torch.tensor(at / FINER)
    late = torch.tensor(delay, dtype=torch.float64)
    each = equivalent_inputs(SYSTEM.poles, torch.tensor(U), time, late)
    x, states = torch.zeros(2, dtype=torch.complex128), []
    for k, step in enumerate(np.append(np.diff(at), 0.0) / FINER):
        states.append(x)
        phi = (SYSTEM.poles * step).exp()
        x = phi * x + (phi - 1.0) / SYSTEM.poles * SYSTEM.B[:, 0] * each[k]
    found = 2.0 * (torch.stack(states) @ SYSTEM.C[0]).real
    np.testing.assert_allclose(real(found), fine(SYSTEM, at, delay), atol=1e-10)


@pytest.mark.parametrize("delay", DELAYS)
def test_the_share_of_a_change_is_exact(delay):
    whole = int(delay)
    rows = np.arange(len(U))
    here, before = U[np.maximum(rows - whole, 0)], U[np.maximum(rows - whole - 1, 0)]
    share = moved_share(SYSTEM.poles, torch.tensor(delay - whole, dtype=torch.float64))
    gains = torch.cat([SYSTEM.B, SYSTEM.B * share[:, None]], -1)
    two = dgp.Modes(SYSTEM.poles, gains, SYSTEM.output_gain)
    found = mean_response(two, EVEN / FINER, np.column_stack([here, before - here])).output
    np.testing.assert_allclose(real(found), fine(SYSTEM, EVEN, delay), atol=1e-10)


def test_the_share_is_smooth_where_its_series_begins():
    f = torch.tensor([0.0, 0.3, 0.9, 1.0], dtype=torch.float64)
    for z in (NEAR, -NEAR * 1j):
        inside, outside = (
            moved_share(torch.full((4, 1), s * z, dtype=torch.complex128), f)
            for s in (0.9999, 1.0001)
        )
        np.testing.assert_allclose(real(inside), real(outside), atol=1e-7)
        exact = (1.0 - np.exp(-0.9999 * z * f.numpy())) / (1.0 - np.exp(-0.9999 * z))
        np.testing.assert_allclose(real(inside)[:, 0], exact, atol=1e-11)
    assert bool(
        moved_share(torch.tensor([10.0 * GONE], dtype=torch.complex128), f[1]).isfinite().all()
    )
    zero = torch.zeros(4, 1, dtype=torch.complex128)
    np.testing.assert_array_equal(real(moved_share(zero, f))[:, 0], f.numpy())  # an integrator's
    assert CLOSE > NEAR


def test_the_mean_over_a_step_is_right_to_second_order():
    """Half the pole, a quarter of the error; nothing at whole steps."""

    def error(rate: float, delay: float) -> float:
        system = dgp.Modes([rate * (-0.3 + 0.5j)], [[rate * (0.3 - 0.2j)]], [1.0])
        late = of_record(U, EVEN / FINER, delay)
        found = mean_response(system, EVEN / FINER, late[:, None]).output.numpy()
        return float(np.abs(found - fine(system, EVEN, delay)).max())

    assert error(1.0, 2.0) < 1e-12
    assert 0.2 < error(0.25, 2.5) / error(0.5, 2.5) < 0.3
