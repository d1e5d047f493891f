"""Processes and seeds."""

import random

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from pyro_dynogp.support.parallel import child_seeds, one_thread, parallel_map, seeded


def square(x):
    if x < 0:
        raise ValueError(f"cannot take {x}")
    return x * x


@pytest.mark.parametrize("workers", [1, 2])
def test_results_keep_the_order_of_the_items(workers):
    assert parallel_map(square, [3, 1, 2], workers=workers) == [9, 1, 4]


@pytest.mark.parametrize("workers", [1, 2])
def test_errors_come_through(workers):
    with pytest.raises(ValueError, match="cannot take -1"):
        parallel_map(square, [1, -1, 2], workers=workers)


def test_seeded_is_reproducible_and_leaves_no_trace():
    torch.manual_seed(1)
    expected = torch.rand(2), np.random.default_rng(0).random(), random.Random(3).random()
    torch.manual_seed(1)
    np.random.seed(5)  # noqa: NPY002
    random.seed(5)
    outside = np.random.get_state()[1].copy()  # noqa: NPY002
    draws = []
    for _ in range(2):
        with seeded(11):
            draws.append((torch.rand(2), np.random.rand(), random.random()))  # noqa: NPY002
    assert torch.equal(draws[0][0], draws[1][0])
    assert draws[0][1:] == draws[1][1:]
    assert torch.equal(torch.rand(2), expected[0])
    assert np.array_equal(np.random.get_state()[1], outside)  # noqa: NPY002


def test_child_seeds_differ_and_repeat():
    assert child_seeds(4, 5) == child_seeds(4, 5)
    assert len({*child_seeds(4, 5), *child_seeds(5, 5)}) == 10


def threads(_=None):
    """Threads of torch, and of every library of linear algebra that is loaded."""
    return [torch.get_num_threads(), *(pool["num_threads"] for pool in threadpool_info())]


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    with threadpool_limits(2):
        yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("inside", [one_thread(), seeded(3)])
def test_work_is_done_on_one_thread_and_others_get_theirs_back(inside):
    found = []

    @inside
    def fails():
        found.extend(threads())
        raise KeyError("stop")

    with pytest.raises(KeyError, match="stop"):
        fails()
    assert set(found) == {1}
    assert set(threads()) == {2}
    assert set(parallel_map(threads, [0])[0]) == {1}
