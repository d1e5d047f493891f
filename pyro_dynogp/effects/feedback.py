"""Inputs that follow the output: the record comes from a closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import held
from pyro_dynogp.effects.base import Effect
from pyro_dynogp.models.variants import Model
from pyro_dynogp.statistics.autoregression import Whitener, fitted_filter
from pyro_dynogp.statistics.bootstrap import Noise, standardised_gains, tail_probability
from pyro_dynogp.statistics.controllers import SET, controller_of
from pyro_dynogp.statistics.detecting import looked
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.prewhitening import Projection, log_ratio, spanning
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import input_columns

# Of future inputs: a controller answers within as many samples.
AHEAD = (1, 2, 4, 8, 16)
# p-value of an exact relation, which no chance makes.
CERTAIN = 1e-300


def feedback(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> list[Evidence]:
    """Inputs that follow the output: held-out residuals that foretell an input.

    The whitened residual, less what past inputs explain, against the next values of each input,
    less what its own past foretells; no causal effect of the input on the output does that. What
    they share at the same instant may be a direct path and does not count: a controller that
    answers within the sample is seen only as far as it goes on answering. An input that is computed
    from the output to the last digits, with or without a recorded set point, is under feedback
    whatever the residual is; see `statistics.controllers`.

    Returns:
        One for each input that varies, and first one for each input that is computed, with the
        `where` of its set point ("" for none that is recorded). where: channel. size: part of the
        one-step error that the input repeats [output]. gain is of the input's future in the
        residual [nats].

    Source: cross-correlation at negative lags (Ljung, System Identification, 2nd ed., 16.6), both
    sides whitened (Haugh, JASA 71(354):378, 1976); largest over windows, null by resampling.
    """
    r = residuals
    whiten = fitted_filter(looked(r), settings)
    inputs = [(name, held(u)) for name, u in zip(r.input_names, r.inputs.T, strict=True)]
    varied = [(name, u) for name, u in inputs if np.std(u) > 0]
    followed = [_followed(r, whiten, name, u, settings, seed) for name, u in varied]
    computed = (
        _computed(r, one, u, settings) for one, (_, u) in zip(followed, varied, strict=True)
    )
    return [*(one for one in computed if one is not None), *followed]


def _computed(
    r: Residuals, followed: Evidence, u: np.ndarray, settings: LoopSettings
) -> Evidence | None:
    """Evidence that an input u (n,) is computed from the output; None where it is not."""
    controller = controller_of(u, r.output, r.candidates)
    if controller is None or controller.share >= settings.controller:
        return None
    name, sources = followed.where["channel"], [r.output_name]
    sources += [controller.set_point] if controller.set_point else []
    names = " and ".join(repr(one) for one in sources)
    return replace(
        followed,
        p_value=CERTAIN,
        where={"channel": name, SET: controller.set_point},
        sentence=f"Input {name!r} is computed from {names}: it is under feedback.",
    )


def _followed(
    r: Residuals, whiten: Whitener, name: str, u: np.ndarray, settings: LoopSettings, seed: int
) -> Evidence:
    """Evidence for one input u (n,); `whiten` is the filter of the residual."""
    foretell, x = fitted_filter(u, settings), looked(r)
    n, K = len(u), AHEAD[-1]
    surprise = np.full(n, np.nan)
    surprise[foretell.order :] = foretell(u - u.mean())
    future = np.column_stack([np.append(surprise[k:], np.full(k, np.nan)) for k in range(1, K + 1)])
    missing = ~(np.isfinite(x) & np.isfinite(future).all(1))
    under = Projection(whiten, spanning(input_columns(r)), missing, settings)
    white, e = under.filtered(x), under(x)
    F = future[under.samples]
    size = np.sqrt(np.square(F).sum(0))
    F = F / np.where(size > 0, size, 1.0)
    F = F - under.Q @ (under.Q.T @ F)
    # Orthogonal in the order of the lags, so that sums over the first ones are those windows.
    Q, R = np.linalg.qr(F)
    Q = Q * (np.abs(np.diag(R)) > 1e-6)
    variance = max(float(e @ e) / max(len(e) - under.Q.shape[1], 1), 1e-300)
    windows = np.array(AHEAD)

    def standardised(b: np.ndarray) -> np.ndarray:
        return standardised_gains(np.cumsum(b**2, axis=-1)[..., windows - 1] / variance, windows)

    left = under.filtered(r.deviations.T).T
    noise = Noise(np.zeros(0), white, np.zeros(len(white), dtype=bool), left)
    null = [
        standardised((batch - (batch @ under.Q) @ under.Q.T) @ Q).max(1)
        for batch in noise.replicates(settings.replicates, seed)
    ]
    b = e @ Q
    z = standardised(b)
    best = int(np.argmax(z))
    explained, total = float(np.square(b[: windows[best]]).sum()), max(float(e @ e), 1e-300)
    correlation = (F.T @ e) / np.maximum(np.sqrt(np.square(F).sum(0) * total), 1e-300)
    soonest = float(1 + np.argmax(np.abs(correlation[: windows[best]]))) * r.step
    return Evidence(
        effect="feedback",
        statistic=float(z[best]),
        p_value=tail_probability(np.concatenate(null), float(z[best]), settings),
        gain=0.5 * len(e) * float(log_ratio(np.array(explained), total)),
        size=float(np.sqrt(variance * explained / total)),
        where={"channel": name},
        sentence=f"Input {name!r} follows the disturbances of {r.output_name!r}, most after "
        f"{soonest:.3g} {r.time_unit}: it is under feedback.",
        curve=Curve(
            x=np.arange(1, K + 1) * r.step,
            y=correlation,
            fitted=np.full(K, np.nan),
            x_label=f"time by which the input comes later [{r.time_unit}]",
            y_label=f"correlation of residual and {name}",
        ),
    )


class Feedback(Effect):
    """Inputs that follow the output: the record comes from a closed loop."""

    name = "feedback"
    family = "feedback"
    acts_on = "noise"
    added = False
    test = staticmethod(feedback)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Nothing: it is reported."""
        return []
