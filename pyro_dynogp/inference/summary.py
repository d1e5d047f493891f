"""What a fit says about itself in a few lines of text."""

from __future__ import annotations

import numpy as np
import torch

from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.posteriors import Mixture
from pyro_dynogp.inference.stability import warnings_of
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.models.arrival import DELAY
from pyro_dynogp.models.step import is_step
from pyro_dynogp.models.wiring import Dynamic, Known, Layer


def summary(fit: Fitted) -> str:
    """What was fitted, how well it went, the modes at the best optimum."""
    system = fit.system_at(fit.mode)
    model = fit.model
    chain = " -> ".join(f"{wire.name} ({_describe(wire.layer)})" for wire in model.wires)
    plural = "s" if model.inputs != 1 else ""
    lines = [f"{model.inputs} input{plural} -> {chain}"]
    lines[0] += f"; method {fit.method!r}, seed {fit.seed}"
    energies = ", ".join(f"{e:.1f}" for e in fit.start_energies[:6])
    lines.append(f"-log p(y, values) of the starts: {energies}")
    lines.append(_posterior(fit))
    unit = fit.scaling.time_unit
    for wire, layer in system.dynamic:
        if len(model.wires) > 1:
            lines.append(f"layer {wire.name}:")
        assert isinstance(wire.layer, Dynamic)
        lines.extend(_modes(layer.modes, wire.layer, unit))
    for wire in model.wires:
        for name in wire.layer.parameters if isinstance(wire.layer, Known) else ():
            draws = fit.draws[f"{wire.name}_{name}"]
            lines.append(f"{wire.name}_{name}: {float(draws.mean()):.4g}")
    lines.extend(_dead_times(fit))
    if not model.likelihood.varying:
        sd = ", ".join(f"{value:.4g}" for value in fit.noise_sd)
        lines.append(f"measurement noise sd: {sd}")
    lines.extend(f"warning: {sentence}" for sentence in warnings_of(fit))
    return "\n".join(lines)


def _dead_times(fit: Fitted) -> list[str]:
    """Those that are parameters; with their spread where the draws are not of the optima alone."""
    lines = []
    posterior = fit.posterior
    at_optima = isinstance(posterior, Mixture) and DELAY in posterior.points
    for k, channel in enumerate(fit.model.late):
        d = fit.draws[DELAY][:, k]
        line = f"dead time of {channel.channel}: {float(d.mean()):.4g} {fit.scaling.time_unit}"
        if len(d) > 1 and not at_optima:
            low, high = np.quantile(d.numpy(), [0.05, 0.95])
            line += f", sd {float(d.std()):.2g}, 90 % from {low:.4g} to {high:.4g}"
        lines.append(line)
    return lines


def _posterior(fit: Fitted) -> str:
    """What the draws are."""
    if fit.method == "map":
        return "parameters at the mode: bands leave out their uncertainty (the default counts it)"
    count = len(next(iter(fit.draws.values())))
    line = f"{count} draws: {fit.posterior.kind}"
    if "independent draws" in fit.diagnostics:
        k, number = fit.diagnostics["pareto_k"], fit.diagnostics["independent draws"]
        line += f"; Pareto k {k:.2f} of the proposal, {number:.0f} effective draws"
    if fit.diagnostics.get("r_hat", 1.0) > 1.0:
        line += f", R-hat {fit.diagnostics['r_hat']:.2f} of their log-density"
    return line


def _describe(layer: Layer) -> str:
    width = f", {layer.outputs} outputs" if layer.outputs > 1 else ""
    if isinstance(layer, Dynamic):
        integrates = ", an integrator" if layer.integrators else ""
        return f"dynamic, {layer.pairs} pairs{integrates}{width}"
    if isinstance(layer, Known):
        return f"{'step' if is_step(layer) else 'known function'}{width}"
    return f"static, {layer.inducing} inducing values{width}"


def _modes(modes: Modes, layer: Dynamic, unit: str) -> list[str]:
    frequency, damping = modes.natural_frequency[: layer.pairs], modes.damping
    return [
        f"  natural frequency {float(frequency[j]):10.4g} rad/{unit}"
        f"   damping {float(damping[j]):6.3f}"
        for j in torch.argsort(frequency).tolist()
    ]
