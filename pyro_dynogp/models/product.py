"""A static function that multiplies signals: a flow times a temperature, an input times a state."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pyro_dynogp.models.layer import Known, Layer
from pyro_dynogp.support.errors import COUNT


@dataclass(frozen=True)
class Products:
    """Products of signals.

    Attributes:
        first: number of signals that come first, each multiplied with each of the others.
    """

    first: int

    def __call__(self, *signals: Tensor) -> Tensor:
        """Products (*b, n, e), those of the first signal first; (*b, n) for a single one."""
        found = [one * other for one in signals[: self.first] for other in signals[self.first :]]
        return torch.stack(found, -1) if len(found) > 1 else found[0]


def Product(
    first: int = 1,
    others: int = 1,
    *,
    skip: tuple[str, ...] = (),
    sees: tuple[str, ...] = (),
    name: str | None = None,
) -> Known:
    r"""A static layer that multiplies each of the signals that it sees first with each other one.

    f(u, y)_{ij} = u_i y_j. In feedback of inputs and an output it makes a bilinear system,
    x' = A x + B u + sum_ij F_ij u_i y_j: what flows takes heat with it, a brake slows what moves.
    Given the inputs such a system is linear, and the filter exact. Products of signals of dynamics
    are what two species or two reagents, a flux and a current, or two rates of rotation make;
    their mean and variance are exact for up to four signals, and they grow beyond the data.

    Sites: none. The gains of the layer that sees it are the sizes of the products. Inputs and the
    output are seen as standard deviations from their mean, signals of dynamics as they are.

    Source: Mohler, Bilinear Control Processes, 1973, chapter 1.

    Args:
        first: number of signals that come first, inputs for example. others: of those that follow.
        skip: names of earlier signals that the layer sees too. sees: those that it sees instead.
        name: prefix of its signals; f, or f1, f2, ... by default.

    Raises:
        ValueError: where one of the numbers is no whole number of at least one.

    Returns:
        A `Known` layer of first x others outputs, which unlike others can be saved.

    Example:
        >>> mixed = dgp.Dynamic(pairs=1, feedback=("heat",), name="level")
        >>> heat = dgp.Product(2, sees=("inputs", "level"), name="heat")
        >>> dgp.Cascade(2, (mixed, heat), output="level").wires[1].channels
        3
    """
    COUNT.check("first", first)
    COUNT.check("others", others)
    return Known(
        Products(first), outputs=first * others, range=(-math.inf, math.inf), scaled=True,
        skip=skip, sees=sees, name=name,
    )  # fmt: skip


def factors(layer: Layer) -> int:
    """How many signals come first in a layer made by `Product`; zero of any other."""
    function = layer.function if isinstance(layer, Known) else None
    return function.first if isinstance(function, Products) else 0


def is_product(layer: Layer) -> bool:
    """Whether a layer is made by `Product`."""
    return factors(layer) > 0
