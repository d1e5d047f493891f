"""Residuals of a fit along a record, with all that the tests look at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pyro_dynogp.criticism.posterior_draws import draws_of
from pyro_dynogp.data.channels import count_direct
from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.held_out_errors import one_step_errors
from pyro_dynogp.discrepancy.parameter_spread import normal_near
from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError
from pyro_dynogp.models.delays import longest_delay, unknown_beginning
from pyro_dynogp.models.limits import at_limits
from pyro_dynogp.prediction.first_state import States
from pyro_dynogp.prediction.predict import (
    forecast,
    holds_after,
    leave_range,
    predict,
    runs_after,
    simulate,
    states_before,
)
from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.support.errors import invalid

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit

# Share of a posterior draw's distance from the mode at which runs are linear in the parameters.
NEAR = 1e-3


@dataclass(frozen=True, eq=False)
class FreeRun:
    """A free run of a fit along a record, of all its outputs.

    Attributes:
        begin: first sample that counts: see `residuals_of`.
        mean: (n, n_y) of the fit itself [output].
        deviations: (S, n, n_y) of posterior draws, less their mean [output].
        errors: (n, n_y) one step ahead, as of `one_step_errors`.
    """

    begin: int
    mean: np.ndarray
    deviations: np.ndarray
    errors: np.ndarray


def free_run_of(
    fit: Fit, record: Record, *, held_out: np.ndarray, seed: int, settings: LoopSettings
) -> FreeRun:
    """The free run that residuals of every output are of; see `residuals_of`."""
    prepared = fit.model.check(record)[0]
    begin = unknown_beginning(record, longest_delay(fit.model)) + settling(fit, record, settings)

    # First states take longest to estimate, and are the same for all draws of the parameters.
    states = None
    if _has_past(fit, prepared, begin):
        states = states_before(fit, prepared[:begin], prepared[begin:])

    def run(spread: Fit) -> tuple[np.ndarray, np.ndarray]:
        return _free_run(fit, spread, prepared, begin, settings.draws, seed, states)

    if fit.method != "map":
        mean, component = run(fit)
    else:
        mean, component = _straight(run, fit, settings, seed)
    # What runs away is no spread of what was learnt.
    holds = ~leave_range(fit, component[:, begin:]).any(1)
    component = component[holds] if holds.any() else component
    chosen = np.linspace(0, len(component) - 1, min(settings.draws, len(component))).astype(int)
    drawn = component[chosen]
    errors = one_step_errors(fit, record, held_out)
    return FreeRun(begin, mean, drawn - drawn.mean(0), errors)


def _straight(
    run: Callable[[Fit], tuple[np.ndarray, np.ndarray]], fit: Fit, settings: LoopSettings, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and draws of a free run whose change by the parameters is taken as linear.

    Parameters are far from linear along their ridges: runs of draws from a normal are then spread
    by several times the noise, which no posterior is (557 samples of a Wiener model: 0.114 with
    Laplace's approximation and 0.684 with the Fisher matrix, where the noise is 0.036; linear in
    the parameters 0.063 and 0.060; 381 samples of a tank, linear dynamics of two pairs: 0.9 for a
    noise of 0.09; 0.035). Each draw has a first state of its own, the same at the mode and near it.
    Where the filter cannot be run at some of them, all are draws as they are.
    """
    count = settings.draws
    mean, still = run(_at_mode(fit, count))
    _, moved = run(fit.with_draws(normal_near(fit, settings, NEAR).draws(count, seed).values))
    if len(still) != len(moved):  # the filter fails at some of them
        return run(_spread(fit, count, seed))
    return mean, still + (moved - still) / NEAR


def residuals_of(
    fit: Fit,
    record: Record,
    *,
    held_out: np.ndarray | None = None,
    candidates: Sequence[str] = (),
    output: int = 0,
    seed: int = 0,
    settings: LoopSettings,
    run: FreeRun | None = None,
) -> Residuals:
    """Free-run residuals and innovations of one output, in the units of the record.

    The output counts as missing until the model knows its inputs, until a simulation whose first
    state is unknown would have settled, and where it is exactly at a limit that the model knows.
    The free run begins then, with the state that the filter has found in the outputs before: slow
    poles, and several alike, remember for longer. From where it leaves the range of the training
    outputs far behind the output counts as missing, too.

    Args:
        fit: the fit. record: along which, in one piece.
        held_out: (n,) True where the fit has not seen the output; by default everywhere.
        candidates: names of extra channels that may act.
        output: which one. seed: of posterior draws. settings: thresholds.
        run: of `free_run_of`, where there is one already.

    Raises:
        ValueError: where a candidate is no extra channel of the record.
    """
    for name in candidates:
        if name not in record.extra:
            raise invalid(
                "candidates", expected=f"extra channels {list(record.extra)}", got=repr(name)
            )
    prepared = fit.model.check(record)[0]
    held_out = np.ones(len(record), dtype=bool) if held_out is None else held_out
    if run is None:
        run = free_run_of(fit, record, held_out=held_out, seed=seed, settings=settings)
    driving = prepared.n_inputs - count_direct(fit.model.channels)
    y, mean = record.outputs[:, output].copy(), run.mean[:, output]
    y[: run.begin] = np.nan
    # What follows a run that leaves the range is no prediction.
    away = np.logical_or.accumulate(leave_range(fit, run.mean[None])[0])
    y[away], mean = np.nan, np.where(away, float(fit.scaling.output_offset[output]), mean)
    innovations = run.errors[:, output]
    # A sensor at its limit says nothing of the error there.
    stopped = at_limits(fit.model.layers, prepared)
    y[stopped], innovations = np.nan, np.where(stopped, np.nan, innovations)
    return Residuals(
        time=record.time,
        output=y,
        mean=mean,
        deviations=run.deviations[..., output],
        innovations=innovations,
        poles=poles_of(fit),
        inputs=prepared.inputs[:, :driving],
        input_names=prepared.input_names[:driving],
        candidates={name: record.extra[name] for name in candidates},
        held_out=held_out,
        output_name=record.output_names[output],
        output_unit=record.output_units[output],
        time_unit=record.time_unit,
        step=record.sampling_time,
        stamps=record.timestamps,
        linear=fit.model.is_linear,
    )


