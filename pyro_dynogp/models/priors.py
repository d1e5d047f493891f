r"""Priors on the poles and gains of a linear system, as Pyro sample sites.

Everything is stated in units that the record sets: time in steps and lengths of the record, inputs
and outputs in their standard deviations. The same record in hours or seconds, volts or millivolts
gives the same posterior.

Gauge: a single output has c_j = 1 (scale and phase of c_j, B_j and L_j are not separately
identified); several outputs have c_j of unit length, its entry for the reference output of the
record (`Scaling.reference_output`) positive. Each pair is then a second-order section, and its
gains are given as such a section's numerator,

    G_j(s) = |lambda| (g1 s + g0 |lambda|) / ((s - lambda)(s - conj lambda)),

so that g0 is the steady-state gain of the pair and g1 that of its derivative path. Residues
(B_j = lim (s - lambda) G_j) would grow without bound as a pair becomes critically damped.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.data.scaling import TimeScale
from pyro_dynogp.distributions.decay import LogDecayRate
from pyro_dynogp.distributions.shared_scale import SharedScaleNormal
from pyro_dynogp.layers.sites import Site, Values, sample
from pyro_dynogp.lti.modes import Modes, NoiseStructure
from pyro_dynogp.models.gains import input_gains, noise_gains, unit_direction
from pyro_dynogp.models.horseshoe import horseshoe, horseshoe_sites
from pyro_dynogp.support.errors import instance, invalid, verify_fields
from pyro_dynogp.support.tensors import at_places, joined

PriorName = Literal["default", "paper"]

# Gains of a pair for an input of unit size, a priori, and the degrees of freedom of that size.
GAIN_SCALE, GAIN_FREEDOM = 0.3, 3.0
# Least ratio of frequency to decay rate of a pair.
CRITICAL = 0.02
# Decay rates below this many per record are unlikely a priori: in 1/SETTLING of the record such a
# mode has decayed to a third.
SETTLING = 10.0
# The same of real poles with feedback.
LASTING = 0.1
# Standard deviation of a prior that is flat for all practical purposes.
FLAT = 1e3
# Of the random walk beside an integrator: its rate, per record, and how far it gets within one, in
# standard deviations of the outputs, a priori.
WALK, WALKED = 0.01, 0.1
# What is left of new noise gains where a model is extended: not nothing, since at zero the density
# has no slope.
QUIET = 0.05
# Time counted in samples of a record of 1000.
OF_SAMPLES = TimeScale(1.0, 1000.0)
NO_NAMES: Mapping[str, str] = MappingProxyType({})


def _normal(scale: float, *shape: int) -> dist.Distribution:
    zero = torch.zeros(shape, dtype=torch.float64)
    return dist.Normal(zero, zero + scale).to_event(len(shape))


def _gains(scale: float | None, *shape: int, apart: int) -> dist.Distribution:
    """Of unknown size around a scale, one size for each entry of `apart`; flat without a scale."""
    if scale is None:
        return _normal(FLAT, *shape)
    return SharedScaleNormal(GAIN_FREEDOM, scale, shape, apart=apart)


def _complex(x: Tensor) -> Tensor:
    return torch.complex(x[..., 0], x[..., 1])


@dataclass(frozen=True)
class ModesPrior:
    """Prior of a stochastic LTI system for inputs and outputs of unit standard deviation.

    It lists the sites and maps their values to `Modes`. Sites (all start with ``<name>_``), *
    marking what depends on the options:

    - ``log_decay``, ``log_frequency`` (P,): logarithms of -Re lambda and of Im lambda over the
      typical rate of the record. Default: `LogDecayRate` up to the rate pi/step, which all but
      excludes what hardly decays within the record; frequencies uniform from a tenth of the rate
      1/duration (as good as a real pole) to pi/step. Paper: flat.
    - ``input_gain`` (P, n_u, 2)*: g1 and g0 of each section (output per input). Those of one
      input are normal around zero with a size of their own, unknown (`SharedScaleNormal`): pairs
      that are not needed shrink, as do inputs that have no effect; a slow pair may have gains of
      ten.
    - ``feedthrough`` (n_y, n_d) or (n_d,)*: normal(0, 1), of the inputs with a direct path.
    - ``noise_gain_local_scale`` (P,), ``noise_gain_unit`` (P, n_l, 2)*: horseshoe of scale 0.1 on
      n1 and n0 of the noise's sections (n1 s + n0 |lambda|) sqrt(4 r) / (...), r the typical rate
      of the record: the standard deviation of the output of a pair that decays at that rate. The
      prior is on the intensity of the noise (as the paper's), so that a pair so fast that it would
      imitate measurement noise needs a large, unlikely one. Where only the squares of n1 and n0
      matter (one output; one pair, or independent noise; n_l = 1) they are positive.
    - ``output_gain`` (n_y, P, 2)*: direction of c, only for several outputs; normal(0, 1).
    - ``integrator_gain`` (n_y, n_u)*: rate of each output's integrator for each input over the
      typical rate, of unknown size: with one, inputs that change from sample to sample move the
      level by a standard deviation within the record; without a slow part they need tens. The pole
      is zero, and the level at the first sample unknown (`past_input_covariance`).
    - ``integrator_drift`` (n_y,)*: the same of what drives it beside the inputs, always (the input
      that keeps the level is not the mean of the record's).
    - ``integrator_noise`` (n_y, n_l)*: the random walk of the level, how far it gets within the
      record over 0.1 standard deviations, normal(0, 1). It is a pair of its own without inputs,
      whose real pole lets it forget within a hundred lengths of the record.

    Attributes:
        name: prefix of the sites.
        inputs: n_u. pairs: P.
        outputs: n_y for modes with an output dimension; None for a single output without one.
        brownian: n_l, number of Brownian motions (for each pair, if independent).
        noise: "shared" or "independent", see `Modes`.
        feedthrough: whether there is a direct path D.
        fed: how many of the inputs, the last ones, come back and have no direct path.
        late: columns of inputs whose dead time is a parameter: with a direct path a later first
            effect and another dead time would be the same, and they have none.
        levels: number of integrators, one for each of the first outputs: n_y, less those that are
            hidden signals, or 0.
        process_noise: whether there is process noise at all.
        time_scale: step and duration of the record [s].
        gain_scale: of the gains of an input a priori.
        priors: "default", or "paper" for flat ones but for the horseshoe.
        reference: the output whose entries of c are positive, where there are several.
        real: whether there are P real poles in place of pairs, of a single output. There are no
            frequencies then, and one number g for each gain: G_j(s) = g r / (s - lambda), r the
            typical rate. With feedback, which decides how fast a level settles, such a pole may be
            as slow as an integrator (`LASTING`).

    Raises:
        ValueError: on unknown priors, or a record of three samples or fewer.
    """

    name: str
    inputs: int
    pairs: int
    outputs: int | None = None
    brownian: int = 1
    noise: NoiseStructure = "shared"
    feedthrough: bool = True
    process_noise: bool = True
    time_scale: TimeScale = OF_SAMPLES
    gain_scale: float = GAIN_SCALE
    priors: PriorName = "default"
    fed: int = 0
    levels: int = 0
    late: tuple[int, ...] = ()
    reference: int = 0
    real: bool = False

    def __post_init__(self) -> None:
        verify_fields(self)
        instance("time_scale", self.time_scale, TimeScale)
        low, high = self.time_scale.rate_bounds
        if high <= low:
            expected = "more than three samples"
            raise invalid("time_scale", expected=expected, got=repr(self.time_scale))

    def sites(self, dims: Mapping[str, str] = NO_NAMES) -> tuple[Site, ...]:
        """The sites, in the order in which they are sampled.

        Args:
            dims: names of dimensions ("pair", "input", "output", "brownian", and "direct", inputs
                with a direct path) where they are others.
        """

        def named(*generic: str) -> tuple[str, ...]:
            return tuple(dims.get(dim, dim) for dim in generic)

        name, P, n_u, terms = self.name, self.pairs, self.inputs, 1 if self.real else 2
        flat, wide = self.priors == "paper", self.time_scale.brevity
        sites = [*self._pole_sites(named("pair"))]
        if n_u:
            gain = _gains(None if flat else wide * self.gain_scale, P, n_u, terms, apart=1)
            over = named("pair", "input", "term")
            sites.append(Site(f"{name}_input_gain", gain, over, growth=0.0))
            if self.feedthrough and self._prompt:
                direct_inputs = len(self._prompt)
                shape = (direct_inputs,) if self.outputs is None else (self.outputs, direct_inputs)
                across = dims.get("direct", dims.get("input", "input"))
                across = "prompt input" if self.late else across
                over = (across,) if self.outputs is None else (*named("output"), across)
                direct = _normal(FLAT if flat else 1.0, *shape)
                sites.append(Site(f"{name}_feedthrough", direct, over, growth=0.0))
        if self.process_noise:
            # The sign of a Brownian motion, and of a zero, cannot be seen in a covariance.
            single = self.pairs + self.levels == 1 or self.noise == "independent"
            sites += horseshoe_sites(
                f"{name}_noise_gain", P, self.brownian, terms,
                dims=named("pair", "brownian", "term"),
                positive=self.outputs is None and self.brownian == 1 and single,
                growth=QUIET,
            )  # fmt: skip
        if self.outputs is not None:
            direction = _normal(1.0, self.outputs, P, 2)
            over = named("output", "pair", "part")
            sites.append(Site(f"{name}_output_gain", direction, over))
        if self.levels:
            n, level = self.levels, dims.get("level", dims.get("output", "output"))
            one = None if flat else 1.0
            sites.append(Site(f"{name}_integrator_drift", _gains(one, n, apart=0), (level,)))
            if n_u:
                prior, over = _gains(one, n, n_u, apart=1), (level, *named("input"))
                sites.append(Site(f"{name}_integrator_gain", prior, over, growth=0.0))
            if self.process_noise:
                prior, over = _normal(one or FLAT, n, self.brownian), (level, *named("brownian"))
                sites.append(Site(f"{name}_integrator_noise", prior, over))
        return tuple(sites)

    @property
    def _prompt(self) -> list[int]:
        """Columns of inputs with a direct path, where there is any."""
        return [column for column in range(self.inputs - self.fed) if column not in self.late]

    def _pole_sites(self, dims: tuple[str, ...]) -> tuple[Site, ...]:
        low, high = self.time_scale.rate_bounds
        if self.priors == "paper":
            decay = frequency = _normal(FLAT, self.pairs)
        else:
            half = 0.5 * (high - low)
            top = torch.full((self.pairs,), half, dtype=torch.float64)
            least = (LASTING if self.real and self.fed else SETTLING) / self.time_scale.brevity
            settling = torch.full_like(top, least / math.exp(half))
            decay = LogDecayRate(settling, top).to_event(1)
            bottom = torch.full_like(top, -half - math.log(10.0))
            frequency = dist.Uniform(bottom, top).to_event(1)
        sites = (
            Site(f"{self.name}_log_decay", decay, dims),
            Site(f"{self.name}_log_frequency", frequency, dims),
        )
        return sites[:1] if self.real else sites

    def modes(self, values: Values) -> Modes:
        """Poles and gains at values (*b, *shape) of the sites; batch shape *b."""
        name = self.name
        rate = self.time_scale.typical_rate
        decay = rate * values[f"{name}_log_decay"].exp()
        frequency = torch.zeros_like(decay)
        if not self.real:
            undamped = rate * values[f"{name}_log_frequency"].exp()
            # As good as a double real pole (relative error 4e-4), and residues stay finite.
            frequency = (undamped.square() + (CRITICAL * decay).square()).sqrt()
        poles = torch.complex(-decay, frequency)
        B = L = drift = None
        if self.inputs:
            gain = values[f"{name}_input_gain"]
            B = input_gains(poles, gain, rate)
        if self.process_noise:
            share = horseshoe(f"{name}_noise_gain", values, 3)
            L = noise_gains(poles, share, rate)
        if self.outputs is None:
            c = torch.ones(self.pairs, dtype=torch.complex128)
            c = c.expand(poles.shape)
        else:
            c = unit_direction(_complex(values[f"{name}_output_gain"]), self.reference)
        if self.levels:
            poles, B, c, L, drift = self._with_integrators(values, poles, B, c, L)
        D = values.get(f"{name}_feedthrough")
        if D is not None and len(self._prompt) < self.inputs:
            D = at_places(D, self._prompt, self.inputs)
        return Modes(poles, B, c, L, D, noise=self.noise, drift=drift)

    def _with_integrators(
        self, values: Values, poles: Tensor, B: Tensor | None, c: Tensor, L: Tensor | None
    ) -> tuple[Tensor, Tensor | None, Tensor, Tensor | None, Tensor]:
        """Poles and gains with an integrator for each level, then a random walk for each."""
        count, duration = self.levels, self.time_scale.duration
        rates = [0.0] if L is None else [0.0, -WALK / duration]
        new = torch.tensor(rates, dtype=torch.float64).repeat_interleave(count).to(poles)
        scale = 0.5 * self.time_scale.typical_rate
        silent = torch.zeros(1, 1, dtype=torch.complex128)
        poles = joined([poles, new], 1, -1)
        own = torch.eye(self.outputs or 1, count).repeat(1, len(rates)).to(c)
        c = joined([c, own[0] if self.outputs is None else own], 1 + (self.outputs is not None), -1)
        if B is not None:
            gain = scale * values[f"{self.name}_integrator_gain"]
            rest = silent.expand((len(rates) - 1) * count, self.inputs)
            B = joined([B, gain.to(B), rest], 2, -2)
        if L is not None:
            walk = values[f"{self.name}_integrator_noise"] * 0.5 * WALKED / math.sqrt(duration)
            L = joined([L, silent.expand(count, self.brownian), walk.to(L)], 2, -2)
        rate = scale * values[f"{self.name}_integrator_drift"]
        still = torch.zeros(self.pairs), rate, torch.zeros((len(rates) - 1) * count)
        drift = joined([x.to(poles) for x in still], 1, -1)
        return poles, B, c, L, drift


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

    Arguments are the attributes of `ModesPrior`, which lists the sites; by default time is counted
    in samples of a record of 1000. Modes have the batch shape of the sites (particles).

    Raises:
        ValueError: on unknown priors, or a record of three samples or fewer.

    Examples:
        >>> modes = dgp.sample_modes("g", inputs=1, pairs=2)  # inside a Pyro model
        >>> modes.pairs
        2
    """
    prior = ModesPrior(
        name, inputs, pairs, outputs, brownian, noise, feedthrough, process_noise,
        time_scale or OF_SAMPLES, gain_scale, priors,
    )  # fmt: skip
    return prior.modes(sample(prior.sites()))


def direct_site(columns: int, outputs: int, *, flat: bool = False) -> Site:
    """Weights (n_y, K) of inputs that act on the output at once, site ``direct``."""
    prior = _normal(FLAT if flat else 1.0, outputs, columns)
    return Site("direct", prior, ("output", "direct input"), growth=0.0)
