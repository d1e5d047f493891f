r"""Moments of a function of one channel at many points, compiled, with derivatives.

For points x and inducing locations z of one channel and K_zz = L L',

    m(x) = k(x, z) alpha',      q(x) = |L^-1 k(z, x)|^2,

the function's mean beside its prior mean and the share of its variance that the inducing values
explain. Eight points are computed together (`lti.lanes`); no matrix of points and locations is
kept. Derivatives are by hand; where they are to be differentiated themselves, the graph of the
plain formulas is made instead.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from pyro_dynogp.layers.radial import function_of_distance
from pyro_dynogp.lti.lanes import WIDTH, exponential, get, magnitude, put, splat, total
from pyro_dynogp.lti.primitives import array, flatten_batch
from pyro_dynogp.lti.primitives import run as run_function
from pyro_dynogp.support.compiled import BORROWING, OPTIONS

FORMS = {"rbf": 0, "matern32": 1, "matern52": 2}
_ROOTS = (1.0, math.sqrt(3.0), math.sqrt(5.0))


@njit(**BORROWING)
def _kernel(form, d):
    """Kernel at distance d in lengthscales, and its derivative by d."""
    one = splat(1.0)
    if form == 0:
        value = exponential(splat(-0.5) * d * d)
        return value, splat(-1.0) * value * d
    a = splat(_ROOTS[form]) * magnitude(d)
    decay = exponential(splat(-1.0) * a)
    if form == 1:
        return (one + a) * decay, splat(-3.0) * decay * d
    slope = splat(-5.0 / 3.0) * (one + a) * decay * d
    return (one + a + a * a * splat(1.0 / 3.0)) * decay, slope


@njit(**BORROWING)
def _solve(L, w):
    """W <- L^-1 w, of eight points (M, 8)."""
    for j in range(L.shape[0]):
        own = get(w, j) / splat(L[j, j])
        put(w, j, own)
        for i in range(j + 1, L.shape[0]):
            put(w, i, get(w, i) - splat(L[i, j]) * own)


@njit(**BORROWING)
def _solve_back(L, w):
    """W <- L'^-1 w, of eight points (M, 8)."""
    for i in range(L.shape[0] - 1, -1, -1):
        own = get(w, i) / splat(L[i, i])
        put(w, i, own)
        for j in range(i):
            put(w, j, get(w, j) - splat(L[i, j]) * own)


@njit(**OPTIONS)
def evaluate(form, x, z, inverse, alpha, L):
    """Mean (e, n) and explained share (n,) of one element; n is a multiple of eight.

    x: (n,). z: (M,). inverse: of the lengthscale. alpha: (e, M). L: (M, M), or (0, 0) for the mean
    alone.
    """
    M, e, vectors = z.shape[0], alpha.shape[0], x.shape[0] // WIDTH
    mean = np.zeros((e, x.shape[0]))
    explained = np.zeros(x.shape[0])
    w = np.empty((M, WIDTH))
    for v in range(vectors):
        at = get(x, v)
        for i in range(M):
            value, _ = _kernel(form, (at - splat(z[i])) * splat(inverse))
            put(w, i, value)
            for a in range(e):
                k = a * vectors + v
                put(mean, k, get(mean, k) + splat(alpha[a, i]) * value)
        if L.shape[0] > 0:
            _solve(L, w)
            share = splat(0.0)
            for i in range(M):
                share = share + get(w, i) * get(w, i)
            put(explained, v, share)
    return mean, explained


@njit(**OPTIONS)
def evaluate_adjoint(form, x, z, inverse, alpha, L, mean_bar, explained_bar):
    """Gradients by x, z, inverse, alpha and L of one element; see `evaluate`."""
    M, e, vectors = z.shape[0], alpha.shape[0], x.shape[0] // WIDTH
    x_bar = np.empty(x.shape[0])
    z_bar, alpha_bar = np.zeros((M, WIDTH)), np.zeros((e, M, WIDTH))
    L_bar = np.zeros((L.shape[0], L.shape[1], WIDTH))
    w, u = np.empty((M, WIDTH)), np.empty((M, WIDTH))
    slope, bar = np.empty((M, WIDTH)), np.empty((M, WIDTH))
    inverse_bar = splat(0.0)
    for v in range(vectors):
        at = get(x, v)
        for i in range(M):
            value, by_d = _kernel(form, (at - splat(z[i])) * splat(inverse))
            put(w, i, value)
            put(slope, i, by_d)
            own = splat(0.0)
            for a in range(e):
                given = get(mean_bar, a * vectors + v)
                own = own + given * splat(alpha[a, i])
                put(alpha_bar, a * M + i, get(alpha_bar, a * M + i) + given * value)
            put(bar, i, own)
        if L.shape[0] > 0:
            _solve(L, w)
            twice = splat(2.0) * get(explained_bar, v)
            for i in range(M):
                put(u, i, twice * get(w, i))
            _solve_back(L, u)
            for i in range(M):
                own = get(u, i)
                put(bar, i, get(bar, i) + own)
                for j in range(i + 1):
                    put(L_bar, i * M + j, get(L_bar, i * M + j) - own * get(w, j))
        own = splat(0.0)
        for i in range(M):
            by_d = get(bar, i) * get(slope, i)
            own = own + by_d
            put(z_bar, i, get(z_bar, i) - by_d)
            inverse_bar = inverse_bar + by_d * (at - splat(z[i]))
        put(x_bar, v, own * splat(inverse))
    return x_bar, inverse * z_bar, total(inverse_bar), alpha_bar, L_bar


