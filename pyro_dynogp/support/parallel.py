"""One way to run independent pieces of work: processes here, or a cluster where the user has one.

Work goes through joblib. By default it runs in local processes; inside
``joblib.parallel_config(backend="dask")`` (or "ray") it runs on that cluster.
"""

from __future__ import annotations

import contextlib
import functools
import os
import random
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import joblib
import numpy as np
import torch
from joblib.externals.loky import BrokenProcessPool
from joblib.parallel import get_active_backend
from threadpoolctl import ThreadpoolController
from tqdm import tqdm

from pyro_dynogp.support.errors import verify

# joblib replaces a process that has grown by 300 MB, between two pieces of work of which none is
# lost. Its warning of a leak would reach whoever fits a long record. It comes from a thread of
# joblib, which no filter around a call reaches.
warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)

# How often work is begun of which processes were killed.
ATTEMPTS = 3
# Threads of one process take turns: random numbers, Pyro's handlers and the number of threads are
# the process's. Held only while a piece of work runs, and another lock than that of
# `inference.isolation`: whoever hands out the work holds that one meanwhile.
_TURN = threading.RLock()
Item = TypeVar("Item")
Result = TypeVar("Result")


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Inside, torch and the linear algebra of numpy and scipy run on one thread; also a decorator.

    Matrices are small here: more threads gain nothing on an idle machine, wait for each other in
    circles on a busy one, and let the order of a sum depend on how many processors there are.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with _libraries().limit(limits=1):
            yield
    finally:
        torch.set_num_threads(threads)


@functools.cache
def _libraries() -> ThreadpoolController:
    """Libraries of linear algebra that are loaded: to look for them takes milliseconds."""
    return ThreadpoolController()


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed torch, numpy and random inside, on one thread; outside nothing has changed."""
    states = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 (Pyro and its guides draw from the global state)
    random.seed(seed)
    try:
        with one_thread():
            yield
    finally:
        torch.set_rng_state(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        random.setstate(states[2])


def child_seeds(seed: int, count: int) -> list[int]:
    """Independent seeds for `count` pieces of work, the same for the same seed."""
    children = np.random.SeedSequence(seed).spawn(count)
    return [int(child.generate_state(1, np.uint32)[0]) for child in children]


def parallel_map(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    workers: int | None = None,
    progress: bool = False,
    description: str = "",
    news: Callable[[Sequence[Result]], str] | None = None,
) -> list[Result]:
    """Apply a function to every item; results in the order of the items.

    Args:
        function: importable or closure (it is sent to other processes).
        items: arguments, one for each call.
        workers: number of processes; 1 runs here, None uses every processor or the whole cluster.
        progress: whether to show a bar, with the time left. description: its label.
        news: what to write beside the bar, of the results so far.

    Raises:
        ValueError: where workers is not a positive whole number. Errors of the function are
            raised here as they are.
        RuntimeError: where processes are killed again and again.
    """
    verify(workers=workers)
    bar = tqdm(total=len(items), desc=description, disable=not progress)
    results: list[Result] = []

    def advance(result: Result) -> None:
        results.append(result)
        if news is not None:
            bar.set_postfix_str(news(results), refresh=False)
        bar.update()

    parent = os.getpid()
    with bar:
        if workers == 1 or len(items) <= 1:
            for item in items:
                advance(_call(function, item, parent))
            return results
        backend, _ = get_active_backend()
        local = type(backend).__name__ == "LokyBackend"
        count = min(len(items), workers or joblib.cpu_count()) if local else workers
        kind = "generator" if local else "list"
        for attempt in range(ATTEMPTS):
            pool, lost = joblib.Parallel(n_jobs=count, return_as=kind), items[len(results) :]
            try:
                for result in pool(joblib.delayed(_call)(function, item, parent) for item in lost):
                    advance(result)
                break
            except BrokenProcessPool as error:  # a process was killed: what it had begun is lost
                if attempt == ATTEMPTS - 1:
                    raise RuntimeError(
                        f"Worker processes were killed {ATTEMPTS} times, with {len(results)} of "
                        f"{len(items)} pieces of work done. Where memory is short, fewer workers "
                        "need less of it."
                    ) from error
    return results


def _call(function: Callable[[Any], Any], item: Any, parent: int) -> Any:
    if os.getppid() == parent:
        _end_with(parent)
    with _TURN, one_thread():
        return function(item)


@functools.cache
def _end_with(parent: int) -> None:
    """End this process when its parent is gone, which cannot tell it any more."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
