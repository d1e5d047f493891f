"""The hand-written reverse mode of the filter against finite differences, batches and segments."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pyro_dynogp.moments.filtering import SEGMENT
from pyro_dynogp.moments.layout import Values
from pyro_dynogp.moments.problem import EVENTS, log_density
from tests.moments import oracles
from tests.moments.problems import (
    LINE,
    WIDE,
    Block,
    direction,
    element,
    leaves,
    moved,
    random_problem,
)

TABLES = ("table_mean", "table_variance", "low", "spacing")
RADIAL = ("weight", "Z", "inverse", "constant", "slope")
CASES = {
    "no static layer": {"blocks": (), "n_y": 2},
    "one table": {"blocks": (LINE,)},
    "table of two outputs": {"blocks": (WIDE,), "n_y": 2},
    "tables in series, heavy tails": {"blocks": (LINE, LINE, WIDE), "n_y": 2, "student": True},
    "radial": {"blocks": (Block("rbf", 2, 2),), "n_y": 2},
    "radial of one channel": {"blocks": (Block("matern52", 1, 1), LINE)},
    "radial, then table": {"blocks": (Block("matern32", 2, 3), LINE), "n_y": 3},
    "radial in series, heavy tails": {
        "blocks": (Block("rbf", 3, 2), Block("matern52", 2, 1)),
        "student": True,
    },
    "cubature of five channels": {"blocks": (Block("matern32", 5, 2), LINE), "pairs": 3},
    "exponential kernel": {"blocks": (Block("matern12", 2, 2),)},
    "regular, complete": {"blocks": (LINE, LINE), "repeated": False, "missing": False},
    "three steps": {"blocks": (LINE,), "distinct": 3, "pairs": 1},
    "one sample": {"blocks": (LINE, Block("rbf", 2, 1)), "n": 1, "n_y": 2},
    "just a segment": {"blocks": (LINE,), "n": SEGMENT},
    "a sample beyond a segment": {"blocks": (LINE,), "n": SEGMENT + 1, "n_y": 2},
    "measured": {"blocks": (LINE,), "measured": True},
    "radial, then measured": {"blocks": (Block("rbf", 2, 2), LINE), "measured": True},
    "measured, heavy tails": {"blocks": (LINE,), "measured": True, "student": True, "n": 70},
    "three segments": {"blocks": (LINE, Block("rbf", 2, 2)), "n": 2 * SEGMENT + 7, "student": True},
}


def used(problem):
    """Names of the numbers that enter: others have a gradient of zero."""
    layout = problem.layout
    forms = set(layout.form.tolist())
    names = set(Values._fields)
    if 0 not in forms:
        names -= set(TABLES)
    if not forms - {0}:
        names -= set(RADIAL)
    if not len(layout.form):
        names -= {"G", "offset", "gamma"}
    if layout.measured >= 0:
        names -= {"H"}
        if len(layout.form) == 1:
            names -= {"gamma"}
    if len(layout.step) == 1:
        names -= {"re", "im", "Q", "gamma"}
    return names


def along(problem, name, move, h):
    """Derivative along a direction by central differences of fourth order."""

    def value(s):
        return float(log_density(moved(problem, name, s * h * move)))

    return (8.0 * (value(1) - value(-1)) - (value(2) - value(-2))) / (12.0 * h)


@pytest.mark.parametrize("case", CASES)
def test_every_gradient_is_that_of_finite_differences(case):
    problem = random_problem(**CASES[case], seed=len(case))
    at, leaf = leaves(problem)
    log_density(at).backward()
    rng = np.random.default_rng(0)
    names = used(problem)
    for name, x in leaf.items():
        assert x.grad is not None
        if name not in names:
            assert not x.grad.any(), name
            continue
        assert x.grad.any(), name
        for _ in range(2):
            move = direction(problem, name, rng)
            expected = along(problem, name, move, 2e-6 if name in TABLES[2:] else 1e-5)
            found = float((x.grad * move).sum())
            scale = float((x.grad * move).square().sum().sqrt()) + abs(found)
            assert abs(found - expected) < 1e-5 * scale + 1e-7, (name, found, expected)


@pytest.mark.parametrize("case", [name for name in CASES if not CASES[name].get("measured")])
def test_value_is_that_of_a_plain_filter(case):
    problem = random_problem(**CASES[case], seed=len(case))
    expected = oracles.run(problem.layout, element(problem)).log_density
    assert float(log_density(problem)) == pytest.approx(expected, rel=1e-9)


def batched(problem, rng):
    """Batch shape (2, 3), from tensors that have both dimensions, one of them or none."""

    def around(name, *shape):
        x = getattr(problem, name)
        return x + 0.05 * torch.tensor(rng.standard_normal((*shape, *x.shape)))

    P0 = problem.P0 * torch.tensor([1.0, 1.5, 0.7], dtype=torch.float64)[:, None, None]
    return replace(
        problem,
        re=around("re", 2, 1),
        weight=around("weight", 3),
        table_mean=around("table_mean", 2, 1),
        low=around("low", 2, 3),
        H=around("H", 1, 3),
        y=around("y", 3),
        P0=P0,
    )


def pick(problem, index):
    """One element of the batch, as a problem without batch dimensions."""
    picked = {}
    for name in Values._fields:
        x = getattr(problem, name)
        event = x.shape[x.dim() - EVENTS[name] :]
        picked[name] = x.expand((2, 3, *event))[index].detach()
    return replace(problem, **picked)


def test_batch_equals_loop_and_gradients_sum_over_what_is_shared():
    blocks = (LINE, Block("rbf", 2, 2))
    problem = batched(random_problem(blocks, n=SEGMENT + 9, n_y=2), np.random.default_rng(1))
    at, leaf = leaves(problem)
    found = log_density(at)
    assert found.shape == (2, 3)
    weights = torch.arange(1.0, 7.0, dtype=torch.float64).reshape(2, 3)
    (weights * found).sum().backward()
    total = {name: torch.zeros_like(x) for name, x in leaf.items()}
    for i in range(2):
        for j in range(3):
            one, own = leaves(pick(problem, (i, j)))
            value = log_density(one)
            torch.testing.assert_close(value, found[i, j], rtol=1e-13, atol=0.0)
            value.backward()
            for name, x in own.items():
                lead = leaf[name].dim() - x.dim()
                shape = (1, 1, *leaf[name].shape) if lead == 0 else leaf[name].shape
                shape = (1, *shape) if lead == 1 else shape
                place = (i if shape[0] > 1 else 0, j if shape[1] > 1 else 0)
                total[name].view(shape)[place] += weights[i, j] * x.grad
    for name, x in leaf.items():
        torch.testing.assert_close(x.grad, total[name], rtol=1e-11, atol=1e-10, msg=name)


def test_missing_samples_have_no_gradient_and_their_numbers_do_not_matter():
    problem = random_problem((LINE,), n_y=2)
    gone = torch.isnan(problem.y)
    assert gone.sum() == 3
    at, leaf = leaves(problem)
    value = log_density(at)
    value.backward()
    for name in ("y", "R", "y_offset"):
        assert torch.equal(leaf[name].grad == 0.0, gone), name
    other = replace(problem, R=torch.where(gone, 99.0, problem.R))
    assert float(log_density(other)) == float(value.detach())


def test_only_what_asks_gets_a_gradient():
    problem = random_problem((LINE,))
    H = problem.H.clone().requires_grad_()
    log_density(replace(problem, H=H)).backward()
    assert H.grad is not None
    assert all(x.grad is None for x in problem.tensors())
