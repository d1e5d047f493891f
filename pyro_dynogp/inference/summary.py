"""What a fit says about itself in a few lines of text."""

from __future__ import annotations

from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.stability import warnings_of
from pyro_dynogp.models.description import kind_of
from pyro_dynogp.models.wiring import Dynamic, Known, Layer


def summary(fit: Fitted) -> tuple[str, str]:
    """What was fitted and how well it went; and what is to be warned of, which may be nothing."""
    model = fit.model
    chain = " -> ".join(f"{wire.name} ({_describe(wire.layer)})" for wire in model.wires)
    plural = "s" if model.inputs != 1 else ""
    lines = [f"{model.inputs} input{plural} -> {chain}"]
    lines[0] += f"; method {fit.method!r}, seed {fit.seed}"
    energies = ", ".join(f"{e:.1f}" for e in fit.start_energies[:6])
    lines.append(f"-log p(y, values) of the starts: {energies}")
    lines.append(_posterior(fit))
    warned = "\n".join(f"warning: {sentence}" for sentence in warnings_of(fit))
    return "\n".join(lines), warned


def _posterior(fit: Fitted) -> str:
    """What the draws are."""
    if fit.method == "map":
        return "parameters at the mode: bands leave out their uncertainty (the default counts it)"
    count = fit.n_draws
    line = f"{count} draws: {fit.posterior.kind}"
    if "independent draws" in fit.diagnostics:
        k, number = fit.diagnostics["pareto_k"], fit.diagnostics["independent draws"]
        line += f"; Pareto k {k:.2f} of the proposal, whose effective size is {number:.0f}"
    if fit.diagnostics.get("r_hat", 1.0) > 1.0:
        line += f", R-hat {fit.diagnostics['r_hat']:.2f} of their log-density"
    return line


def _describe(layer: Layer) -> str:
    width = f", {layer.outputs} outputs" if layer.outputs > 1 else ""
    if isinstance(layer, Dynamic):
        integrates = ", an integrator" if layer.integrators else ""
        return f"dynamic, {layer.pairs} pairs{integrates}{width}"
    if isinstance(layer, Known):
        return f"{kind_of(layer)}{width}"
    return f"static, {layer.inducing} inducing values{width}"
