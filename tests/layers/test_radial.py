"""Functions of the distance against GPyTorch's kernels, and their derivatives."""

import gpytorch.kernels as theirs
import pytest
import torch

from pyro_dynogp.layers.radial import _plain, function_of_distance

FORMS = {
    "rbf": theirs.RBFKernel,
    "matern12": lambda **options: theirs.MaternKernel(0.5, **options),
    "matern32": lambda **options: theirs.MaternKernel(1.5, **options),
    "matern52": lambda **options: theirs.MaternKernel(2.5, **options),
}


def normal(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, dtype=torch.float64, generator=generator)


@pytest.mark.parametrize("channels", [1, 2, 3])
@pytest.mark.parametrize("form", FORMS)
def test_values_are_gpytorchs(form, channels):
    x1, x2 = normal(6, channels), normal(4, channels, seed=1)
    lengthscale = normal(channels, seed=2).exp()
    kernel = FORMS[form](ard_num_dims=channels).double()
    kernel.lengthscale = lengthscale
    expected = kernel(x1, x2).to_dense()
    torch.testing.assert_close(
        function_of_distance(form, lengthscale, x1, x2), expected, atol=1e-12, rtol=0
    )
    assert torch.equal(function_of_distance(form, lengthscale, x1, None), torch.ones(6).double())


@pytest.mark.parametrize("shapes", [((5, 2), (4, 2), (2,)), ((3, 1, 5, 2), (2, 4, 2), (3, 1, 1))])
@pytest.mark.parametrize("form", FORMS)
def test_first_and_second_derivatives_are_those_of_finite_differences(form, shapes):
    x1, x2, raw = (normal(*shape, seed=k) for k, shape in enumerate(shapes))
    arguments = tuple(x.requires_grad_() for x in (raw.exp().detach(), x1, x2))

    def evaluate(lengthscale, x1, x2):
        return function_of_distance(form, lengthscale, x1, x2)

    assert torch.autograd.gradcheck(evaluate, arguments)
    assert torch.autograd.gradgradcheck(evaluate, arguments)


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize("form", FORMS)
def test_one_side_alone_has_the_derivative_of_the_plain_formula(form, place):
    points = [normal(5, 2), normal(3, 5, 2, seed=1)]
    points[place].requires_grad_()
    weight = normal(3, 5, 5, seed=2)
    one = torch.ones(1, dtype=torch.float64)
    total = (function_of_distance(form, one, *points) * weight).sum()
    plain = (_plain(form, *points) * weight).sum()
    (actual,), (expected,) = (torch.autograd.grad(v, points[place]) for v in (total, plain))
    torch.testing.assert_close(actual, expected, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("form", FORMS)
def test_points_are_left_as_they_are(form):
    x1, x2 = normal(5, 2), normal(4, 2, seed=1)
    before = x1.clone(), x2.clone()
    function_of_distance(form, torch.ones(2).double(), x1.requires_grad_(), x2).sum().backward()
    assert torch.equal(x1, before[0])
    assert torch.equal(x2, before[1])


@pytest.mark.parametrize("form", FORMS)
def test_coincident_points_have_no_slope(form):
    x = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)
    value = function_of_distance(form, torch.ones(2).double(), x, x)
    (slope,) = torch.autograd.grad(value.sum(), x)
    assert torch.equal(slope, torch.zeros_like(x))
