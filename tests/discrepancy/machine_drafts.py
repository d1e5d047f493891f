"""One draw of a machine with effects of a given strength, whatever its noise comes to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

import pyro_dynogp as dgp
from tests.discrepancy import machine_noise as noise
from tests.discrepancy import machine_rigs as rigs
from tests.discrepancy.machine_effects import BUILDERS
from tests.discrepancy.machine_inputs import Array, Generator, decoy
from tests.discrepancy.machine_outside import BUILDERS as OUTSIDE_BUILDERS
from tests.discrepancy.machine_planting import Ground, Planting, ground, limited, run
from tests.discrepancy.machine_rigs import LEAD, Rig
from tests.discrepancy.machine_sizes import relative_size

MULTIPLES = {"weak": 1.0, "middle": 2.0, "strong": 4.0}
HEAVY, SPREAD, PROCESS = "heavy tails", "heteroscedastic noise", "process noise"
FEEDBACK, NONLINEAR = "feedback", "nonlinear feedback"
# Machine -> effects of its noise.
NOISE_EFFECTS: Mapping[str, tuple[str, ...]] = {
    "motor": (HEAVY,),
    "masses": (SPREAD,),
    "exchanger": (PROCESS,),
    "loop": (FEEDBACK,),
    "sensor": (HEAVY,),
}
# Noise for which amounts are chosen, over the output's standard deviation.
WANTED = (0.015, 0.1)
# Relative difference of the strengths of several effects.
TOLERANCE, STEPS = 0.04, 8
# Least standard deviation of a signal in a part of the record, over that in the whole.
QUIET = 0.2
# Stands for the excess of an effect with which a loop is not stable.
UNSTABLE = 10.0
Amounts = list[tuple[Planting, float]]


@dataclass(frozen=True, eq=False)
class Draft:
    """A machine with its record, before channels have names and places.

    Attributes:
        rig: the machine, as prepared for its effects. what: which machine.
        planted: effects that change the output, with amounts.
        u: (n, n_u) recorded inputs. y: (n, n_y) measured. clean: (n, n_y) without noise.
        noise_sd: (n_y,). accepted: names that say each planted effect right.
        acting, decoys: channels (n,). loop: around the machine, or None.
        model: to start from.
    """

    rig: Rig
    what: str
    planted: Amounts
    u: Array
    y: Array
    clean: Array
    noise_sd: Array
    accepted: Mapping[str, tuple[str, ...]]
    acting: Sequence[Array]
    decoys: Sequence[Array]
    loop: noise.Loop | None
    model: dgp.Model


def draft(
    kind: str, effects: Sequence[str], strength: str, samples: int, split: str,
    source: np.random.SeedSequence,
) -> Draft | None:  # fmt: skip
    """One draw; None where the effects cannot be made equally strong.

    Args:
        kind: of machine. effects: to be planted. strength: of each of them.
        samples: of the record. split: "development" or "final".
        source: of what is random.
    """
    plan, planted, shaken, others = map(np.random.default_rng, source.spawn(4))
    rig = _rig(kind, effects, plan, samples, split)
    level = float(np.exp(plan.uniform(*np.log(WANTED))))
    structural = [name for name in sorted(effects) if name in BUILDERS[kind]]
    children = [np.random.default_rng(s) for s in planted.integers(2**32, size=len(structural))]
    builders = list(zip(structural, children, strict=True))
    loop = noise.random_loop(shaken, rig) if kind == "loop" else None
    if loop is not None and FEEDBACK in effects:
        found = _in_loop(rig, loop, builders, strength)
    else:
        if loop is not None:  # a recorded input of a loop without noise, played again
            rig = replace(rig, u=noise.controlled_input(rig, loop, (), 0.0))
        found = _with_amounts(kind, rig, builders, strength, level)
    if found is None or not lively(found[0].u[LEAD:]):
        return None
    rig, amounts, noise_sd = found
    if "inflow" in rig.numbers and rig.u.min() < 0:  # which a controller of tanks may ask for
        return None
    channels = [p.channel(amount) for p, amount in amounts if p.channel]
    if not all(lively(channel[:, None], parts=2) for channel in channels):
        return None
    return _finished(rig, kind, amounts, noise_sd, (effects, strength), loop, (shaken, others))


def outside_draft(
    which: int, strength: str, samples: int, split: str, source: np.random.SeedSequence
) -> Draft | None:
    """One draw of a machine whose effect is not in the catalogue, by its number; see `draft`."""
    plan, shaken, others = map(np.random.default_rng, source.spawn(3))
    chosen = OUTSIDE_BUILDERS[which % len(OUTSIDE_BUILDERS)](plan, samples, split)
    if not lively(chosen.rig.u[LEAD:]):
        return None
    base = ground(chosen.rig)
    level = float(np.exp(plan.uniform(*np.log(WANTED))))
    amount, size = solved(base, chosen.planting, MULTIPLES[strength] * level)
    amounts = [(chosen.planting, amount)]
    noise_sd = size / MULTIPLES[strength] * base.sd
    made = _finished(
        chosen.rig, chosen.what, amounts, noise_sd, ((), strength), None, (shaken, others)
    )  # fmt: skip
    return replace(made, acting=chosen.channels, accepted={})


def lively(signals: Array, parts: int = 4) -> bool:
    """Whether each signal (n, m) varies in every part of the record, so that all can be learned."""
    whole = signals.std(axis=0)
    shares = [part.std(axis=0) for part in np.array_split(signals, parts)]
    return bool((whole > 0).all() and (np.array(shares) > QUIET * whole).all())


def _rig(kind: str, effects: Sequence[str], rng: Generator, samples: int, split: str) -> Rig:
    if kind == "motor":
        return rigs.motor(rng, samples, split, position="integrator" in effects)
    if kind == "masses":
        return rigs.masses(
            rng, samples, split, count=1 if "unmodelled dynamics" in effects else None
        )
    made = {
        "tanks": rigs.tanks, "exchanger": rigs.exchanger, "load": rigs.load, "loop": rigs.loop,
        "two outputs": rigs.two_outputs, "sensor": rigs.sensor,
    }  # fmt: skip
    return made[kind](rng, samples, split)


def solved(base: Ground, planting: Planting, target: float) -> tuple[float, float]:
    """Amount at which an effect has a size over the output's deviation, and the size it has.

    The nearest there is, where none has that size.
    """

    def size(amount: float) -> float:
        return float(relative_size(base, planting, amount).max())

    def missing(log_amount: float) -> float:
        return float(np.log(max(size(float(np.exp(log_amount))), 1e-12) / target))

    if planting.discrete:
        amount = min(planting.amounts, key=lambda a: abs(missing(np.log(a))))
        return amount, size(amount)
    tried = np.linspace(*np.log(planting.amounts), STEPS)
    before, errors = tried[0], list[float]()
    for at in tried:
        errors.append(missing(at))
        if errors[-1] >= 0:
            break
        before = at
    if errors[-1] < 0 or len(errors) == 1:
        amount = float(np.exp(tried[int(np.argmin(np.abs(errors)))]))
    else:
        amount = float(np.exp(brentq(missing, before, at, xtol=3e-3)))
    return amount, size(amount)


def _with_amounts(
    kind: str, rig: Rig, builders: Sequence[tuple[str, Generator]], strength: str, level: float
) -> tuple[Rig, Amounts, Array] | None:
    """The machine with effects of equal size, and the noise to which they have that strength."""
    base, amounts, fixed = ground(rig), Amounts(), False
    made = [(BUILDERS[kind][name](base, rng), name, rng) for name, rng in builders]
    # What changes the input comes first, then what has few amounts.
    made.sort(key=lambda m: (m[0].prepare is None, not m[0].discrete))
    for planting, name, rng in made:
        if amounts and amounts[0][0].prepare:
            planting = BUILDERS[kind][name](base, rng)
        amount, size = solved(base, planting, MULTIPLES[strength] * level)
        if fixed and abs(size / (MULTIPLES[strength] * level) - 1) > TOLERANCE:
            return None
        if planting.prepare:
            base = ground(planting.prepare(base.rig, amount))
        level, fixed = (level if fixed else size / MULTIPLES[strength]), True
        amounts.append((planting, amount))
    return base.rig, amounts, level * base.sd


def _in_loop(
    rig: Rig, loop: noise.Loop, builders: Sequence[tuple[str, Generator]], strength: str
) -> tuple[Rig, Amounts, Array] | None:
    """The machine in its loop, with the noise that makes the share of the input."""
    share, base = noise.SHARES[strength], ground(rig)
    if not builders:
        found = noise.fed_back(rig, loop, (), share)
        return None if found is None else (found[0], [], np.array([found[1]]))
    ((name, rng),) = builders
    planting = BUILDERS["loop"][name](base, rng)

    def excess(log_amount: float) -> float:
        amount = float(np.exp(log_amount))
        found = noise.fed_back(rig, loop, [(planting, amount)], share)
        if found is None:
            return UNSTABLE
        around = ground(found[0])
        size = float((relative_size(around, planting, amount) * around.sd)[0])
        return float(np.log(max(size / found[1], 1e-12) / MULTIPLES[strength]))

    tried, errors = np.linspace(*np.log(planting.amounts), STEPS), list[float]()
    for at in tried:
        errors.append(excess(at))
        if errors[-1] >= 0:
            break
    if len(errors) == 1 or errors[-1] < 0:
        return None
    bracket = tried[len(errors) - 2 : len(errors)]
    amount = float(np.exp(brentq(excess, *bracket, xtol=2e-3)))
    found = noise.fed_back(rig, loop, [(planting, amount)], share)
    if found is None or abs(excess(np.log(amount))) > TOLERANCE:
        return None
    return found[0], [(planting, amount)], np.array([found[1]])


def _finished(
    rig: Rig, what: str, amounts: Amounts, noise_sd: Array, wish: tuple[Sequence[str], str],
    loop: noise.Loop | None, sources: tuple[Generator, Generator],
) -> Draft:  # fmt: skip
    """The record of a machine with its noise.

    Args:
        rig, what, amounts, noise_sd: of the draft. wish: all effects, and their strength.
        loop: around the machine, or None. sources: of noise, and of what does not act.
    """
    (effects, strength), (rng, others) = wish, sources
    made, n = run(rig, amounts), rig.samples
    n_y = made.output.shape[1]
    e = noise.gaussian(rng, n, n_y)
    if HEAVY in effects:
        e = noise.heavy_tailed(rng, n, n_y, noise.DEGREES[strength])
    if SPREAD in effects:
        e = e * noise.profile(rng, rig.u, made.output, noise.SPREADS[strength])
    added = noise_sd * e
    if PROCESS in effects:
        added = added + MULTIPLES[strength] * noise_sd * noise.process_noise(rng, rig)[LEAD:]
    if loop is not None:
        added = loop.disturbance(float(noise_sd[0]))[LEAD:, None]
    accepted = {name: (name,) for name in effects} | {p.effect: p.accepted for p, _ in amounts}
    n_u = made.u.shape[1]
    model = (
        dgp.Wiener(n_u, pairs=rig.pairs, inducing=16)
        if rig.curve
        else dgp.LinearDynamicGP(
            n_u, outputs=n_y, pairs=rig.pairs, process_noise=PROCESS not in effects
        )
    )
    return Draft(
        rig, what, amounts, made.u[LEAD:], limited(made.output + added, amounts),
        limited(made.output, amounts), noise_sd, accepted,
        [p.channel(amount) for p, amount in amounts if p.channel], _decoys(others, rig),
        loop, model,
    )  # fmt: skip


def _decoys(rng: Generator, rig: Rig) -> list[Array]:
    """Two or three channels that do not act; one of them a flag of days, where there are days."""
    count, u = int(rng.integers(2, 4)), rig.u[LEAD:, 0]
    channels = [decoy(rng, u, rig.memory, rig.split) for _ in range(count)]
    if rig.stamps is not None:
        days = np.unique(np.asarray(rig.stamps.date), return_inverse=True)[1]
        channels[0] = (rng.uniform(size=days.max() + 1) < 0.2)[days].astype(float)
    return channels
