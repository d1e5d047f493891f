"""Starting points of a cascade: the best linear fits, spread over its layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyro
import torch
from torch import Tensor

from pyro_dynogp.inference.starts import random_poles
from pyro_dynogp.layers.functions import StaticFunction
from pyro_dynogp.layers.noise import TYPICAL
from pyro_dynogp.lti.grid import time_grid
from pyro_dynogp.lti.response import mean_response
from pyro_dynogp.models.assembly import assemble
from pyro_dynogp.models.cascade import Cascade
from pyro_dynogp.models.layers import INPUTS, Dynamic, Static, Wire
from pyro_dynogp.models.linear import LinearDynamicGP
from pyro_dynogp.models.priors import TimeScale
from pyro_dynogp.models.systems import DynamicSystem, scaled_inputs, see
from pyro_dynogp.moments import filtering, smoothing
from pyro_dynogp.parallel import child_seeds
from pyro_dynogp.record import Record
from pyro_dynogp.scaling import Scaling

Values = dict[str, Tensor]
# Size of gains that are there to be learnt.
SMALL = 0.05


def linear_twin(model: Cascade, layer: Dynamic, scaling: Scaling) -> LinearDynamicGP:
    """The linear model whose optimum starts a dynamic layer."""
    return LinearDynamicGP(
        inputs=model.inputs,
        direct=model.direct,
        outputs=layer.outputs if layer.outputs == model.outputs else 1,
        pairs=layer.pairs,
        noise=layer.noise,
        brownian=layer.brownian,
        feedthrough=layer.feedthrough,
        process_noise=layer.process_noise or model.inputs == model.direct,
        scaling=scaling,
    )


def leading_layers(model: Cascade) -> tuple[Wire, ...]:
    """Dynamic layers that can take over a linear fit: they see as many channels as inputs."""
    return tuple(
        one
        for one in model.wires
        if isinstance(one.layer, Dynamic) and one.channels == model.inputs - model.direct
    )


@dataclass(frozen=True)
class Plan:
    """One restart: which layer takes over which linear optimum.

    Attributes:
        leading: name of the layer, None where there is none that can.
        linear: values of the linear model's sites at an optimum.
        curved: whether a last static layer starts as the mean of the output given its input;
            else, as other static layers do, as a straight line.
        seed: of everything random.
    """

    leading: str | None
    linear: Mapping[str, Tensor] | None
    curved: bool
    seed: int


def plans(
    model: Cascade, optima: Mapping[str, Sequence[Mapping[str, Tensor]]], count: int, seed: int
) -> list[Plan]:
    """Restarts in turn over leading layers and optima of the linear fit.

    A last static layer starts curved, but straight at every fourth restart: a straight start lets
    the dynamics first imitate what the function should do, and seldom recovers.

    Args:
        optima: for each leading layer the linear optima, best first.
    """
    names = [one.name for one in leading_layers(model)]
    seeds = child_seeds(seed, count)
    if not names:
        return [Plan(None, None, bool(index % 2), s) for index, s in enumerate(seeds)]
    bends = isinstance(model.layers[-1], Static)
    out = []
    used = dict.fromkeys(names, 0)  # linear optima, best first
    for index, s in enumerate(seeds):
        name, turn = names[index % len(names)], index // len(names)
        curved = bends and turn % 4 != 1
        found = optima[name]
        if bends and not curved:
            linear = found[(turn // 4) % len(found)]
        else:
            linear = found[used[name] % len(found)]
            used[name] += 1
        out.append(Plan(name, linear, curved, s))
    return out


def starting_point(
    model: Cascade, records: Sequence[Record], scaling: Scaling, plan: Plan
) -> Values:
    """Values of every site of a cascade, layer by layer along the mean trajectories.

    The leading layer is the linear fit, other dynamic layers pass their input on with small random
    dynamics beside it, and static layers start as the identity on the range of their input: the
    cascade starts as the linear model, whose offset and noise it takes over.
    """
    generator = np.random.default_rng(plan.seed)
    values: Values = {}
    inputs = [scaled_inputs(scaling, record) for record in records]
    driving = model.inputs - model.direct
    signals = [{INPUTS: u[:, :driving]} for u in inputs]
    if model.direct:
        values["direct"] = _direct(model, plan)
    targets = [_scaled_outputs(scaling, record) for record in records]
    if model.direct:
        added = [u[:, driving:] @ values["direct"].mT for u in inputs]
        targets = [y - a for y, a in zip(targets, added, strict=True)]
    size = 1.0  # what signals below the leading layer were divided by
    level = torch.zeros(model.outputs, dtype=torch.float64)
    if plan.linear is not None:
        level = level + plan.linear["offset"]
    for one in model.wires:
        seen = [see(s, one) for s in signals]
        if isinstance(one.layer, Dynamic):
            start = _Dynamic(model, one, one.layer, scaling, generator)
            if one.name == plan.leading and plan.linear is not None:
                values.update(start.from_linear(plan.linear))
            else:
                values.update(start.near_identity())
            outputs = [start.response(values, r, x) for r, x in zip(records, seen, strict=True)]
            factor = size
            if not one.last:  # unit scale for the layer above
                factor = 1.0 / max(float(torch.cat(outputs).std()), 1e-6)
                size = size / factor
            start.scale(values, factor)
            outputs = [o * factor for o in outputs]
        else:
            assert isinstance(one.layer, Static)
            line = (size, level) if one.last else None
            curve = torch.cat(targets) if one.last and plan.curved else None
            reach = torch.cat(targets) if one.last else None
            outputs = _static(model, one, one.layer, values, seen, line, curve, reach)
        for signal, out in zip(signals, outputs, strict=True):
            signal[one.name] = out
    last = model.wires[-1].name
    if isinstance(model.layers[-1], Dynamic):
        values["offset"] = level
    if plan.linear is not None and not plan.curved:
        noise = plan.linear["noise_sd"].expand(model.outputs)
    else:
        errors = torch.cat([t - s[last] for t, s in zip(targets, signals, strict=True)])
        noise = (0.7 * torch.nanmean(errors.square(), 0).sqrt() + 1e-3).clamp_max(1.0)
    for index, record in enumerate(records):
        suffix = "" if len(records) == 1 else f"_{index}"
        for one in model.state_sites:
            assert isinstance(one.layer, Dynamic)
            state = torch.zeros(2 * one.layer.pairs, dtype=torch.float64)
            if one.name == plan.leading and plan.linear is not None:
                state = _linear_state(model, one, scaling, record, plan.linear)
            values[f"{one.name}_initial_state{suffix}"] = state
    if model.likelihood.varying:
        values["log_noise_constant"] = (noise / TYPICAL).log()
    else:
        values["noise_sd"] = noise
    _complete(model, scaling, values)
    return {name: value.detach().clone() for name, value in values.items()}


def _direct(model: Cascade, plan: Plan) -> Tensor:
    """Weights of direct inputs as the linear fit has them, where it has all outputs."""
    shape = (model.outputs, model.direct)
    found = None if plan.linear is None else plan.linear.get("direct")
    return torch.zeros(shape, dtype=torch.float64) if found is None else found.expand(shape)


def _linear_state(
    model: Cascade,
    one: Wire,
    scaling: Scaling,
    record: Record,
    linear: Mapping[str, Tensor],
) -> Tensor:
    """Standard normal numbers (2P,) of the first state that the linear fit finds by smoothing."""
    layer = one.layer
    assert isinstance(layer, Dynamic)
    if layer.outputs != model.outputs:
        return torch.zeros(2 * layer.pairs, dtype=torch.float64)
    twin = Cascade(
        model.inputs, (layer,), direct=model.direct, initial_state="integrated", scaling=scaling
    )
    with torch.no_grad(), pyro.poutine.block():
        system = pyro.poutine.condition(twin.sample_system, data=dict(linear))(scaling)
        assembly = assemble(system, time_grid(record.time), scaled_inputs(scaling, record))
        problem = assembly.with_outputs(_scaled_outputs(scaling, record))
        elements, _ = problem.elements()
        _, means, covariances, _, _ = filtering.run(problem.layout, elements[0])
        rows = np.zeros((0, problem.G.shape[-1]))
        first = smoothing.smooth(problem.layout, elements[0], rows, means, covariances)[0][0]
        dynamic = system.layers[0]
        assert isinstance(dynamic, DynamicSystem)
        past, whole = dynamic.past_inputs, dynamic.prior_state().covariance
        assert whole is not None
        J = len(past)
        eye = torch.eye(J, dtype=torch.float64)
        ridge = 1e-9 * whole.diagonal().mean() * eye
        left = past @ torch.linalg.solve(whole + ridge, torch.tensor(first[:J]))
        root = torch.linalg.cholesky(past + 1e-9 * past.diagonal().mean() * eye)
        state = torch.linalg.solve_triangular(root, left.unsqueeze(-1), upper=False).squeeze(-1)
    return state.clamp(-3.0, 3.0)


def _middle(name: str, node: Mapping[str, Any]) -> Tensor:
    """A typical value of a site: zero for standard normal ones, the mean of normal ones."""
    fn = node["fn"]
    base = fn.base_dist if hasattr(fn, "base_dist") else fn
    if isinstance(base, torch.distributions.LogNormal):
        return base.loc.exp().expand(node["value"].shape).clone()
    if isinstance(base, torch.distributions.Normal):
        return base.mean.expand(node["value"].shape).clone()
    return node["value"].detach().clone()


def _complete(model: Cascade, scaling: Scaling, values: Values) -> None:
    """Typical values for sites that no layer's start knows (hyperparameters of other kernels)."""
    with pyro.poutine.block(), torch.no_grad():
        trace = pyro.poutine.trace(
            pyro.poutine.condition(model.sample_system, data=values)
        ).get_trace(scaling)
    for name, node in trace.nodes.items():
        if node["type"] == "sample" and name not in values and not node["is_observed"]:
            values[name] = _middle(name, node)


