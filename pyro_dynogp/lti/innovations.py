"""Innovations of observed outputs and their variances, with gradients, for many points at once.

The compiled passes are those of `innovation_passes`; here tensors are laid out
in lanes for them. Compiled code runs on the processor: other tensors are moved there and back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.lti import innovation_layout as layout
from pyro_dynogp.lti import innovation_passes as passes
from pyro_dynogp.lti.fused import output_covariance
from pyro_dynogp.lti.grid import TimeGrid
from pyro_dynogp.lti.lanes import WIDTH
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.primitives import array, run
from pyro_dynogp.support.tensors import broadcast


def _to_lanes(x: np.ndarray) -> np.ndarray:
    """(B, ...) to (groups, k, WIDTH); the last point fills what lanes are left."""
    groups = -(-len(x) // WIDTH)
    order = np.minimum(np.arange(groups * WIDTH), len(x) - 1)
    real = x.reshape(len(x), -1).view(np.float64)
    return np.ascontiguousarray(real[order].reshape(groups, WIDTH, -1).swapaxes(1, 2))


def _from_lanes(bars: list[np.ndarray], like: Tensor) -> Tensor:
    """Arrays (k, WIDTH) of all groups to a tensor of the shape and dtype of `like`."""
    rows = np.stack(bars).swapaxes(1, 2).reshape(len(bars) * WIDTH, -1)[: len(like)]
    out = torch.from_numpy(np.ascontiguousarray(rows)).to(like.device)
    if like.is_complex():
        out = torch.view_as_complex(out.reshape(len(like), -1, 2))
    return out.reshape(like.shape)


@np.errstate(all="ignore")  # out of range the variances are NaN, which the caller refuses
def _times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of complex arrays, rounded alike in every place, as numpy's own need not be."""
    re = a.real * b.real - a.imag * b.imag
    return re + 1j * (a.real * b.imag + a.imag * b.real)


class _Innovations(torch.autograd.Function):
    """z and d (B, N) of points; c scales the states of a single output (and `start` already)."""

    @staticmethod
    def forward(ctx: Any, grid: TimeGrid, missing: np.ndarray, *args: Tensor | None) -> Any:
        poles, q, c, start, noise, residual = args
        assert poles is not None
        assert q is not None
        assert c is not None
        assert noise is not None
        assert residual is not None
        pairs, (B, _, n_y) = poles.shape[-1], noise.shape
        n = len(grid)
        z, d = np.empty((B, n * n_y)), np.empty((B, n * n_y))
        gains = (array(q), array(c)) if n_y > 1 else (_times(array(c), array(q)), None)
        arrays = (array(poles), *gains, None if start is None else array(start))
        lanes = [None if x is None else _to_lanes(x) for x in arrays]
        rows = layout.Rows(
            grid.step_index, array(grid.steps), array(noise), missing, array(residual)
        )
        kept = layout.keep(B if any(ctx.needs_input_grad) else 0, n, pairs, n_y)
        for g, points in enumerate(_groups(lanes)):
            work, x = layout.workspace(pairs, n_y), layout.records(pairs, 0)
            passes.run_points(g, points, rows, work, x, z, d, kept)
        ctx.save_for_backward(*args)
        ctx.arrays = lanes, rows, kept
        return tuple(torch.from_numpy(x).to(poles.device) for x in (z, d))

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> Any:
        args = ctx.saved_tensors
        poles, q, c, start, noise, residual = args
        lanes, rows, kept = ctx.arrays
        pairs, n_y = poles.shape[-1], noise.shape[-1]
        z_bar, d_bar = (array(x) for x in bars)
        noise_bar, residual_bar = np.zeros(noise.shape), np.zeros(residual.shape)
        found = []
        x = layout.records(pairs, layout.SEGMENT * n_y)
        for g, points in enumerate(_groups(lanes)):
            work, own = layout.workspace(pairs, n_y), layout.bars_of(pairs, n_y)
            passes.reverse_points(
                g, points, rows, work, x, kept, own, z_bar, d_bar, residual_bar, noise_bar
            )
            found.append(own)
        size = pairs * (pairs + 1) * 2
        q_bar = _from_lanes([own.q for own in found], q)
        if n_y == 1:
            bar, factors = array(q_bar), (array(c).conj(), array(q).conj())
            q_bar, c_bar = (torch.from_numpy(_times(x, bar)).to(q.device) for x in factors)
        else:
            c_bar = _from_lanes([own.c for own in found if own.c is not None], c)
        gradients = [
            _from_lanes([own.poles for own in found], poles),
            q_bar,
            c_bar,
            None if start is None else _from_lanes([own.state[:size] for own in found], start),
        ]
        rest = (torch.from_numpy(x).to(poles.device) for x in (noise_bar, residual_bar))
        return (None, None, *gradients, *rest)


