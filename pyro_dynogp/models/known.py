r"""Static functions that the user writes: a friction law, the root of a level, a saturation.

With x the signals, scaled, and f the user's function of signals in their units,

    value = (f(shift + scale x; parameters) - centre) / size.

`centre` and `size` bring what goes on to other layers to unit scale.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.layers.functions import even_grid
from pyro_dynogp.layers.sites import Site, Values
from pyro_dynogp.models.forms import form_of
from pyro_dynogp.models.layer import in_double
from pyro_dynogp.models.product import is_product
from pyro_dynogp.models.selection import part, signal_of
from pyro_dynogp.models.structure import Structure
from pyro_dynogp.models.wiring import HIDDEN, INPUTS, Known, Wire
from pyro_dynogp.moments.functions import gauss_hermite
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import as_tensor, broadcast

# Standard deviations of a signal over which a function is looked at.
REACH = 8.0


@dataclass(frozen=True, eq=False)
class KnownFunction:
    """A user's function at values of its parameters.

    Attributes:
        function: f, see `Known`. parameters: (*b,) by name.
        shift: (*b, d), scale: (d,): from scaled signals to those that the function sees.
        ends: (2, d) first and last value of each signal, beyond which the function keeps its value.
        centre, size: (e,), see the module.
        name: what error messages call it.
    """

    function: Callable[..., Tensor]
    parameters: Mapping[str, Tensor]
    shift: Tensor
    scale: Tensor
    ends: Tensor
    centre: Tensor
    size: Tensor
    name: str

    @property
    def channels(self) -> int:
        """Number of signals d."""
        return self.scale.shape[-1]

    @property
    def outputs(self) -> int:
        """Number of outputs e."""
        return self.centre.shape[-1]

    @property
    def batch_shape(self) -> torch.Size:
        """Batch shape *b of the parameters and of the shift."""
        return broadcast(self.shift.shape[:-1], *(p.shape for p in self.parameters.values()))

    @property
    def scaled_ends(self) -> tuple[Tensor, Tensor]:
        """First and last value (*b) of the one signal, scaled."""
        low, high = ((end - self.shift) / self.scale for end in self.ends)
        return low.squeeze(-1), high.squeeze(-1)

    def of(self, x: Tensor) -> Tensor:
        """Values (*b, n, e) at signals (*b, n, d) in their own units."""
        given = {name: value.unsqueeze(-1) for name, value in self.parameters.items()}
        value = self.function(*x.clamp(*self.ends).unbind(-1), **given)
        several = (self.outputs,) if self.outputs > 1 else ()
        batch = broadcast(x.shape[:-2], *(p.shape for p in self.parameters.values()))
        shape = (*batch, x.shape[-2], *several)
        if not isinstance(value, Tensor) or value.dtype != torch.float64:
            got = str(getattr(value, "dtype", type(value).__name__))
            raise invalid(self.name, expected="a function that gives float64 tensors", got=got)
        try:
            value = value.expand(shape)
        except RuntimeError:
            got = f"shape {tuple(value.shape)}"
            raise invalid(self.name, expected=f"values of shape {shape}", got=got) from None
        return ((value if several else value.unsqueeze(-1)) - self.centre) / self.size

    def mean(self, x: Tensor) -> Tensor:
        """Values (*b, n, e) at scaled signals (*b, n, d)."""
        return self.of(self.shift.unsqueeze(-2) + self.scale * x)

    def variance(self, x: Tensor) -> Tensor:
        """Zero (*b, n, e): the function is known."""
        return self.moments(x)[1]

    def moments(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """`mean` and `variance` at scaled signals (*b, n, d)."""
        mean = self.mean(x)
        return mean, torch.zeros_like(mean)

    def table(self, count: int) -> Tensor:
        """Values (*b, count, e) on an even grid from end to end of the one signal."""
        return self.of(even_grid(self.ends[0], self.ends[1], count).mT)


def known_sites(name: str, layer: Known) -> tuple[Site, ...]:
    """Sites of a known function's parameters."""
    return tuple(
        Site(f"{name}_{parameter}", in_double(prior, f"parameters[{parameter!r}]"), (), "free")
        for parameter, prior in layer.parameters.items()
    )