def _scaled_outputs(scaling: Scaling, record: Record) -> Tensor:
    y = (record.outputs - scaling.output_offset) / scaling.output_scale
    return torch.tensor(y, dtype=torch.float64)


class _Dynamic:
    """Starting values of one dynamic layer."""

    def __init__(
        self,
        model: Cascade,
        one: Wire,
        layer: Dynamic,
        scaling: Scaling,
        generator: np.random.Generator,
    ) -> None:
        self.model, self.one, self.layer = model, one, layer
        self.scaling, self.generator = scaling, generator

    def key(self, name: str) -> str:
        return f"{self.one.name}_{name}"

    def random(self, *shape: int, scale: float = SMALL) -> Tensor:
        return torch.tensor(scale * self.generator.standard_normal(shape), dtype=torch.float64)

    def from_linear(self, linear: Mapping[str, Tensor]) -> Values:
        """The linear optimum's values under this layer's names."""
        values = {
            self.one.name + name[1:]: value for name, value in linear.items() if name[:2] == "g_"
        }
        layer = self.layer
        if layer.outputs > 1 and self.key("output_gain") not in values:
            # One signal is the linear fit; the others see the same modes with other gains.
            P = layer.pairs
            gain = self.random(layer.outputs, P, 2, scale=0.7)
            gain[0] = torch.tensor([1.0, 0.0], dtype=torch.float64)
            values[self.key("output_gain")] = gain
            length = gain.square().sum((0, -1)).sqrt()  # directions have unit length
            values[self.key("input_gain")] = values[self.key("input_gain")] * length[:, None, None]
            if layer.feedthrough:
                D = values[self.key("feedthrough")]
                rest = self.random(layer.outputs - 1, D.shape[-1], scale=0.1)
                values[self.key("feedthrough")] = torch.cat([D.reshape(1, -1), rest])
            if layer.process_noise:
                values.update(self.small_noise())
        if not layer.process_noise:
            values = {k: v for k, v in values.items() if "_noise_gain" not in k}
        return values

    def near_identity(self) -> Values:
        """Each output is an input, beside small random dynamics."""
        layer, d = self.layer, self.one.channels
        P, several = layer.pairs, layer.outputs > 1
        rate = TimeScale.of(self.scaling).typical_rate
        poles = random_poles(P, self.scaling, self.generator)
        values = {
            self.key("log_decay"): torch.tensor(np.log(-poles.real / rate)),
            self.key("log_frequency"): torch.tensor(np.log(poles.imag / rate)),
        }
        if d:
            values[self.key("input_gain")] = self.random(P, d, 2)
            if layer.feedthrough:
                D = torch.eye(layer.outputs, d, dtype=torch.float64)
                D = D + self.random(layer.outputs, d)
                values[self.key("feedthrough")] = D if several else D[0]
            else:  # the fastest pair passes the first input on
                fastest = int(np.argmax(np.abs(poles)))
                values[self.key("input_gain")][fastest, 0, 1] = 1.0
        if several:
            gain = self.random(layer.outputs, P, 2, scale=0.7)
            gain[0] = gain[0] + torch.tensor([1.0, 0.0], dtype=torch.float64)
            values[self.key("output_gain")] = gain
        if layer.process_noise:
            values.update(self.small_noise())
        return values

    def small_noise(self) -> Values:
        layer = self.layer
        count = layer.brownian or layer.outputs
        return {
            self.key("noise_gain_local_scale"): torch.full((layer.pairs,), 0.5).double(),
            self.key("noise_gain_unit"): self.random(layer.pairs, count, 2, scale=0.3).abs() + 0.05,
        }

    def response(self, values: Values, record: Record, x: Tensor) -> Tensor:
        """Mean trajectory (n, w) of the layer."""
        with torch.no_grad(), pyro.poutine.block():
            sample = pyro.poutine.condition(self.model.sample_dynamic_layer, data=values)
            modes = sample(self.one, self.layer, TimeScale.of(self.scaling)).modes
            out = mean_response(modes, record.time, x if modes.inputs else None).output
        return out if modes.several_outputs else out.unsqueeze(-1)

    def scale(self, values: Values, factor: float) -> None:
        """Multiply the layer's output."""
        for name in ("input_gain", "feedthrough", "noise_gain_unit"):
            if self.key(name) in values:
                values[self.key(name)] = values[self.key(name)] * factor