def _has_past(fit: Fit, record: Record, begin: int) -> bool:
    """Whether outputs before a sample tell something of the state there."""
    return bool(np.isfinite(record.outputs[:begin]).any() and poles_of(fit).size)


def _free_run(
    fit: Fit,
    spread: Fit,
    record: Record,
    begin: int,
    count: int,
    seed: int,
    states: States | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (n, n_y) of a free run from sample `begin` on, and draws of it (S, n, n_y).

    Before, and along all of a record without outputs there, from an unknown first state; so where
    predictions before run away. Where functions in feedback make free runs from an unknown state
    run away, predictions one step ahead stand before: no residual is taken there, but tests see the
    past of each sample.
    """
    noisy = fit.model.is_linear
    mean = simulate(fit, record, noisy, seed=seed, warns=False).mean
    component = simulate(spread, record, noisy, count, seed, warns=False).component_mean
    if _has_past(fit, record, begin):
        past, rest = record[:begin], record[begin:]
        runs = _runs(spread, past, rest, count, seed, states)
        few = min(len(component), len(runs))
        if few and bool(holds_after(fit, past, rest, states).all()):
            found = forecast(fit, past, rest, noisy, seed=seed, states=states, warns=False)
            mean[begin:] = found.mean
            component = np.concatenate([component[:few, :begin], runs[:few]], axis=1)
            before = np.concatenate([mean[None], component])[:, :begin]
            if leave_range(fit, before).any():
                mean[:begin] = component[:, :begin] = predict(fit, past).mean
    return mean, component


def _runs(
    spread: Fit, past: Record, rest: Record, count: int, seed: int, states: States | None = None
) -> np.ndarray:
    """Draws of a free run (S, n, n_y), of those parameter draws at which the filter can be run.

    A draw may have a first state so uncertain that nothing of the noise is left of its variance, or
    run away with what comes back.
    """
    holding = holds_after(spread, past, rest, states)
    if not bool(holding.any()):
        return np.empty((0, len(rest), rest.n_outputs))
    if not bool(holding.all()):
        spread = spread.with_draws({name: x[holding] for name, x in spread.draws.items()})
    try:
        return runs_after(spread, past, rest, samples=count, seed=seed, states=states)
    except NotPositiveDefiniteError:
        if spread.n_draws == 1:
            return np.empty((0, len(rest), rest.n_outputs))
    draws = spread.draws
    halves = [
        spread.with_draws({name: x.tensor_split(2)[half] for name, x in draws.items()})
        for half in (0, 1)
    ]
    return np.concatenate([_runs(half, past, rest, count, seed, states) for half in halves])


def _spread(fit: Fit, count: int, seed: int) -> Fit:
    """A mode with draws around it."""
    return fit.with_draws(draws_of(fit, count=count, seed=seed, anneal=False).values)


def _at_mode(fit: Fit, count: int) -> Fit:
    """A mode with draws that all are the mode."""
    return fit.with_draws({
        name: value.unsqueeze(0).expand(count, *value.shape) for name, value in fit.mode.items()
    })  # fmt: skip


def settling(fit: Fit, record: Record, settings: LoopSettings) -> int:
    """Samples until what the first state left in a simulation has died away."""
    poles = poles_of(fit)
    if not len(poles):
        return 0
    slowest = float(-poles.real.max())
    count = settings.settled / max(slowest * record.sampling_time, 1e-9)
    return int(min(count, settings.settling_share * len(record)))


def poles_of(fit: Fit) -> np.ndarray:
    """Poles (P,) of all dynamic layers at the mode, one of each conjugate pair [1 / time unit]."""
    found = [layer.modes.poles.numpy() for _, layer in fit.system_at(fit.mode).dynamic]
    return np.concatenate(found) if found else np.zeros(0, dtype=complex)
