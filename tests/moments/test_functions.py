"""Static functions inside the filter: tables, radial expansions, quadrature nodes."""

from itertools import combinations_with_replacement

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from scipy.special import factorial2

from pyro_dynogp.moments import functions
from tests.moments import oracles


def look_up(table, low, spacing, points):
    """Value and derivative at each point as the filter takes them."""
    weight, slope = np.empty(4), np.empty(4)
    out = []
    for z in points:
        k = functions.locate(z, low, 1.0 / spacing, len(table), weight, slope)
        assert 0 <= k <= len(table) - 4
        first, u, _ = functions.place((z - low) / spacing, len(table))
        one_pass = functions.between(table, first, u)
        np.testing.assert_allclose(one_pass, weight @ table[k : k + 4], rtol=1e-12, atol=1e-13)
        out.append((weight @ table[k : k + 4], slope @ table[k : k + 4]))
    return np.array(out).T


def test_table_is_cubic_convolution():
    rng = np.random.default_rng(0)
    table = rng.standard_normal(12)
    points = np.concatenate([rng.uniform(-3, 9, 200), [-1.0, 0.0, 4.5, 9.5]])
    value, _ = look_up(table, -1.5, 0.7, points)
    np.testing.assert_allclose(
        value, oracles.interpolate(table, -1.5, 0.7, points), rtol=1e-12, atol=1e-13
    )


def test_table_goes_through_its_points_and_has_quadratics_exactly():
    grid = np.linspace(-2.0, 3.0, 26)
    inner = np.linspace(-1.79, 2.79, 301)
    for polynomial in ([1.0], [2.0, -1.0], [0.7, 0.3, -2.0]):
        table = np.polyval(polynomial, grid)
        value, slope = look_up(table, -2.0, 0.2, inner)
        np.testing.assert_allclose(value, np.polyval(polynomial, inner), atol=1e-13)
        np.testing.assert_allclose(slope, np.polyval(np.polyder(polynomial), inner), atol=1e-12)
    rough = np.random.default_rng(1).standard_normal(26)
    np.testing.assert_allclose(look_up(rough, -2.0, 0.2, grid[1:-1])[0], rough[1:-1], atol=1e-12)


def test_table_follows_a_smooth_function_as_a_spline_does():
    """Third order: error of about h^3 |f'''| / 20, here 4e-5; scipy's spline knows better."""
    grid = np.linspace(-4.0, 4.0, 81)
    inner = np.linspace(-3.8, 3.8, 500)
    value, slope = look_up(np.tanh(grid), -4.0, 0.1, inner)
    spline = CubicSpline(grid, np.tanh(grid))
    assert np.abs(value - spline(inner)).max() < 1e-4
    assert np.abs(slope - spline(inner, 1)).max() < 3e-3


@pytest.mark.parametrize("seed", range(3))
def test_slopes_are_derivatives_everywhere(seed):
    rng = np.random.default_rng(seed)
    table = rng.standard_normal(20)
    points = rng.uniform(-1.0, 2.5, 100)
    h = 1e-6
    plus, minus = (look_up(table, -0.8, 0.15, points + s * h)[0] for s in (1, -1))
    _, slope = look_up(table, -0.8, 0.15, points)
    np.testing.assert_allclose(slope, (plus - minus) / (2 * h), atol=1e-4)


def test_rising_table_has_positive_slope_and_ends_are_held():
    table = np.arange(10.0) ** 1.5
    value, slope = look_up(table, 0.0, 1.0, np.array([2.5, -50.0, 0.3, 8.5, 1e6, np.nan]))
    assert slope[0] > 0.0
    np.testing.assert_allclose(value[1:], [table[1], table[1], table[8], table[8], table[1]])
    assert not slope[1:].any()


