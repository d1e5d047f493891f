"""The same system as an engineer writes it: state space, transfer function, responses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pyro_dynogp.lti.covariance import held_gain, state_covariance, step_noises
from pyro_dynogp.lti.fused import propagators
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.state import real_propagator
from pyro_dynogp.support.tensors import Numbers, as_tensor


@dataclass(frozen=True)
class StateSpace:
    """Real state space dz = A z dt + B u dt + L dbeta, y = C z + D u.

    Attributes:
        A: (*b, 2P, 2P) [1/s]. B: (*b, 2P, n_u). C: (*b, n_y, 2P). D: (*b, n_y, n_u).
        L: (*b, 2P, m), m = n_l Brownian motions if shared, P n_l if independent.
    """

    A: Tensor
    B: Tensor
    C: Tensor
    D: Tensor
    L: Tensor


@dataclass(frozen=True)
class DiscreteStateSpace:
    """Sampled system z[k+1] = A z[k] + B u[k] + w[k], w ~ N(0, Q), y[k] = C z[k] + D u[k].

    Attributes:
        A: (*b, 2P, 2P). B: (*b, 2P, n_u), for an input held constant over the step.
        C: (*b, n_y, 2P). D: (*b, n_y, n_u). Q: (*b, 2P, 2P), exact.
        stationary: (*b, 2P, 2P) stationary covariance of z.
        step: sampling time [s].
    """

    A: Tensor
    B: Tensor
    C: Tensor
    D: Tensor
    Q: Tensor
    stationary: Tensor
    step: float


@dataclass(frozen=True)
class TransferFunction:
    """Rational transfer functions, coefficients of s in falling powers.

    Attributes:
        numerator: (*b, n_y, n_u, 2P + 1). denominator: (*b, 2P + 1), common, leading 1.
    """

    numerator: Tensor
    denominator: Tensor


def real_state_space(modes: Modes) -> StateSpace:
    """Real form with state sqrt(2) [Re x_1, -Im x_1, Re x_2, ...].

    Equation (14) of the paper with one sign mended: C = sqrt(2) [Re c, +Im c]; with the printed
    minus the real and the complex system have different outputs.
    """
    lam = modes.poles
    blocks = torch.stack(
        [torch.stack([lam.real, lam.imag], -1), torch.stack([-lam.imag, lam.real], -1)], -2
    )
    P = modes.pairs
    A = torch.zeros(*lam.shape[:-1], P, 2, P, 2, dtype=torch.float64, device=lam.device)
    index = torch.arange(P, device=lam.device)
    A[..., index, :, index, :] = blocks.movedim(-3, 0)
    root = 2.0**0.5

    def stack(gain: Tensor) -> Tensor:
        return root * torch.stack([gain.real, -gain.imag], -2).flatten(-3, -2)

    C = root * torch.stack([modes.C.real, modes.C.imag], -1).flatten(-2)
    noise = modes.L if modes.noise == "shared" else _separate(modes.L)
    return StateSpace(A.flatten(-4, -3).flatten(-2), stack(modes.B), C, modes.D, stack(noise))


def _separate(L: Tensor) -> Tensor:
    """Independent noise as one wide noise gain (*b, P, P n_l), a block of columns per pair."""
    P = L.shape[-2]
    eye = torch.eye(P, dtype=L.dtype, device=L.device)
    return (L.unsqueeze(-2) * eye.unsqueeze(-1)).flatten(-2)


def discrete_state_space(modes: Modes, step: float) -> DiscreteStateSpace:
    """Exact sampling at a constant step [s]; state [Re x_1..x_P, Im x_1..x_P]."""
    phi, gamma = propagators(modes, torch.tensor([step], dtype=torch.float64))
    A = real_propagator(phi.squeeze(-2))
    drive = gamma.squeeze(-2).unsqueeze(-1) * modes.B
    return DiscreteStateSpace(
        A=A,
        B=torch.cat([drive.real, drive.imag], -2),
        C=torch.cat([2.0 * modes.C.real, -2.0 * modes.C.imag], -1),
        D=modes.D,
        Q=step_noises(modes, as_tensor([step]))[..., 0, :, :],
        stationary=state_covariance(modes),
        step=float(step),
    )


def _times_monomial(coefficients: Tensor, root: Tensor) -> Tensor:
    """Multiply a polynomial (falling powers) by (s - root)."""
    zero = torch.zeros_like(coefficients[..., :1])
    shifted = torch.cat([coefficients, zero], -1)
    return shifted - root.unsqueeze(-1) * torch.cat([zero, coefficients], -1)


def transfer_function(modes: Modes) -> TransferFunction:
    """Transfer functions from each input to each output over their common denominator."""
    lam = modes.poles
    stacked = torch.cat([lam, lam.conj()], -1)
    residues = modes.C.unsqueeze(-2) * modes.B.mT.unsqueeze(-3)  # *b, n_y, n_u, P
    residues = torch.cat([residues, residues.conj()], -1)

    def product(skip: int | None) -> Tensor:
        out = torch.ones(*lam.shape[:-1], 1, dtype=torch.complex128, device=lam.device)
        for j in range(stacked.shape[-1]):
            if j != skip:
                out = _times_monomial(out, stacked[..., j])
        return out

    denominator = product(None).real
    numerator: Any = 0.0
    for j in range(stacked.shape[-1]):
        others = product(j).unsqueeze(-2).unsqueeze(-2)
        numerator = numerator + (residues[..., j].unsqueeze(-1) * others).real
    padded = torch.nn.functional.pad(numerator, (1, 0))
    feed = modes.D.unsqueeze(-1) * denominator.unsqueeze(-2).unsqueeze(-2)
    return TransferFunction(padded + feed, denominator)


def frequency_response(modes: Modes, omega: Numbers) -> Tensor:
    """G(i omega) (*b, m, n_y, n_u), complex, at angular frequencies omega (m,) [rad/s]."""
    s = 1j * as_tensor(omega, device=modes.poles.device)
    lam = modes.poles.unsqueeze(-2)
    direct = modes.C.unsqueeze(-3) / (s[:, None] - lam).unsqueeze(-2)
    mirrored = modes.C.conj().unsqueeze(-3) / (s[:, None] - lam.conj()).unsqueeze(-2)
    B = modes.B.unsqueeze(-3)
    return direct @ B + mirrored @ B.conj() + modes.D.unsqueeze(-3)


def impulse_response(modes: Modes, time: Numbers) -> Tensor:
    """Response (*b, m, n_y, n_u) [output/(input s)] to a unit impulse at 0, without D delta(t).

    time (m,) [s] is the time since the impulse; the response is zero before it.
    """
    t = as_tensor(time, device=modes.poles.device)
    decay = torch.exp(modes.poles.unsqueeze(-2) * t.clamp_min(0.0).unsqueeze(-1))
    h = 2.0 * ((modes.C.unsqueeze(-3) * decay.unsqueeze(-2)) @ modes.B.unsqueeze(-3)).real
    return torch.where((t < 0)[:, None, None], torch.zeros_like(h), h)


def step_response(modes: Modes, time: Numbers) -> Tensor:
    """Response (*b, m, n_y, n_u) [output/input] to a unit step at 0; time (m,) [s] since it."""
    t = as_tensor(time, device=modes.poles.device)
    lam = modes.poles.unsqueeze(-2)
    grown = held_gain(lam, t.clamp_min(0.0).unsqueeze(-1))
    h = 2.0 * ((modes.C.unsqueeze(-3) * grown.unsqueeze(-2)) @ modes.B.unsqueeze(-3)).real
    h = h + modes.D.unsqueeze(-3)
    return torch.where((t < 0)[:, None, None], torch.zeros_like(h), h)


def steady_state_gain(modes: Modes) -> Tensor:
    """Gain (*b, n_y, n_u) [output/input] for constant inputs."""
    return frequency_response(modes, torch.zeros(1, dtype=torch.float64))[..., 0, :, :].real


def residues(poles: Tensor, numerator: Tensor) -> Tensor:
    """Residue at each pole of (b1 s + b0) / ((s - lambda)(s - conj lambda)).

    Args:
        poles: (*b, P). numerator: (*b, P, n, 2), b1 and b0 last, real.

    Returns:
        (*b, P, n), complex: B with B/(s - lambda) + conj = the section.
    """
    lam = poles.unsqueeze(-1)
    b1, b0 = numerator[..., 0], numerator[..., 1]
    real = 0.5 * b1
    return torch.complex(real, -(0.5 * b0 + real * lam.real) / lam.imag)


def numerators(poles: Tensor, residue: Tensor) -> Tensor:
    """Inverse of `residues`: b1 and b0 (*b, P, n, 2)."""
    b0 = -2.0 * (residue * poles.unsqueeze(-1).conj()).real
    return torch.stack([2.0 * residue.real, b0], -1)
