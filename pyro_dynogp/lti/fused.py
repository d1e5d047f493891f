"""Small complex algebra in one step with its derivative: what every likelihood evaluation needs.

The same covariances stand in plain torch in `covariance`, against which the tests hold these; here
they are one node of the gradient graph instead of many. Complex gradients follow torch:
dL/dRe + i dL/dIm.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.lti.covariance import output_row
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.primitives import array, flatten_batch, run


def _transpose(x: np.ndarray) -> np.ndarray:
    return np.swapaxes(x, -1, -2)


def _covariances(
    shared: bool, lam: np.ndarray, C: np.ndarray, L: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Denominators, numerators and values of E[xi xi^H], E[xi xi^T], and q = E[xi y].

    Out of floating-point range they are infinite or NaN, as torch would have it: the factorisation
    refuses them.
    """
    pairs = (lam[:, :, None] + lam.conj()[:, None, :], lam[:, :, None] + lam[:, None, :])
    sums = [np.where(s == 0, 1.0, s) for s in pairs]  # poles at zero are driven by nothing
    products = [L @ _transpose(L.conj()), L @ _transpose(L)]
    if not shared:
        same = np.eye(lam.shape[-1])
        products = [product * same for product in products]
    hermitian, symmetric = (-p / s for p, s in zip(products, sums, strict=True))
    q = _transpose(hermitian @ _transpose(C.conj()) + symmetric @ _transpose(C))
    return (*sums, *products, hermitian, symmetric, q)


class _OutputCovariance(torch.autograd.Function):
    """q = E[xi y] (b, n_y, P) from poles, C and L."""

    @staticmethod
    def forward(ctx: Any, shared: bool, *args: Tensor) -> Any:  # poles (b, P), C, L
        lam, C, L = (array(a) for a in args)
        with np.errstate(all="ignore"):
            q = _covariances(shared, lam, C, L)[-1]
        ctx.save_for_backward(*args)
        ctx.shared = shared
        return torch.from_numpy(q).to(args[0].device)

    @staticmethod
    @np.errstate(all="ignore")  # out of range as the value is: the caller looks at both
    def backward(ctx: Any, bar: Tensor) -> Any:
        lam, C, L = (array(a) for a in ctx.saved_tensors)
        sums_h, sums_s, product_h, product_s, hermitian, symmetric, _ = _covariances(
            ctx.shared, lam, C, L
        )
        q_bar = array(bar)
        P = lam.shape[-1]
        C_bar = q_bar.conj() @ hermitian + q_bar @ symmetric.conj()
        # The covariances, summed over outputs.
        hermitian_bar = _transpose(q_bar) @ C
        symmetric_bar = _transpose(q_bar) @ C.conj()
        if not ctx.shared:
            same = np.eye(P)
            hermitian_bar, symmetric_bar = hermitian_bar * same, symmetric_bar * same
        sum_h_bar = hermitian_bar * (product_h / sums_h**2).conj()
        sum_s_bar = symmetric_bar * (product_s / sums_s**2).conj()
        lam_bar = sum_h_bar.sum(-1) + sum_h_bar.conj().sum(-2)
        lam_bar = lam_bar + sum_s_bar.sum(-1) + sum_s_bar.sum(-2)
        product_h_bar = -hermitian_bar / sums_h.conj()
        product_s_bar = -symmetric_bar / sums_s.conj()
        L_bar = product_h_bar @ L + _transpose(product_h_bar.conj()) @ L
        L_bar = L_bar + (product_s_bar + _transpose(product_s_bar)) @ L.conj()
        return (None, *(torch.from_numpy(x).to(bar.device) for x in (lam_bar, C_bar, L_bar)))


class _Propagators(torch.autograd.Function):
    """exp(lambda d) and (exp(lambda d) - 1)/lambda for every step d; poles at zero are fixed."""

    @staticmethod
    def forward(ctx: Any, steps: np.ndarray, poles: Tensor) -> Any:
        lam = array(poles)[:, None, :]
        z = lam * steps[:, None]
        phi = np.exp(z)
        apart = np.where(lam == 0, 1.0, lam)
        gamma = np.where(lam == 0, steps[:, None], np.expm1(z) / apart)
        ctx.arrays = steps, apart, phi, gamma
        return torch.from_numpy(phi).to(poles.device), torch.from_numpy(gamma).to(poles.device)

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> Any:
        steps, apart, phi, gamma = ctx.arrays
        phi_bar, gamma_bar = (array(b) for b in bars)
        moved = steps[:, None] * phi  # derivative of phi, and of lambda gamma
        lam_bar = moved.conj() * phi_bar + ((moved - gamma) / apart).conj() * gamma_bar
        return None, torch.from_numpy(lam_bar.sum(-2)).to(bars[0].device)


def output_covariance(modes: Modes) -> Tensor:
    """Covariance q (*b, n_y, P) of each mode with each output."""
    args, batch = flatten_batch([modes.poles, modes.C, modes.L], [1, 2, 2])
    q = run(_OutputCovariance, (modes.noise == "shared",), *args)
    return q.reshape(batch + q.shape[1:])


def output_rows(modes: Modes) -> tuple[Tensor, Tensor, Tensor]:
    """Rows h, g (*b, n_y, 2P) and variances k0 (*b, n_y) of the semiseparable recursion."""
    q = output_covariance(modes)
    g = torch.cat([q.real, q.imag], dim=-1)
    return output_row(modes), g, 2.0 * (modes.C * q).sum(-1).real


def propagators(modes: Modes, steps: Tensor) -> tuple[Tensor, Tensor]:
    """exp(lambda d) and the held input's gain (exp(lambda d) - 1)/lambda, each (*b, m, P)."""
    (poles,), batch = flatten_batch([modes.poles], [1])
    phi, gamma = run(_Propagators, (array(steps),), poles)
    return phi.reshape(batch + phi.shape[1:]), gamma.reshape(batch + gamma.shape[1:])