def known_function(
    model: Structure, place: Wire, layer: Known, values: Values, scaling: Scaling
) -> KnownFunction:
    """The function of a known layer at values of the sites.

    Args:
        model: that the layer is in. place, layer: which one. values: of all sites of the model.
        scaling: of the training record.

    Raises:
        ValueError: where the function does not change over the range of its signals, or is not
            finite there, or gives something else than it should.
    """
    widths = {wire.name: wire.layer.outputs for wire in model.wires}
    widths |= {f"{wire.name}{HIDDEN}": layer.hidden for wire, layer in model.dynamic}
    widths[INPUTS] = model.inputs - model.direct
    shifts, scales, middles = [], [], []
    for source in place.sources:
        whole = signal_of(source)
        measured = model.measured_signal in (source, whole)
        own = slice(None) if source == model.measured_signal else part(source, widths[whole])
        if whole == INPUTS:
            scale, middle = scaling.input_scale[own], scaling.input_offset[own]
        elif measured:
            scale, middle = scaling.output_scale[own], scaling.output_offset[own]
        else:
            scale, middle = np.ones(widths[whole])[own], np.zeros(widths[whole])[own]
        if layer.scaled:
            scale, middle = np.ones_like(scale), np.zeros_like(middle)
        scales.append(as_tensor(scale))
        middles.append(as_tensor(middle))
        level = values.get("offset") if measured else None
        shift = middles[-1] if level is None else middles[-1] + scales[-1] * level[..., own]
        shifts.append(shift)
    batch = broadcast(*(shift.shape[:-1] for shift in shifts))
    shift = torch.cat([one.expand(*batch, one.shape[-1]) for one in shifts], -1)
    scale_, middle_ = torch.cat(scales), torch.cat(middles)
    ends = torch.stack([middle_ - REACH * scale_, middle_ + REACH * scale_])
    if layer.range is not None:
        ends = as_tensor(layer.range).unsqueeze(-1).expand(2, place.channels)
    parameters = {name: values[f"{place.name}_{name}"] for name in layer.parameters}
    zero = torch.zeros(layer.outputs, dtype=torch.float64)
    name = f"layer {place.name!r}"
    f = KnownFunction(layer.function, parameters, shift, scale_, ends, zero, zero + 1.0, name)
    if (place.last and layer.scaled) or is_product(layer) or form_of(layer) == "hysteresis":
        return f
    if place.last:
        level, size = as_tensor(scaling.output_offset), as_tensor(scaling.output_scale)
        return replace(f, centre=level, size=size)
    with torch.no_grad():
        sites = known_sites(place.name, layer)
        typical = dict(zip(layer.parameters, map(middle_of, sites), strict=True))
        level, size = _standard(replace(f, shift=middle_, parameters=typical))
    return replace(f, centre=level, size=size)


def _standard(f: KnownFunction) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation (e,) of a function of scaled signals that are standard normal."""
    nodes, weights = (as_tensor(part) for part in gauss_hermite(f.channels))
    value = f.mean(nodes)
    mean = weights @ value
    sd = (weights @ (value - mean).square()).sqrt()
    if not bool((sd > 1e-12 * mean.abs()).all() and sd.isfinite().all()):
        raise invalid(
            f.name,
            expected="a function that is finite and changes over the range of its signals",
            got=f"standard deviation {sd.tolist()} at signals of mean {f.shift.tolist()} and sd "
            f"{f.scale.tolist()}, its parameters in the middle of their priors",
            advice="Inputs and the measured output are in units of the record.",
        )
    return mean, sd


def middle_of(site: Site) -> Tensor:
    """A value in the middle of a prior, always the same.

    `Site.typical` where that is no draw, else the mean, else zero in unconstrained coordinates.
    """
    if isinstance(site.prior, dist.LogNormal | dist.Normal):
        return site.typical()
    mean: Tensor = site.prior.mean
    free = torch.zeros((), dtype=torch.float64)
    constrained: Tensor = torch.distributions.biject_to(site.prior.support)(free)
    return mean if bool(mean.isfinite()) else constrained
