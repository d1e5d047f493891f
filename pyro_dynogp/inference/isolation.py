"""What a public function computes does not depend on what happens around it.

Pyro keeps its handlers in one list for the whole process, and torch its random numbers and modes:
two fits in two threads, or a fit inside somebody's trace, plate or `torch.no_grad`, would give
other numbers.
"""

from __future__ import annotations

import contextlib
import functools
import os
import threading
from collections.abc import Callable, Iterator
from typing import ParamSpec, TypeVar

import numpy as np
import torch
from pyro.poutine.runtime import _DIM_ALLOCATOR, _PYRO_STACK

from pyro_dynogp.support.errors import checked

Given = ParamSpec("Given")
Result = TypeVar("Result")


class _Turn:
    """Whose turn it is among the threads of a process."""

    def __init__(self) -> None:
        self.lock = threading.RLock()


_TURN = _Turn()
if hasattr(os, "register_at_fork"):  # a forked child has no thread that would give the lock back
    os.register_at_fork(after_in_child=_TURN.__init__)  # type: ignore[misc]


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Inside, one thread at a time, outside all handlers of Pyro, with gradients, on the processor.

    Outside nothing has changed. Threads of the caller that use Pyro, or torch's global random
    numbers, by themselves meanwhile are not held back.
    """
    with _TURN.lock, contextlib.ExitStack() as modes:
        outer = [(stack, stack[:]) for stack in (_PYRO_STACK, _DIM_ALLOCATOR._stack)]
        for stack, _ in outer:
            stack.clear()
        try:
            modes.enter_context(torch.inference_mode(False))
            modes.enter_context(torch.enable_grad())
            modes.enter_context(torch.autocast("cpu", enabled=False))
            modes.enter_context(np.errstate(all="warn", under="ignore"))
            if torch.get_default_device().type != "cpu":
                modes.enter_context(torch.device("cpu"))
            yield
        finally:
            for stack, before in outer:
                stack[:] = before


def isolated(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """Check the arguments, then run `alone`: a decorator of public functions."""

    @functools.wraps(function)
    def call(*args: Given.args, **kwargs: Given.kwargs) -> Result:
        with alone():
            return function(*args, **kwargs)

    return checked(call)
