"""Cases of the study of naming: which machine, which effects, how strong."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tests.discrepancy.machines import KINDS

KEY = ("group", "kind", "effects", "strength", "seed", "split", "oracle")
STRENGTHS = ("weak", "middle", "strong")
GROUPS = ("single", "null", "two", "three", "outside")
SEVERAL = {"two": 2, "three": 3}
# Machines without effect for each seed, so that the gauge has enough of them.
NULLS = 3


@dataclass(frozen=True)
class Case:
    """One machine of the study.

    Attributes:
        group: of GROUPS. kind: machine, "outside" for one whose effect the catalogue lacks.
        effects: that are planted. strength: of each, "none" without effects.
        seed: of the machine. split: "development", or "final".
        oracle: whether the loop looks for the planted effects alone.
    """

    group: str
    kind: str
    effects: tuple[str, ...]
    strength: str
    seed: int
    split: str = "development"
    oracle: bool = False

    @property
    def fields(self) -> dict[str, Any]:
        """What tells it from the others, as a row has it."""
        return {name: getattr(self, name) for name in KEY} | {"effects": ", ".join(self.effects)}

    @property
    def key(self) -> tuple[Any, ...]:
        """What tells it from the others, as one value."""
        return tuple(self.fields[name] for name in KEY)


@dataclass(frozen=True)
class Choice:
    """Which cases: by seed, machine, effect (None: all), strength and group."""

    seeds: Sequence[int] = range(5)
    kinds: Sequence[str] = tuple(KINDS)
    effects: Sequence[str] | None = None
    strengths: Sequence[str] = STRENGTHS
    groups: Sequence[str] = GROUPS
    split: str = "development"
    oracle: bool = False

    def __post_init__(self) -> None:
        planted = [effect for effects in KINDS.values() for effect in effects]
        for name, given, known in (
            ("kinds", self.kinds, list(KINDS)),
            ("effects", self.effects or (), sorted(set(planted))),
            ("strengths", self.strengths, list(STRENGTHS)),
            ("groups", self.groups, list(GROUPS)),
        ):
            if unknown := [one for one in given if one not in known]:
                raise ValueError(f"{name}: expected some of {known}, got {unknown}.")


def cases_of(choice: Choice) -> list[Case]:
    """All cases of a choice, by seed, and within a seed in random order.

    What there is of an interrupted study is balanced. The oracle has none without effects.
    """
    found = []
    for seed in choice.seeds:
        own = list(_of_seed(choice, seed))
        if choice.oracle:
            own = [replace(case, oracle=True) for case in own if case.effects]
        order = np.random.default_rng(seed).permutation(len(own))
        found += [own[k] for k in order]
    return found


def _of_seed(choice: Choice, seed: int) -> Iterator[Case]:
    split, strengths = choice.split, choice.strengths
    chosen = {
        kind: [e for e in KINDS[kind] if choice.effects is None or e in choice.effects]
        for kind in choice.kinds
    }
    for group in choice.groups:
        if group == "outside":
            yield from (Case(group, group, (), s, seed, split) for s in strengths)
        elif group == "null":
            seeds = range(NULLS * seed, NULLS * (seed + 1))
            yield from (Case(group, kind, (), "none", n, split) for kind in chosen for n in seeds)
        elif group == "single":
            for kind, effects in chosen.items():
                yield from (Case(group, kind, (e,), s, seed, split) for e in effects for s in
                            strengths)  # fmt: skip
        else:
            yield from _several(group, chosen, strengths, seed, split)


def _several(
    group: str,
    chosen: Mapping[str, Sequence[str]],
    strengths: Sequence[str],
    seed: int,
    split: str,
) -> Iterator[Case]:
    """Two or three effects of each machine that has as many, drawn by seed."""
    count = SEVERAL[group]
    for number, kind in enumerate(KINDS):
        effects = chosen.get(kind, ())
        if len(effects) < count:
            continue
        rng = np.random.default_rng([seed, number, count])
        places = sorted(rng.choice(len(effects), count, replace=False))
        strength = strengths[(seed + number) % len(strengths)]
        yield Case(group, kind, tuple(effects[k] for k in places), strength, seed, split)


def chosen_by(environment: Mapping[str, str]) -> Choice:
    """The choice that variables name."""
    words = {name: environment.get(f"NAMING_{name.upper()}") for name in
             ("seeds", "kinds", "strengths", "groups")}  # fmt: skip
    return choice_of({name: text for name, text in words.items() if text})


def choice_of(words: Mapping[str, str], split: str = "development", oracle: bool = False) -> Choice:
    """From texts: names with commas between them, and seeds as "3" or "0-4".

    Raises:
        ValueError: for unknown names, or seeds that are no such range.
    """
    found: dict[str, Any] = {name: text.split(",") for name, text in words.items()}
    if "seeds" in words:
        first, _, last = words["seeds"].partition("-")
        if not (first + last).isdigit() or int(last or first) < int(first):
            raise ValueError(f"seeds: expected '3' or '0-4', got {words['seeds']!r}.")
        found["seeds"] = range(int(first), int(last or first) + 1)
    return Choice(**found, split=split, oracle=oracle)
