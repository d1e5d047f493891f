"""Starting points: of linear models, and of cascades from the best linear fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.delays import with_delays
from pyro_dynogp.inference.starts.dynamic import DynamicStart, Values, with_late_inputs
from pyro_dynogp.inference.starts.linear import Twin, leading_layers, linear_twins
from pyro_dynogp.inference.starts.static import start_static
from pyro_dynogp.layers.noise import TYPICAL
from pyro_dynogp.models.arrival import DELAY
from pyro_dynogp.models.assembly import assemble
from pyro_dynogp.models.known import known_function, known_sites, middle_of
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.selection import signal_of
from pyro_dynogp.models.system import DynamicSystem, see
from pyro_dynogp.models.wiring import INPUTS, Dynamic, Known, Static, Wire
from pyro_dynogp.moments import filtering, smoothing
from pyro_dynogp.support.parallel import child_seeds, seeded


@dataclass(frozen=True)
class Plan:
    """One restart: which layer takes over which linear optimum.

    Attributes:
        leading: name of the layer, None where there is none that can.
        linear: values of the linear model's sites at an optimum.
        curved: whether a last static layer starts as the mean of the output given its input;
            else, as other static layers do, as a straight line.
        seed: of everything random.
        ahead: whether hidden signals of the leading layer start as what a first-order lag before
            the output sees; else as the output's derivative.
        usual: whether parameters of known functions start in the middle of their priors; else they
            are drawn.
    """

    leading: str | None
    linear: Mapping[str, Tensor] | None
    curved: bool
    seed: int
    ahead: bool = True
    usual: bool = True


def plans(
    model: Model, optima: Mapping[str, Sequence[Mapping[str, Tensor]]], count: int, seed: int
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
    bends = isinstance(model.output_wire.layer, Static)
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
        out.append(Plan(name, linear, curved, s, ahead=turn % 2 == 0, usual=turn < 2))
    return out


def starting_point(model: Model, records: Sequence[PreparedRecord], plan: Plan) -> Values:
    """Values of every site of a cascade, layer by layer along the mean trajectories.

    The leading layer is the linear fit, a layer beside it has its modes, moved at random, other
    dynamic layers pass their input on with small random dynamics beside it, and static layers start
    as the identity on the range of their input: the cascade starts as the linear model, whose
    offset and noise it takes over. From static layers in feedback nothing comes back at first.
    """
    generator = np.random.default_rng(plan.seed)
    values: Values = {}
    scaling = records[0].scaling
    if model.late:
        values[DELAY], records = with_delays(model, records, plan.linear)
    inputs = [record.scaled_inputs for record in records]
    driving = model.inputs - model.direct
    signals = [{INPUTS: u[:, :driving]} for u in inputs]
    if model.direct:
        values["direct"] = _direct(model, plan)
    targets = [record.scaled_outputs for record in records]
    if model.direct:
        added = [u[:, driving:] @ values["direct"].mT for u in inputs]
        targets = [y - a for y, a in zip(targets, added, strict=True)]
    size = 1.0  # what signals below the leading layer were divided by
    level = torch.zeros(model.outputs, dtype=torch.float64)
    back = {name for one in model.wires for name in one.feedback}
    last = model.output_wire.name
    if plan.linear is not None:
        level = level + plan.linear["offset"]
    for one in model.wires:
        seen = [see(s, one) for s in signals]
        if isinstance(one.layer, Dynamic):
            start = DynamicStart(model, one, one.layer, scaling, generator)
            if one.layer.real:
                values.update(start.lags(plan.linear))
            elif one.name == plan.leading and plan.linear is not None:
                values.update(start.from_linear(plan.linear, ahead=plan.ahead))
            elif plan.linear is not None and _beside(model, one, plan.leading):
                values.update(start.from_linear(plan.linear, moved=True))
            else:
                values.update(start.near_identity())
            outputs = [start.response(values, r, x) for r, x in zip(records, seen, strict=True)]
            factor = size
            # Unit scale for the layer above, and of what does not begin at the linear fit.
            if one.name != signal_of(model.measured_signal or "") or one.layer.real:
                factor = 1.0 / max(float(torch.cat(outputs).std()), 1e-6)
                size = size / factor
            start.scale(values, factor)
            outputs = [o * factor for o in outputs]
        elif isinstance(one.layer, Known):
            for site in known_sites(one.name, one.layer):
                values[site.name] = middle_of(site) if plan.usual else site.prior.sample()
            values["offset"] = level
            function = known_function(model, one, one.layer, values, scaling)
            outputs = [function.mean(s) for s in seen]
        else:
            if one.reads == {last}:  # seen where it was measured
                known = [
                    see({last: torch.where(y.isnan(), s[last], y - level)}, one)
                    for y, s in zip(targets, signals, strict=True)
                ]
                seen = known if one.name in back else seen
            line = (size, level) if one.last else None
            curve = torch.cat(targets) if one.last and plan.curved else None
            reach = torch.cat(targets) if one.last else None
            fed = one.name in back
            outputs = start_static(model, one, one.layer, values, seen, line, curve, reach, fed)
        for signal, out in zip(signals, outputs, strict=True):
            parts = out.split(list(one.signals.values()), -1)
            signal |= dict(zip(one.signals, parts, strict=True))
    if model.measured_signal is not None:
        values["offset"] = level
    if plan.linear is not None and not plan.curved:
        noise = plan.linear["noise_sd"].expand(model.outputs)
    else:
        errors = torch.cat([t - s[last] for t, s in zip(targets, signals, strict=True)])
        noise = (0.7 * torch.nanmean(errors.square(), 0).sqrt() + 1e-3).clamp_max(1.0)
    values |= _first_states(model, records, plan)
    if model.likelihood.varying:
        values["log_noise_constant"] = (noise / TYPICAL).log()
    else:
        values["noise_sd"] = noise
    for site in model.all_sites(scaling, len(records)):  # hyperparameters of other kernels
        if site.name not in values:
            values[site.name] = site.typical()
    return {name: value.detach().clone() for name, value in values.items()}


def _first_states(model: Model, records: Sequence[PreparedRecord], plan: Plan) -> Values:
    """Standard normal numbers of first states: of the leading layer those of the linear fit."""
    values: Values = {}
    for index, record in enumerate(records):
        suffix = "" if len(records) == 1 else f"_{index}"
        for one in model.state_sites:
            assert isinstance(one.layer, Dynamic)
            state = torch.zeros(len(one.layer.past_states), dtype=torch.float64)
            if one.name == plan.leading and plan.linear is not None:
                state = _linear_state(model, one, record, plan.linear)
            values[f"{one.name}_initial_state{suffix}"] = state
    return values


def _beside(model: Model, one: Wire, leading: str | None) -> bool:
    """Whether a layer is of the same form as the leading one, and sees the same."""
    same = {w.name: (w.sources, w.fed, replace(d, name=None)) for w, d in model.dynamic}
    return leading is not None and same[one.name] == same[leading]


def _direct(model: Model, plan: Plan) -> Tensor:
    """Weights of direct inputs as the linear fit has them, where it has all outputs."""
    shape = (model.outputs, model.direct)
    found = None if plan.linear is None else plan.linear.get("direct")
    return torch.zeros(shape, dtype=torch.float64) if found is None else found.expand(shape)


def _linear_state(
    model: Model,
    one: Wire,
    record: PreparedRecord,
    linear: Mapping[str, Tensor],
) -> Tensor:
    """Standard normal numbers of the first state that the linear fit finds by smoothing."""
    layer = one.layer
    assert isinstance(layer, Dynamic)
    if layer.outputs != model.outputs or not one.channels or layer.real:
        return torch.zeros(len(layer.past_states), dtype=torch.float64)
    noisy = "g_noise_gain_unit" in linear
    own = replace(layer, feedback=(), hidden=0, substeps=1, process_noise=noisy)
    alone = (replace(own, sees=(), skip=()),)  # a function of inputs is a line as yet
    twin = Model(
        model.inputs, alone, direct=model.direct, initial_state="integrated", scaling=record.scaling
    )
    with torch.no_grad():
        ((place, _),) = twin.dynamic
        named = {place.name + k[1:] if k[:2] == "g_" else k: v for k, v in linear.items()}
        if (direct := f"{place.name}_feedthrough") in named:
            named[direct] = with_late_inputs(named[direct], model, record.scaling, place.channels)
        system = twin.system(named, record.scaling)
        assembly = assemble(system, record.grid, record.scaled_inputs)
        problem = assembly.with_outputs(record.scaled_outputs)
        elements, _ = problem.elements()
        _, track, _, _ = filtering.run(problem.layout, elements[0])
        rows = np.zeros((0, problem.G.shape[-1]))
        first = smoothing.smooth(problem.layout, elements[0], rows, track)[0][0]
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
    return state.clamp(-3.0, 3.0)[list(alone[0].past_states)]


def starting_points(
    model: Model, records: Sequence[PreparedRecord], run: Run, *, count: int, steps: int
) -> list[Values]:
    """Values of every site for each restart, from the optima of linear fits."""
    return starts_of(model, records, linear_twins(model, records, run, steps), count, run.seed)


def starts_of(
    model: Model,
    records: Sequence[PreparedRecord],
    twins: Mapping[str, Twin],
    count: int,
    seed: int,
) -> list[Values]:
    """Values of every site for each of so many restarts, from the optima of the twins."""
    optima = {name: values for name, (_, _, values) in twins.items()}
    with seeded(seed):  # what has no typical value is drawn
        return [starting_point(model, records, one) for one in plans(model, optima, count, seed)]
