r"""Stationary covariance of a stochastic LTI system in modal form.

The Lyapunov equation of a diagonal system has the solution (paper, Lemma 1)

    E[xi_a xi_b^H] = -L_a L_b^H / (lambda_a + conj lambda_b),
    E[xi_a xi_b^T] = -L_a L_b^T / (lambda_a + lambda_b),

for all pairs a, b with shared noise, and for a = b alone with independent noise; nothing drives
those with a pole at zero, whose covariances are zero. The covariance of
the outputs at lag tau >= 0 is then a sum of damped sinusoids,

    S_ab(tau) = E[y_a(t + tau) y_b(t)] = 2 Re sum_j c_aj q_bj exp(lambda_j tau),
    q_bj = E[xi_j y_b] = sum_i E[xi_j xi_i^H] conj(c_bi) + E[xi_j xi_i^T] c_bi,

and S_ab(-tau) = S_ba(tau). (Proposition 1 of the paper prints other exponents for t' < t, with
which the kernel would not be symmetric.)
"""

from __future__ import annotations

import torch
from torch import Tensor

from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.support.tensors import as_tensor


def modal_covariance(modes: Modes) -> tuple[Tensor, Tensor]:
    """Stationary E[xi xi^H] and E[xi xi^T], each (*b, P, P), complex."""
    lam, L = modes.poles, modes.L
    hermitian = -(L @ L.mH) / apart_from_zero(lam.unsqueeze(-1) + lam.conj().unsqueeze(-2))
    symmetric = -(L @ L.mT) / apart_from_zero(lam.unsqueeze(-1) + lam.unsqueeze(-2))
    if modes.noise == "independent":
        same = torch.eye(modes.pairs, dtype=torch.bool, device=lam.device)
        zero = torch.zeros((), dtype=hermitian.dtype, device=lam.device)
        hermitian = torch.where(same, hermitian, zero)
        symmetric = torch.where(same, symmetric, zero)
    return hermitian, symmetric


def real_covariance(hermitian: Tensor, symmetric: Tensor) -> Tensor:
    """Covariance (*b, 2P, 2P) of [Re xi; Im xi] from E[xi xi^H] and E[xi xi^T]."""
    plus, minus = 0.5 * (symmetric + hermitian), 0.5 * (symmetric - hermitian)
    return torch.cat(
        [
            torch.cat([plus.real, minus.imag], dim=-1),
            torch.cat([plus.imag, -minus.real], dim=-1),
        ],
        dim=-2,
    )


def complex_expm1(z: Tensor) -> Tensor:
    """Compute exp(z) - 1 without cancellation for small complex z."""
    a, b = z.real, z.imag
    half = torch.sin(0.5 * b)
    real = torch.expm1(a) * torch.cos(b) - 2.0 * half * half
    return torch.complex(real, torch.exp(a) * torch.sin(b))


def apart_from_zero(x: Tensor) -> Tensor:
    """One in place of zero: for what has zero in the numerator there, too."""
    return torch.where(x == 0, 1.0, x)


def held_gain(poles: Tensor, step: Tensor | float) -> Tensor:
    """What a held input adds to a state for each unit of B: (exp(lambda s) - 1)/lambda, s at 0."""
    gain = complex_expm1(poles * step) / apart_from_zero(poles)
    return torch.where(poles == 0, step, gain)


def step_noises(modes: Modes, steps: Tensor) -> Tensor:
    """Covariance (*b, m, 2P, 2P) that process noise adds to [Re x; Im x] within each step (m,) [s].

    Equal to P - Phi P Phi' for the stationary P, without its cancellation at short steps.
    """
    lam = modes.poles
    hermitian, symmetric = (x.unsqueeze(-3) for x in modal_covariance(modes))
    sums = lam.unsqueeze(-1) + lam.conj().unsqueeze(-2), lam.unsqueeze(-1) + lam.unsqueeze(-2)
    decays = (complex_expm1(x.unsqueeze(-3) * steps[:, None, None]) for x in sums)
    return real_covariance(-hermitian * next(decays), -symmetric * next(decays))


def state_covariance(modes: Modes) -> Tensor:
    """Stationary covariance (*b, 2P, 2P) of the real state [Re x; Im x] that noise drives."""
    return real_covariance(*modal_covariance(modes))


def state_output_covariance(modes: Modes) -> Tensor:
    """Q (*b, n_y, P), complex: the covariance of each mode with each output."""
    hermitian, symmetric = modal_covariance(modes)
    C = modes.C
    return (hermitian @ C.mH + symmetric @ C.mT).mT


def output_row(modes: Modes) -> Tensor:
    """The real row h (*b, n_y, 2P) with y = h [Re x; Im x]."""
    return torch.cat([2.0 * modes.C.real, -2.0 * modes.C.imag], dim=-1)


def stationary_variance(modes: Modes) -> Tensor:
    """Variance S_aa(0) of each output (*b, n_y), without measurement noise."""
    return 2.0 * (modes.C * state_output_covariance(modes)).sum(-1).real


def observability(modes: Modes, time: Tensor) -> Tensor:
    """Rows (*b, N, 2P) that read the outputs from the state [Re x; Im x] at time[0]."""
    decay = torch.exp(modes.poles.unsqueeze(-2) * (time - time[0]).unsqueeze(-1))
    row = modes.C.unsqueeze(-3) * decay.unsqueeze(-2)  # *b, n, n_y, P
    real = torch.cat([2.0 * row.real, -2.0 * row.imag], dim=-1)
    return real.flatten(-3, -2)


def jitter_variance(modes: Modes, initial_covariance: Tensor | None, relative: float) -> Tensor:
    """Variance (*b, 1) that is added to a noise-free trajectory so that it can be factored."""
    variance = stationary_variance(modes).amax(-1)
    if initial_covariance is not None:
        h = output_row(modes)
        variance = variance + torch.einsum(
            "...ai,...ij,...aj->...a", h, initial_covariance, h
        ).amax(-1)
    tiny = torch.finfo(torch.float64).tiny ** 0.5
    return (relative * variance + tiny).unsqueeze(-1)


def autocovariance(modes: Modes, lag: Tensor) -> Tensor:
    """Covariance of the outputs as a function of lag.

    Args:
        modes: the system.
        lag: tau [s], any shape, any sign.

    Returns:
        S (*b, *lag.shape, n_y, n_y) [output^2] with S[..., a, b] = E[y_a(t + tau) y_b(t)];
        without the last two dimensions for a system with one output.
    """
    lag = as_tensor(lag, device=modes.poles.device)
    flat = lag.reshape(-1)
    weights = modes.C.unsqueeze(-2) * state_output_covariance(modes).unsqueeze(-3)  # a, b, P
    decay = torch.exp(modes.poles.unsqueeze(-2) * flat.abs().unsqueeze(-1))  # *b, m, P
    S = 2.0 * torch.einsum("...abp,...mp->...mab", weights, decay).real
    S = torch.where((flat < 0)[:, None, None], S.mT, S)
    S = S.reshape(S.shape[:-3] + lag.shape + S.shape[-2:])
    return S if modes.several_outputs else S[..., 0, 0]
