"""A static function that steps: friction that changes sign, an edge over which a tank flows."""

from __future__ import annotations

import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.models.layer import Known, Layer
from pyro_dynogp.support.frozen import FrozenMapping

# Of the logarithm of a width in standard deviations of the signal: most from 0.02 to 1.
WIDTH, SPREAD = -2.0, 1.0
# Parts of each interval between samples in which feedback with a step is computed anew by default.
SUBSTEPS = 3


def usual_substeps(*, steps: bool, late: bool) -> int:
    """Parts of each interval where a step is in feedback; one beside free dead times."""
    return SUBSTEPS if steps and not late else 1


def step(x: Tensor, at: Tensor, width: Tensor) -> Tensor:
    """tanh((x - at) / width)."""
    return ((x - at) / width).tanh()


class _Priors(FrozenMapping[str, dist.Distribution]):
    """The same object in copies and in other processes: distributions are equal to themselves."""

    def __reduce__(self) -> str:
        return "PRIORS"

    def __deepcopy__(self, memo: dict[int, object]) -> _Priors:
        return self


def _number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


PRIORS = _Priors(
    {
        "at": dist.Normal(_number(0.0), _number(1.0)),
        "width": dist.LogNormal(_number(WIDTH), _number(SPREAD)),
    }
)


def Step(
    *, skip: tuple[str, ...] = (), sees: tuple[str, ...] = (), name: str | None = None
) -> Known:
    r"""A static layer of one signal that steps from one level to another.

    f(x) = tanh((x - at) / width): what a smooth Gaussian process takes very many inducing values
    for. In feedback beside one it is Coulomb's friction where x is a velocity, an edge over which
    a tank flows where x is a level. The gains of the layer that sees it are its size.

    Sites: ``<layer>_at``, normal(0, 1), and ``<layer>_width``, LogNormal(-2, 1). Inputs and the
    output are seen as standard deviations from their mean, signals of dynamics as they are.

    Args:
        skip: names of earlier signals that the layer sees too. sees: those that it sees instead.
        name: prefix of its sites; f, or f1, f2, ... by default.

    Returns:
        A `Known` layer, which unlike others can be saved.

    Example:
        >>> sorted(Step(sees=("g_hidden",)).parameters)
        ['at', 'width']
    """
    return Known(step, PRIORS, scaled=True, skip=skip, sees=sees, name=name)


def is_step(layer: Layer) -> bool:
    """Whether a layer is made by `Step`."""
    return isinstance(layer, Known) and layer.function is step
