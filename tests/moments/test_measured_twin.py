"""The update of an output measured through a function, node by node in torch: the compiled twin."""

import math

import numpy as np
import pytest
import torch

from pyro_dynogp.layers.noise import student_components
from pyro_dynogp.moments.layout import Values, workspace, zero_bars
from pyro_dynogp.moments.measured_function import function_adjoint
from pyro_dynogp.moments.measured_function import function_terms as compiled
from pyro_dynogp.moments.nodes import COUNT, REACH, SPACING, SPREAD
from pyro_dynogp.moments.problem import TABLE, make_layout

GRID = 120


def cubic(table, k, u):
    a, b, c, d = (table[k + i] for i in range(-1, 3))
    one, square = 0.5 * (c - a), a - 2.5 * b + 2.0 * c - 0.5 * d
    return b + u * (one + u * (square + u * (1.5 * (b - c) + 0.5 * (d - a))))


def twin(y, R, centre, p, mean, variance, low, spacing, share, multiple):
    """l, alpha, beta of `function_terms`, written as its docstring has them."""
    xi = SPACING * (torch.arange(COUNT + 4.0, dtype=torch.float64) - REACH - 2)
    t = ((centre + p.sqrt() * xi - low) / spacing).clamp(1.0, GRID - 2.0)
    k = t.detach().floor().long().clamp(max=GRID - 3)
    f, v = cubic(mean, k, t - k), cubic(variance, k, t - k)[2:-2].clamp(min=0.0)
    bend = f[:-4] - 2.0 * f[2:-2] + f[4:]
    slope = (f[4:] - f[:-4]) / (4.0 * SPACING)
    inside = slope**2 * SPREAD**2 + v + bend**2 / 18.0
    S = inside[:, None] + R * multiple
    xi = xi[2:-2]
    prior = torch.log_softmax(-0.5 * xi**2 / (1.0 - SPREAD**2), 0)
    r = (y - f[2:-2] - bend / 6.0)[:, None]
    log_terms = prior[:, None] + share.log() - 0.5 * (r**2 / S + torch.log(2.0 * math.pi * S))
    l = torch.logsumexp(log_terms, (0, 1))
    weight = (log_terms - l).exp()
    along = SPREAD**2 * slope[:, None] / S
    first, spread = xi[:, None] + along * r, SPREAD**2 * (1.0 - along * slope[:, None])
    average = (weight * first).sum()
    second = (weight * (spread + first**2)).sum() - average**2
    return l, average / p.sqrt(), (1.0 - second) / p


def random_case(rng, heavy):
    share, multiple = student_components(4.0, 4) if heavy else (np.ones(1), np.ones(1))
    layout = make_layout(np.array([-1]), [1], [1], [TABLE], share, multiple, measured=True)
    grid = np.linspace(-2.0, 2.0, GRID)
    values = Values(
        **{name: np.zeros((1, 1)) for name in Values._fields}
        | {
            "table_mean": np.tanh(rng.uniform(0.5, 3.0) * grid + rng.normal())[None],
            # Below zero in places, where it counts as nothing.
            "table_variance": 0.05 * (np.sin(2.0 * grid) + 0.5)[None],
            "low": grid[:1],
            "spacing": np.diff(grid[:2]),
        }
    )
    numbers = rng.normal(), 10.0 ** rng.uniform(-4, 0), rng.normal(), 10.0 ** rng.uniform(-8, 0.5)
    return layout, values, numbers


@pytest.mark.parametrize("heavy", [False, True])
def test_values_and_gradients_are_those_of_the_twin(heavy):
    rng = np.random.default_rng(3)
    for _ in range(40):
        layout, values, numbers = random_case(rng, heavy)
        scale = np.array([1.0, numbers[3] ** 0.5, numbers[3]])  # units of l, 1/alpha, 1/beta
        bars_of = rng.standard_normal(2) * scale[1:]
        names = ("table_mean", "table_variance", "low", "spacing")
        parts = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in numbers]
        tables = [torch.tensor(getattr(values, name)[0], requires_grad=True) for name in names]
        noise = torch.tensor(layout.share), torch.tensor(layout.multiple)
        expected = torch.stack(twin(*parts, *tables, *noise))
        (expected * torch.tensor([1.0, *bars_of])).sum().backward()
        work = workspace(layout, values)
        found = compiled(0, *numbers, layout, values, work)
        np.testing.assert_allclose(
            found * scale, expected.detach().numpy() * scale, rtol=1e-10, atol=1e-10
        )
        bars = zero_bars(values)
        gradients = function_adjoint(0, *numbers, layout, values, bars, work, *bars_of)
        exact = np.array([float(x.grad) for x in parts])
        units = np.array([1.0, numbers[1], 1.0, numbers[3]])  # log R and log p
        np.testing.assert_allclose(gradients * units, exact * units, rtol=1e-8, atol=1e-8)
        for name, table in zip(names, tables, strict=True):
            own = np.abs(table.grad.numpy()).max()
            np.testing.assert_allclose(
                getattr(bars, name)[0], table.grad.numpy(), rtol=1e-8, atol=1e-8 * own, err_msg=name
            )