def _groups(lanes: Sequence[np.ndarray | None]) -> list[layout.Points]:
    poles, q, c, start = lanes
    assert poles is not None
    assert q is not None
    pairs = poles.shape[1] // 2
    rest = np.zeros((2 * pairs * (pairs + 1), WIDTH))
    return [
        layout.Points(
            poles[g], q[g], None if c is None else c[g], rest if start is None else start[g]
        )
        for g in range(len(poles))
    ]


def _packed(S: Tensor, c: Tensor | None) -> Tensor:
    """Upper triangles of E[xi xi^H] and E[xi xi^T] from the real (*b, 2P, 2P), interleaved."""
    P = S.shape[-1] // 2
    S = 0.5 * (S + S.mT)
    xx, xy, yx, yy = S[..., :P, :P], S[..., :P, P:], S[..., P:, :P], S[..., P:, P:]
    hermitian, symmetric = torch.complex(xx + yy, yx - xy), torch.complex(xx - yy, yx + xy)
    if c is not None:
        hermitian = c.unsqueeze(-1) * hermitian * c.conj().unsqueeze(-2)
        symmetric = c.unsqueeze(-1) * symmetric * c.unsqueeze(-2)
    a, b = torch.triu_indices(P, P)
    pairs = torch.stack([hermitian[..., a, b], symmetric[..., a, b]], -1)
    return torch.view_as_real(pairs.resolve_conj()).flatten(-3)


def _flat(x: Tensor, events: int, batch: torch.Size) -> Tensor:
    """(*b, ...) to (B, ...), or to (1, ...) where b is nothing but ones."""
    own, event = x.shape[: x.dim() - events], x.shape[x.dim() - events :]
    if math.prod(own) == 1:
        return x.reshape(1, *event)
    return x.expand((*batch, *event)).reshape(batch.numel(), *event)


def innovations(
    modes: Modes,
    grid: TimeGrid,
    noise_variance: Tensor,
    residual: Tensor,
    *,
    missing: Tensor | None = None,
    explained: Tensor | None = None,
    output_covariances: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    r"""Innovations and their variances: each sample less its prediction from those before.

    With the covariance K = L D L' of the samples, z = L^{-1} r and d = diag D; the log-density of
    r is -1/2 sum (z^2 / d + log 2 pi d) over the rows that are not missing. Differentiable with
    respect to everything. Of batches the points that are computed together do not change each
    other's results, not in the last bit.

    Args:
        modes: the system, batch shape *b.
        grid: n times [s].
        noise_variance: v [output^2] (*b, 1, n_y) where it is the same at all times, which lets the
            gain settle on equal steps (O(P) a sample from there); else (*b, n, n_y).
        residual: r (*b, N), N = n n_y, samples less mean response [output]; not used where missing.
        missing: (*b, N), True where there is no sample.
        explained: (*b, 2P, 2P) stationary less initial covariance of [Re x; Im x]; None for zero.
        output_covariances: q (*b, n_y, P) of `fused.output_covariance`, where it is known already.

    Returns:
        z (*b, N) [output] and d (*b, N) [output^2], float64. Missing rows have d infinite, z
        without meaning. d is not positive, or NaN, from where on K is not positive definite.

    Examples:
        >>> import torch
        >>> from pyro_dynogp import Modes
        >>> from pyro_dynogp.lti.grid import time_grid
        >>> from pyro_dynogp.lti.innovations import innovations
        >>> modes = Modes([-1.0 + 2.0j], None, [1.0 + 0.0j], [[0.5 + 0.0j]])
        >>> v = torch.full((1, 1), 0.1, dtype=torch.float64)
        >>> z, d = innovations(modes, time_grid([0.0, 0.1]), v, torch.ones(2, dtype=torch.float64))
        >>> z.shape, bool((d > 0.1).all())
        (torch.Size([2]), True)
    """
    q = output_covariance(modes) if output_covariances is None else output_covariances
    start = None
    if explained is not None:
        start = _packed(explained, modes.C[..., 0, :] if modes.outputs == 1 else None)
    shapes: list[tuple[Tensor | None, int]] = [
        (modes.poles, 1), (q, 2), (modes.C, 2), (start, 1), (noise_variance, 2), (residual, 1),
    ]  # fmt: skip
    batch = broadcast(*(x.shape[: x.dim() - k] for x, k in [*shapes, (missing, 1)]
                        if x is not None))  # fmt: skip
    size = batch.numel()
    *whole, r = [None if x is None else _flat(x, k, batch) for x, k in shapes]
    absent = np.zeros((0, residual.shape[-1]), dtype=np.bool_)
    if missing is not None:
        absent = array(_flat(missing, 1, batch))
    whole = [None if x is None else x.expand(size, *x.shape[1:]) for x in whole]
    z, d = run(_Innovations, (grid, absent), *whole, r)
    return z.reshape(batch + z.shape[1:]), d.reshape(batch + d.shape[1:])
