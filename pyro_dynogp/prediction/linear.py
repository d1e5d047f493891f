"""Simulation, k-step prediction and forecast of a fitted linear dynamic GP, exact and O(n)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.distributions.process import LTIProcess, ObservedLTIProcess
from pyro_dynogp.distributions.trajectory import split_missing
from pyro_dynogp.lti.filtering import predict_k_steps
from pyro_dynogp.lti.semiseparable import SemiseparableCovariance
from pyro_dynogp.lti.state import ModalState, propagate
from pyro_dynogp.models.linear import LinearDynamicGP, initial_mean
from pyro_dynogp.prediction.prediction import Prediction
from pyro_dynogp.prediction.records import following, gap_between, one_record
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.parallel import seeded
from pyro_dynogp.support.tensors import as_tensor

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fit

# In the kind of a k-step prediction whose joint samples depend on each other as its errors do.
JOINT = ", errors drawn jointly"


def _model(fit: Fit) -> LinearDynamicGP:
    assert isinstance(fit.model, LinearDynamicGP)
    return fit.model


def prior_process(
    fit: Fit, record: Record, *, process_noise: bool = True, unknown_start: bool = False
) -> LTIProcess:
    """Noise-free trajectories along a record, one batch element for each draw.

    Where the first state is a site (``initial_state="site"``) the draws know that of the training
    record, so that densities given a draw begin there; on other records it is unknown.

    Args:
        fit: the fit. record: time and inputs. process_noise: False for the deterministic system.
        unknown_start: whether the first state is unknown on the training record, too, as
            predictions have it: they serve every record in the same way.
    """
    model, system = _model(fit), fit.system
    state = None
    if model.initial_state == "site":
        index = None if unknown_start else _place(fit, record)
        if index is not None:
            return process_given(fit, record, index)
        modes = system.modes if process_noise else system.modes.without_process_noise()
        state = model.prior_state(system, modes)
    return model.process(system, record, fit.scaling, state, process_noise=process_noise)


def process_given(fit: Fit, record: Record, index: int) -> LTIProcess:
    """Trajectories as the draws have them of a training record, of which `record` has the times.

    Args:
        fit: the fit. record: time and inputs. index: of the training record.
    """
    model, system = _model(fit), fit.system
    if model.initial_state != "site":
        return prior_process(fit, record)
    suffix = "" if len(fit.records) == 1 else f"_{index}"
    state = initial_mean(system.past_inputs, fit.draws[f"initial_state{suffix}"])
    return model.process(system, record, fit.scaling, state)


def _place(fit: Fit, record: Record) -> int | None:
    """Index of a record among the training records, as measured or as the model sees them."""
    for index, one in enumerate(fit.records):
        if record.fingerprint in (one.fingerprint, fit.model.check(one)[0].fingerprint):
            return index
    return None


def simulate(fit: Fit, record: Record, process_noise: bool, samples: int, seed: int) -> Prediction:
    """See `Fit.simulate`."""
    record = one_record(fit, record)
    with torch.no_grad():
        process = prior_process(fit, record, process_noise=process_noise, unknown_start=True)
        return _of_process(fit, process, record, samples, seed, "simulation")


def forecast(
    fit: Fit, past: Record, future: Record, process_noise: bool, samples: int, seed: int
) -> Prediction:
    """See `Fit.forecast`."""
    past, future = following(fit, past, future)
    gap = gap_between(past, future)
    if not past.n_outputs:
        raise invalid("past", expected="outputs to start from", got="none")
    with torch.no_grad():
        system, model, scaling = fit.system, _model(fit), fit.scaling
        before = prior_process(fit, past, unknown_start=True)
        y = past.tensors().observations
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
    record = one_record(fit, record)
    if not record.n_outputs:
        raise invalid("record", expected="outputs to predict from", got="none")
    with torch.no_grad():
        process = prior_process(fit, record, unknown_start=True)
        observed = process.observed(fit.system.noise_sd)
        y = record.tensors().observations
        residual, missing = split_missing(observed.rows(y - process.mean))
        v = observed.noise_rows
        v = v if missing is None else v.masked_fill(missing, torch.inf)
        seen = process.covariance(v)
        moments = predict_k_steps(seen, residual, horizon)
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
        if horizon == 1 and not fit.model.several_outputs and missing is None:
            # Errors are innovations, independent of each other.
            generator = np.random.default_rng(seed)
            which = generator.integers(len(mean_), size=samples)
            sd = np.sqrt(variance_ + noise[:, None, :])
            return mean_[which] + sd[which] * generator.standard_normal((samples, *mean_.shape[1:]))
        with torch.no_grad(), seeded(seed):
            errors = prediction_errors(observed, seen, horizon, -(-samples // len(mean_)))
            return _each(mean_ + _outputs(fit, errors), samples)

    kind = f"{horizon}-step prediction"
    if horizon > 1:
        kind += JOINT
    return _prediction(fit, record, mean_, variance_, noise, parts, draw, kind)


def prediction_errors(
    observed: ObservedLTIProcess, seen: SemiseparableCovariance, horizon: int, count: int
) -> Tensor:
    """Draws (count, S, *event) of the errors of all k-step predictions of a record, jointly.

    Neighbouring errors share innovations: in the steady state of a regular record they are the
    moving average e_t = sum_{j<k} psi_j nu_{t-j} of the innovations nu. Here they are what the
    predictor makes of outputs drawn from the model, so that any clock, gaps, the first samples and
    several outputs are exact, too; one filter pass for each draw.

    Args:
        observed: distribution of the outputs, batch (S,). horizon: k [samples].
        seen: covariance of the samples that the predictor sees (missing ones left out).
        count: number of draws for each of the S.
    """
    residual = observed.rows(observed.sample((count,)) - observed.mean)
    known = residual.masked_fill(seen.missing, 0.0)
    return observed.from_rows(residual - predict_k_steps(seen, known, horizon).mean)


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
            each = -(-samples // process.batch_shape[0])
            y = process.observed(fit.system.noise_sd).sample((each,))
            return _each(_outputs(fit, y), samples)

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


def _each(y: np.ndarray, samples: int) -> np.ndarray:
    """So many of the samples y (R, S, n, n_y), as many of each draw S as of any other, or nearly.

    Those that not all draws give come from draws spread evenly over all of them.
    """
    whole, rest = divmod(samples, y.shape[1])
    evenly = ((np.arange(rest) + 0.5) * y.shape[1] / max(rest, 1)).astype(int)
    return np.concatenate([y[:whole].reshape(-1, *y.shape[2:]), y[-1, evenly]])


def _outputs(fit: Fit, x: Tensor) -> np.ndarray:
    """(*b, n) or (*b, n, n_y) to an array (*b, n, n_y)."""
    return (x if fit.model.several_outputs else x.unsqueeze(-1)).numpy()


def _noise(fit: Fit) -> np.ndarray:
    """Measurement-noise variance (S, n_y)."""
    sd = fit.system.noise_sd
    return (sd if fit.model.several_outputs else sd.unsqueeze(-1)).square().numpy()
