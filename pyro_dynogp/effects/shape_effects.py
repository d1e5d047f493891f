"""Static nonlinearities and hysteresis, at the output and at the inputs, that a model lacks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.signals import hermite, hinges, play
from pyro_dynogp.effects.saturation import saturation
from pyro_dynogp.statistics.detecting import (
    NOTICED,
    about,
    binned,
    evidence,
    labelled,
    lasting,
    located,
    located_limits,
    of_positive_weight,
    unexplained,
    unit,
)
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.regression import with_past
from pyro_dynogp.statistics.responses import responses, standardised
from pyro_dynogp.statistics.shares_of_inputs import Paths, own, paths

__all__ = ["dead_zone", "hysteresis", "input_nonlinearity", "output_nonlinearity", "saturation"]

# Quantiles of an input between which a dead zone may lie.
LEVELS = np.linspace(0.0, 1.0, 9)
# Widths of play that are tried, against the range of the signal.
WIDTHS = np.geomspace(0.02, 0.8, 10)


def output_nonlinearity(residuals: Residuals, *, seed: int = 0) -> Evidence:
    """Test for a function of the mean alone, beyond the mean itself.

    Variants: Hermite polynomials of the second and third degree, apart and together, and piecewise
    linear functions with one knot and with five (after Ramsey's RESET, J. R. Stat. Soc. B 31:350,
    1969). `where` is empty.

    Raises:
        ValueError: where fewer than 30 samples are held out and measured.
    """
    r = residuals
    powers, bends = hermite(r.mean), hinges(r.mean)
    variants = [powers[:, :1], powers[:, 1:], powers, bends, *bends.T]
    variants, nuisance = [with_past(v) for v in variants], with_past(r.mean)
    found = lasting(r, variants, nuisance, seed)
    axes = (
        labelled(f"simulated {r.output_name}", r.output_unit),
        labelled("residual", r.output_unit),
    )
    return evidence(
        "output nonlinearity",
        found,
        {},
        f"'{r.output_name}' is a nonlinear function of what the model says{about(r, found)}.",
        binned(r, r.mean, unexplained(r, nuisance, found.fitted), found.fitted, axes),
    )


def input_nonlinearity(residuals: Residuals, *, seed: int = 0) -> Evidence:
    """Test for responses of even and odd functions of each used input, beyond those of itself.

    The functions (Hermite polynomials, piecewise linear ones) go through the model's own path from
    that input, and the polynomials through a bank of filters as well (after the cross-correlations
    with squared inputs of Billings and Voon, Int. J. Control 44:235, 1986). `where`: channel.

    Raises:
        ValueError: where fewer than 30 samples are held out and measured.
    """
    r = residuals
    path = paths(r)
    nuisance = _linear(r, path)
    tried: list[tuple[int, np.ndarray]] = []
    for j, u in enumerate(r.inputs.T):
        powers, bends = hermite(u), hinges(u, 3)
        through = path(j, np.column_stack([powers, bends]))
        banks = [responses(powers[:, i], r.step, r.time, constants=4, lags=1) for i in (0, 1)]
        ways = [through[:, :1], through[:, 1:2], through[:, :2], through[:, 2:]]
        tried += [(j, way) for way in [*map(with_past, ways), *banks]]
    found = lasting(r, [columns for _, columns in tried], nuisance, seed)
    j = tried[found.best][0]
    name = r.input_names[j]
    axes = (name, labelled("residual", r.output_unit))
    return evidence(
        "input nonlinearity",
        found,
        {"channel": name},
        f"Channel '{name}' acts on '{r.output_name}' through a nonlinear function of itself"
        f"{about(r, found)}.",
        binned(r, r.inputs[:, j], unexplained(r, nuisance, found.fitted), found.fitted, axes),
    )


def dead_zone(residuals: Residuals, *, seed: int = 0) -> Evidence:
    """Test whether an input has no effect between two of its values.

    The column is the model's own path from that input, driven by dead zone less input. `where`:
    channel, low, high [input]; the smallest or largest value of the input where the zone reaches
    that far. An input with less than three values among its octiles is left out.

    Raises:
        ValueError: where fewer than 30 samples are held out and measured, or all inputs are left
            out.
    """
    r = residuals
    path = paths(r)
    nuisance = _linear(r, path)

    def columns(j: int, limits: Sequence[tuple[float, float]]) -> np.ndarray:
        return path(j, np.column_stack([-np.clip(r.inputs[:, j], *at) for at in limits]))

    tried: list[tuple[int, float, float]] = []
    variants: list[np.ndarray] = []
    for j, u in enumerate(r.inputs.T):
        at = np.unique(np.quantile(u, LEVELS))
        inner = [(a, b) for i, a in enumerate(at) for b in at[i + 1 :] if (a, b) != (at[0], at[-1])]
        if not inner:
            continue
        tried += [(j, float(a), float(b)) for a, b in inner]
        variants += [with_past(c) for c in columns(j, inner).T]
    if not variants:
        raise ValueError(
            "residuals: expected an input of more than two values among its octiles, between which "
            f"a dead zone could lie; none of the {r.inputs.shape[1]} has them."
        )
    found = of_positive_weight(lasting(r, variants, nuisance, seed))
    j, low, high = tried[found.best]
    if found.p_value < NOTICED:
        at = np.unique(np.quantile(r.inputs[:, j], np.linspace(0.0, 1.0, 21)))
        low, high = located_limits(r, lambda a, b: columns(j, [(a, b)]), (low, high), at, nuisance)
    name = r.input_names[j]
    return evidence(
        "dead zone",
        found,
        {"channel": name, "low": low, "high": high},
        f"Channel '{name}' has no effect on '{r.output_name}' from {low:.3g} to {high:.3g}"
        f"{about(r, found)}.",
        binned(
            r,
            r.inputs[:, j],
            unexplained(r, nuisance, found.fitted),
            found.fitted,
            (name, labelled("residual", r.output_unit)),
        ),
    )


def hysteresis(residuals: Residuals, *, seed: int = 0) -> Evidence:
    """Test for play (backlash) at an input or at the output.

    Columns: the model's own path driven by play(u_j, width) - u_j, and play(mean, width) - mean.
    A phase lag, which differs from play in that it depends on frequency, is left to the responses
    of the inputs. `where`: channel (the output's name for play there), width (full, of that
    channel's unit).

    Raises:
        ValueError: where fewer than 30 samples are held out and measured.
    """
    r = residuals
    path = paths(r)
    nuisance = _linear(r, path)
    signals = [*r.inputs.T, r.mean]
    names = [*r.input_names, r.output_name]

    def columns(j: int, widths: np.ndarray) -> np.ndarray:
        s = signals[j]
        lost = np.column_stack([play(s, w) - s for w in widths])
        return path(j, lost) if j < len(signals) - 1 else lost

    ranges = [float(np.ptp(np.quantile(s, [0.01, 0.99]))) for s in signals]
    tried = [(j, k) for j in range(len(signals)) for k in range(len(WIDTHS))]
    variants = [with_past(c) for j in range(len(signals)) for c in columns(j, WIDTHS * ranges[j]).T]
    found = of_positive_weight(lasting(r, variants, nuisance, seed))
    j, k = tried[found.best]
    width = float(WIDTHS[k] * ranges[j])
    if found.p_value < NOTICED:
        grid = WIDTHS * ranges[j]
        width = located(r, lambda w: columns(j, np.array([w])), width, grid, nuisance)
    own_gains = found.gains[[i for i, t in enumerate(tried) if t[0] == j]]
    of = unit(r.output_unit) if j == len(signals) - 1 else ""
    label = labelled(f"width of the play of {names[j]}", of.strip())
    return evidence(
        "hysteresis",
        found,
        {"channel": names[j], "width": width},
        f"'{r.output_name}' follows channel '{names[j]}' with play, {width:.3g}{of} wide"
        f"{about(r, found)}."
        if j < len(signals) - 1
        else f"'{r.output_name}' has play, {width:.3g}{of} wide{about(r, found)}.",
        Curve(WIDTHS * ranges[j], own_gains, np.full(len(WIDTHS), np.nan), label, "gain [nats]"),
    )


def _linear(residuals: Residuals, path: Paths) -> np.ndarray:
    """What is linear in the inputs, with the model's own dynamics and with others."""
    return np.column_stack([own(residuals), with_past(standardised(path.shares))])
