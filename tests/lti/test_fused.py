"""The fused small algebra against the same formulas in plain torch."""

import pytest
import torch

from pyro_dynogp.lti import fused
from pyro_dynogp.lti.covariance import (
    complex_expm1,
    output_row,
    state_output_covariance,
    stationary_variance,
)
from pyro_dynogp.lti.modes import Modes


def parts(outputs, noise, batch=()):
    def normal(*shape):
        return torch.randn(*batch, *shape, dtype=torch.complex128)

    torch.manual_seed(0)
    poles = -torch.complex(
        torch.rand(*batch, 3, dtype=torch.float64) + 0.2,
        3 * torch.randn(*batch, 3, dtype=torch.float64),
    )
    c = normal(3) if outputs == 1 else normal(outputs, 3)
    leaves = [x.requires_grad_() for x in (poles, c, normal(3, 2))]
    return leaves, Modes(leaves[0], None, leaves[1], leaves[2], noise=noise)


@pytest.mark.parametrize("noise", ["shared", "independent"])
@pytest.mark.parametrize(("outputs", "batch"), [(1, ()), (2, ()), (2, (4,))])
def test_rows_and_their_gradients(noise, outputs, batch):
    leaves, modes = parts(outputs, noise, batch)
    ours = fused.output_rows(modes)
    q = state_output_covariance(modes)
    plain = output_row(modes), torch.cat([q.real, q.imag], -1), stationary_variance(modes)
    weights = [torch.randn_like(x) for x in plain]
    gradients = []
    for version in (ours, plain):
        for a, b in zip(version, plain, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-13)
        total = sum((w * x).sum() for w, x in zip(weights, version, strict=True))
        gradients.append(torch.autograd.grad(total, leaves))
    for a, b in zip(*gradients, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-12)


def test_propagators_and_their_gradients():
    leaves, modes = parts(1, "shared", (2,))
    steps = torch.tensor([1e-9, 0.1, 3.0], dtype=torch.float64)
    z = modes.poles.unsqueeze(-2) * steps.unsqueeze(-1)
    plain = torch.exp(z), complex_expm1(z) / modes.poles.unsqueeze(-2)
    ours = fused.propagators(modes, steps)
    weights = [torch.randn_like(x) for x in plain]
    gradients = []
    for version in (ours, plain):
        for a, b in zip(version, plain, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-13, atol=0)
        total = sum((w * x).real.sum() for w, x in zip(weights, version, strict=True))
        gradients.append(torch.autograd.grad(total, leaves[0])[0])
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-12)
