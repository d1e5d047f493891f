"""How much the thresholds of the loop decide: stored refits judged again with other values.

`record` closes the loop on development plants and keeps what every refit gained, sample by sample;
`judge_again` needs no refit. Run `python -m tests.benchmarks thresholds`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from pyro_dynogp.discrepancy import decision
from pyro_dynogp.statistics.settings import LoopSettings
from tests.benchmarks.markdown import table
from tests.benchmarks.planted import Case, study

KEPT = Path("docs/planted/refits.development.npz")
PLANTS = tuple(
    Case(effect, strength, 1)
    for effect in ("extra input", "dead time", "output nonlinearity", "saturation", "drift",
                   "level shift", "heavy tails", "heteroscedastic noise", "outside catalogue")
    for strength in ("weak", "middle")
)  # fmt: skip
VARIED = {
    "gain": (2.0, 8.0),
    "standard_errors": (1.0, 3.0),
    "cap": (5.0, 20.0),
    "harm": (0.025, 0.1),
    "special": (0.025, 0.1),
}


@dataclass(frozen=True, eq=False)
class Refit:
    """What one candidate gained over the model without it.

    Attributes:
        plant: which. effect: name. gains: (N,) of held-out samples [nats].
        losses: (M,) of forecasts, empty where structure was added [nats].
        special_of: name of the effect of which it is a special case.
    """

    plant: int
    effect: str
    gains: np.ndarray
    losses: np.ndarray
    special_of: str


def record(plants: tuple[Case, ...] = PLANTS) -> list[Refit]:
    """Refits of the first round of the loop on each plant."""
    kept: list[Refit] = []
    judge = decision._judge

    for number, case in enumerate(plants):

        def recording(found: Any, kind: Any, tried: Any, base: Any, *rest: Any,
                      number: int = number) -> Any:  # fmt: skip
            if not (tried.failure or base.failure):
                losses = np.zeros(0)
                if len(tried.errors):
                    losses = decision._loss(tried.errors, base.errors)
                effect = found.effect
                gains = tried.densities - base.densities
                kept.append(Refit(number, effect.name, gains, losses, effect.special_of))
            return judge(found, kind, tried, base, *rest)

        with mock.patch.object(decision, "_judge", recording):
            study(case)
    return kept


def save(refits: list[Refit], path: Path = KEPT) -> None:
    """Write refits to a file, gains in single precision."""
    arrays: dict[str, Any] = {
        "plant": np.array([one.plant for one in refits]),
        "effect": np.array([one.effect for one in refits]),
        "special_of": np.array([one.special_of for one in refits]),
    }
    for k, one in enumerate(refits):
        arrays[f"gains/{k}"] = one.gains.astype(np.float32)
        arrays[f"losses/{k}"] = one.losses.astype(np.float32)
    np.savez_compressed(path, **arrays)


def load(path: Path = KEPT) -> list[Refit]:
    """Refits from a file."""
    with np.load(path, allow_pickle=False) as file:
        return [
            Refit(int(plant), str(effect), file[f"gains/{k}"].astype(float),
                  file[f"losses/{k}"].astype(float), str(special))
            for k, (plant, effect, special) in enumerate(
                zip(file["plant"], file["effect"], file["special_of"], strict=True)
            )
        ]  # fmt: skip


def helps(refit: Refit, settings: LoopSettings) -> bool:
    """Whether a candidate counts as a help."""
    enough = decision.certain(refit.gains, settings) or decision.certain(
        np.minimum(refit.gains, settings.cap), settings
    )
    harms = len(refit.losses) and decision.certain(refit.losses, settings)
    return bool(enough and not (harms and refit.losses.mean() > settings.harm))


def special_ties(refits: list[Refit], settings: LoopSettings) -> int:
    """Special cases that count as equal to the general effect beside them."""
    count = 0
    for one in refits:
        for other in refits:
            if one.plant == other.plant and one.special_of == other.effect:
                gained = other.gains.sum()
                count += bool(gained - one.gains.sum() <= max(settings.gain,
                              settings.special * gained))  # fmt: skip
    return count


def judge_again(refits: list[Refit]) -> list[tuple[str, float, int, int]]:
    """For each value of each threshold: candidates judged otherwise, and special cases.

    Returns:
        (threshold, value, changed, change of the number of special cases that tie).
    """
    before = [helps(one, DEFAULTS) for one in refits]
    ties = special_ties(refits, DEFAULTS)
    rows = []
    for name, values in VARIED.items():
        for value in values:
            settings = replace(DEFAULTS, **{name: value})
            after = [helps(one, settings) for one in refits]
            changed = sum(a != b for a, b in zip(before, after, strict=True))
            rows.append((name, value, changed, special_ties(refits, settings) - ties))
    return rows


def run(folder: Path) -> str:
    """Record what is missing, and tabulate."""
    del folder  # it has no picture
    if not KEPT.exists():
        save(record())
    refits = load()
    rows = [
        [name, f"{getattr(DEFAULTS, name):g}", f"{value:g}", str(changed), f"{special:+d}"]
        for name, value, changed, special in judge_again(refits)
    ]
    plants = len({one.plant for one in refits})
    head = ["threshold", "default", "instead", "candidates judged otherwise", "special cases"]
    return f"{len(refits)} candidates on {plants} plants.\n\n" + table(head, rows)
