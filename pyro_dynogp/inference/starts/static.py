"""Starting values of one static layer: a straight line, or mean outputs given its input."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pyro_dynogp.data.channel_statistics import by_smoothness
from pyro_dynogp.inference.starts.dynamic import Values
from pyro_dynogp.layers.functions import StaticFunction
from pyro_dynogp.layers.kernels import KernelPrior
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.wiring import Static, Wire


def start_static(
    model: Model,
    one: Wire,
    layer: Static,
    values: Values,
    seen: Sequence[Tensor],
    line: tuple[float, Tensor] | None,
    curve: Tensor | None,
    reach: Tensor | None,
    fed_back: bool = False,
) -> list[Tensor]:
    """Add a static layer's values; its outputs along the mean trajectories.

    Args:
        line: slope and level (e,) of the function, None for the identity.
        curve: (n, e) what its outputs should be on average; None for a straight line.
        reach: (n, e) outputs that the straight line should be able to reach, or None.
        fed_back: whether it is in feedback; nothing comes back at first.
    """
    x = torch.cat(list(seen))
    d, e, M = one.channels, layer.outputs, layer.inducing
    low, high = x.amin(0), x.amax(0)
    smoothest = smoothest_first(seen)
    order = torch.arange(d) if d == e else smoothest
    if reach is not None and line is not None and d == 1:
        # Process noise takes the input further than its mean goes: to where the outputs came from.
        back = (reach - line[1]) / line[0]
        back = back[torch.isfinite(back)]
        low, high = torch.minimum(low, back.amin()), torch.maximum(high, back.amax())
    # A function in feedback keeps from there on the value that it has there.
    margin = (0.02 if fed_back else 0.2) * (high - low) + 1e-3
    low, high = low - margin, high + margin
    name = one.name
    if not layer.learn_locations:
        pass
    elif d == 1:
        values[f"{name}_center"] = 0.5 * (low + high)
        values[f"{name}_half_width"] = 0.5 * (high - low)
    else:  # where the data are, spread along the record
        index = torch.linspace(0, len(x) - 1, M).round().long()
        cloud = torch.quasirandom.SobolEngine(d).draw(M, dtype=torch.float64) - 0.5
        cloud = cloud[:, smoothest.argsort()]
        values[f"{name}_locations"] = x[index] + 0.1 * (high - low) * cloud
    values[f"{name}_constant"] = torch.zeros(e, dtype=torch.float64)
    values[f"{name}_output_scale"] = torch.full((e,), 1.5, dtype=torch.float64)
    if layer.mean == "linear":
        slope = torch.zeros if fed_back else torch.eye
        values[f"{name}_slope"] = slope(e, d, dtype=torch.float64)[:, order.argsort()]
    if layer.kernel is None:
        spread = (high - low) / (4.0 if d == 1 else 1.5)
        values[f"{name}_lengthscale"] = spread.clamp(0.1, 10.0)
    for site in KernelPrior(name, layer.kernel, d).sites():  # of a kernel of the user's
        values.setdefault(site.name, site.typical())
    values[f"{name}_values"] = torch.zeros(e, M, dtype=torch.float64)
    function = _function(model, one, layer, values)
    Z = function.locations
    u = torch.stack([Z[:, order[o % d]] for o in range(e)])
    if line is not None:
        u = line[0] * u + line[1].unsqueeze(-1)
    if curve is not None and d == 1:
        u = torch.stack([_smooth_means(x[:, 0], curve[:, o], Z[:, 0]) for o in range(e)])
    u = torch.zeros_like(u) if fed_back else u
    u = u.clamp(*function.limits)
    values[f"{name}_values"] = _whiten(function, u)
    function = _function(model, one, layer, values)
    with torch.no_grad():
        return [function.mean(s) for s in seen]


def smoothest_first(signals: Sequence[Tensor]) -> Tensor:
    """Places (d,) of channels by how little they change, in sds, from one sample to the next.

    What a start has for a first or a second channel does then not depend on how they are given.

    Args:
        signals: (n, d) of each record.
    """
    scale = torch.cat(list(signals)).std(0)
    scale = torch.where(scale > 0, scale, 1.0)  # what is constant comes first
    return torch.tensor(by_smoothness([(x / scale).numpy() for x in signals]))


def _function(model: Model, one: Wire, layer: Static, values: Values) -> StaticFunction:
    with torch.no_grad():
        return model.static_function(one, layer, values)


def _whiten(function: StaticFunction, u: Tensor) -> Tensor:
    """Whitened values v (e, M) with which the function has the values u (e, M) at its locations."""
    prior = function.prior_mean(function.locations).mT
    centred = (u - prior) / function.output_scale.unsqueeze(-1)
    K = function.kernel(function.locations, function.locations)
    # A start need not interpolate: rough targets would ask for values that the prior rules out.
    M = K.shape[-1]
    ridge = 1e-3 * torch.eye(M, dtype=K.dtype)
    smooth = (K @ torch.linalg.solve(K + ridge, centred.unsqueeze(-1))).squeeze(-1)
    root = torch.linalg.cholesky(K + 1e-6 * torch.eye(M, dtype=K.dtype))
    return torch.linalg.solve_triangular(root, smooth.unsqueeze(-1), upper=False).squeeze(-1)


def _smooth_means(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Mean of y given x at points z: a kernel smoother that leans on the straight line."""
    there = torch.isfinite(y)
    x, y = x[there], y[there]
    slope = ((x - x.mean()) * (y - y.mean())).mean() / (x.var() + 1e-9)
    width = (x.amax() - x.amin()) / 16.0 + 1e-9
    weight = torch.exp(-0.5 * ((z[:, None] - x) / width).square())
    line = slope * (x - x.mean()) + y.mean()
    departure = (weight @ (y - line)) / (weight.sum(-1) + 1.0)
    return slope * (z - x.mean()) + y.mean() + departure
