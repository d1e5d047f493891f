"""Several optimisers side by side, each in a thread, whose function evaluations are done together.

A model's density at many points costs little more than at one: most of an evaluation is Python, and
only the compiled recursions are done for each point. Optimisers that ask for one point at a time
wait here until all that still run have asked. Only the caller's thread evaluates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from queue import SimpleQueue
from threading import Thread
from typing import Any, TypeVar, cast

import numpy as np

Result = TypeVar("Result")
# What there is to know at points (k, d): arrays (k, ...).
Answer = TypeVar("Answer", bound=tuple[np.ndarray, ...])
# Values (k,) and gradients (k, d) at points (k, d).
Functions = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class _StoppedError(Exception):
    """Raised in an optimiser's thread when there will be no answer."""


def in_lockstep(
    functions: Callable[[np.ndarray], Answer],
    runs: Sequence[Callable[[Callable[[np.ndarray], Answer]], Result]],
) -> list[Result]:
    """Results of optimisers, in their order; each is called with the functions to minimise.

    The points of one evaluation are in the order of the optimisers: the same runs, the same bits.
    An error in one of them, or in the function, ends all and is raised here.
    """
    if len(runs) == 1:
        return [runs[0](functions)]
    asked: SimpleQueue[tuple[int, str, Any]] = SimpleQueue()
    answers: list[SimpleQueue[Answer | None]] = [SimpleQueue() for _ in runs]

    def work(i: int) -> None:
        def waiting(z: np.ndarray) -> Answer:
            asked.put((i, "points", np.array(z, dtype=float)))
            answer = answers[i].get()
            if answer is None:
                raise _StoppedError
            return answer

        try:
            asked.put((i, "result", runs[i](waiting)))
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
                (points if what == "points" else results)[i] = content
            if points:
                order = sorted(points)
                found = functions(np.concatenate([points[i] for i in order]))
                ends = np.cumsum([len(points[i]) for i in order])[:-1]
                parts = zip(*(np.split(x, ends) for x in found), strict=True)
                for i, part in zip(order, parts, strict=True):
                    answers[i].put(cast("Answer", part))
    finally:
        for answer in answers:
            answer.put(None)
        for thread in threads:
            thread.join()
    return [results[i] for i in range(len(runs))]
