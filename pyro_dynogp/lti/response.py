r"""Mean response: the modal recursion driven by zero-order-hold inputs, exact at any step.

    x[k+1] = exp(lambda d_k) x[k] + (exp(lambda d_k) - 1) / lambda  B u[k],
    m[k]   = 2 Re sum_j c_j x_j[k] + D u[k].

(The paper's Proposition 2 prints u(i d) beside exp(lambda (i - 1) d); a convolution has
u((k - i) d) there, which is what this recursion computes.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from pyro_dynogp.lti.fused import propagators
from pyro_dynogp.lti.grid import TimeGrid, time_grid
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.primitives import array, flatten_batch, run
from pyro_dynogp.support.compiled import OPTIONS
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import Numbers, as_tensor, broadcast, joined


@njit(**OPTIONS)
def _scan(phi, gamma, step, B, c, u, x0):
    """Outputs (b, n, n_y) and modal states (b, n, P) for inputs (b, n, n_u)."""
    batch, n, n_u = u.shape
    P = phi.shape[2]
    n_y = c.shape[1]
    states = np.empty((batch, n, P), dtype=np.complex128)
    y = np.empty((batch, n, n_y))
    x = np.empty(P, dtype=np.complex128)
    for b in range(batch):
        for j in range(P):
            x[j] = x0[b, j]
        for i in range(n):
            k = step[i]
            if k >= 0:
                for j in range(P):
                    v = 0.0j
                    for m in range(n_u):
                        v += B[b, j, m] * u[b, i - 1, m]
                    x[j] = phi[b, k, j] * x[j] + gamma[b, k, j] * v
            for j in range(P):
                states[b, i, j] = x[j]
            for a in range(n_y):
                total = 0.0
                for j in range(P):
                    total += c[b, a, j].real * x[j].real - c[b, a, j].imag * x[j].imag
                y[b, i, a] = 2.0 * total
    return y, states


@njit(**OPTIONS)
def _scan_adjoint(phi, gamma, step, B, c, u, states, y_bar, end_bar):
    """Reverse mode of `_scan`; complex gradients are dL/dRe + i dL/dIm (torch's convention)."""
    batch, n, n_u = u.shape
    P = phi.shape[2]
    n_y = c.shape[1]
    phi_bar = np.zeros_like(phi)
    gamma_bar = np.zeros_like(gamma)
    B_bar = np.zeros_like(B)
    c_bar = np.zeros_like(c)
    u_bar = np.zeros_like(u)
    x0_bar = np.zeros((batch, P), dtype=np.complex128)
    mu = np.empty(P, dtype=np.complex128)
    for b in range(batch):
        for j in range(P):
            mu[j] = end_bar[b, j]
        for i in range(n - 1, -1, -1):
            for a in range(n_y):
                yb = 2.0 * y_bar[b, i, a]
                for j in range(P):
                    mu[j] += np.conj(c[b, a, j]) * yb
                    c_bar[b, a, j] += np.conj(states[b, i, j]) * yb
            k = step[i]
            if k >= 0:
                for j in range(P):
                    v = 0.0j
                    for m in range(n_u):
                        v += B[b, j, m] * u[b, i - 1, m]
                    phi_bar[b, k, j] += mu[j] * np.conj(states[b, i - 1, j])
                    gamma_bar[b, k, j] += mu[j] * np.conj(v)
                    v_bar = np.conj(gamma[b, k, j]) * mu[j]
                    for m in range(n_u):
                        B_bar[b, j, m] += v_bar * u[b, i - 1, m]
                        u_bar[b, i - 1, m] += (
                            v_bar.real * B[b, j, m].real + v_bar.imag * B[b, j, m].imag
                        )
                    mu[j] = np.conj(phi[b, k, j]) * mu[j]
        for j in range(P):
            x0_bar[b, j] = mu[j]
    return phi_bar, gamma_bar, B_bar, c_bar, u_bar, x0_bar


class _Scan(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, step: np.ndarray, *args: Tensor) -> Any:  # phi gamma B c u x0
        arrays = [array(a) for a in args]
        phi, gamma, B, c, u, x0 = arrays
        y, states = _scan(phi, gamma, step, B, c, u, x0)
        ctx.step, ctx.states = step, states
        ctx.save_for_backward(*args)
        like = args[0]
        return (
            torch.from_numpy(y).to(like.device),
            torch.from_numpy(np.ascontiguousarray(states[:, -1])).to(like.device),
        )

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> Any:
        phi, gamma, B, c, u, _ = (array(a) for a in ctx.saved_tensors)
        grads = _scan_adjoint(
            phi, gamma, ctx.step, B, c, u, ctx.states, array(bars[0]), array(bars[1])
        )
        return (None, *(torch.from_numpy(g).to(bars[0].device) for g in grads))


@dataclass(frozen=True)
class Response:
    """Mean response of a system.

    Attributes:
        output: m (*b, n) or (*b, n, n_y) [output].
        state: x (*b, P), complex: the modal state at the last time.
    """

    output: Tensor
    state: Tensor


def mean_response(
    modes: Modes,
    time: Numbers | TimeGrid,
    inputs: Numbers | None = None,
    initial_state: Tensor | None = None,
) -> Response:
    """Response to inputs that are held constant from each sample to the next.

    Args:
        modes: the system, batch shape *b.
        time: (n,) times [s] or a `TimeGrid`; any steps.
        inputs: u (*b, n, n_u) [input]; None for a system without inputs.
        initial_state: x (*b, P), complex, the modal state at time[0]; zero by default.

    Returns:
        The output at every time and the state at the last, ready to go on from there.

    Raises:
        ValueError: where the shape of inputs or initial_state does not fit the system.
    """
    device = modes.poles.device
    grid = time_grid(time).to(device)
    u = as_inputs(modes, grid, inputs)
    x0 = (
        torch.zeros(modes.pairs, dtype=torch.complex128, device=device)
        if initial_state is None
        else as_tensor(initial_state, torch.complex128, device)
    )
    if x0.shape[-1:] != (modes.pairs,):
        raise invalid(
            "initial_state",
            expected=f"shape (..., {modes.pairs}), one number for each pole",
            got=f"shape {tuple(x0.shape)}",
        )
    if (
        initial_state is None and not modes.inputs and modes.drift is None
    ):  # at rest, and nothing moves it
        event = (len(grid), modes.outputs) if modes.several_outputs else (len(grid),)
        batch = broadcast(modes.batch_shape, u.shape[:-2])
        return Response(
            torch.zeros((*batch, *event), dtype=torch.float64, device=device),
            x0.expand((*batch, modes.pairs)),
        )
    phi, gamma = propagators(modes, grid.steps)
    B, driving = modes.B, u
    if modes.drift is not None:  # as an input that is always one
        B = joined([B, modes.drift.unsqueeze(-1)], 2, -1)
        driving = joined([u, torch.ones_like(grid.time).unsqueeze(-1)], 2, -1)
    args = [phi, gamma, B, modes.C, driving, x0]
    flat, batch = flatten_batch(args, [2, 2, 2, 2, 2, 1])
    y, end = run(_Scan, (grid.step_index,), *flat)
    y = y.reshape(batch + y.shape[1:])
    if modes.inputs:
        y = y + u @ modes.D.mT
    return Response(
        y if modes.several_outputs else y.squeeze(-1), end.reshape((*batch, modes.pairs))
    )


def held_states(modes: Modes, time: Numbers | TimeGrid, inputs: Numbers | None) -> np.ndarray:
    """Modal states (n, P), complex, from zero at the first time; no batches, no gradient."""
    grid = time_grid(time)
    u = as_inputs(modes, grid, inputs)
    phi, gamma = propagators(modes, grid.steps)
    zero = torch.zeros(1, modes.pairs, dtype=torch.complex128)
    args = [x.unsqueeze(0) for x in (phi, gamma, modes.B, modes.C, u)]
    phi, gamma, B, C, u = args
    states = _scan(
        array(phi), array(gamma), grid.step_index, array(B), array(C), array(u), array(zero)
    )[1]
    return states[0]


def as_inputs(modes: Modes, grid: TimeGrid, inputs: Numbers | None) -> Tensor:
    """Inputs as a tensor (*b, n, n_u), checked against the system and the time axis."""
    n, n_u = len(grid), modes.inputs
    device = modes.poles.device
    if inputs is None:
        if n_u:
            raise invalid(
                "inputs",
                expected=f"shape (..., {n}, {n_u}): the system has {n_u} inputs",
                got="None",
            )
        return torch.zeros(n, 0, dtype=torch.float64, device=device)
    u = as_tensor(inputs, device=device)
    if u.dim() == 1 and n_u == 1 and u.shape[0] == n:
        u = u.unsqueeze(-1)
    if u.shape[-2:] != (n, n_u):
        raise invalid(
            "inputs",
            expected=f"shape (..., {n}, {n_u}), a row for each time, a column for each input",
            got=f"shape {tuple(u.shape)}",
        )
    if not bool(torch.isfinite(u).all()):
        row = int((~torch.isfinite(u)).any(-1).nonzero()[0][-1])
        raise invalid(
            "inputs",
            expected="finite numbers",
            got=f"NaN or infinity, first in row {row}",
            advice="Inputs must be known at all times: fill the gap, or split the record there.",
        )
    return u


def hold(time: Numbers | TimeGrid, inputs: Tensor, at: Tensor) -> Tensor:
    """Zero-order hold: the inputs (*b, m, n_u) that act at times `at` (m,), all >= time[0]."""
    t = time_grid(time).time
    index = torch.searchsorted(t.contiguous(), at.contiguous(), right=True) - 1
    if bool((index < 0).any()):
        raise invalid(
            "at",
            expected=f"times from {float(t[0])} on, where the input is known",
            got=f"{float(at.min())}",
        )
    return inputs[..., index, :]
