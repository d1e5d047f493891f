"""Static functions as the moment-matching filter takes them.

A function of one channel is a table of its moments, one of several is weights of a radial kernel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pyro_dynogp.layers.functions import StaticFunction, even_grid
from pyro_dynogp.models.forms import MEAN_SIZE, hysteresis
from pyro_dynogp.models.known import KnownFunction
from pyro_dynogp.models.product import Products
from pyro_dynogp.moments.functions import HYSTERESIS, KERNELS, PRODUCT, TABLE
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import broadcast

# Points of the table of a static function of one channel.
GRID = 801


@dataclass(frozen=True, eq=False)
class Block:
    """One static function inside the filter: its inputs, and how it is evaluated.

    ends: range of the table of a function of one channel, beyond which it keeps its value; None for
        one that reaches to where the function is back at its prior mean.
    """

    rows: Tensor
    known: Tensor
    function: StaticFunction | KnownFunction | None  # None: the identity
    with_variance: bool
    ends: tuple[Tensor, Tensor] | None = None

    @property
    def channels(self) -> int:
        """Inputs of the function."""
        return int(self.rows.shape[-2])

    @property
    def outputs(self) -> int:
        """Outputs of the function."""
        return self.channels if self.function is None else self.function.outputs

    @property
    def is_linear(self) -> bool:
        """Whether it is linear in what is random: products whose first signals are known."""
        function = self.function
        if not (isinstance(function, KnownFunction) and isinstance(function.function, Products)):
            return False
        return not bool((self.rows[..., : function.function.first, :] != 0.0).any())

    @property
    def order(self) -> Sequence[int]:
        """Places of its inputs as the filter has them: quadrature goes channel by channel."""
        order = self.function.order if isinstance(self.function, StaticFunction) else None
        return range(self.channels) if order is None else order


def functions_of(blocks: Sequence[Block]) -> tuple[list[int], dict[str, Tensor]]:
    """Form of each static function, and the tensors that `Values` keeps of it."""
    widest = max((b.channels for b in blocks), default=1)
    radial = [
        b.function for b in blocks if isinstance(b.function, StaticFunction) and b.channels > 1
    ]
    M = max((f.whitened.shape[-1] for f in radial), default=1)
    forms: list[int] = []
    columns: dict[str, list[Tensor]] = {}
    for block in blocks:
        form, values = _function(block, M, widest)
        forms.append(form)
        for name, value in values.items():
            columns.setdefault(name, []).append(value)
    if not blocks:
        return [], {name: torch.zeros(shape, dtype=torch.float64) for name, shape in _EMPTY.items()}
    joined = {}
    for name, parts in columns.items():
        event = len(_EMPTY[name])
        batch = broadcast(*(p.shape[: p.dim() - event] for p in parts))
        joined[name] = torch.cat(
            [p.expand(batch + p.shape[p.dim() - event :]) for p in parts], -event
        )
    return forms, joined


# Shapes without any static layer; all are joined along the first of these dimensions.
_EMPTY: dict[str, tuple[int, ...]] = {
    "table_mean": (0, 4),
    "table_variance": (0, 4),
    "low": (0,),
    "spacing": (0,),
    "weight": (0, 1),
    "Z": (0, 1, 1),
    "inverse": (0, 1),
    "constant": (0,),
    "slope": (0, 1),
}


def _function(block: Block, M: int, widest: int) -> tuple[int, dict[str, Tensor]]:
    d, e = block.channels, block.outputs

    def zeros(*shape: int) -> Tensor:
        return torch.zeros(shape, dtype=torch.float64)

    values = {
        "table_mean": zeros(e, GRID),
        "table_variance": zeros(e, GRID),
        "low": zeros(1),
        "spacing": zeros(1) + 1.0,
        "weight": zeros(e, M),
        "Z": zeros(1, M, widest),
        "inverse": zeros(1, widest),
        "constant": zeros(e),
        "slope": zeros(e, widest),
    }
    function = block.function
    if function is None:
        values["slope"] = torch.eye(d, widest, dtype=torch.float64)
        return KERNELS["rbf"], values
    if isinstance(function, KnownFunction) and isinstance(function.function, Products):
        return PRODUCT + function.function.first, values | _shifted(function, widest)
    if isinstance(function, KnownFunction) and function.function is hysteresis:
        return HYSTERESIS, values | _hysteretic(function, M, widest)
    if isinstance(function, KnownFunction):
        if d > 1:
            raise invalid(
                f"layer {function.name!r}",
                expected="one signal for a known function of what is integrated out",
                got=f"{d} signals",
            )
        low, high = function.scaled_ends
        values["table_mean"] = function.table(GRID).mT
        values["low"] = low.unsqueeze(-1)
        values["spacing"] = ((high - low) / (GRID - 1)).unsqueeze(-1)
        return TABLE, values
    if d == 1:
        low, high = block.ends or table_range(function)
        points = even_grid(low, high, GRID).unsqueeze(-1)
        if block.with_variance:
            mean, variance = function.moments(points)
            values["table_variance"] = variance.mT
        else:
            mean = function.mean(points)
        values["table_mean"] = mean.mT
        values["low"] = low.unsqueeze(-1)
        values["spacing"] = ((high - low) / (GRID - 1)).unsqueeze(-1)
        return TABLE, values
    radial = function.kernel.radial
    if radial is None:
        raise invalid(
            "kernel",
            expected="RBF or Matern (with ARD) for a layer of several channels that is "
            "integrated out",
            got="another kernel",
            advice="Use integrate='none' and another guide ('gauss-markov'), which take any.",
        )
    name, lengthscale = radial
    weight = function.weights
    if function.kernel.radial_variance is not None:
        weight = weight * function.kernel.radial_variance[..., None, None]
    pad = torch.nn.functional.pad
    count = weight.shape[-1]
    values["weight"] = pad(weight, (0, M - count))
    order = list(block.order)
    Z = function.locations[..., order]
    values["Z"] = pad(Z, (0, widest - d, 0, M - count)).unsqueeze(-3)
    values["inverse"] = pad(1.0 / lengthscale[..., order], (0, widest - d)).unsqueeze(-2)
    values["constant"] = function.constant
    if function.slope is not None:
        values["slope"] = pad(function.slope[..., order], (0, widest - d))
    return KERNELS[name], values


def _shifted(function: KnownFunction, widest: int) -> dict[str, Tensor]:
    """What products of signals have beside those of the channels: (s + z)(t + w) = s t + ... ."""
    assert isinstance(function.function, Products)
    first = function.function.first
    shift = function.shift
    s, t = shift[..., :first], shift[..., first:]
    others = t.shape[-1]
    eye = torch.eye(function.channels, widest, dtype=torch.float64)
    slope = [
        t[..., j, None] * eye[i] + s[..., i, None] * eye[first + j]
        for i in range(first)
        for j in range(others)
    ]
    constant = (s.unsqueeze(-1) * t.unsqueeze(-2)).flatten(-2)
    return {"constant": constant, "slope": torch.stack(slope, -2)}


def _hysteretic(function: KnownFunction, M: int, widest: int) -> dict[str, Tensor]:
    """Where a hysteresis has its centre, the share of its second part, and its line."""
    pad = torch.nn.functional.pad
    share = function.parameters["share"]
    s, t = function.shift.unbind(-1)
    slope = torch.stack([share, torch.ones_like(share)], -1).unsqueeze(-2)
    Z = pad(-function.shift, (0, widest - function.channels)).unsqueeze(-2)
    return {
        "Z": pad(Z, (0, 0, 0, M - 1)).unsqueeze(-3),
        "weight": pad(share[..., None, None], (0, M - 1)),
        "constant": -MEAN_SIZE * (t + share * s).unsqueeze(-1),
        "slope": pad(-MEAN_SIZE * slope, (0, widest - function.channels)),
    }


def inducing_range(function: StaticFunction) -> tuple[Tensor, Tensor]:
    """First and last inducing location (*b) of a function of one channel."""
    z = function.locations.squeeze(-1)
    return z.amin(-1), z.amax(-1)


def table_range(function: StaticFunction) -> tuple[Tensor, Tensor]:
    """Range (*b) of a function's table: where it has inducing points, and well beyond.

    It moves with the parameters, and gradients know: a table that did not would leave steps in the
    likelihood.
    """
    low, high = inducing_range(function)
    margin = 0.5 * (high - low)
    if function.kernel.radial is not None:
        # A function is back at its prior mean within some lengthscales.
        margin = margin + 3.0 * function.kernel.radial[1].squeeze(-1)
    return low - margin, high + margin
