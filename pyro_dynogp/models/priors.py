r"""Priors on the poles and gains of a linear system, as Pyro sample sites.

Everything is stated in units that the record sets: time in steps and lengths of the record, inputs
and outputs in their standard deviations. The same record in hours or seconds, volts or millivolts
gives the same posterior.

Gauge: a single output has c_j = 1 (scale and phase of c_j, B_j and L_j are not separately
identified); several outputs have c_j of unit length with a positive first entry. Each pair is then
a second-order section, and its gains are given as such a section's numerator,

    G_j(s) = |lambda| (g1 s + g0 |lambda|) / ((s - lambda)(s - conj lambda)),

so that g0 is the steady-state gain of the pair and g1 that of its derivative path. Residues
(B_j = lim (s - lambda) G_j) would grow without bound as a pair becomes critically damped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.distributions.decay import LogDecayRate
from pyro_dynogp.distributions.shared_scale import SharedScaleNormal
from pyro_dynogp.lti.modes import Modes, NoiseStructure
from pyro_dynogp.support.errors import invalid

PriorName = Literal["default", "paper"]

# Scale of the horseshoe on the noise gains (paper, appendix "Implementation").
HORSESHOE_SCALE = 0.1
# Gains of a pair for an input of unit size, a priori, and the degrees of freedom of that size.
GAIN_SCALE, GAIN_FREEDOM = 0.3, 3.0
# Least ratio of frequency to decay rate of a pair.
CRITICAL = 0.02
# Decay rates below this many per record are unlikely a priori: in 1/SETTLING of the record such a
# mode has decayed to a third.
SETTLING = 10.0
# Standard deviation of a prior that is flat for all practical purposes.
FLAT = 1e3


@dataclass(frozen=True)
class TimeScale:
    """What the record says about time constants.

    Attributes:
        step: median sampling step [s].
        duration: length of the record [s].
    """

    step: float
    duration: float

    @classmethod
    def of(cls, scaling: Scaling) -> TimeScale:
        """Step and duration of the training record(s)."""
        return cls(float(scaling.time_step), float(scaling.duration))

    @property
    def rate_bounds(self) -> tuple[float, float]:
        """Logarithms of the slowest and fastest rates [1/s] that the record can show."""
        return math.log(1.0 / self.duration), math.log(math.pi / self.step)

    @property
    def typical_rate(self) -> float:
        """Geometric mean [1/s] of the slowest and fastest rates."""
        return math.exp(0.5 * sum(self.rate_bounds))


def _normal(scale: float, *shape: int) -> dist.Distribution:
    zero = torch.zeros(shape, dtype=torch.float64)
    return dist.Normal(zero, zero + scale).to_event(len(shape))


def _complex(x: Tensor) -> Tensor:
    return torch.complex(x[..., 0], x[..., 1])


def sample_poles(name: str, pairs: int, time_scale: TimeScale, priors: PriorName) -> Tensor:
    """Sample P poles (*b, P) [1/s].

    Sites: ``<name>_log_decay`` and ``<name>_log_frequency`` (P,), logarithms of -Re lambda and of
    Im lambda over the typical rate of the record. Default: `LogDecayRate` up to the rate pi/step,
    which all but excludes what hardly decays within the record; frequencies uniform from a tenth of
    the rate 1/duration (as good as a real pole) to pi/step. Paper: flat.
    """
    low, high = time_scale.rate_bounds
    if high <= low:
        raise invalid("time_scale", expected="more than three samples", got=repr(time_scale))
    if priors == "paper":
        flat = _normal(FLAT, pairs)
        log_decay = pyro.sample(f"{name}_log_decay", flat)
        log_frequency = pyro.sample(f"{name}_log_frequency", flat)
    else:
        half = 0.5 * (high - low)
        top = torch.full((pairs,), half, dtype=torch.float64)
        settling = torch.full_like(top, SETTLING / math.exp(half))
        log_decay = pyro.sample(f"{name}_log_decay", LogDecayRate(settling, top).to_event(1))
        bottom = torch.full_like(top, -half - math.log(10.0))
        log_frequency = pyro.sample(f"{name}_log_frequency", dist.Uniform(bottom, top).to_event(1))
    decay = time_scale.typical_rate * log_decay.exp()
    undamped = time_scale.typical_rate * log_frequency.exp()
    # The floor is as good as a double real pole (relative error 4e-4) and keeps residues bounded.
    frequency = (undamped.square() + (CRITICAL * decay).square()).sqrt()
    return torch.complex(-decay, frequency)


def residues(poles: Tensor, numerator: Tensor) -> Tensor:
    """Residue at each pole of (b1 s + b0) / ((s - lambda)(s - conj lambda)).

    Args:
        poles: (*b, P). numerator: (*b, P, n, 2), b1 and b0 last, real.

    Returns:
        (*b, P, n), complex: B with B/(s - lambda) + conj = the section.
    """
    lam = poles.unsqueeze(-1)
    b1, b0 = numerator[..., 0], numerator[..., 1]
    real = 0.5 * b1
    return torch.complex(real, -(0.5 * b0 + real * lam.real) / lam.imag)


def numerators(poles: Tensor, residue: Tensor) -> Tensor:
    """Inverse of `residues`: b1 and b0 (*b, P, n, 2)."""
    b0 = -2.0 * (residue * poles.unsqueeze(-1).conj()).real
    return torch.stack([2.0 * residue.real, b0], -1)


def sample_horseshoe(
    name: str, *shape: int, scale: float = HORSESHOE_SCALE, positive: bool = False
) -> Tensor:
    """Horseshoe of the given scale over rows: scale * local * z (*b, *shape).

    Hierarchical and non-centred (Carvalho, Polson & Scott 2009): sites ``<name>_local_scale``
    (shape[0],) half-Cauchy(1) and ``<name>_unit`` standard normal, or half-normal if `positive`.
    Its density is proper, unlike the horseshoe density itself, whose mode at zero is infinite.
    """
    one = torch.ones(shape[:1], dtype=torch.float64)
    local = pyro.sample(f"{name}_local_scale", dist.HalfCauchy(one).to_event(1))
    ones = torch.ones(shape, dtype=torch.float64)
    prior = dist.HalfNormal(ones) if positive else dist.Normal(0.0 * ones, ones)
    unit = pyro.sample(f"{name}_unit", prior.to_event(len(shape)))
    return scale * local.reshape(local.shape + (1,) * (len(shape) - 1)) * unit


def sample_modes(
    name: str,
    *,
    inputs: int,
    pairs: int,
    outputs: int | None = None,
    brownian: int = 1,
    noise: NoiseStructure = "shared",
    feedthrough: bool = True,
    process_noise: bool = True,
    time_scale: TimeScale | None = None,
    gain_scale: float = GAIN_SCALE,
    priors: PriorName = "default",
) -> Modes:
    """Sample a stochastic LTI system, for inputs and outputs of unit standard deviation.

    Sites (all start with ``<name>_``), * marking what depends on the options:

    - ``log_decay``, ``log_frequency`` (P,): see `sample_poles`.
    - ``input_gain`` (P, n_u, 2)*: g1 and g0 of each section (output per input). Those of one
      input are normal around zero with a size of their own, unknown (`SharedScaleNormal`): pairs
      that are not needed shrink, as do inputs that have no effect; a slow pair may have gains of
      ten.
    - ``output_gain`` (n_y, P, 2)*: direction of c, only for several outputs; normal(0, 1).
    - ``noise_gain_local_scale`` (P,), ``noise_gain_unit`` (P, n_l, 2)*: horseshoe of scale 0.1 on
      n1 and n0 of the noise's sections (n1 s + n0 |lambda|) sqrt(4 r) / (...), r the typical rate
      of the record: the standard deviation of the output of a pair that decays at that rate. The
      prior is on the intensity of the noise (as the paper's), so that a pair so fast that it would
      imitate measurement noise needs a large, unlikely one. Where only the squares of n1 and n0
      matter (one output; one pair, or independent noise; n_l = 1) they are positive.
    - ``feedthrough`` (n_y, n_u) or (n_u,)*: normal(0, 1).

    Args:
        name: prefix of the sites.
        inputs: n_u. pairs: P.
        outputs: n_y for modes with an output dimension; None for a single output without one.
        brownian: n_l, number of Brownian motions (for each pair, if independent).
        noise: "shared" or "independent", see `Modes`.
        feedthrough: whether there is a direct path D.
        process_noise: whether there is process noise at all.
        time_scale: step and duration of the record [s]; by default time is counted in samples of
            a record of 1000.
        gain_scale: of the gains of an input a priori.
        priors: "default", or "paper" for flat ones but for the horseshoe.

    Returns:
        Modes with the batch shape of the sites (particles).
    """
    if priors not in ("default", "paper"):
        raise invalid("priors", expected="'default' or 'paper'", got=repr(priors))
    scale = time_scale or TimeScale(1.0, 1000.0)
    poles = sample_poles(name, pairs, scale, priors)
    flat = priors == "paper"
    B = L = D = None
    if inputs:
        gain = _input_gain(f"{name}_input_gain", pairs, inputs, None if flat else gain_scale)
        B = residues(poles, _section(poles, gain) * poles.abs()[..., None, None])
        if feedthrough:
            shape = (inputs,) if outputs is None else (outputs, inputs)
            D = pyro.sample(f"{name}_feedthrough", _normal(FLAT if flat else 1.0, *shape))
    if process_noise:
        # The sign of a Brownian motion, and of a zero, cannot be seen in a covariance.
        alone = outputs is None and brownian == 1 and (pairs == 1 or noise == "independent")
        share = sample_horseshoe(f"{name}_noise_gain", pairs, brownian, 2, positive=alone)
        L = residues(poles, _section(poles, share) * math.sqrt(4.0 * scale.typical_rate))
    if outputs is None:
        c = torch.ones(pairs, dtype=torch.complex128)
        c = c.expand(poles.shape)
    else:
        raw = _complex(pyro.sample(f"{name}_output_gain", _normal(1.0, outputs, pairs, 2)))
        c = unit_direction(raw)
    return Modes(poles=poles, input_gain=B, output_gain=c, noise_gain=L, feedthrough=D, noise=noise)


def sample_direct(columns: int, outputs: int, *, flat: bool = False) -> Tensor:
    """Weights (*b, n_y, K) of inputs that act on the output at once, site ``direct``."""
    return pyro.sample("direct", _normal(FLAT if flat else 1.0, outputs, columns))


def _input_gain(name: str, pairs: int, inputs: int, scale: float | None) -> Tensor:
    """Gains (*b, P, n_u, 2) of all sections; flat without a scale."""
    if scale is None:
        return pyro.sample(name, _normal(FLAT, pairs, inputs, 2))
    return pyro.sample(name, SharedScaleNormal(GAIN_FREEDOM, scale, (pairs, inputs, 2), apart=1))


def _section(poles: Tensor, gain: Tensor) -> Tensor:
    """(g1, g0) to the numerator (g1, g0 |lambda|)."""
    size = poles.abs().unsqueeze(-1)
    return torch.stack(torch.broadcast_tensors(gain[..., 0], gain[..., 1] * size), -1)


def unit_direction(raw: Tensor) -> Tensor:
    """Columns of raw (*b, n_y, P) scaled to unit length, their first entries real, positive."""
    first = raw[..., :1, :]
    turned = raw * (first.conj() / first.abs())
    return turned / raw.abs().square().sum(-2, keepdim=True).sqrt()