@pytest.mark.parametrize("form", functions.KERNELS)
def test_radial_value_and_derivative(form):
    """The derivative is by the squared distance, so never positive: kernels fall."""
    for r2 in (1e-6, 0.3, 1.0, 9.0):
        value, slope = functions.radial(functions.KERNELS[form], r2)
        h = 1e-4 * r2
        difference = (oracles.kappa(form, r2 + h) - oracles.kappa(form, r2 - h)) / (2 * h)
        assert value == pytest.approx(oracles.kappa(form, r2), rel=1e-12)
        assert slope == pytest.approx(difference, rel=1e-6)
        assert slope < 0.0
    value, slope = functions.radial(functions.KERNELS[form], 0.0)
    assert value == pytest.approx(1.0, abs=1e-12)
    assert np.isfinite(slope)


def torch_expansion(form, z, Z, inverse, weight, constant, slope):
    r2 = (((z - Z) * inverse) ** 2).sum(-1)
    r = r2.sqrt()
    if form == "rbf":
        k = torch.exp(-r2 / 2)
    elif form == "matern12":
        k = torch.exp(-r)
    elif form == "matern32":
        k = (1 + 3**0.5 * r) * torch.exp(-(3**0.5) * r)
    else:
        k = (1 + 5**0.5 * r + 5 / 3 * r2) * torch.exp(-(5**0.5) * r)
    return constant + slope @ z + weight @ k


def part_of(numbers):
    return functions.Expansion(*(numbers[name] for name in functions.Expansion._fields))


@pytest.mark.parametrize("form", functions.KERNELS)
@pytest.mark.parametrize(("d", "e"), [(1, 1), (2, 3), (5, 2)])
def test_expansion_and_its_adjoint_against_autograd(form, d, e):
    rng = np.random.default_rng([d, e])
    names = ("z", "Z", "inverse", "weight", "constant", "slope")
    shapes = ((d,), (6, d), (d,), (e, 6), (e,), (e, d))
    at = {name: rng.standard_normal(shape) for name, shape in zip(names, shapes, strict=True)}
    leaf = {name: torch.tensor(value, requires_grad=True) for name, value in at.items()}
    expected = torch_expansion(form, *leaf.values())
    f = np.empty(e)
    code = functions.KERNELS[form]
    functions.expansion(code, at["z"], part_of(at), f)
    np.testing.assert_allclose(f, expected.detach().numpy(), rtol=1e-12)
    f_bar = rng.standard_normal(e)
    grads = torch.autograd.grad(expected, list(leaf.values()), torch.tensor(f_bar))
    # What was there before is added to, not replaced.
    bars = {name: np.ones_like(value) for name, value in at.items()}
    functions.expansion_adjoint(code, at["z"], part_of(at), f_bar, bars["z"], part_of(bars))
    for name, grad in zip(names, grads, strict=True):
        np.testing.assert_allclose(
            bars[name] - 1.0, grad.numpy(), rtol=1e-10, atol=1e-13, err_msg=name
        )


def normal_moment(powers):
    """E prod x_c^p_c of independent standard normals: (p - 1)!! each, zero for odd powers."""
    if any(p % 2 for p in powers):
        return 0.0
    return float(np.prod([factorial2(p - 1) if p else 1.0 for p in powers]))


@pytest.mark.parametrize(("channels", "degree"), [(1, 21), (2, 9), (3, 5), (4, 5), (5, 3), (8, 3)])
def test_quadrature_is_exact_up_to_its_degree(channels, degree):
    """Q nodes of Gauss-Hermite are exact for degree 2 Q - 1 in each channel."""
    nodes, weights = functions.gauss_hermite(channels)
    assert nodes.shape == (len(weights), channels)
    assert (weights > 0.0).all()
    for total in range(degree + 1):
        for chosen in combinations_with_replacement(range(channels), total):
            powers = np.bincount(np.array(chosen, dtype=int), minlength=channels)
            expected = normal_moment(powers)
            found = weights @ np.prod(nodes**powers, -1)
            assert found == pytest.approx(expected, rel=1e-10, abs=1e-10 * 2.0**total), powers
    beyond = weights @ nodes[:, 0] ** (degree + 1)
    assert abs(beyond / normal_moment([degree + 1]) - 1.0) > 1e-7  # ... and not beyond
