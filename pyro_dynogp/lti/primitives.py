"""The compiled recursions as differentiable torch functions with broadcast batch dimensions.

Compiled code runs on the processor: tensors that live on an accelerator are moved there and the
result is moved back. For small problems on an accelerator use `pyro_dynogp.gp.LTIKernel`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.overrides import handle_torch_function, has_torch_function

from pyro_dynogp.lti import factorisation, information, products
from pyro_dynogp.support.tensors import broadcast


@dataclass(frozen=True)
class Generators:
    """What defines the rows of a semiseparable covariance (see `factorisation`).

    Attributes:
        re, im: (*b, m, P) propagators exp(lambda d) of the m distinct steps.
        h: (*b, n_y, 2P) output from state. g: (*b, n_y, 2P) covariance of state with output.
        k0: (*b, n_y) variance of each output.
        S0: (*b, 2P, 2P) stationary minus initial covariance of the state.
        step, out: (N,) int64 step index and output index of each row.
    """

    re: Tensor
    im: Tensor
    h: Tensor
    g: Tensor
    k0: Tensor
    S0: Tensor
    step: np.ndarray
    out: np.ndarray


def array(x: Tensor) -> np.ndarray:
    """Contiguous array of a tensor's values."""
    return np.ascontiguousarray(x.detach().resolve_conj().cpu().numpy())


class _Recursion(torch.autograd.Function):
    """Common tail: numpy results back to the tensors' device."""

    @staticmethod
    def tensors(like: Tensor, *arrays: np.ndarray) -> tuple[Tensor, ...]:
        return tuple(torch.from_numpy(a).to(like.device) for a in arrays)


class _Factor(_Recursion):
    @staticmethod
    def forward(ctx: Any, step: Any, out: Any, *args: Tensor) -> Any:  # re im h g k0 v S0
        re, im, h, g, k0, v, S0 = (array(a) for a in args)
        ctx.save_for_backward(*args)
        ctx.index = (step, out)
        found = factorisation.factor(re, im, step, out, h, g, k0, v, S0)
        return _Recursion.tensors(args[0], *found)

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> Any:
        re, im, h, g, k0, v, S0 = (array(a) for a in ctx.saved_tensors)
        step, out = ctx.index
        grads = factorisation.factor_adjoint(
            re, im, step, out, h, g, k0, v, S0, *(array(b) for b in bars)
        )
        return (None, None, *_Recursion.tensors(bars[0], *grads))


class _Lower(_Recursion):
    """M X or (I + M)^{-1} X for the strictly lower M; `transpose` uses M'."""

    @staticmethod
    def forward(ctx: Any, step: Any, out: Any, solve: bool, transpose: bool, *args: Tensor) -> Any:
        arrays = [array(a) for a in args]  # re im h w X
        kernel = products.upper if transpose else products.lower
        re, im, h, w, X = arrays
        (Z,) = _Recursion.tensors(args[0], kernel(re, im, step, out, h, w, X, solve))
        ctx.save_for_backward(*args, Z)
        ctx.index = (step, out, solve, transpose)
        return Z

    @staticmethod
    def backward(ctx: Any, Z_bar: Tensor) -> Any:
        re, im, h, w, X, Z = (array(a) for a in ctx.saved_tensors)
        step, out, solve, transpose = ctx.index
        kernel = products.lower if transpose else products.upper
        X_bar = kernel(re, im, step, out, h, w, array(Z_bar), solve)
        # <Z_bar, dM X> for a product; for a solution -<X_bar, dM Z>.
        left, right = (-X_bar, Z) if solve else (array(Z_bar), X)
        if transpose:
            left, right = right, left
        grads = products.lower_gradient(re, im, step, out, h, w, right, left)
        return (None, None, None, None, *_Recursion.tensors(Z_bar, *grads, X_bar))


class _LaterInformation(_Recursion):
    @staticmethod
    def forward(ctx: Any, step: Any, out: Any, *args: Tensor) -> Any:  # re im h e d
        re, im, h, e, d = (array(a) for a in args)
        ctx.save_for_backward(*args)
        ctx.index = (step, out)
        kappa = information.later_information(re, im, step, out, h, e, d)
        return _Recursion.tensors(args[0], kappa)[0]

    @staticmethod
    def backward(ctx: Any, kappa_bar: Tensor) -> Any:
        re, im, h, e, d = (array(a) for a in ctx.saved_tensors)
        step, out = ctx.index
        grads = information.later_information_adjoint(re, im, step, out, h, e, d, array(kappa_bar))
        return (None, None, *_Recursion.tensors(kappa_bar, *grads))


def run(
    function: type[torch.autograd.Function], constants: tuple[Any, ...], *args: Tensor | None
) -> Any:
    """Apply a recursion, letting tensor subclasses (Pyro's provenance tracking) see it as one."""
    if has_torch_function(args):
        return handle_torch_function(run, args, function, constants, *args)
    return function.apply(*constants, *args)


def flatten_batch(args: list[Tensor], events: list[int]) -> tuple[list[Tensor], torch.Size]:
    """Broadcast the batch dimensions left of `events` trailing ones; make them one."""
    batch = broadcast(*(a.shape[: a.dim() - k] for a, k in zip(args, events, strict=True)))
    count = batch.numel()
    flat = [
        a.expand(batch + a.shape[a.dim() - k :]).reshape((count, *a.shape[a.dim() - k :]))
        for a, k in zip(args, events, strict=True)
    ]
    return flat, batch


def factor(rows: Generators, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Factor S + diag(v): predictive covariances e (*b, N, 2P), variances p (*b, N), last S.

    v (*b, N) is the noise variance of each row, infinite for a missing sample.
    """
    args, batch = flatten_batch(
        [rows.re, rows.im, rows.h, rows.g, rows.k0, v, rows.S0], [2, 2, 2, 2, 1, 1, 2]
    )
    e, p, S = run(_Factor, (rows.step, rows.out), *args)
    return (
        e.reshape(batch + e.shape[1:]),
        p.reshape(batch + p.shape[1:]),
        S.reshape(batch + S.shape[1:]),
    )


def triangular(
    rows: Generators, w: Tensor, X: Tensor, *, solve: bool = False, transpose: bool = False
) -> Tensor:
    """Product with, or solution by, the triangular matrix of generators h and w (*b, N, 2P).

    The product is with the *strict* triangle M; the solution is with I + M. X is (*b, N, R).
    """
    args, batch = flatten_batch([rows.re, rows.im, rows.h, w, X], [2, 2, 2, 2, 2])
    Z = run(_Lower, (rows.step, rows.out, solve, transpose), *args)
    return Z.reshape(batch + Z.shape[1:])


def later_information(rows: Generators, e: Tensor, d: Tensor) -> Tensor:
    """Information of later rows on each row, e' Lambda e (*b, N); see `information`."""
    args, batch = flatten_batch([rows.re, rows.im, rows.h, e, d], [2, 2, 2, 2, 1])
    kappa = run(_LaterInformation, (rows.step, rows.out), *args)
    return kappa.reshape(batch + kappa.shape[1:])
