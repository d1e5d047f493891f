"""Held inputs that arrive later, as differentiable functions of the delay.

A held input u is constant from each time t_k to the next. Delayed by d it changes between the
samples. On an even clock, d = (j + f) steps, a step has u_{k-j-1} for its first part f and then
u_{k-j}; a state with the pole lambda, z = lambda step, goes on by

    x_{k+1} = e^z x_k + gamma B (u_{k-j} + w (u_{k-j-1} - u_{k-j})),     gamma = (e^z - 1) / lambda,
    w(z, f) = (1 - e^{-z f}) / (1 - e^{-z}),

exactly (`moved_share`; the sampled model with a fractional delay of Astrom & Wittenmark, Computer-
Controlled Systems, 3rd ed., section 2.3, in modal form). For a pole that is slow beside a step w is
f, and the two are one input, the mean over the step

    v_k = (I(t_{k+1} - d) - I(t_k - d)) / (t_{k+1} - t_k),      I(t) = integral of u up to t,

which is right for the integral of the input at any steps (`delayed`). What it leaves of a change of
the input is of second order, f (1 - f) z^2 / 2 of the response, and nothing at whole steps. Where
steps differ, what the state takes up from one sample to the next follows from the state x(t) that
the input would cause without the delay (`equivalent_inputs`):

    m_k = (x(t_{k+1} - d) - e^{lambda s} x(t_k - d)) / (gamma B),      s = t_{k+1} - t_k.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.response import mean_response


def delayed(u: Tensor, time: Tensor, delay: Tensor) -> Tensor:
    """A held signal, `delay` later: its mean from t_k - delay to t_(k+1) - delay, (*b, n).

    Before the first time the first value is held, after the last one the last; the last step is as
    long as the one before. The result is continuous in the delay and its gradient is exact, at
    whole steps that to the longer side.

    Args:
        u: (n,), constant from each time to the next. time: (n,) increasing [time unit].
        delay: (*b,) [time unit].
    """
    n = len(time)
    if n < 2:
        return u.expand((*delay.shape, n))
    edges = _edges(time)
    # Of what is above the first value: the integral of a large constant would cost digits.
    above = u - u[0]
    area = torch.cat([above.new_zeros(1), torch.cumsum(above * edges.diff(), 0)])
    shifted = edges - delay.unsqueeze(-1)
    place = _places(edges, shifted)
    reached = area[place] + above[place] * (shifted - edges[place])
    return u[0] + reached.diff(dim=-1) / edges.diff()


def _edges(time: Tensor) -> Tensor:
    """Beginnings and ends (n + 1,) of steps since the first time; the last is as the one before."""
    return torch.cat([time, 2.0 * time[-1:] - time[-2:-1]]) - time[0]


def _places(edges: Tensor, at: Tensor) -> Tensor:
    """In which step (0 to n - 1) times are; the first and the last reach on."""
    found = torch.searchsorted(edges, at.detach().contiguous(), right=True) - 1
    return found.clamp(0, len(edges) - 2)


def equivalent_inputs(poles: Tensor, u: Tensor, time: Tensor, delay: Tensor) -> Tensor:
    """What, held over each step, moves a state as the late input does: (*b, n, P), complex.

    Args:
        poles: (*b, P). u: (n,), time: (n,) and delay: (*b,) as of `delayed`, n >= 2.
    """
    edges, P = _edges(time), poles.shape[-1]
    above = u - u[0]
    eye = torch.eye(P, dtype=torch.complex128)
    one = torch.ones(P, 1, dtype=torch.complex128)
    # Outputs that are real and imaginary parts of the states.
    every = Modes(
        poles, one, torch.cat([0.5 * eye, -0.5j * eye]).expand(*poles.shape[:-1], 2 * P, P)
    )
    parts = mean_response(every, time, above.unsqueeze(-1)).output
    states = torch.complex(parts[..., :P], parts[..., P:])  # (*b, n, P)
    shifted = edges - delay.unsqueeze(-1)
    place = _places(edges, shifted)
    rest = (shifted - edges[place]).clamp_min(0.0).unsqueeze(-1)
    batch = torch.broadcast_shapes(states.shape[:-2], place.shape[:-1])
    index = place.expand((*batch, place.shape[-1])).unsqueeze(-1).expand((*batch, -1, P))
    before = torch.gather(states.expand((*batch, *states.shape[-2:])), -2, index)
    lam = poles.unsqueeze(-2)
    there = (lam * rest).exp() * before + _gain(lam, rest) * above[place].unsqueeze(-1)
    step = edges.diff().unsqueeze(-1)
    taken = there[..., 1:, :] - (lam * step).exp() * there[..., :-1, :]
    return u[0] + taken / _gain(lam, step)


def _gain(lam: Tensor, step: Tensor) -> Tensor:
    """(exp(lambda s) - 1) / lambda, s where lambda is zero."""
    z = lam * step
    near = z.abs() < CLOSE
    far = torch.where(near, torch.ones_like(z), z)
    series = 1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0 * (1.0 + z / 5.0)))
    return step * torch.where(near, series, (far.exp() - 1.0) / far)


# |z| below which the share is a series: what it leaves out is below 1e-11. Decay in a step beyond
# which nothing is left of its first part.
NEAR, GONE = 1e-3, -30.0
# The same of (e^z - 1) / z.
CLOSE = 1e-2


def moved_share(z: Tensor, share: Tensor) -> Tensor:
    """w(z, f) (*b, P), complex: what a part f of a step counts, at its beginning, in the state.

    Args:
        z: (*b, P) poles times the step, real parts not above 0. share: f (*b,), from 0 to 1.
    """
    z = torch.complex(z.real.clamp_min(GONE), z.imag)
    f = share.unsqueeze(-1)
    near = z.abs() < NEAR
    far = torch.where(near, torch.ones_like(z), z)
    exact = (1.0 - torch.exp(-far * f)) / (1.0 - torch.exp(-far))
    rest = 1.0 - f
    series = f * (1.0 + 0.5 * z * rest * (1.0 + z * (1.0 - 2.0 * f) / 6.0))
    return torch.where(near, series, exact)
