"""A Matern-3/2 process as a linear system: the paper's Example 1."""

import torch

from pyro_dynogp.lti.modes import Modes


def matern32(lengthscale: float, sd: float = 1.0, *, split: float = 1e-4) -> Modes:
    """Build one pair with the covariance of a Matern-3/2 process (the paper's Example 1).

    The Matern-3/2 process has a double real pole at -a, a = sqrt(3)/lengthscale, which no
    diagonal system has exactly. This pair sits at -a +- i split a; its normalised covariance
    differs from exp(-a tau) (1 + a tau) by less than split^2 + 1e-15/split^2, the second part
    being rounding: 1e-4 is near the best.

    Args:
        lengthscale: l [s]. sd: standard deviation of the process [output].
        split: imaginary part of the poles relative to a; the gains grow as 1/split.

    Returns:
        White noise of intensity 12 sqrt(3)/l^3 sd^2 through 1/(s + a)^2, nearly. (Example 1 prints
        36/l^3, with which the variance is sqrt(3) sd^2.)
    """
    a = 3.0**0.5 / lengthscale
    omega = split * a
    # c L exp(lambda t) + conjugate = q exp(-a t) sin(omega t)/omega, the smooth double-pole filter;
    # q makes the stationary variance q^2 / (4 a (a^2 + omega^2)) equal to sd^2.
    q = sd * (4.0 * a * (a * a + omega * omega)) ** 0.5
    return Modes(
        poles=torch.tensor([complex(-a, omega)], dtype=torch.complex128),
        output_gain=torch.tensor([complex(0.0, -0.5 * q / omega)], dtype=torch.complex128),
        noise_gain=torch.ones(1, 1, dtype=torch.complex128),
    )
