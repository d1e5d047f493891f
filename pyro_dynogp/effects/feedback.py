"""Inputs that follow the output: the record comes from a closed loop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import held
from pyro_dynogp.effects.base import Effect
from pyro_dynogp.models.variants import Model
from pyro_dynogp.statistics.autoregression import fitted_filter
from pyro_dynogp.statistics.bootstrap import projector, spanning
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.scan import tail_probability
from pyro_dynogp.statistics.serial import REPLICATES
from pyro_dynogp.statistics.shares_of_inputs import own
from pyro_dynogp.statistics.whitening import Whitener

# Of future inputs: a controller answers within as many samples.
AHEAD = (1, 2, 4, 8, 16)


def feedback(residuals: Residuals, *, seed: int = 0) -> list[Evidence]:
    """Inputs that follow the output: held-out residuals that foretell an input.

    The whitened residual, less what past inputs explain, against the next values of each input,
    less what its own past foretells; no causal effect of the input on the output does that. What
    they share at the same instant may be a direct path and does not count: a controller that
    answers within the sample is seen only as far as it goes on answering.

    Args:
        residuals: of one output (n,). seed: of the permutations.

    Returns:
        One for each input that varies. where: channel. size: part of the one-step error that the
        input repeats [output]. gain is of the input's future in the residual [nats].

    Raises:
        ValueError: where fewer than 30 held-out samples are measured.

    Source: cross-correlation at negative lags (Ljung, System Identification, 2nd ed., 16.6), both
    sides whitened (Haugh, JASA 71(354):378, 1976); largest over windows, null by permutation.
    """
    r = residuals
    x = np.where(r.held_out, r.residual, np.nan)
    whiten = fitted_filter(x)
    found = []
    for name, u in zip(r.input_names, r.inputs.T, strict=True):
        if np.std(held(u)) > 0:
            found.append(_followed(r, x, whiten, name, held(u), seed))
    return found


def _followed(
    r: Residuals, x: np.ndarray, whiten: Whitener, name: str, u: np.ndarray, seed: int
) -> Evidence:
    """Evidence for one input u (n,); x (n,): the residual where held out, whitened by `whiten`."""
    foretell = fitted_filter(u)
    n, K = len(u), AHEAD[-1]
    surprise = np.full(n, np.nan)
    surprise[foretell.order :] = foretell(u - u.mean())
    future = np.column_stack([np.append(surprise[k:], np.full(k, np.nan)) for k in range(1, K + 1)])
    missing = ~(np.isfinite(x) & np.isfinite(future).all(1))
    there, Q0, _ = projector(whiten, spanning(own(r)), missing)
    e = whiten(x)[there]
    F = future[whiten.order :][there]
    size = np.sqrt(np.square(F).sum(0))
    F = F / np.where(size > 0, size, 1.0)
    F = F - Q0 @ (Q0.T @ F)
    # Orthogonal in the order of the lags, so that sums over the first ones are those windows.
    Q, R = np.linalg.qr(F)
    Q = Q * (np.abs(np.diag(R)) > 1e-6)
    e0 = e - Q0 @ (Q0.T @ e)
    variance = max(float(e0 @ e0) / max(len(e) - Q0.shape[1], 1), 1e-300)
    generator = np.random.default_rng(seed)
    shuffled = np.stack([generator.permutation(e) for _ in range(REPLICATES)])
    if len(r.deviations):
        left = whiten(r.deviations.T)[there].T
        shuffled = shuffled + left[generator.integers(len(left), size=REPLICATES)]
    shuffled = shuffled - (shuffled @ Q0) @ Q0.T
    windows = np.array(AHEAD)

    def standardised(b: np.ndarray) -> np.ndarray:
        sums = np.cumsum(b**2, axis=-1)[..., windows - 1] / variance
        return (sums - windows) / np.sqrt(2.0 * windows)

    own_b = e0 @ Q
    z = standardised(own_b)
    null = standardised(shuffled @ Q).max(1)
    best = int(np.argmax(z))
    share = float(np.square(own_b[: windows[best]]).sum() / max(e0 @ e0, 1e-300))
    lags = np.arange(1, K + 1)
    correlation = (F.T @ e0) / np.maximum(np.sqrt(np.square(F).sum(0) * (e0 @ e0)), 1e-300)
    soonest = float(lags[int(np.argmax(np.abs(correlation[: windows[best]])))]) * r.step
    return Evidence(
        effect="feedback",
        statistic=float(z[best]),
        p_value=tail_probability(null, float(z[best])),
        gain=-0.5 * len(e) * float(np.log1p(-min(share, 1.0 - 1e-9))),
        size=float(np.sqrt(variance * share)),
        where={"channel": name},
        sentence=f"Input {name!r} follows the disturbances of {r.output_name!r}, most after "
        f"{soonest:.3g} {r.time_unit}: it is under feedback.",
        curve=Curve(
            x=lags * r.step,
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
