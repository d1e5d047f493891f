"""The time axis: what is refused, and which step leads to each row."""

import numpy as np
import pytest
import torch

from pyro_dynogp.lti.grid import time_grid


@pytest.mark.parametrize(
    ("time", "said"),
    [
        ([], r"time.*\(n,\)"),
        (1.0, r"time.*\(n,\)"),
        ([[0.0, 1.0]], r"time.*\(1, 2\)"),
        ([0.0, np.nan, 1.0], "time.*finite.*nan at index 1"),
        ([0.0, np.inf], "time.*finite.*inf at index 1"),
        (np.arange(3.0)[::-1], "time.*decrease.*1.0 after 2.0 at index 1"),
        ([0.0, 1.0, 0.5], "time.*decrease.*0.5 after 1.0 at index 2.*[Ss]ort"),
    ],
)
def test_errors(time, said):
    with pytest.raises(ValueError, match=said):
        time_grid(time)


def test_steps_are_those_between_the_samples():
    t = np.array([-1.0, -0.5, -0.5, 0.0, 2.0, 2.5])
    grid = time_grid(t)
    assert len(grid) == 6
    assert time_grid(grid) is grid
    assert grid.step_index[0] == -1
    taken = [0.0 if k < 0 else grid.steps[k].item() for k in grid.step_index[1:]]
    assert taken == list(np.diff(t))
    assert grid.steps.tolist() == [0.5, 2.0]  # distinct ones, none of them zero


def test_steps_that_differ_by_rounding_are_one():
    for t in (0.05 * np.arange(5000), np.linspace(0.0, 7.3, 4000), 1.7e9 + 0.01 * np.arange(500)):
        assert len(set(np.diff(t))) > 1
        grid = time_grid(t)
        assert len(grid.steps) == 1
        assert grid.step_index[1:].tolist() == [0] * (len(t) - 1)
        assert grid.steps[0].item() * (len(t) - 1) == pytest.approx(t[-1] - t[0], rel=1e-12)


def test_steps_further_apart_than_rounding_are_kept_apart():
    last = np.spacing(0.2)
    assert len(time_grid([0.0, 0.1, 0.2 + 2.0 * last]).steps) == 1
    t = np.array([0.0, 0.1, 0.2 + 4.0 * last])
    assert time_grid(t).steps.tolist() == sorted(set(np.diff(t)))
    chain = np.cumsum(np.concatenate([[0.0], 1.0 + 1e-14 * np.arange(200)]))  # no step is near all
    grid = time_grid(chain)
    assert 10 < len(grid.steps) < 100
    assert np.abs(grid.steps.numpy()[grid.step_index[1:]] - np.diff(chain)).max() < 1e-13
    repeated = time_grid([1.0, 1.0, np.nextafter(1.0, 2.0)])
    assert repeated.step_index.tolist() == [-1, -1, 0]


def test_one_sample():
    grid = time_grid(torch.tensor([3.0]))
    assert grid.time.dtype == torch.float64
    assert (len(grid), len(grid.steps), grid.step_index.tolist()) == (1, 0, [-1])


def test_rows_of_several_outputs_move_the_state_once():
    step, out = time_grid([0.0, 1.0, 1.0, 3.0]).rows(2)
    assert step.tolist() == [-1, -1, 0, -1, -1, -1, 1, -1]
    assert out.tolist() == [0, 1] * 4
