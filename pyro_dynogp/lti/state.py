"""The modal state at one instant: what a record hands over to the next one."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pyro_dynogp.lti.covariance import held_gain, state_covariance, step_noises
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import as_tensor


@dataclass(frozen=True, eq=False)
class ModalState:
    """Gaussian distribution of the modal state x of a system at one time.

    Attributes:
        mean: (*b, P), complex.
        covariance: (*b, 2P, 2P), real: covariance of [Re x; Im x], process noise included. None
            stands for the stationary covariance of the system.
    """

    mean: Tensor
    covariance: Tensor | None = None

    def check(self, pairs: int) -> None:
        """Refuse a state that is not one of a system with P = `pairs` modes.

        Raises:
            ValueError: where the shape of the mean or of the covariance does not fit.
        """
        P, size = self.covariance, (2 * pairs,) * 2
        if self.mean.shape[-1:] != (pairs,) or (P is not None and P.shape[-2:] != size):
            covariance = "None" if P is None else f"shape {tuple(P.shape)}"
            raise invalid(
                "initial_state",
                expected=f"mean (..., {pairs}) and covariance (..., {2 * pairs}, {2 * pairs}) "
                "or None",
                got=f"mean of shape {tuple(self.mean.shape)}, covariance {covariance}",
            )


def real_propagator(phi: Tensor) -> Tensor:
    """The real matrix (*b, 2P, 2P) that multiplies [Re x; Im x] where phi (*b, P) multiplies x."""
    a, b = torch.diag_embed(phi.real), torch.diag_embed(phi.imag)
    return torch.cat([torch.cat([a, -b], -1), torch.cat([b, a], -1)], -2)


def propagate(
    modes: Modes, state: ModalState, step: float, held_input: Tensor | None = None
) -> ModalState:
    """Carry a state over a gap.

    Args:
        modes: the system; its process noise acts during the gap.
        state: distribution at the beginning.
        step: length of the gap [s], not negative.
        held_input: u (*b, n_u), constant over the gap; None for no input.

    Raises:
        ValueError: where step is negative.
    """
    if step < 0:
        raise invalid("step", expected="a length >= 0", got=f"{step}")
    phi = torch.exp(modes.poles * step)
    mean = phi * state.mean
    gain = held_gain(modes.poles, step)
    if held_input is not None and modes.inputs:
        drive = (modes.B @ held_input.to(modes.B.dtype).unsqueeze(-1)).squeeze(-1)
        mean = mean + gain * drive
    if modes.drift is not None:
        mean = mean + gain * modes.drift
    if state.covariance is None:
        return ModalState(mean, state_covariance(modes))
    F = real_propagator(phi)
    noise = step_noises(modes, as_tensor([step]))[..., 0, :, :]
    return ModalState(mean, F @ state.covariance @ F.mT + noise)
