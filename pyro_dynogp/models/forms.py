"""Parametric forms of static functions: a step, a root, an edge, a cube, a hysteresis.

Each is a `Known` layer with at most two parameters, for what plants often have in feedback.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Literal

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.nn.functional import softplus

from pyro_dynogp.data.channels import Channel
from pyro_dynogp.models.arrival import free_delays
from pyro_dynogp.models.layer import HIDDEN, Dynamic, Known, Layer
from pyro_dynogp.models.product import is_product
from pyro_dynogp.models.selection import each_channel
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping

# Of the logarithm of a width in standard deviations of the signal: most from 0.02 to 1.
WIDTH, SPREAD = -2.0, 1.0
# Standard deviations of the signal over which a root is rounded where it begins, and its square
# there: roots have no slope at zero.
ROUNDED, LEAST = 0.1, 1e-4
# Where a root begins, and an edge lies, by their priors: levels are mostly above the one, and
# seldom above the other.
BEGINS, LEVEL = -2.0, 1.0
# Of the second part of a hysteresis in the first, by its prior.
SHARE = 0.5
FormName = Literal["step", "root", "edge", "cube", "hysteresis"]
# Mean of the absolute value of a standard normal number.
MEAN_SIZE = math.sqrt(2.0 / math.pi)
# Parts of each interval between samples in which feedback with a form is computed anew by default.
SUBSTEPS = 3


def usual_substeps(channels: Sequence[Channel], *, forms: bool) -> int:
    """Parts of each interval where a form is in feedback; one beside free dead times."""
    return SUBSTEPS if forms and not free_delays(channels) else 1


def step(x: Tensor, at: Tensor, width: Tensor) -> Tensor:
    """tanh((x - at) / width)."""
    return ((x - at) / width).tanh()


def root(x: Tensor, at: Tensor) -> Tensor:
    """sqrt(x - at), rounded where it begins, and zero below."""
    return (ROUNDED * softplus((x - at) / ROUNDED) + LEAST).sqrt()


def edge(x: Tensor, at: Tensor, width: Tensor) -> Tensor:
    """The part of x above `at`, rounded over the width."""
    return width * softplus((x - at) / width)


def cube(x: Tensor, at: Tensor) -> Tensor:
    """(x - at)^3."""
    return (x - at) ** 3


def hysteresis(v: Tensor, w: Tensor, share: Tensor) -> Tensor:
    """(|v| - c) w + share v (|w| - c), with c = sqrt(2 / pi)."""
    return (v.abs() - MEAN_SIZE) * w + share * v * (w.abs() - MEAN_SIZE)


class _Priors(FrozenMapping[str, dist.Distribution]):
    """The same object in copies and in other processes: distributions are equal to themselves."""

    def __init__(self, name: str, items: Mapping[str, dist.Distribution]) -> None:
        super().__init__(items)
        self.name = name

    def __reduce__(self) -> str:
        return self.name

    def __deepcopy__(self, memo: dict[int, object]) -> _Priors:
        return self


def _normal(mean: float) -> dist.Distribution:
    return dist.Normal(_number(mean), _number(1.0))


def _width() -> dist.Distribution:
    return dist.LogNormal(_number(WIDTH), _number(SPREAD))


def _number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


STEP = _Priors("STEP", {"at": _normal(0.0), "width": _width()})
ROOT = _Priors("ROOT", {"at": _normal(BEGINS)})
HYSTERESIS = _Priors("HYSTERESIS", {"share": _normal(SHARE)})
CUBE = _Priors("CUBE", {"at": _normal(0.0)})
EDGE = _Priors("EDGE", {"at": _normal(LEVEL), "width": _width()})
# Function and priors of each form.
FORMS: Mapping[FormName, tuple[Callable[..., Tensor], _Priors]] = MappingProxyType(
    {
        "step": (step, STEP),
        "root": (root, ROOT),
        "edge": (edge, EDGE),
        "cube": (cube, CUBE),
        "hysteresis": (hysteresis, HYSTERESIS),
    }
)
OF_ONE_SIGNAL: tuple[FormName, ...] = tuple(name for name in FORMS if name != "hysteresis")


def Form(
    form: FormName,
    *,
    skip: tuple[str, ...] = (),
    sees: tuple[str, ...] = (),
    name: str | None = None,
) -> Known:
    r"""A static layer of one signal x, or of two, whose function has a given form.

    - "step": tanh((x - at) / width). In feedback Coulomb's friction, where x is a velocity.
    - "root": the square root of x - at, zero below. The outflow of a tank by Torricelli's law,
      where x is a level; the flow through a valve, where x is a pressure. It is
      sqrt(r(x - at) + 1e-4), r(z) = 0.1 log(1 + exp(z / 0.1)), and so has a slope everywhere.
    - "edge": x - at, zero below; width log(1 + exp((x - at) / width)). What flows over the edge of
      a tank, a stop that a mass hits, a valve that opens.
    - "cube": (x - at)^3, which contains a square. A spring that hardens or softens.
    - "hysteresis", of two signals v and w: (\|v\| - c) w + share v (\|w\| - c), c = sqrt(2 / pi),
      which contains no line where both are standard normal. In feedback of hidden signals that are
      a velocity and a force it makes the Bouc-Wen model, w' = a v - b \|v\| w - d v \|w\|, where
      share is d / b: a spring or a magnet whose force depends on its past.

    A Gaussian process of one signal can take the same shapes, but needs many inducing values for an
    edge, has to learn from the data where a function bends, and keeps its value beyond them. The
    gains of the layer that sees a form are its size and sign.

    Sites: ``<layer>_at``, normal with mean 0 (step, cube), -2 (root) or 1 (edge) and standard
    deviation 1; ``<layer>_width``, LogNormal(-2, 1), of a step and of an edge;
    ``<layer>_share``, normal with mean 0.5 and standard deviation 1, of a hysteresis. Inputs and
    the output are seen as standard deviations from their mean, signals of dynamics as they are.

    Args:
        form: "step", "root", "edge", "cube" or "hysteresis".
        skip: names of earlier signals that the layer sees too. sees: those that it sees instead.
        name: prefix of its sites; f, or f1, f2, ... by default.

    Returns:
        A `Known` layer, which unlike others can be saved.

    Raises:
        ValueError: on an unknown form.

    Source of the Bouc-Wen model: Y.-K. Wen, Method for random vibration of hysteretic systems,
    Journal of the Engineering Mechanics Division 102, 1976.

    Examples:
        >>> sorted(dgp.Form("edge", sees=("g_hidden",)).parameters)
        ['at', 'width']
        >>> mass = dgp.Dynamic(pairs=2, hidden=2, feedback=("past",), name="mass")
        >>> past = dgp.Form("hysteresis", sees=("mass_hidden",), name="past")
        >>> [wire.name for wire in dgp.Cascade(1, (mass, past), output="mass").wires]
        ['mass', 'past']
    """
    if not isinstance(form, str) or form not in FORMS:
        expected = ", ".join(repr(known) for known in FORMS)
        raise invalid("form", expected=f"one of {expected}", got=repr(form))
    function, priors = FORMS[form]
    # Compiled as it is: it has no table, which would end.
    ends = (-math.inf, math.inf) if form == "hysteresis" else None
    return Known(function, priors, range=ends, scaled=True, skip=skip, sees=sees, name=name)


def forms_of(name: str, *, outputs: int = 1, hidden: int = 0) -> list[Known]:
    """The forms that a dynamic layer usually has in feedback.

    A root and an edge of each output, and of each hidden signal; a step of each of the latter, or
    of the outputs where there is no other signal. No cube: where there is none in the plant it
    grows beyond the data (a motor with friction: held-out data were 222 nats less probable with
    one).

    Args:
        name: of the layer. outputs, hidden: how many outputs and hidden signals it has.
    """
    signals = signals_of(name, outputs=outputs, hidden=hidden)
    seen: list[tuple[str, FormName]] = [(x, form) for x in signals for form in ("root", "edge")]
    stepped = signals_of(name, outputs=0 if hidden else outputs, hidden=hidden)
    seen += [(x, "step") for x in stepped]
    return [Form(form, sees=(signals[x],), name=f"{x}_{form}") for x, form in seen]


def each_form(form: FormName, name: str, *, outputs: int = 0, hidden: int = 0) -> list[Known]:
    """The same form of each output and hidden signal of a dynamic layer of that name."""
    signals = signals_of(name, outputs=outputs, hidden=hidden)
    return [Form(form, sees=(seen,), name=f"{form}_of_{x}") for x, seen in signals.items()]


def signals_of(name: str, *, outputs: int, hidden: int) -> dict[str, str]:
    """Signals of a dynamic layer, of one channel each, by labels for functions of them.

    No label begins with the name of the layer, as its sites do.
    """
    own = each_channel("output", name, outputs)
    return own | each_channel("hidden", name + HIDDEN, hidden)


def form_of(layer: Layer) -> FormName | None:
    """The form of a layer that `Form` makes, else None."""
    if not isinstance(layer, Known):
        return None
    return next((form for form, (f, _) in FORMS.items() if layer.function is f), None)


def have_no_place(layers: Sequence[Layer]) -> bool:
    """Whether functions have no place, beside signals of dynamics that nothing measures.

    Smooth functions, a hysteresis and products of such signals have none; a step, a root and an
    edge lie somewhere.
    """
    hidden = any(isinstance(layer, Dynamic) and layer.hidden for layer in layers)
    known = [layer for layer in layers if isinstance(layer, Known)]
    return hidden and all(
        layer.function is hysteresis or (is_product(layer) and layer.sees[0].endswith(HIDDEN))
        for layer in known
    )
