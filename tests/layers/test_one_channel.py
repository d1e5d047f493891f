"""Compiled moments of functions of one channel: those of the plain formulas, with derivatives."""

import pytest
import torch

from pyro_dynogp.layers import one_channel
from pyro_dynogp.layers.one_channel import FORMS, moments_along, plain

COUNT, LOCATIONS = 21, 6


def arguments(batch, explained=True):
    torch.manual_seed(4)
    x = torch.randn(*batch, COUNT, dtype=torch.float64)
    z = torch.linspace(-2.0, 2.0, LOCATIONS, dtype=torch.float64) + 0.05 * torch.randn(
        *batch, LOCATIONS, dtype=torch.float64
    )
    x[..., 3] = z[..., 2]  # at a location
    scale = 0.5 + torch.rand(batch, dtype=torch.float64)
    alpha = torch.randn(*batch, 2, LOCATIONS, dtype=torch.float64)
    L = torch.randn(*batch, LOCATIONS, LOCATIONS, dtype=torch.float64).tril()
    L = L + 3.0 * torch.eye(LOCATIONS, dtype=torch.float64)
    parts = [scale, x, z, alpha, *([L] if explained else [])]
    return [part.requires_grad_() for part in parts]


def expected(form, scale, x, z, alpha, L=None):
    L = torch.zeros(*scale.shape, 0, 0, dtype=torch.float64) if L is None else L
    mean, share = plain(form, x, z, scale.reciprocal(), alpha, L)
    return mean.mT, share


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("explained", [True, False])
def test_values_and_gradients(form, explained):
    args = arguments((3,), explained)
    found = moments_along(form, *args, *([] if explained else [None]))
    exact = expected(form, *args)
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(x.shape, dtype=torch.float64, generator=generator) for x in exact]
    if not explained:
        weights[1].zero_()
    slopes = []
    for pair in (found, exact):
        value = sum((x * w).sum() for x, w in zip(pair, weights, strict=True))
        slopes.append(torch.autograd.grad(value, args))
    for one, other in (*zip(found, exact, strict=True), *zip(*slopes, strict=True)):
        size = float(other.detach().abs().max())
        tail = torch.tril(one) if one.shape[-2:] == (LOCATIONS, LOCATIONS) else one
        torch.testing.assert_close(tail, other, rtol=1e-12, atol=1e-12 * max(size, 1.0))


def test_elements_do_not_meet():
    """Whatever else is in the batch, an element's moments are the same to the bit."""
    args = [part.detach() for part in arguments((3,))]
    together = moments_along("matern32", *args)
    for b in range(3):
        alone = moments_along("matern32", *(part[b] for part in args))
        for one, other in zip(alone, together, strict=True):
            assert torch.equal(one, other[b])


def test_what_broadcasts():
    scale, x, z, alpha, L = (part.detach() for part in arguments((3,)))
    found = moments_along("rbf", scale, x[0], z[0], alpha[0], L[0])
    for b in range(3):
        alone = moments_along("rbf", scale[b], x[0], z[0], alpha[0], L[0])
        assert torch.equal(found[0][b], alone[0])


@pytest.mark.parametrize("form", FORMS)
def test_derivatives_can_be_differentiated(form):
    args = arguments(())
    args[1].data[3] += 0.1
    assert torch.autograd.gradgradcheck(lambda *parts: moments_along(form, *parts), args)


def test_equal_elements_are_evaluated_once(monkeypatch):
    """As where differences are taken by what is no number of the function."""
    calls = []
    evaluate = one_channel.evaluate

    def counted(*given):
        calls.append(given)
        return evaluate(*given)

    args = [part.detach() for part in arguments((3,))]
    places = [0, 1, 0, 2, 1]
    alone = moments_along("rbf", *args)
    monkeypatch.setattr(one_channel, "evaluate", counted)
    found = moments_along("rbf", *(part[places] for part in args))
    assert len(calls) == 3
    for ours, each in zip(found, alone, strict=True):
        assert torch.equal(ours, each[places])
