"""Processes and seeds."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import joblib
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


def dies_once(task):
    """The first process that comes to the second item is killed, as one is when memory is short."""
    item, mark = task
    if item == 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return item * item


def test_work_of_a_killed_process_is_done_again(tmp_path):
    tasks = [(item, tmp_path / "killed") for item in (3, 2, 1, 4)]
    assert parallel_map(dies_once, tasks, workers=2) == [9, 4, 1, 16]
    assert (tmp_path / "killed").exists()


def dies(_):
    os.kill(os.getpid(), signal.SIGKILL)


def test_work_that_kills_its_process_again_and_again_ends_in_a_sentence():
    with pytest.raises(RuntimeError, match="killed 3 times, with 0 of 2 pieces"):
        parallel_map(dies, [1, 2], workers=2)


def slow_draw(seed):
    with seeded(seed):
        before = torch.rand(3)
        time.sleep(0.01)
        return torch.cat([before, torch.rand(3)]).tolist()


def test_threads_of_one_process_take_turns():
    """Random numbers are the process's: pieces in two threads at once would mix them up."""
    alone = [slow_draw(seed) for seed in range(6)]
    with joblib.parallel_config(backend="threading", n_jobs=2):
        assert parallel_map(slow_draw, range(6), workers=2) == alone


ORPHANS = """
import os, sys, time
from pathlib import Path
sys.path.insert(0, {root!r})
from pyro_dynogp.support.parallel import parallel_map

def work(item):
    Path({folder!r}, str(os.getpid())).touch()
    time.sleep(600)

parallel_map(work, [1, 2], workers=2)
"""


def test_workers_end_when_their_parent_is_killed(tmp_path):
    code = ORPHANS.format(root=str(Path(__file__).parents[2]), folder=str(tmp_path))
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL) as parent:
        while len(list(tmp_path.iterdir())) < 2 and parent.poll() is None:
            time.sleep(0.05)
        parent.kill()
    workers = [int(path.name) for path in tmp_path.iterdir()]
    assert len(workers) == 2
    until = time.monotonic() + 60
    while any(map(lives, workers)) and time.monotonic() < until:
        time.sleep(0.1)
    assert not any(map(lives, workers))


def lives(process):
    """Whether a process runs; one that has ended and is not yet collected does not."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state not in "ZX"