def _static(
    model: Cascade,
    one: Wire,
    layer: Static,
    values: Values,
    seen: Sequence[Tensor],
    line: tuple[float, Tensor] | None,
    curve: Tensor | None,
    reach: Tensor | None,
) -> list[Tensor]:
    """Add a static layer's values; its outputs along the mean trajectories.

    Args:
        line: slope and level (e,) of the function, None for the identity.
        curve: (n, e) what its outputs should be on average; None for a straight line.
        reach: (n, e) outputs that the straight line should be able to reach, or None.
    """
    x = torch.cat(list(seen))
    d, e, M = one.channels, layer.outputs, layer.inducing
    low, high = x.amin(0), x.amax(0)
    if reach is not None and line is not None and d == 1:
        # Process noise takes the input further than its mean goes: to where the outputs came from.
        back = (reach - line[1]) / line[0]
        back = back[torch.isfinite(back)]
        low, high = torch.minimum(low, back.amin()), torch.maximum(high, back.amax())
    margin = 0.2 * (high - low) + 1e-3
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
        values[f"{name}_locations"] = x[index] + 0.1 * (high - low) * cloud
    values[f"{name}_constant"] = torch.zeros(e, dtype=torch.float64)
    values[f"{name}_output_scale"] = torch.full((e,), 1.5, dtype=torch.float64)
    if layer.mean == "linear":
        values[f"{name}_slope"] = torch.eye(e, d, dtype=torch.float64)
    if layer.kernel is None:
        spread = (high - low) / (4.0 if d == 1 else 1.5)
        values[f"{name}_lengthscale"] = spread.clamp(0.1, 10.0)
    values[f"{name}_values"] = torch.zeros(e, M, dtype=torch.float64)
    function = _function(model, one, layer, values)
    Z = function.locations
    u = torch.stack([Z[:, o % d] for o in range(e)])
    if line is not None:
        u = line[0] * u + line[1].unsqueeze(-1)
    if curve is not None and d == 1:
        u = torch.stack([_smooth_means(x[:, 0], curve[:, o], Z[:, 0]) for o in range(e)])
    values[f"{name}_values"] = _whiten(function, u)
    function = _function(model, one, layer, values)
    with torch.no_grad():
        return [function.mean(s) for s in seen]


def _function(model: Cascade, one: Wire, layer: Static, values: Values) -> StaticFunction:
    with torch.no_grad():
        return model.static_given(one, layer, values)


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
