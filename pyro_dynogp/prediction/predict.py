"""Simulation, k-step prediction and forecast of a fitted model."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.models.draws import JointState, first_state, variance_multiples
from pyro_dynogp.models.exact_outputs import ExactOutputs, spread_evenly
from pyro_dynogp.models.late_systems import arrive
from pyro_dynogp.models.output_process import OutputProcess, flat
from pyro_dynogp.models.outputs import engine_for, output_process
from pyro_dynogp.models.prepared import PreparedRecord, with_outputs
from pyro_dynogp.prediction.first_state import States, beginning, estimated, unknown_beginning
from pyro_dynogp.prediction.free_run_variance import with_held_parameters
from pyro_dynogp.prediction.prediction import Parts, Prediction
from pyro_dynogp.prediction.records import following, prepared
from pyro_dynogp.support.errors import warn
from pyro_dynogp.support.parallel import seeded

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted

# Widths of the range of the training outputs beyond which a free run has diverged.
FAR = 3.0
# In the kind of a k-step prediction whose joint samples depend on each other as its errors do.
JOINT = ", errors drawn jointly"


def simulate(
    fit: Fitted,
    record: Record,
    process_noise: bool = True,
    samples: int = 200,
    seed: int = 0,
    warns: bool = True,
) -> Prediction:
    """See `Fit.simulate`; `warns`: as of `forecast`."""
    along = prepared(fit, record)
    with torch.no_grad():
        system = unknown_beginning(fit)
        system = system if process_noise else system.without_process_noise
        outputs = output_process(system, along)
        found = _forward(fit, along, outputs, samples, seed, "simulation", _at_rest)
    if warns:
        _warn_of_divergence(fit, found)
    return found


def forecast(
    fit: Fitted,
    past: Record,
    future: Record,
    process_noise: bool = True,
    samples: int = 200,
    seed: int = 0,
    states: States | None = None,
    warns: bool = True,
) -> Prediction:
    """See `Fit.forecast`; `states`: of `states_before`, where they are there already.

    `warns`: False for candidates, which their errors judge: no user hears that one diverges.
    """
    earlier, later, gap = following(fit, past, future)
    if states is None:
        states = estimated(fit, earlier)
    with torch.no_grad():
        before, start = _after(fit, earlier, later, gap, process_noise, states)
        # Noise that follows the output continues from where the past has brought the output.
        time = np.append(past.time, past.time[-1] + gap + (future.time - future.time[0]))
        system = fit.system if process_noise else fit.system.without_process_noise
        outputs = output_process(system, later, start=start)
        inputs = torch.cat([before.scaled_inputs, outputs.scaled_inputs], -2)
        outputs.noise_sd = before.system.noise_sd(inputs, time)[..., len(past) :, :]
        found = _forward(
            fit, later, outputs, samples, seed, "forecast",
            lambda other: _after(other, earlier, later, gap, False, states)[1],
        )  # fmt: skip
    if warns:
        _warn_of_divergence(fit, found)
    return found


def _at_rest(fit: Fitted) -> JointState:
    """The state after past inputs of which nothing is known."""
    return first_state(unknown_beginning(fit))


def states_before(fit: Fitted, past: Record, future: Record) -> States | None:
    """First states of a past that are estimated, for all draws of the parameters."""
    return estimated(fit, following(fit, past, future)[0])


def _after(
    fit: Fitted,
    earlier: PreparedRecord,
    later: PreparedRecord,
    gap: float,
    process_noise: bool,
    states: States | None = None,
) -> tuple[OutputProcess, JointState]:
    """Outputs along a past, and the state at the first sample of what follows it."""
    with_outputs([earlier], "past")
    before = output_process(beginning(fit, earlier, predicting=True, states=states), earlier)
    next_inputs = arrive(fit.system, later).inputs[..., 0, :]
    y = earlier.observations
    return before, before.state_after(y, gap, next_inputs, process_noise=process_noise)


def holds_after(fit: Fitted, past: Record, future: Record, states: States | None = None) -> Tensor:
    """Which draws (S,) of parameters have a state after a past that is finite.

    All of models without feedback: functions in it may make predictions run away before.
    `states`: as of `forecast`.
    """
    if not fit.model.has_feedback:
        return torch.ones(fit.n_draws, dtype=torch.bool)
    earlier, later, gap = following(fit, past, future)
    with torch.no_grad():
        _, given = _after(fit, earlier, later, gap, False, states)
    finite = torch.isfinite(given.mean).all(-1) & torch.isfinite(given.covariance).all(-1).all(-1)
    return finite.expand(fit.n_draws)


def runs_after(
    fit: Fitted,
    past: Record,
    future: Record,
    samples: int = 200,
    seed: int = 0,
    states: States | None = None,
) -> np.ndarray:
    """Outputs (S, n, n_y) without any noise, one for each draw of parameters and of the state.

    The state is drawn given the past. There is one draw of it, and of functions, for each draw of a
    linear model's parameters, and at least `samples` of other models.

    Args:
        fit: the fit. past, future: as for `Fit.forecast`. samples, seed: of the draws.
        states: as of `forecast`.
    """
    if not fit.model.is_linear:
        found = forecast(fit, past, future, False, samples, seed, states, warns=False)
        return found.component_mean
    earlier, later, gap = following(fit, past, future)
    with torch.no_grad(), seeded(seed):
        _, given = _after(fit, earlier, later, gap, False, states)
        state = given.drawn(torch.randn(given.mean.shape, dtype=torch.float64))
        start = JointState(state, torch.zeros_like(given.covariance))
        outputs = output_process(fit.system.without_process_noise, later, start=start)
        return outputs.components(samples=1, seed=seed).mean


def _forward(
    fit: Fitted,
    record: PreparedRecord,
    outputs: OutputProcess,
    samples: int,
    seed: int,
    kind: str,
    begin: Callable[[Fitted], JointState],
) -> Prediction:
    """Outputs from a first state and the inputs."""
    found = outputs.components(samples=samples, seed=seed, several_channels=not fit.collapsed)
    found = with_held_parameters(fit, found, record, begin, seed)
    names = fit.scaling.output_names
    return Prediction(
        record.record.time, names, found.mean, found.variance, found.noise_variance,
        Parts(found.parts), found.draw, kind, output_units=fit.scaling.output_units,
    )  # fmt: skip


def leave_range(fit: Fitted, runs: np.ndarray) -> np.ndarray:
    """Where (S, n) free runs (S, n, n_y) leave the range of the training outputs far behind.

    Nowhere without feedback, where runs are as large as inputs make them.
    """
    if not fit.model.has_feedback:
        return np.zeros(runs.shape[:-1], dtype=bool)
    known = np.concatenate([one.outputs for one in fit.records])
    low, high = np.nanmin(known, 0), np.nanmax(known, 0)
    margin = FAR * (high - low)
    left: np.ndarray = ~((runs > low - margin) & (runs < high + margin)).all(-1)
    return left


def _warn_of_divergence(fit: Fitted, found: Prediction) -> None:
    """Warn where free runs leave the range of the training outputs far behind."""
    runs = found.component_mean
    left = leave_range(fit, runs)
    if left.any():
        first = int(left.any(0).argmax())
        warn(
            f"{found.kind}: {left.any(1).sum()} of {len(runs)} free runs leave the range of the "
            f"training outputs by more than {FAR:g} times its width, first at sample {first} "
            f"(time {found.time[first]:.6g}). What follows is no prediction."
        )


def predict(
    fit: Fitted, record: Record, horizon: int = 1, samples: int = 200, seed: int = 0
) -> Prediction:
    """See `Fit.predict`."""
    along = prepared(fit, record)
    with_outputs([along])
    y = along.observations
    with torch.no_grad():
        outputs = output_process(beginning(fit, along, predicting=True), along)
        found = outputs.ahead(y, horizon)
        mean, variance = flat(found.mean), flat(found.variance)
        noise = flat((outputs.scale * outputs.noise_sd).square())
    noise = np.broadcast_to(noise, mean.shape)
    likelihood = outputs.system.noise.likelihood
    shares, multiples = likelihood.components()
    parts = {
        "parameters": mean.var(0),
        "state": variance.mean(0),
        "measurement noise": float(shares @ multiples) * noise.mean(0),
    }
    exact = engine_for(outputs.system) is ExactOutputs
    # Errors one step ahead are innovations, independent of each other.
    joint = exact and (horizon > 1 or fit.model.several_outputs or record.missing.any())

    def draw() -> np.ndarray:
        if joint:
            with torch.no_grad(), seeded(seed):
                errors = outputs.prediction_errors(y, horizon, -(-samples // len(mean)))
            if errors is not None:
                return spread_evenly(mean + errors.numpy(), samples)
        generator = np.random.default_rng(seed)
        which = generator.integers(len(mean), size=samples)
        drawn = noise[which] * variance_multiples(likelihood, noise[which].shape, generator)
        sd = np.sqrt(variance[which] + drawn)
        return mean[which] + sd * generator.standard_normal(sd.shape)

    kind = f"{horizon}-step prediction" + (JOINT if exact and horizon > 1 else "")
    names, units = fit.scaling.output_names, fit.scaling.output_units
    if likelihood.gaussian:
        return Prediction(
            record.time, names, mean, variance, noise, parts, draw, kind, output_units=units
        )
    # Each draw of the parameters gives a component for each of the mixture that the noise is.
    S, K = len(mean), len(shares)
    return Prediction(
        record.time, names, np.repeat(mean, K, 0), np.repeat(variance, K, 0),
        (noise[:, None] * multiples[:, None, None]).reshape(S * K, *noise.shape[1:]),
        parts, draw, kind, weights=np.tile(shares, S) / S, output_units=units,
    )  # fmt: skip
