"""The compiled filter as a differentiable torch function with broadcast batch dimensions."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import joblib
import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.lti.primitives import array, flatten_batch
from pyro_dynogp.lti.primitives import run as run_recursion
from pyro_dynogp.moments import filtering, reverse
from pyro_dynogp.moments.functions import TABLE, cubature, gauss_hermite
from pyro_dynogp.moments.layout import Layout, Values, zero_bars
from pyro_dynogp.support.tensors import broadcast

# Dimensions of each value right of the batch.
EVENTS = {
    "re": 2,
    "im": 2,
    "Q": 3,
    "gamma": 3,
    "m0": 1,
    "P0": 2,
    "G": 2,
    "offset": 2,
    "table_mean": 2,
    "table_variance": 2,
    "low": 1,
    "spacing": 1,
    "weight": 2,
    "Z": 3,
    "inverse": 2,
    "constant": 1,
    "slope": 2,
    "H": 2,
    "y_offset": 2,
    "y": 2,
    "R": 2,
}


@dataclass(frozen=True, eq=False)
class FilterProblem:
    """A cascade along a record, ready for the filter: `Values` as tensors, and the `Layout`.

    Batch dimensions stand to the left of each tensor and broadcast.
    """

    layout: Layout
    re: Tensor
    im: Tensor
    Q: Tensor
    gamma: Tensor
    m0: Tensor
    P0: Tensor
    G: Tensor
    offset: Tensor
    table_mean: Tensor
    table_variance: Tensor
    low: Tensor
    spacing: Tensor
    weight: Tensor
    Z: Tensor
    inverse: Tensor
    constant: Tensor
    slope: Tensor
    H: Tensor
    y_offset: Tensor
    y: Tensor
    R: Tensor

    def tensors(self) -> list[Tensor]:
        """In the order of `Values`."""
        return [getattr(self, name) for name in Values._fields]

    @property
    def batch_shape(self) -> torch.Size:
        """What all batch dimensions broadcast to."""
        each = ((getattr(self, name), EVENTS[name]) for name in Values._fields)
        return broadcast(*(x.shape[: x.dim() - event] for x, event in each))

    @property
    def wants_gradient(self) -> bool:
        """Whether what is computed from it is differentiated."""
        return torch.is_grad_enabled() and any(x.requires_grad for x in self.tensors())

    def flat(self) -> tuple[list[Tensor], torch.Size]:
        """All tensors with one common batch dimension, and the batch shape."""
        return flatten_batch(self.tensors(), [EVENTS[name] for name in Values._fields])

    def elements(self) -> tuple[list[Values], torch.Size]:
        """One `Values` of arrays for each batch element."""
        flat, batch = self.flat()
        arrays = [array(x) for x in flat]
        count = arrays[0].shape[0]
        return [Values(*(a[b] for a in arrays)) for b in range(count)], batch


def make_layout(
    step: np.ndarray,
    channels: Sequence[int],
    outputs: Sequence[int],
    forms: Sequence[int],
    share: np.ndarray,
    multiple: np.ndarray,
    *,
    linear: Sequence[bool] = (),
    measured: bool = False,
) -> Layout:
    """Index arrays and quadrature nodes of the static layers, in order.

    Args:
        linear: which of them are linear in what is random, for which the fewest nodes are exact;
            by default none. measured: whether the last of them is what the outputs are, a function
            of one signal.
    """
    sets = [
        cubature(d) if exact else gauss_hermite(d)
        for d, exact in zip(channels, linear or [False] * len(channels), strict=True)
    ]
    widest = max(channels, default=1)
    most = max((len(w) for _, w in sets), default=1)
    nodes = np.zeros((len(sets), most, widest))
    weights = np.zeros((len(sets), most))
    for i, (x, w) in enumerate(sets):
        nodes[i, : len(w), : x.shape[1]] = x
        weights[i, : len(w)] = w

    def starts(sizes: Sequence[int]) -> np.ndarray:
        return np.concatenate([[0], np.cumsum(np.asarray(sizes, dtype=np.int64))]).astype(np.int64)

    def whole(values: Sequence[int]) -> np.ndarray:
        return np.asarray(values, dtype=np.int64)

    return Layout(
        step=np.ascontiguousarray(step, dtype=np.int64),
        channels=whole(channels),
        outputs=whole(outputs),
        form=whole(forms),
        g_start=starts(channels),
        f_start=starts(outputs),
        nodes=nodes,
        node_weight=weights,
        node_count=whole([len(w) for _, w in sets]),
        share=np.ascontiguousarray(share, dtype=np.float64),
        multiple=np.ascontiguousarray(multiple, dtype=np.float64),
        measured=len(sets) - 1 if measured else -1,
    )


@lru_cache
def _processors() -> int:
    """Asked once: the answer is in files that take longer to read than a short record to filter."""
    return int(joblib.cpu_count())


def each(function: Callable[[int], Any], count: int) -> list[Any]:
    """Apply to 0..count-1, on threads: the compiled code holds no lock.

    Within a worker process of `parallel_map` on one thread, since all processors are taken there.
    Elements do not meet, so that the numbers do not depend on the number of threads.
    """
    alone = multiprocessing.parent_process() is None
    threads = min(count, _processors() if alone else 1)
    if threads <= 1:
        return [function(b) for b in range(count)]
    parts = [range(first, count, threads) for first in range(threads)]

    def work(part: range) -> list[Any]:
        return [function(b) for b in part]

    with ThreadPoolExecutor(threads - 1) as pool:
        others = [pool.submit(work, part) for part in parts[1:]]
        found = [work(parts[0]), *(other.result() for other in others)]
    return [found[b % threads][b // threads] for b in range(count)]


class _Filter(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, layout: Layout, *args: Tensor) -> Tensor:
        arrays = [array(x) for x in args]
        elements = [Values(*(a[b] for a in arrays)) for b in range(arrays[0].shape[0])]
        results = each(lambda b: filtering.run(layout, elements[b]), len(elements))
        ctx.layout = layout
        ctx.elements = elements
        ctx.tracks = [r[1] for r in results]
        return torch.tensor([r[0] for r in results], dtype=torch.float64, device=args[0].device)

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> Any:
        def gradient(b: int) -> Values:
            out = zero_bars(ctx.elements[b])
            return reverse.run_adjoint(ctx.layout, ctx.elements[b], out, ctx.tracks[b])

        scale = array(bars[0])
        gradients = each(gradient, len(ctx.elements))
        grads: list[Tensor | None] = []
        for name, needed in zip(Values._fields, ctx.needs_input_grad[1:], strict=True):
            if not needed:
                grads.append(None)
                continue
            stacked = np.stack([scale[b] * getattr(g, name) for b, g in enumerate(gradients)])
            grads.append(torch.from_numpy(stacked).to(bars[0].device))
        return (None, *grads)


def log_density(problem: FilterProblem) -> Tensor:
    """Log-density (*b) of the outputs in `y`, all states integrated out by moment matching."""
    flat, batch = problem.flat()
    return run_recursion(_Filter, (problem.layout,), *flat).reshape(batch)


assert [f.name for f in fields(FilterProblem)][1:] == list(Values._fields)  # one order for both
__all__ = ["TABLE", "FilterProblem", "each", "log_density", "make_layout"]
