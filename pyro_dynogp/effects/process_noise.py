"""Disturbances that pass through dynamics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Effect
from pyro_dynogp.models.variants import Model, has_process_noise, with_pairs, with_process_noise
from pyro_dynogp.statistics.autoregression import fitted_filter
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.serial import held_out_innovations, one_step_sd, portmanteau
from pyro_dynogp.statistics.settings import LoopSettings


def process_noise(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    """Disturbances that pass through dynamics: autocorrelated held-out one-step errors.

    Their null keeps their sizes in place, so that heteroscedastic noise does not look coloured.

    Returns:
        where: time_constant of an autocorrelation c exp(-lag / time_constant) [time unit], zero
        where neighbours differ in sign. size: what the past tells of the one-step error [output].

    Source: `portmanteau`.
    """
    r = residuals
    v = held_out_innovations(r, settings)
    statistic, p_value, window, rho = portmanteau(v, settings, seed, signs=True)
    gain = 0.5 * float(np.isfinite(v).sum()) * float(np.square(rho[:window]).sum())
    decay, amplitude = _decay(rho)
    constant = -r.step / np.log(decay) if decay > 0 else 0.0
    whiten = fitted_filter(v, settings)
    left = float(np.nanvar(whiten(v)) / max(np.nanvar(v), 1e-300))
    known = f"; their autocorrelation decays with a time constant of {constant:.3g} {r.time_unit}"
    lags = np.arange(1, len(rho) + 1)
    return Evidence(
        effect="process noise",
        statistic=statistic,
        p_value=p_value,
        gain=gain,
        size=one_step_sd(r, settings) * float(np.sqrt(max(1.0 - left, 0.0))),
        where={"time_constant": float(constant)},
        sentence=f"One-step errors of {r.output_name!r} depend on earlier ones ({rho[0]:.2f} with "
        f"the one before){known if decay > 0 else ''}.",
        curve=Curve(
            x=lags * r.step,
            y=rho,
            fitted=amplitude * decay**lags,
            x_label=f"lag [{r.time_unit}]",
            y_label=f"autocorrelation of one-step errors of {r.output_name}",
        ),
    )


def _decay(rho: np.ndarray) -> tuple[float, float]:
    """Decay per step and amplitude of amplitude * decay^lag, least squares; zeros: none."""
    grid = np.linspace(0.01, 0.995, 198)
    shapes = grid[:, None] ** np.arange(1, len(rho) + 1)
    norm = np.square(shapes).sum(1)
    amplitude = shapes @ rho / norm
    gain = np.where(amplitude > 0, amplitude**2 * norm, 0.0)
    best = int(np.argmax(gain))
    return (float(grid[best]), float(amplitude[best])) if gain[best] > 0 else (0.0, 0.0)


class ProcessNoise(Effect):
    """Disturbances that pass through dynamics."""

    name = "process noise"
    score = "one step"
    family = "paths"
    acts_on = "noise"
    freedom = 6
    once = True
    absorbs_structure = True
    settled_by_evidence = True  # its mode may have a poor mean (37 +- 37 nats, draws of it 120)
    test = staticmethod(process_noise)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Process noise in every dynamic layer; where it is there, more poles are for dynamics."""
        if has_process_noise(model):
            return []
        noisy = with_process_noise(model)
        return [noisy, with_pairs(noisy, 1)]
