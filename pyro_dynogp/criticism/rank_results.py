"""What simulation-based calibration found: ranks, tests, a verdict in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from pyro_dynogp.criticism.ranks import Uniformity, holm, uniformity
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.shown import shown


@shown
@dataclass(repr=False, frozen=True, eq=False)
class SimulationBasedCalibration:
    """Ranks of true values among posterior draws, and whether they are uniform.

    Attributes:
        method: of the fits.
        replicates: number of simulated records, those that failed included.
        draws: L, number of posterior draws that each truth was ranked among.
        level: probability that nothing is found where all is right.
        ranks: name -> (N,) whole numbers 0 to L, of the N replicates that did not fail; the
            quantities are the numbers of all sites, and "log joint".
        tests: name -> p-values of the chi-square test and of the ECDF's simultaneous band, the
            band itself, and the shape of the departure in words.
        p_adjusted: name -> p-value of both tests, adjusted for the number of quantities (Holm).
        failures: why each replicate failed that did.
        notes: what limits the result, in words.
    """

    method: str
    replicates: int
    draws: int
    level: float
    ranks: Mapping[str, np.ndarray]
    tests: Mapping[str, Uniformity]
    p_adjusted: Mapping[str, float]
    failures: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def p_chi_square(self) -> dict[str, float]:
        """P-value by quantity of the chi-square test of the rank histogram."""
        return {name: one.p_chi_square for name, one in self.tests.items()}

    @property
    def p_ecdf(self) -> dict[str, float]:
        """P-value by quantity of the largest departure of the ranks' distribution."""
        return {name: one.p_ecdf for name, one in self.tests.items()}

    @property
    def miscalibrated(self) -> tuple[str, ...]:
        """Quantities whose ranks are not uniform, the surest first."""
        limit = 1.0 - self.level + 1e-9
        found = [name for name, p in self.p_adjusted.items() if p <= limit]
        return tuple(sorted(found, key=lambda name: self.p_adjusted[name]))

    @property
    def calibrated(self) -> bool:
        """Whether no quantity, all of them looked at, has ranks that are not uniform."""
        return not self.miscalibrated

    @property
    def verdict(self) -> str:
        """What was found, in words."""
        count = len(next(iter(self.ranks.values())))
        smallest = min(self.p_adjusted.values())
        over = f"{len(self.ranks)} quantities over {count} simulated records"
        if self.calibrated:
            text = f"No sign of miscalibration of {over} (smallest adjusted p = {smallest:.2g})"
        else:
            each = [
                f"{name} ({' and '.join(self.tests[name].shape) or 'of another shape'}, "
                f"p = {self.p_adjusted[name]:.2g})"
                for name in self.miscalibrated
            ]
            text = f"Not calibrated, {len(each)} of {over}: {', '.join(each)}"
        if self.failures:
            reasons = [
                f"{n} times {what}" if n > 1 else what
                for what, n in Counter(self.failures).most_common(3)
            ]
            text += (
                f". {len(self.failures)} of {self.replicates} replicates failed and count nowhere, "
                f"which may hide or feign miscalibration: {'; '.join(reasons)}"
            )
        return text.rstrip(".") + "."

    def to_frame(self) -> pd.DataFrame:
        """Table of one row for each quantity: mean rank, p-values, shape."""
        return pd.DataFrame(
            {
                # Of 0.5 where it is uniform, whatever the number of draws.
                "mean rank": [float((r.mean() + 0.5) / (self.draws + 1)) for r in
                              self.ranks.values()],
                "p chi-square": list(self.p_chi_square.values()),
                "p ecdf": list(self.p_ecdf.values()),
                "p adjusted": [self.p_adjusted[name] for name in self.ranks],
                "finding": [
                    " and ".join(self.tests[name].shape) or "of another shape"
                    if name in self.miscalibrated
                    else ""
                    for name in self.ranks
                ],
            },
            index=pd.Index(list(self.ranks), name="quantity"),
        )  # fmt: skip

    def __str__(self) -> str:
        title = (
            f"Simulation-based calibration of {self.method}: {self.replicates} replicates, ranks "
            f"among {self.draws} draws"
        )
        table = self.to_frame().to_string(float_format=lambda value: f"{value:.3g}")
        return "\n".join([title, table, self.verdict, *self.notes])


def judged(
    ranks: Mapping[str, np.ndarray],
    draws: int,
    *,
    method: str,
    failures: tuple[str, ...] = (),
    level: float = 0.95,
    seed: int = 0,
) -> SimulationBasedCalibration:
    """Test ranks (N,) of each quantity, whole numbers 0 to `draws`.

    Args:
        ranks: by quantity. draws: L. method: in words. failures: reasons of what failed.
        level: of the bands and of the verdict. seed: of simulated uniform ranks.
    """
    tests = uniformity(ranks, draws, level=level, seed=seed)
    adjusted = holm(np.array([one.p_value for one in tests.values()]))
    count = len(next(iter(ranks.values())))
    return SimulationBasedCalibration(
        method=method,
        replicates=count + len(failures),
        draws=draws,
        level=level,
        ranks=FrozenMapping(dict(ranks)),
        tests=FrozenMapping(tests),
        p_adjusted=FrozenMapping(dict(zip(tests, adjusted.tolist(), strict=True))),
        failures=failures,
    )