def _padded(x: np.ndarray) -> np.ndarray:
    """The last axis filled up with zeros to whole vectors."""
    more = -x.shape[-1] % WIDTH
    return np.ascontiguousarray(np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, more)]))


def _once_each(form: str, arrays: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """What `evaluate` has of each element; of equal ones, as differences by poles ask for, once."""
    done: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
    found = []
    for one in zip(*arrays, strict=True):
        key = b"".join(part.tobytes() for part in one)
        if key not in done:
            done[key] = evaluate(FORMS[form], *one)
        found.append(done[key])
    return found


class _Moments(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, form: str, *args: Tensor) -> Any:  # x z inverse alpha L
        arrays = [array(a) for a in args]
        n = arrays[0].shape[-1]
        arrays[0] = _padded(arrays[0])
        ctx.form, ctx.arrays = form, arrays
        ctx.save_for_backward(*args)
        found = _once_each(form, arrays)
        mean = np.stack([m for m, _ in found])[..., :n]
        return torch.from_numpy(mean), torch.from_numpy(np.stack([q for _, q in found])[..., :n])

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> Any:
        if torch.is_grad_enabled():  # the derivative is to be differentiated
            found = plain(ctx.form, *ctx.saved_tensors)
            some = [x for x in ctx.saved_tensors if x.requires_grad]
            each = iter(
                torch.autograd.grad(found, some, bars, create_graph=True, allow_unused=True)
            )
            return None, *(next(each) if x.requires_grad else None for x in ctx.saved_tensors)
        n = ctx.saved_tensors[0].shape[-1]
        given = zip(*ctx.arrays, *(_padded(array(b)) for b in bars), strict=True)
        parts = zip(*(evaluate_adjoint(FORMS[ctx.form], *one) for one in given), strict=True)
        x, z, inverse, alpha, L = (np.stack(part) for part in parts)
        grads = x[..., :n], z.sum(-1), inverse, alpha.sum(-1), L.sum(-1)
        return None, *(torch.from_numpy(np.ascontiguousarray(g)) for g in grads)


def plain(
    form: str, x: Tensor, z: Tensor, inverse: Tensor, alpha: Tensor, L: Tensor
) -> tuple[Tensor, Tensor]:
    """Mean (k, e, n) and explained share (k, n) in torch, for as many derivatives as are wanted."""
    scale = inverse.reciprocal().unsqueeze(-1)
    K = function_of_distance(form, scale, z.unsqueeze(-1), x.unsqueeze(-1))
    if not L.shape[-1]:
        return alpha @ K, torch.zeros_like(x)
    return alpha @ K, torch.linalg.solve_triangular(L, K, upper=False).square().sum(-2)


def moments_along(
    form: str, lengthscale: Tensor, x: Tensor, z: Tensor, alpha: Tensor, L: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Mean (*b, n, e) beside the prior mean, and explained share (*b, n) of a unit variance.

    Args:
        form: one of `FORMS`. lengthscale: (*b,). x: (*b, n) points. z: (*b, M) locations.
        alpha: (*b, e, M) weights. L: (*b, M, M) Cholesky factor; None where the mean is enough.
    """
    root = torch.zeros(0, 0, dtype=torch.float64) if L is None else L
    args = [x, z, lengthscale.reciprocal(), alpha, root]
    flat, batch = flatten_batch(args, [1, 1, 0, 2, 2])
    mean, explained = run_function(_Moments, (form,), *flat)
    return (
        mean.reshape(batch + mean.shape[1:]).mT,
        explained.reshape(batch + explained.shape[1:]),
    )
