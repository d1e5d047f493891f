"""Several optimisers side by side, each in a thread, whose function evaluations are done together.

A model's density at many points costs little more than at one: most of an evaluation is Python, and
only the compiled recursions are done for each point. Optimisers that ask for one point at a time
wait here until all that still run have asked. Only the caller's thread evaluates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from queue import SimpleQueue
from threading import Thread
from typing import Any, TypeVar

import numpy as np

Result = TypeVar("Result")
# Value and gradient (d,) at a point (d,); values (k,) and gradients (k, d) at points (k, d).
Function = Callable[[np.ndarray], tuple[float, np.ndarray]]
Functions = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class _StoppedError(Exception):
    """Raised in an optimiser's thread when there will be no answer."""


def in_lockstep(functions: Functions, runs: Sequence[Callable[[Function], Result]]) -> list[Result]:
    """Results of optimisers, in their order; each is called with the function to minimise.

    The points of one evaluation are in the order of the optimisers: the same runs, the same bits.
    An error in one of them, or in the function, ends all and is raised here.
    """
    if len(runs) == 1:
        return [runs[0](lambda z: _first(functions(z[None])))]
    asked: SimpleQueue[tuple[int, str, Any]] = SimpleQueue()
    answers: list[SimpleQueue[tuple[float, np.ndarray] | None]] = [SimpleQueue() for _ in runs]

    def work(i: int) -> None:
        def function(z: np.ndarray) -> tuple[float, np.ndarray]:
            asked.put((i, "point", np.array(z, dtype=float)))
            answer = answers[i].get()
            if answer is None:
                raise _StoppedError
            return answer

        try:
            asked.put((i, "result", runs[i](function)))
        except _StoppedError:
            return
        except BaseException as error:  # raised again in the caller's thread
            asked.put((i, "error", error))

    threads = [Thread(target=work, args=(i,), daemon=True) for i in range(len(runs))]
    results: dict[int, Result] = {}
    for thread in threads:
        thread.start()
    try:
        while len(results) < len(runs):
            points: dict[int, np.ndarray] = {}
            while len(points) + len(results) < len(runs):
                i, what, content = asked.get()
                if what == "error":
                    raise content
                (points if what == "point" else results)[i] = content
            if points:
                order = sorted(points)
                values, gradients = functions(np.stack([points[i] for i in order]))
                for i, value, gradient in zip(order, values, gradients, strict=True):
                    answers[i].put((float(value), gradient))
    finally:
        for answer in answers:
            answer.put(None)
        for thread in threads:
            thread.join()
    return [results[i] for i in range(len(runs))]


def _first(found: tuple[np.ndarray, np.ndarray]) -> tuple[float, np.ndarray]:
    return float(found[0][0]), found[1][0]
