"""A table of what a fit says about its plant: frequencies, damping, gains, noise, lengthscales."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from pyro_dynogp.criticism.physical import physical_quantities
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.posteriors import Mixture
from pyro_dynogp.models.arrival import DELAY
from pyro_dynogp.models.selection import part, signal_of
from pyro_dynogp.models.wiring import INPUTS, Dynamic, Known, Static, Wire

COLUMNS = ("mean", "sd", "2.5 %", "97.5 %", "unit")
Row = tuple[str, np.ndarray, str]


def parameter_table(fit: Fitted) -> pd.DataFrame:
    """Posterior mean, standard deviation and central 95 % interval of each quantity, and its unit.

    Natural frequencies |lambda| and damping ratios -Re(lambda) / |lambda| of each dynamic layer, in
    every draw ordered by the frequency; steady-state gains (rates, of layers that integrate) of
    linear models; scale of the measurement noise; dead times; parameters of known functions;
    lengthscales of static functions, in the unit of what they see where it is measured, else in
    standard deviations of it ("-").

    Args:
        fit: any fit. What all its draws have in common has a mean alone, NaN for the rest: all of a
            fit at the mode, and what stays at the optimum in others.
    """
    rows = {}
    posterior = fit.posterior
    # A normal around several optima may keep dead times at theirs, which is no spread.
    fixed = isinstance(posterior, Mixture) and DELAY in posterior.points
    for name, values, unit in _rows(fit):
        spread = np.full(3, np.nan)
        varies = len(values) > 1 and np.ptp(values) > 1e-12 * np.abs(values).max()
        if varies and not (fixed and name.startswith("dead time of ")):
            spread = np.array([values.std(), *np.quantile(values, [0.025, 0.975])])
        rows[name] = (float(values.mean()), *spread.tolist(), unit)
    return pd.DataFrame.from_dict(rows, orient="index", columns=list(COLUMNS)).rename_axis(
        "quantity"
    )


def _rows(fit: Fitted) -> Iterator[Row]:
    scaling, model = fit.scaling, fit.model
    count = fit.n_draws
    several = len(model.wires) > 1
    for wire, layer in fit.system.dynamic:
        assert isinstance(wire.layer, Dynamic)
        poles = layer.modes.expand((count,)).poles[:, : wire.layer.pairs].numpy()
        order = np.argsort(np.abs(poles), axis=1)
        poles = np.take_along_axis(poles, order, axis=1)
        before = f"{wire.name}: " if several else ""
        for j in range(poles.shape[1]):
            size = np.abs(poles[:, j])
            label = f" {j + 1}" if poles.shape[1] > 1 else ""
            yield f"{before}natural frequency{label}", size, f"rad/{scaling.time_unit}"
            yield f"{before}damping ratio{label}", -poles[:, j].real / size, "-"
    found = physical_quantities(model, scaling, fit.system, count)
    for name, what in (("g_steady_state_gain", "gain"), ("g_integrator_rate", "integrator rate")):
        for a, output in enumerate(scaling.output_names if name in found else ()):
            for b, given in enumerate(scaling.input_names):
                unit = _ratio(scaling.output_units[a], scaling.input_units[b])
                unit += f"/{scaling.time_unit}" if what == "integrator rate" else ""
                yield f"{what} from {given} to {output}", found[name].values[:, a, b], unit
    if "measurement_noise_sd" in found:
        for a, output in enumerate(scaling.output_names):
            unit = scaling.output_units[a] or "-"
            yield f"noise sd of {output}", found["measurement_noise_sd"].values[:, a], unit
    for k, channel in enumerate(model.late):
        yield f"dead time of {channel.channel}", fit.draws[DELAY][:, k].numpy(), scaling.time_unit
    for wire in model.wires:
        if isinstance(wire.layer, Known):
            for parameter in wire.layer.parameters:
                draws = fit.draws[f"{wire.name}_{parameter}"].reshape(count, -1).numpy()
                for j in range(draws.shape[1]):
                    label = f"[{j}]" if draws.shape[1] > 1 else ""
                    yield f"{wire.name}: {parameter}{label}", draws[:, j], "-"
        elif isinstance(wire.layer, Static):
            yield from _lengthscales(fit, wire)


def _lengthscales(fit: Fitted, wire: Wire) -> Iterator[Row]:
    """Of the default kernel, one for each channel that the function sees."""
    scaling = fit.scaling
    assert isinstance(wire.layer, Static)
    draws = fit.model.static_prior(wire, wire.layer, scaling).lengthscale(fit.draws)
    if draws is None:
        return
    seen: list[tuple[str, float, str]] = []
    for source in wire.sources:
        whole = signal_of(source)
        own = next((w for w in fit.model.wires if w.name == whole), None)
        if whole == INPUTS and fit.model.inputs == len(scaling.input_names):
            units = scaling.input_units
            known = list(zip(scaling.input_names, scaling.input_scale, units, strict=True))
        elif own is not None and own.name == fit.model.output_wire.name:
            units = scaling.output_units
            known = list(zip(scaling.output_names, scaling.output_scale, units, strict=True))
        else:
            width = wire.channels - len(seen) if own is None else own.layer.outputs
            known = [(source, 1.0, "")] * width
        seen += known[part(source, len(known))]
    if len(seen) != wire.channels:
        seen = [("what it sees", 1.0, "")] * wire.channels
    values = draws.reshape(len(draws), -1).numpy()
    for j in range(values.shape[1]):
        name, scale, unit = seen[j] if values.shape[1] == len(seen) else ("what it sees", 1.0, "")
        label = f" [{j}]" if sum(name == other for other, _, _ in seen) > 1 else ""
        yield f"{wire.name}: lengthscale along {name}{label}", scale * values[:, j], unit or "-"


def _ratio(above: str, below: str) -> str:
    return f"{above or '1'}/{below}" if below else above or "-"
