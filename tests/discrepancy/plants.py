"""Synthetic plants with one planted effect, for a blind study of what names it.

A plant is a random linear system of one or two pairs of poles, in a third of the cases (where the
effect allows) with a sensor curve behind it, driven by one or two random inputs. Its record holds
two to four channels that have nothing to do with it. The effect's strength is exact:

- effects that change the noise-free output: root mean square of the change beyond what the base
  model could absorb (`plant_absorption`) is 1, 2 or 4 times the standard
  deviation of the measurement noise;
- process noise: its standard deviation at the linear output, 1, 2 or 4 times the same;
- heavy tails: Student-t noise with 8, 4 or 2.5 degrees of freedom;
- heteroscedastic noise: the logarithm of its standard deviation has a standard deviation of 0.25,
  0.5 or 1;
- feedback: the part of the input that the output's noise causes has 0.1, 0.2 or 0.3 of the
  input's standard deviation.

Noise is 2 to 10 % of the output. Where an effect cannot be made as large or small as asked, the
noise is changed instead, within 1.5 to 12 %; plants beyond that are drawn again.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.optimize import brentq

import pyro_dynogp as dgp
from tests.discrepancy.plant_absorption import absorbed, unexplained, unexplained_by_fit
from tests.discrepancy.plant_dynamics import Array, response
from tests.discrepancy.plant_effects import PLANTINGS, WISHES
from tests.discrepancy.plant_noise import close_loop_around, heavy_tails, heteroscedastic
from tests.discrepancy.plant_record import Draft, in_units
from tests.discrepancy.plant_setting import (
    Generator,
    Setting,
    Wish,
    random_setting,
    unit_process_noise,
)
from tests.discrepancy.planting import Planting

Strength = Literal["weak", "middle", "strong"]
STRENGTHS: tuple[Strength, ...] = ("weak", "middle", "strong")
MULTIPLES = {"weak": 1.0, "middle": 2.0, "strong": 4.0}
DEGREES = {"weak": 8.0, "middle": 4.0, "strong": 2.5}
SPREADS = {"weak": 0.25, "middle": 0.5, "strong": 1.0}
SHARES = {"weak": 0.1, "middle": 0.2, "strong": 0.3}
NOISE_EFFECTS = ("heavy tails", "heteroscedastic noise", "process noise", "feedback")
OUTSIDE = "outside catalogue"
# What the search may name, then what it cannot.
CATALOGUE = (*(name for name in PLANTINGS if name != OUTSIDE), *NOISE_EFFECTS)
EFFECTS = (*CATALOGUE, OUTSIDE)
# Measurement noise over the output's standard deviation; plants beyond are drawn again.
NOISE, ATTEMPTS = (0.015, 0.12), 40
SPLITS = {"development": 1, "final": 2}


@dataclass(frozen=True, eq=False)
class Plant:
    """A record and what is behind it; only `record` and `base` are for the search.

    Attributes:
        record: inputs that the base model uses, output, and in `extra` the other channels.
        base: the model to start from: "kind" ("linear" or "wiener"), "pairs", "process_noise".
        effect: what was planted, None for nothing. strength: of it. seed, split: which plant.
        truth: true values in the units of the record ("size": the strength as it came out,
            "channel", "delay", "period", "time", ...).
        noise_free: (n,) output of a free run that knows the plant and the effect [output].
        noise_sd: of the measurement noise, root mean square [output].
        process_sd: of what process noise adds to the output, root mean square [output].
    """

    record: dgp.Record
    base: Mapping[str, Any]
    effect: str | None
    strength: Strength
    seed: int
    split: str
    truth: Mapping[str, Any]
    noise_free: Array
    noise_sd: float
    process_sd: float

    def floor(self, part: dgp.Record) -> float:
        """Root mean square error [output], on a part of the record, of who knows the truth.

        A free run from the recorded inputs with the true system and effect; what is left is
        measurement noise and process noise as they happened to be.

        Raises:
            ValueError: where `part` is no part of the record.
        """
        rows = np.searchsorted(self.record.time, part.time)
        inside = rows < len(self.record)
        if not inside.all() or not np.array_equal(self.record.time[rows], part.time):
            raise ValueError("part: expected samples of the plant's record, got other times.")
        error = part.outputs[:, 0] - self.noise_free[rows]
        return float(np.sqrt(np.nanmean(error**2)))


def plant(
    effect: str | None, strength: Strength, seed: int, *, samples: int = 1200,
    split: str = "development",
) -> Plant:  # fmt: skip
    """One plant; the same arguments give the same bits.

    Args:
        effect: one of EFFECTS, or None: nothing is planted (the strength then has no meaning).
        strength: of the effect. seed: which plant, a whole number >= 0.
        samples: length of the record.
        split: "development" or "final"; their plants have nothing in common.

    Raises:
        ValueError: for an unknown effect, strength or split.
    """
    for name, value, known in (
        ("effect", effect, (None, *EFFECTS)),
        ("strength", strength, STRENGTHS),
        ("split", split, tuple(SPLITS)),
    ):
        if value not in known:
            raise ValueError(f"{name}: expected one of {known}, got {value!r}.")
    level = STRENGTHS.index(strength) if effect else 0
    # By name: a new effect leaves the plants of the others as they are.
    key = [SPLITS[split], zlib.crc32(str(effect).encode()), level, seed]
    for attempt in range(ATTEMPTS):
        source = np.random.SeedSequence([*key, attempt])
        draft, others = _draft(effect, strength, samples, source)
        if NOISE[0] <= draft.noise_sd / draft.clean.std() <= NOISE[1]:
            break
    setting = draft.setting
    record, truth, scales = in_units(draft, others)
    base = {
        "kind": "linear" if setting.shape is None else "wiener",
        "pairs": len(setting.system.poles),
        "process_noise": effect != "process noise",
    }
    return Plant(
        record, base, effect, strength, seed, split, truth,
        draft.clean * scales.output_size + scales.output_offset,
        draft.noise_sd * scales.output_size, draft.process_sd * scales.output_size,
    )  # fmt: skip


def _draft(
    effect: str | None, strength: Strength, samples: int, source: np.random.SeedSequence
) -> tuple[Draft, Generator]:  # fmt: skip
    """A plant of any noise level, and the source of what has nothing to do with it."""
    plan, planted, noise, others = map(np.random.default_rng, source.spawn(4))
    setting = random_setting(plan, samples, WISHES.get(str(effect), Wish()))
    if effect is not None and effect in PLANTINGS:
        planting = PLANTINGS[effect](setting, planted)
        return _plant_in_output(setting, planting, strength, noise), others
    return _plant_in_noise(setting, effect, strength, planted, noise), others


def _plant_in_output(
    setting: Setting, planting: Planting, strength: Strength, rng: Generator
) -> Draft:
    amount, size = _amount(setting, planting, MULTIPLES[strength] * setting.noise_level)
    noise_sd = size / MULTIPLES[strength]
    w = _some_process_noise(setting, rng, noise_sd)
    e = noise_sd * rng.standard_normal(setting.samples)
    clean, disturbed = planting.clean(amount, np.zeros_like(w)), planting.clean(amount, w)
    y = disturbed + e
    if planting.limits is not None:  # the sensor's noise comes before its limits
        y = np.clip(setting.observe(setting.linear + w) + e, *planting.limits(amount))
    u = setting.u if planting.recorded is None else planting.recorded(amount)
    truth = planting.truth(amount) | {"size": size / noise_sd}
    return Draft(
        setting, u, y, clean, noise_sd, _rms(disturbed - clean), truth, planting.extra,
    )  # fmt: skip


def _amount(setting: Setting, planting: Planting, target: float) -> tuple[float, float]:
    """Amount of the effect whose unexplained part has the size `target`, and that size.

    Where there is none, the amount with the nearest size.
    """
    quiet, same = np.zeros(len(setting.u)), (setting.window, setting.shape)
    fixed = None if planting.recorded else absorbed(setting.system, setting.u, *same)

    @functools.cache
    def size(amount: float) -> float:
        u = setting.u if planting.recorded is None else planting.recorded(amount)
        without = setting.observe(response(setting.system, u))
        effect = planting.clean(amount, quiet) - without
        if planting.starts:
            return unexplained_by_fit(effect, setting.system, u, *same, planting.starts)
        return unexplained(effect, absorbed(setting.system, u, *same) if fixed is None else fixed)

    if planting.linear:
        amount = target / size(1.0)
        return amount, size(amount)
    low, high = planting.amounts[0], planting.amounts[-1]
    tried = planting.amounts if planting.discrete else tuple(np.geomspace(low, high, 12))
    above = next((k for k, amount in enumerate(tried) if size(amount) >= target), None)
    if planting.discrete or not above:  # none is large enough, or even the smallest is too large
        best = min(tried, key=lambda amount: abs(np.log(max(size(amount), 1e-12) / target)))
        return float(best), size(best)
    found = brentq(lambda x: size(x) - target, tried[above - 1], tried[above], rtol=1e-3)
    return float(found), size(float(found))


def _plant_in_noise(
    setting: Setting, effect: str | None, strength: Strength, planted: Generator, rng: Generator
) -> Draft:
    noise_sd, n, truth = setting.noise_level, setting.samples, dict[str, Any]()
    clean = setting.observe(setting.linear)
    w = _some_process_noise(setting, rng, noise_sd)
    e = rng.standard_normal(n)
    if effect == "heavy tails":
        truth = {"degrees_of_freedom": DEGREES[strength], "size": DEGREES[strength]}
        e = heavy_tails(planted, n, DEGREES[strength])
    elif effect == "heteroscedastic noise":
        e, truth = heteroscedastic(planted, setting, clean, SPREADS[strength])
        truth["size"] = SPREADS[strength]
    elif effect == "process noise":
        size = MULTIPLES[strength]
        w, truth = size * noise_sd * unit_process_noise(setting, planted), {"size": size}
    elif effect == "feedback":
        return _in_a_loop(setting, strength, planted, rng)
    y = setting.observe(setting.linear + w)
    return Draft(
        setting, setting.u, y + noise_sd * e, clean, noise_sd, _rms(y - clean), truth
    )  # fmt: skip


def _in_a_loop(
    setting: Setting, strength: Strength, planted: Generator, rng: Generator
) -> Draft:  # fmt: skip
    """With more process noise than elsewhere: a loop needs disturbances to feed back."""
    ratio = float(planted.uniform(2.0, 4.0))
    w = ratio * setting.noise_level * unit_process_noise(setting, planted)
    e = setting.noise_level * rng.standard_normal(len(w))
    loop = close_loop_around(setting, planted, w + e, SHARES[strength])
    clean = setting.observe(response(setting.system, loop.u))
    truth = {"size": SHARES[strength], "gain": loop.gain, "delay": loop.delay}
    y = clean + loop.noise_scale * (w + e)[setting.window]
    noise_sd = loop.noise_scale * setting.noise_level
    return Draft(setting, loop.u, y, clean, noise_sd, ratio * noise_sd, truth)


def _some_process_noise(setting: Setting, rng: Generator, noise_sd: float) -> Array:
    """At the linear output; every other plant has some, 0.2 to 0.6 of the measurement noise."""
    w = unit_process_noise(setting, rng)
    return np.asarray(float(rng.integers(2)) * rng.uniform(0.2, 0.6) * noise_sd * w)


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))
