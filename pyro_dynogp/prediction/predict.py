"""Simulation, prediction and forecast of a fitted cascade."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.layers.noise import Likelihood
from pyro_dynogp.lti.grid import TimeGrid, time_grid
from pyro_dynogp.models.assembly import Assembly, assemble
from pyro_dynogp.models.draws import (
    Drawn,
    JointState,
    Randomness,
    Switches,
    draw_layers,
)
from pyro_dynogp.models.system import CascadeSystem, DynamicSystem, scaled_inputs, scaled_outputs
from pyro_dynogp.moments import filtering, smoothing
from pyro_dynogp.moments.problem import each
from pyro_dynogp.prediction.first_state import beginning, cascade_of
from pyro_dynogp.prediction.prediction import Parts, Prediction
from pyro_dynogp.prediction.records import following, gap_between, one_record
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.parallel import seeded

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fit


def simulate(fit: Fit, record: Record, process_noise: bool, samples: int, seed: int) -> Prediction:
    """See `Fit.simulate`."""
    record = one_record(fit, record)
    with torch.no_grad():
        system = cascade_of(fit).begin(fit.system, {})
        inputs = scaled_inputs(fit.scaling, record)
        grid = time_grid(record.time)
        problem = assemble(system, grid, inputs, process_noise=process_noise).problem
        start = JointState(problem.m0, problem.P0)  # nothing is known of past inputs
        sd = system.noise_sd(inputs, grid)
        return _forward(
            fit, record, grid, inputs, start, sd, process_noise, samples, seed, "simulation"
        )


def forecast(
    fit: Fit, past: Record, future: Record, process_noise: bool, samples: int, seed: int
) -> Prediction:
    """See `Fit.forecast`."""
    past, future = following(fit, past, future)
    gap = gap_between(past, future)
    if not past.n_outputs:
        raise invalid("past", expected="outputs to start from", got="none")
    with torch.no_grad():
        # One grid over the past and the first time of the future: the filter carries the state.
        time = np.append(past.time, past.time[-1] + gap)
        u = scaled_inputs(fit.scaling, past)
        ahead = scaled_inputs(fit.scaling, future)
        both = torch.cat([u, ahead[:1]])
        y = scaled_outputs(fit.scaling, past)
        y = torch.cat([y, torch.full_like(y[:1], torch.nan)])
        system = beginning(fit, past)
        start = filtered_state(assemble(system, time_grid(time), both), y)
        grid = time_grid(future.time)
        # Noise that follows the output goes on from where the past has brought the output.
        whole = np.append(past.time, past.time[-1] + gap + (future.time - future.time[0]))
        sd = system.noise_sd(torch.cat([u, ahead]), whole)[..., len(past) :, :]
        return _forward(
            fit, future, grid, ahead, start, sd, process_noise, samples, seed, "forecast"
        )


def filtered_state(assembly: Assembly, y: Tensor) -> JointState:
    """State of all dynamic layers at the last time given scaled outputs y (n, n_y)."""
    problem = assembly.with_outputs(y)
    elements, batch = problem.elements()
    N = problem.m0.shape[-1]
    ends = each(lambda b: filtering.run(problem.layout, elements[b]), len(elements))
    m = torch.from_numpy(np.stack([end[3][:N] for end in ends])).reshape(*batch, N)
    P = torch.from_numpy(np.stack([end[4][:N, :N] for end in ends])).reshape(*batch, N, N)
    return JointState(assembly.known_state + m, P)


def predict(fit: Fit, record: Record, horizon: int, samples: int, seed: int) -> Prediction:
    """See `Fit.predict`."""
    record = one_record(fit, record)
    if not isinstance(horizon, int) or horizon < 1:
        raise invalid("horizon", expected="a whole number >= 1", got=repr(horizon))
    if not record.n_outputs:
        raise invalid("record", expected="outputs to predict from", got="none")
    with torch.no_grad():
        inputs = scaled_inputs(fit.scaling, record)
        system, grid = beginning(fit, record), time_grid(record.time)
        problem = assemble(system, grid, inputs).with_outputs(scaled_outputs(fit.scaling, record))
        elements, _ = problem.elements()
        found = each(
            lambda b: smoothing.predict_ahead(problem.layout, elements[b], horizon), len(elements)
        )
        scale, shift = _units(fit)
        mean = shift + scale * np.stack([one[0] for one in found])
        variance = scale**2 * np.stack([one[1] for one in found])
        sd = _flat(system.noise_sd(inputs, grid))
    noise = scale**2 * np.broadcast_to(sd, (len(mean), *sd.shape[1:])) ** 2
    likelihood = system.noise.likelihood
    shares, multiples = likelihood.components()
    parts = {
        "parameters": mean.var(0),
        "state": variance.mean(0),
        "measurement noise": float(shares @ multiples) * noise.mean(0),
    }

    def draw() -> np.ndarray:
        generator = np.random.default_rng(seed)
        which = generator.integers(len(mean), size=samples)
        drawn = noise[which] * _multiples(likelihood, noise[which].shape, generator)
        sd = np.sqrt(variance[which] + drawn)
        return mean[which] + sd * generator.standard_normal(sd.shape)

    kind = f"{horizon}-step prediction"
    names = fit.scaling.output_names
    if likelihood.gaussian:
        return Prediction(record.time, names, mean, variance, noise, parts, draw, kind)
    # Each draw of the parameters gives a component for each of the mixture that the noise is.
    S, K = len(mean), len(shares)
    return Prediction(
        record.time, names, np.repeat(mean, K, 0), np.repeat(variance, K, 0),
        (noise[:, None] * multiples[:, None, None]).reshape(S * K, *noise.shape[1:]),
        parts, draw, kind, weights=np.tile(shares, S) / S,
    )  # fmt: skip


def _forward(
    fit: Fit,
    record: Record,
    grid: TimeGrid,
    inputs: Tensor,
    start: JointState,
    sd: Tensor,
    process_noise: bool,
    samples: int,
    seed: int,
    kind: str,
) -> Prediction:
    """Draw `samples` trajectories over all posterior draws; each gives a Gaussian component."""
    system = fit.system
    batch = system.batch_shape
    each_draw = max(2, -(-samples // max(1, batch.numel())))
    shape = torch.Size((each_draw, *batch))

    def drawn_with(random: Randomness, switches: Switches) -> Drawn:
        numbers = random if switches.any else random.first
        return draw_layers(system, grid, inputs, start, numbers, switches)

    def fresh() -> Randomness:  # the same each time: cheaper to draw again than to keep
        with seeded(seed):
            return Randomness.draw(system, len(grid), shape)

    scale, shift = _units(fit)
    on = Switches.all_on(system, process_noise, several_channels=not fit.collapsed)
    full = drawn_with(fresh(), on)
    mean = shift + scale * _flat(full.mean)
    variance = scale**2 * _flat(full.variance)
    generator = np.random.default_rng(seed)
    noise = scale**2 * _noise_variance(system, sd, len(mean), generator)

    def parts() -> dict[str, np.ndarray]:
        with torch.no_grad():
            found = _decompose(system, partial(drawn_with, fresh()), on, scale)
        return found | {"measurement noise": noise.mean(0)}

    # A joint sample of the last layer: its own draw where it is dynamic.
    last = system.wires[-1].name
    drawn = mean
    if isinstance(system.layers[-1], DynamicSystem):
        level = system.level(inputs)
        signal = full.signals[last]
        drawn = shift + scale * _flat(signal if level is None else signal + level)

    def draw() -> np.ndarray:
        own = np.zeros_like(variance) if drawn is not mean else variance
        y = drawn + np.sqrt(own + noise) * generator.standard_normal(mean.shape)
        return y[generator.permutation(len(y))[:samples]]

    names = fit.scaling.output_names
    return Prediction(record.time, names, mean, variance, noise, Parts(parts), draw, kind)


def _decompose(
    system: CascadeSystem, at: Callable[[Switches], Drawn], on: Switches, scale: np.ndarray
) -> dict[str, np.ndarray]:
    """Share of the variance by cause: what each adds when the causes are switched on in turn.

    The same random numbers serve all of them; the shares add up by construction.
    """
    parts: dict[str, np.ndarray] = {}
    total: np.ndarray | float = 0.0

    def add(cause: str, switches: Switches, whole: bool = False) -> None:
        nonlocal total
        drawn = at(switches)
        now = drawn.mean.reshape(-1, *drawn.mean.shape[-2:]).var(0, correction=0)
        if whole:
            now = now + drawn.variance.reshape(-1, *drawn.mean.shape[-2:]).mean(0)
        value = scale**2 * now.numpy()
        parts[cause] = value - total
        total = value

    current = Switches(False, frozenset(), False)
    add("parameters", current)
    current = replace(current, initial_state=True)
    add("initial state", current)
    for one, layer in zip(system.wires, system.layers, strict=True):
        last = one.name == system.wires[-1].name
        if isinstance(layer, DynamicSystem) and one.name in on.process_noise:
            current = replace(current, process_noise=current.process_noise | {one.name})
            add(f"process noise of {one.name}", current, whole=last)
    add("static functions", on, whole=True)
    return parts


def _flat(x: Tensor) -> np.ndarray:
    """(*shape, n, w) to (S, n, w)."""
    return x.reshape(-1, *x.shape[-2:]).numpy()


def _noise_variance(
    system: CascadeSystem, sd: Tensor, count: int, generator: np.random.Generator
) -> np.ndarray:
    """Variance (count, n, n_y) of noise of scale sd (*b, n, n_y) for each component.

    A Student-t's is drawn.
    """
    flat = sd.reshape(-1, *sd.shape[-2:]).numpy()
    variance = np.broadcast_to(flat, (len(flat), *flat.shape[1:])) ** 2
    variance = np.tile(variance, (-(-count // len(variance)), 1, 1))[:count]
    return variance * _multiples(system.noise.likelihood, variance.shape, generator)


def _multiples(
    likelihood: Likelihood, shape: tuple[int, ...], generator: np.random.Generator
) -> np.ndarray | float:
    """Draws of what multiplies the variance of Gaussian noise: inverse gammas for a Student-t."""
    nu = likelihood.degrees_of_freedom
    return 1.0 if nu is None else 0.5 * nu / generator.standard_gamma(0.5 * nu, shape)


def _units(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    return fit.scaling.output_scale, fit.scaling.output_offset
