"""The public ways to make a model: one linear layer, the paper's architectures, any cascade."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

from gpytorch.kernels import Kernel

from pyro_dynogp.layers.noise import Gaussian, Likelihood
from pyro_dynogp.lti.modes import NoiseStructure
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.structure import ModelOptions
from pyro_dynogp.models.wiring import Dynamic, Layer, Static
from pyro_dynogp.support.errors import COUNT, verify


def LinearDynamicGP(
    inputs: int,
    *,
    outputs: int = 1,
    pairs: int = 5,
    noise: NoiseStructure = "shared",
    brownian: int | None = None,
    feedthrough: bool = True,
    process_noise: bool = True,
    integrators: int = 0,
    likelihood: Likelihood | None = None,
    **options: Unpack[ModelOptions],
) -> Model:
    """Output = stochastic LTI system driven by the inputs + offset + measurement noise.

    The trajectory is integrated out, under Gaussian noise exactly: the observed site ``y`` carries
    the marginal likelihood.

    Args:
        inputs: n_u, may be 0, those that channels make included. outputs: n_y.
        pairs: P, the number of conjugate pairs (order 2P).
        noise: "shared" (one set of Brownian motions drives all pairs) or "independent".
        brownian: n_l, number of Brownian motions; by default n_y.
        feedthrough: whether the input acts on the output at once.
        process_noise: whether there is any.
        integrators: 1 for a pole at zero beside the pairs, one for each output: of a plant that
            integrates its input (a level, a position, a charge).
        likelihood: Gaussian by default.
        options: of `Model`: initial_state, priors, direct, channels, scaling.

    Raises:
        ValueError: on numbers below the least that makes sense, or unknown options.

    Examples:
        >>> model = dgp.LinearDynamicGP(inputs=2, outputs=1, pairs=3)
        >>> model.inputs, model.layers[0].pairs
        (2, 3)
    """
    layer = Dynamic(
        outputs=outputs,
        pairs=pairs,
        noise=noise,
        brownian=brownian,
        feedthrough=feedthrough,
        process_noise=process_noise,
        integrators=integrators,
    )
    options = {"integrate": "all", **options}
    return Model(inputs, (layer,), likelihood or Gaussian(), **options)


def Cascade(
    inputs: int,
    layers: Sequence[Layer],
    likelihood: Likelihood | None = None,
    **options: Unpack[ModelOptions],
) -> Model:
    """Dynamic and static layers in any order, whose trajectories are sample sites.

    Args:
        inputs: n_u, may be 0; those that channels make included.
        layers: `Dynamic` and `Static` layers, first to last.
        likelihood: `Gaussian()` by default, `StudentT(...)` or `Heteroscedastic(...)`.
        options: of `Model`: initial_state, integrate ("all" with feedback), priors, direct,
            channels, scaling, output.

    Raises:
        ValueError: on layers that do not fit together, or unknown options.

    Examples:
        >>> layers = (dgp.Dynamic(pairs=2), dgp.Static(inducing=8))
        >>> model = dgp.Cascade(1, layers, dgp.StudentT(4))
        >>> [wire.name for wire in model.wires]
        ['g', 'f']
    """
    if any(getattr(layer, "feedback", ()) for layer in layers or ()):
        options = {"integrate": "all", **options}
    return Model(inputs, layers, likelihood or Gaussian(), **options)  # type: ignore[arg-type]


def Wiener(
    inputs: int,
    *,
    outputs: int = 1,
    pairs: int = 5,
    inducing: int = 32,
    kernel: Kernel | None = None,
    process_noise: bool = True,
    likelihood: Likelihood | None = None,
    **options: Unpack[ModelOptions],
) -> Model:
    """Linear dynamics g, then a static nonlinearity f: a sensor that is not linear.

    Args:
        inputs: n_u. outputs: n_y; g has as many.
        pairs: conjugate pairs P of g. inducing: inducing values of f.
        kernel: of f, a gpytorch kernel; Matern-3/2 by default.
        process_noise: whether g has any.
        likelihood: Gaussian by default.
        options: of `Model`: initial_state, integrate, priors, direct, channels, scaling.

    Examples:
        >>> model = dgp.Wiener(inputs=1, pairs=2, inducing=16)
        >>> [wire.sources for wire in model.wires]
        [('inputs',), ('g',)]
    """
    layers = (
        Dynamic(outputs=outputs, pairs=pairs, process_noise=process_noise),
        Static(outputs=outputs, inducing=inducing, kernel=kernel),
    )
    return Model(inputs, layers, likelihood or Gaussian(), **options)


def Hammerstein(
    inputs: int,
    *,
    outputs: int = 1,
    pairs: int = 5,
    inducing: int = 32,
    kernel: Kernel | None = None,
    process_noise: bool = True,
    likelihood: Likelihood | None = None,
    **options: Unpack[ModelOptions],
) -> Model:
    """A static nonlinearity f of the inputs, then linear dynamics g: a nonlinear actuator.

    Arguments are those of `Wiener`; f has one output for each input.

    Examples:
        >>> [wire.name for wire in dgp.Hammerstein(inputs=1, pairs=2).wires]
        ['f', 'g']
    """
    verify(inputs=inputs)
    layers = (
        Static(outputs=max(inputs, 1), inducing=inducing, kernel=kernel),
        Dynamic(outputs=outputs, pairs=pairs, process_noise=process_noise),
    )
    return Model(inputs, layers, likelihood or Gaussian(), **options)


def WienerHammerstein(
    inputs: int,
    *,
    outputs: int = 1,
    pairs: int | tuple[int, int] = 5,
    inducing: int = 32,
    kernel: Kernel | None = None,
    width: int = 1,
    process_noise: bool | tuple[bool, bool] = True,
    likelihood: Likelihood | None = None,
    **options: Unpack[ModelOptions],
) -> Model:
    """Linear dynamics g1, a static nonlinearity f, linear dynamics g2.

    Arguments are those of `Wiener`, but for

    Args:
        pairs: for both dynamic layers, or for each.
        width: the number of signals between the layers.
        process_noise: for both dynamic layers, or for each.

    Examples:
        >>> [wire.name for wire in dgp.WienerHammerstein(inputs=1, pairs=(2, 1)).wires]
        ['g1', 'f', 'g2']
    """
    verify(width=width)
    first, second = pairs if isinstance(pairs, tuple) else (pairs, pairs)
    noise = process_noise if isinstance(process_noise, tuple) else (process_noise,) * 2
    layers = (
        Dynamic(outputs=width, pairs=first, process_noise=noise[0]),
        Static(outputs=width, inducing=inducing, kernel=kernel),
        Dynamic(outputs=outputs, pairs=second, process_noise=noise[1]),
    )
    return Model(inputs, layers, likelihood or Gaussian(), **options)


def ParallelWienerHammerstein(
    inputs: int,
    *,
    branches: int = 2,
    outputs: int = 1,
    pairs: int | tuple[int, int] = 2,
    inducing: int = 32,
    kernel: Kernel | None = None,
    process_noise: bool | tuple[bool, bool] = True,
    likelihood: Likelihood | None = None,
    **options: Unpack[ModelOptions],
) -> Model:
    """Branches side by side, dynamics g1 and a function f1 of it, g2 and f2, ...; then dynamics.

    The last dynamics see all branches, each with gains of its own: with enough pairs they are the
    sum of different dynamics for each branch.

    Arguments are those of `WienerHammerstein`, but for

    Args:
        branches: their number.
        pairs: those of each first layer, or of these and the last one, which has `branches` times
            as many by default.

    Examples:
        >>> [wire.sources for wire in dgp.ParallelWienerHammerstein(1).wires]
        [('inputs',), ('g1',), ('inputs',), ('g2',), ('f1', 'f2')]
    """
    COUNT.check("branches", branches)
    first, second = pairs if isinstance(pairs, tuple) else (pairs, pairs)
    noise = process_noise if isinstance(process_noise, tuple) else (process_noise,) * 2
    layers: list[Layer] = []
    for _ in range(branches):
        layers.append(Dynamic(pairs=first, process_noise=noise[0], sees=("inputs",)))
        layers.append(Static(inducing=inducing, kernel=kernel))
    seen = tuple(f"f{branch + 1}" for branch in range(branches)) if branches > 1 else ("f",)
    layers.append(
        Dynamic(outputs=outputs, pairs=branches * second, process_noise=noise[1], sees=seen)
    )
    return Model(inputs, tuple(layers), likelihood or Gaussian(), **options)


def HammersteinWiener(
    inputs: int,
    *,
    outputs: int = 1,
    pairs: int = 5,
    inducing: int | tuple[int, int] = 32,
    kernel: Kernel | None = None,
    process_noise: bool = True,
    likelihood: Likelihood | None = None,
    **options: Unpack[ModelOptions],
) -> Model:
    """A static nonlinearity f1 of the inputs, linear dynamics g, a static nonlinearity f2.

    Arguments are those of `Wiener`; inducing for both static layers or for each.

    Examples:
        >>> [wire.name for wire in dgp.HammersteinWiener(inputs=1, pairs=2).wires]
        ['f1', 'g', 'f2']
    """
    first, second = inducing if isinstance(inducing, tuple) else (inducing, inducing)
    verify(inputs=inputs)
    layers = (
        Static(outputs=max(inputs, 1), inducing=first, kernel=kernel),
        Dynamic(outputs=outputs, pairs=pairs, process_noise=process_noise),
        Static(outputs=outputs, inducing=second, kernel=kernel),
    )
    return Model(inputs, layers, likelihood or Gaussian(), **options)
