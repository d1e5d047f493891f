"""Simulation, k-step prediction and forecast of a fitted linear dynamic GP, exact and O(n)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp._errors import invalid
from pyro_dynogp._tensors import as_tensor
from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.distributions.trajectory import split_missing
from pyro_dynogp.lti.filtering import predict_k_steps
from pyro_dynogp.lti.state import ModalState, propagate
from pyro_dynogp.models.linear import LinearDynamicGP
from pyro_dynogp.parallel import seeded
from pyro_dynogp.prediction.clock import gap_between
from pyro_dynogp.prediction.prediction import Prediction
from pyro_dynogp.record import Record

if TYPE_CHECKING:
    from pyro_dynogp.inference.result import Fit


def _model(fit: Fit) -> LinearDynamicGP:
    assert isinstance(fit.model, LinearDynamicGP)
    return fit.model


def prior_process(fit: Fit, record: Record, *, process_noise: bool = True) -> LTIProcess:
    """Noise-free trajectories along a record, one batch element for each draw."""
    model, system = _model(fit), fit.system
    state = None
    if model.initial_state == "site":
        # The site belongs to the training record; elsewhere the state is unknown again.
        modes = system.modes if process_noise else system.modes.without_process_noise()
        state = model.prior_state(system, modes)
    return model.process(system, record, fit.scaling, state, process_noise=process_noise)


def simulate(fit: Fit, record: Record, process_noise: bool, samples: int, seed: int) -> Prediction:
    """See `Fit.simulate`."""
    _one(fit, record)
    with torch.no_grad():
        process = prior_process(fit, record, process_noise=process_noise)
        return _of_process(fit, process, record, samples, seed, "simulation")


def forecast(
    fit: Fit, past: Record, future: Record, process_noise: bool, samples: int, seed: int
) -> Prediction:
    """See `Fit.forecast`."""
    _one(fit, past)
    _one(fit, future)
    gap = gap_between(past, future)
    if not past.n_outputs:
        raise invalid("past", expected="outputs to start from", got="none")
    with torch.no_grad():
        system, model, scaling = fit.system, _model(fit), fit.scaling
        before = prior_process(fit, past)
        y = past.tensors().outputs
        y = y if model.several_outputs else y[:, 0]
        noise = system.noise_sd
        end = before.condition(y.expand(before.batch_shape + y.shape), noise).final_state
        held = None
        if model.inputs:
            held = past.tensors().inputs[-1] - as_tensor(scaling.input_offset)
        modes = system.modes if process_noise else system.modes.without_process_noise()
        start = propagate(modes, end, gap, held)
        process = model.process(system, future, scaling, start, process_noise=process_noise)
        return _of_process(fit, process, future, samples, seed, "forecast")


def predict(fit: Fit, record: Record, horizon: int, samples: int, seed: int) -> Prediction:
    """See `Fit.predict`."""
    _one(fit, record)
    if not record.n_outputs:
        raise invalid("record", expected="outputs to predict from", got="none")
    with torch.no_grad():
        process = prior_process(fit, record)
        observed = process.observed(fit.system.noise_sd)
        y = record.tensors().outputs
        y = y if fit.model.several_outputs else y[:, 0]
        residual, missing = split_missing(observed.rows(y - process.mean))
        v = observed.noise_rows
        v = v if missing is None else v.masked_fill(missing, torch.inf)
        moments = predict_k_steps(process.covariance(v), residual, horizon)
        mean = process.mean + process.from_rows(moments.mean)
        variance = process.from_rows(moments.variance)
    mean_, variance_ = _outputs(fit, mean), _outputs(fit, variance)
    noise = _noise(fit)
    parts = {
        "parameters": mean_.var(0),
        "state": variance_.mean(0),
        "measurement noise": np.broadcast_to(noise.mean(0), mean_.shape[1:]),
    }

    def draw() -> np.ndarray:
        generator = np.random.default_rng(seed)
        which = generator.integers(len(mean_), size=samples)
        sd = np.sqrt(variance_ + noise[:, None, :])
        return mean_[which] + sd[which] * generator.standard_normal((samples, *mean_.shape[1:]))

    kind = f"{horizon}-step prediction"
    return _prediction(fit, record, mean_, variance_, noise, parts, draw, kind)


def _of_process(
    fit: Fit, process: LTIProcess, record: Record, samples: int, seed: int, kind: str
) -> Prediction:
    mean, variance = _outputs(fit, process.mean), _outputs(fit, process.variance)
    noise = _noise(fit)
    known = ModalState(
        torch.zeros_like(process.modes.poles),
        torch.zeros(2 * process.modes.pairs, 2 * process.modes.pairs, dtype=torch.float64),
    )
    fresh = LTIProcess(process.modes, process.grid, process.inputs, known)
    driven = np.minimum(_outputs(fit, fresh.variance), variance).mean(0)
    parts = {
        "parameters": mean.var(0),
        "initial state": variance.mean(0) - driven,
        "process noise": driven,
        "measurement noise": np.broadcast_to(noise.mean(0), mean.shape[1:]),
    }

    def draw() -> np.ndarray:
        with torch.no_grad(), seeded(seed):
            count = process.batch_shape[0]
            each = -(-samples // count)
            y = process.observed(fit.system.noise_sd).sample((each,))
            return _outputs(fit, y.flatten(0, 1))[:samples]

    return _prediction(fit, record, mean, variance, noise, parts, draw, kind)


def _prediction(
    fit: Fit,
    record: Record,
    mean: np.ndarray,
    variance: np.ndarray,
    noise: np.ndarray,
    parts: Mapping[str, np.ndarray],
    draw: Callable[[], np.ndarray],
    kind: str,
) -> Prediction:
    names = fit.scaling.output_names
    return Prediction(record.time, names, mean, variance, noise, parts, draw, kind)


def _outputs(fit: Fit, x: Tensor) -> np.ndarray:
    """(S, n) or (S, n, n_y) to an array (S, n, n_y)."""
    return (x if fit.model.several_outputs else x.unsqueeze(-1)).numpy()


def _noise(fit: Fit) -> np.ndarray:
    """Measurement-noise variance (S, n_y)."""
    sd = fit.system.noise_sd
    return (sd if fit.model.several_outputs else sd.unsqueeze(-1)).square().numpy()


def _one(fit: Fit, record: Record) -> None:
    if not isinstance(record, Record):
        raise invalid(
            "record",
            expected="one Record",
            got=type(record).__name__,
            advice="Predict several records one after the other.",
        )
    fit.model.check(record)
