"""What inputs before a record may have left in a linear system, and inputs that act at once."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pyro_dynogp.lti.covariance import real_covariance
from pyro_dynogp.lti.modes import Modes

# Standard deviation of the level of an integrator, or of a real pole in feedback, at the first
# sample: in those of the outputs.
LEVEL = 3.0


def past_input_covariance(modes: Modes, memory: float, inputs: int | None = None) -> Tensor:
    """Covariance (*b, 2P, 2P) of [Re x; Im x] after unknown past inputs of unit variance.

    Each input is taken as the sum of a random constant, which holds the state at -B/lambda, and
    of white noise of intensity 2 memory, as of an input that forgets within `memory` [s]. Only the
    first `inputs` count, where that is given: what a loop feeds back comes from no outside. An
    integrator remembers inputs of all times: its state 2 x has the standard deviation `LEVEL`.
    """
    lam, B = modes.poles, modes.B[..., :inputs]
    integrates = lam == 0
    if bool(integrates.any()):
        lam = torch.where(integrates, -1.0, lam)
        B = B.masked_fill(integrates.unsqueeze(-1), 0.0)
        level = torch.where(integrates, (0.5 * LEVEL) ** 2, 0.0)
        levels = torch.diag_embed(torch.cat([level, torch.zeros_like(level)], -1))
    held = B / lam.unsqueeze(-1)
    hermitian = held @ held.mH - 2.0 * memory * (B @ B.mH) / (
        lam.unsqueeze(-1) + lam.conj().unsqueeze(-2)
    )
    symmetric = held @ held.mT - 2.0 * memory * (B @ B.mT) / (lam.unsqueeze(-1) + lam.unsqueeze(-2))
    covariance = real_covariance(hermitian, symmetric)
    return covariance + levels if bool(integrates.any()) else covariance


def first_levels(modes: Modes) -> Tensor:
    """Covariance (*b, 2P, 2P) of [Re x; Im x] of real poles in feedback: levels 2 x of any past.

    What came back before the record is as unknown as its inputs, and held a level that hardly
    decays by itself: its standard deviation is `LEVEL`, as that of an integrator.
    """
    level = torch.full_like(modes.poles.real, (0.5 * LEVEL) ** 2)
    return torch.diag_embed(torch.cat([level, torch.zeros_like(level)], -1))


def initial_mean(covariance: Tensor, standard: Tensor) -> Tensor:
    """Initial state (*b, P), complex, with the given covariance, from standard normals (*b, 2P)."""
    J = covariance.shape[-1]
    ridge = 1e-9 * covariance.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] + 1e-150
    eye = torch.eye(J, dtype=covariance.dtype)
    root = torch.linalg.cholesky(covariance + ridge * eye)
    x = (root @ standard.unsqueeze(-1)).squeeze(-1)
    return torch.complex(x[..., : J // 2], x[..., J // 2 :])


def with_direct(modes: Modes, weights: Tensor) -> Modes:
    """The system with more inputs, which act on the output alone: weights (*b, n_y, K)."""
    B, D = modes.B, modes.D
    silent = torch.zeros((*B.shape[:-1], weights.shape[-1]), dtype=B.dtype)
    batch = torch.broadcast_shapes(D.shape[:-1], weights.shape[:-1])
    joined = torch.cat([part.expand((*batch, part.shape[-1])) for part in (D, weights)], -1)
    if not modes.several_outputs:
        joined = joined.squeeze(-2)
    return replace(modes, input_gain=torch.cat([B, silent], -1), feedthrough=joined)
