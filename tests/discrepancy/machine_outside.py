"""Machines whose effect no block of the catalogue stands for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from tests.discrepancy.machine_inputs import Array, Generator, excitation
from tests.discrepancy.machine_planting import BEYOND_LAGS, Planting
from tests.discrepancy.machine_rigs import LEAD, Rig, exchanger, masses, motor, tanks
from tests.discrepancy.machine_systems import PRODUCT, System, Term

NAME = "outside catalogue"


@dataclass(frozen=True, eq=False)
class Outside:
    """A machine, what is in it, and the channels (n,) of the record by which it acts."""

    what: str
    rig: Rig
    planting: Planting
    channels: tuple[Array, ...] = ()


def with_second_input(rig: Rig, u: Array, acts: Array, name: str, unit: str) -> Rig:
    """The machine with another input (total,) that acts on its states by `acts` (s,)."""
    system, (first, *rest) = rig.system, rig.names
    B = np.column_stack([system.B[:, 0], acts, system.B[:, 1]])
    return replace(
        rig, system=replace(system, B=B), u=np.column_stack([rig.u, u]),
        names=(first, name, *rest), units=(rig.units[0], unit, *rig.units[1:]),
    )  # fmt: skip


def valve(rng: Generator, samples: int, split: str) -> Outside:
    """A valve, the second input, changes the outflow of the first tank: input times level."""
    rig = tanks(rng, samples, split)
    opening = excitation(rng, rig.total, rig.memory, split)
    rig = with_second_input(rig, opening, np.zeros(len(rig.system.A)), "valve", "")
    unit = np.eye(len(rig.system.A))
    acts = rig.system.A @ unit[0]  # the outflow of the first tank, as it acts on all

    def system(linear: System, amount: float) -> System:
        return linear.with_terms(Term(PRODUCT, unit[0], amount * acts, column=1))

    return Outside("valve", rig, Planting(NAME, (), BEYOND_LAGS, (0.01, 0.9), system=system))


def switched_spring(rng: Generator, samples: int, split: str) -> Outside:
    """A spring that is stiffer while a hidden switch is on."""
    rig = masses(rng, samples, split)
    held = 1 + rng.geometric(8 / rig.total, rig.total)
    on = np.repeat(np.arange(rig.total) % 2, held)[: rig.total].astype(float)
    B = rig.system.B.copy()
    B[:, 1] = 0.0
    rig = replace(rig, system=replace(rig.system, B=B))
    rate = rig.numbers["spring"] / rig.numbers["mass"]
    unit = np.eye(len(B))

    def system(linear: System, amount: float) -> System:
        return linear.with_terms(Term(PRODUCT, unit[0], -amount * rate * unit[1], column=1))

    planting = Planting(NAME, (), BEYOND_LAGS, (0.003, 2.0), system=system, drive=lambda _: on)
    return Outside("switched spring", rig, planting)


def product_of_channels(rng: Generator, samples: int, split: str) -> Outside:
    """The gain of the exchanger follows the slow product of two channels."""
    rig = exchanger(rng, samples, split)
    slow = [excitation(rng, rig.total, 5 * rig.memory, split, "filtered noise") for _ in range(2)]
    product = slow[0] * slow[1]
    product = product / np.abs(product).max()
    middle = rig.numbers["flow"]

    def acting(v: Array, amount: float) -> Array:
        factor = 1 + amount * np.repeat(product, rig.parts)
        return np.asarray(middle + factor[:, None] * (v - middle))

    planting = Planting(NAME, (), BEYOND_LAGS, (0.01, 1.0), acting=acting)
    return Outside("product of channels", rig, planting, (slow[0][LEAD:], slow[1][LEAD:]))


def times_the_past(rng: Generator, samples: int, split: str) -> Outside:
    """A motor whose field follows a second input slowly: voltage times the past of another input.

    The second input is a torque of the load as well, so that a linear model has it.
    """
    rig = motor(rng, samples, split)
    other = excitation(rng, rig.total, rig.memory, split)
    pole = np.exp(-1 / (rng.uniform(1.5, 3.0) * rig.memory))
    past = lfilter([1 - pole], [1, -pole], other)
    past = past / np.abs(past).max()
    torque = rig.system.B[:, 1] * rig.numbers["constant"] * 0.3 * np.abs(rig.u).max()
    rig = with_second_input(rig, other, torque / rig.numbers["resistance"], "field current", "A")

    def acting(v: Array, amount: float) -> Array:
        factor = 1 + amount * np.repeat(past, rig.parts)
        return np.column_stack([factor * v[:, 0], v[:, 1]])

    planting = Planting(NAME, (), BEYOND_LAGS, (0.01, 1.0), acting=acting)
    return Outside("times the past", rig, planting)


BUILDERS = (valve, switched_spring, product_of_channels, times_the_past)
