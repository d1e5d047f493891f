"""The architectures of the paper, ready made."""

from __future__ import annotations

from typing import Any

from pyro_dynogp.layers.noise import Gaussian, Likelihood
from pyro_dynogp.models.model import Cascade
from pyro_dynogp.models.wiring import Dynamic, Static


def Wiener(
    inputs: int,
    *,
    outputs: int = 1,
    pairs: int = 5,
    inducing: int = 32,
    kernel: Any = None,
    process_noise: bool = True,
    likelihood: Likelihood | None = None,
    **options: Any,
) -> Cascade:
    """Linear dynamics g, then a static nonlinearity f: a sensor that is not linear.

    Args:
        inputs: n_u. outputs: n_y; g has as many.
        pairs: conjugate pairs P of g. inducing: inducing values of f.
        kernel: of f, a gpytorch kernel; Matern-3/2 by default.
        process_noise: whether g has any.
        likelihood: Gaussian by default.
        options: of `Cascade`.
    """
    layers = (
        Dynamic(outputs=outputs, pairs=pairs, process_noise=process_noise),
        Static(outputs=outputs, inducing=inducing, kernel=kernel),
    )
    return Cascade(inputs, layers, likelihood or Gaussian(), **options)


def Hammerstein(
    inputs: int,
    *,
    outputs: int = 1,
    pairs: int = 5,
    inducing: int = 32,
    kernel: Any = None,
    process_noise: bool = True,
    likelihood: Likelihood | None = None,
    **options: Any,
) -> Cascade:
    """A static nonlinearity f of the inputs, then linear dynamics g: a nonlinear actuator.

    Args: as those of `Wiener`; f has one output for each input.
    """
    layers = (
        Static(outputs=max(inputs, 1), inducing=inducing, kernel=kernel),
        Dynamic(outputs=outputs, pairs=pairs, process_noise=process_noise),
    )
    return Cascade(inputs, layers, likelihood or Gaussian(), **options)


def WienerHammerstein(
    inputs: int,
    *,
    outputs: int = 1,
    pairs: int | tuple[int, int] = 5,
    inducing: int = 32,
    kernel: Any = None,
    width: int = 1,
    process_noise: bool | tuple[bool, bool] = True,
    likelihood: Likelihood | None = None,
    **options: Any,
) -> Cascade:
    """Linear dynamics g1, a static nonlinearity f, linear dynamics g2.

    Args: as those of `Wiener`; pairs and process_noise for both dynamic layers or for each; width
        is the number of signals between the layers.
    """
    first, second = pairs if isinstance(pairs, tuple) else (pairs, pairs)
    noise = process_noise if isinstance(process_noise, tuple) else (process_noise,) * 2
    layers = (
        Dynamic(outputs=width, pairs=first, process_noise=noise[0]),
        Static(outputs=width, inducing=inducing, kernel=kernel),
        Dynamic(outputs=outputs, pairs=second, process_noise=noise[1]),
    )
    return Cascade(inputs, layers, likelihood or Gaussian(), **options)


def HammersteinWiener(
    inputs: int,
    *,
    outputs: int = 1,
    pairs: int = 5,
    inducing: int | tuple[int, int] = 32,
    kernel: Any = None,
    process_noise: bool = True,
    likelihood: Likelihood | None = None,
    **options: Any,
) -> Cascade:
    """A static nonlinearity f1 of the inputs, linear dynamics g, a static nonlinearity f2.

    Args: as those of `Wiener`; inducing for both static layers or for each.
    """
    first, second = inducing if isinstance(inducing, tuple) else (inducing, inducing)
    layers = (
        Static(outputs=max(inputs, 1), inducing=first, kernel=kernel),
        Dynamic(outputs=outputs, pairs=pairs, process_noise=process_noise),
        Static(outputs=outputs, inducing=second, kernel=kernel),
    )
    return Cascade(inputs, layers, likelihood or Gaussian(), **options)
