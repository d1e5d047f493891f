"""Calibration: whether measured outputs follow the distribution predicted for them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from pyro_dynogp.criticism.crps import CrpsDecomposition, decomposition
from pyro_dynogp.criticism.pairing import Pair, paired
from pyro_dynogp.criticism.probability_integral import LEVELS, NOMINAL, PitCurves, pit_curves
from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.isolation import isolated
from pyro_dynogp.prediction.prediction import Prediction
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.shown import shown

# Enough for p-values in steps of 0.2 %; more would cost time in proportion.
MOST_SAMPLES = 500


@shown
@dataclass(repr=False, frozen=True, eq=False)
class Calibration:
    """Probability integral transform (PIT) of measured outputs, beside what is to be expected.

    A calibrated prediction gives PIT values that are uniform on (0, 1) (Dawid 1984; Gneiting,
    Balabdaoui & Raftery 2007). How far their distribution may stray by chance depends on how
    strongly they depend on each other in time; all bands here therefore come from the
    prediction's own joint samples, each taken for the measured record in its turn.

    Attributes:
        kind: what was predicted, in words.
        output_names: of the n_y outputs. output_units: their units.
        level: share of the curves that a band holds wholly inside.
        replicates: number of joint samples used.
        counts: (n_y,) number of samples compared.
        pit: (n, n_y) PIT values; NaN where the output is missing or skipped.
        levels: (K,) probabilities at which the distribution of PIT values is looked at.
        ecdf: (K, n_y) share of PIT values at or below each level.
        low: (K, n_y) lower limit of the simultaneous band. high: (K, n_y) upper limit.
        nominal: (K',) probabilities of central intervals.
        coverage: (K', n_y) share of samples inside; coverage_low, coverage_high: its band, which
            is simultaneous with that of `ecdf`.
        p_value: (n_y,) Monte Carlo p-value of the largest standardised departure of `ecdf` or
            `coverage`; at most 1 - level exactly where one of them leaves its band.
        location: (n_y,) mean over standard deviation of the normal scores of the PIT; expected 0,
            below it where the prediction is biased upwards.
        spread: (n_y,) standard deviation of the normal scores over that of the joint samples;
            expected 1, above it where the prediction is too narrow.
        location_p, spread_p: (n_y,) p-values of the two, adjusted for there being two.
        edges: (B + 1,) of the bins of the PIT histogram.
        density: (B, n_y) its height, 1 on average; density_low, density_high: a simultaneous band
            of its own.
        sharpness: name -> (n_y,) [output]: mean ``width_50`` and ``width_95`` of the central
            intervals, and mean ``sd``, over the samples compared.
        crps: parts of the mean continuous ranked probability score [output].
        note: what limits the comparison, in words; empty where nothing does.
    """

    kind: str
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    level: float
    replicates: int
    counts: np.ndarray
    pit: np.ndarray
    levels: np.ndarray
    ecdf: np.ndarray
    low: np.ndarray
    high: np.ndarray
    nominal: np.ndarray
    coverage: np.ndarray
    coverage_low: np.ndarray
    coverage_high: np.ndarray
    p_value: np.ndarray
    location: np.ndarray
    location_p: np.ndarray
    spread: np.ndarray
    spread_p: np.ndarray
    edges: np.ndarray
    density: np.ndarray
    density_low: np.ndarray
    density_high: np.ndarray
    sharpness: Mapping[str, np.ndarray]
    crps: CrpsDecomposition
    note: str

    @property
    def calibrated(self) -> np.ndarray:
        """(n_y,): whether ECDF and coverage stay inside their simultaneous band."""
        # A p-value is a fraction of whole numbers; 1 - level is rounded.
        return self.p_value > 1.0 - self.level + 1e-9

    @property
    def verdict(self) -> str:
        """One sentence for each output, one line each."""
        return "\n".join(self._sentence(a) for a in range(len(self.output_names)))

    def _sentence(self, a: int) -> str:
        name, p = self.output_names[a], f"p = {self.p_value[a]:.2g}"
        inside = [self.coverage[np.isclose(self.nominal, share), a].item() for share in (0.5, 0.95)]
        numbers = (
            f"the 50 % interval holds {100 * inside[0]:.0f} % and the 95 % interval "
            f"{100 * inside[1]:.0f} % of {self.counts[a]} samples"
        )
        if self.calibrated[a]:
            return f"{name}: no sign of miscalibration ({p}); {numbers}."
        return f"{name}: {' and '.join(self._shape(a))} ({p}); {numbers}; {self._where(a)}."

    def _shape(self, a: int) -> list[str]:
        """What is wrong, the surer finding first."""
        median = 100 * self.ecdf[np.isclose(self.levels, 0.5), a].item()
        bias = "downwards" if self.location[a] > 0 else "upwards"
        width = "too narrow" if self.spread[a] > 1 else "too wide"
        findings = [
            (
                self.spread_p[a],
                f"{width} (PIT scores spread {self.spread[a]:.2g} times as wide as expected)",
            ),
            (self.location_p[a], f"biased {bias} ({median:.0f} % of the samples below its median)"),
        ]
        findings.sort(key=lambda finding: finding[0])
        sure = [text for p, text in findings if p <= 1.0 - self.level + 1e-9]
        return sure or ["of another shape than predicted, neither by a bias nor by its width"]

    def _where(self, a: int) -> str:
        curves = []
        for what, at, values, low, high in (
            ("ECDF", self.levels, self.ecdf, self.low, self.high),
            ("coverage", self.nominal, self.coverage, self.coverage_low, self.coverage_high),
        ):
            sides = []
            for side, outside in (("above", values > high), ("below", values < low)):
                where = at[outside[:, a]]
                if len(where):
                    sides.append(f"{side} (levels {where[0]:.2f} to {where[-1]:.2f})")
            if sides:
                curves.append(f"{what} {' and '.join(sides)}")
        found = ", ".join(curves) or "nothing by more than rounding"
        return f"outside the {100 * self.level:.3g} % band: {found}"

    def to_frame(self) -> pd.DataFrame:
        """Table of one row for each output."""
        inside = {
            f"inside {100 * share:.0f} %": self.coverage[np.isclose(self.nominal, share)][0]
            for share in (0.5, 0.95)
        }
        return pd.DataFrame(
            {
                "samples": self.counts,
                "p": self.p_value,
                **inside,
                "width 50 %": self.sharpness["width_50"],
                "width 95 %": self.sharpness["width_95"],
                "sd": self.sharpness["sd"],
                "crps": self.crps.mean,
                "miscalibration": self.crps.miscalibration,
                "expected": self.crps.miscalibration_expected,
                "discrimination": self.crps.discrimination,
                "uncertainty": self.crps.uncertainty,
            },
            index=pd.Index(self.output_names, name="output"),
        )

    def __str__(self) -> str:
        table = self.to_frame().T.to_string(float_format=lambda value: f"{value:.3g}")
        title = f"Calibration of a {self.kind}, against {self.replicates} joint samples"
        return "\n".join([title, table, self.verdict, *([self.note] if self.note else [])])


@isolated
def calibration(
    prediction: Prediction, record: Record, *, skip: int = 0, level: float = 0.95, seed: int = 0
) -> Calibration:
    """Compare measured outputs with the distribution that was predicted for them.

    Each joint sample of the prediction is taken for the measured record in its turn and gives its
    own curves; between these curves the measured one has to lie. So one mechanism serves
    independent one-step errors as well as the strongly dependent errors of a simulation. The
    p-values hold where the joint samples depend on each other in time as the measured outputs do
    under the model: those of a linear model do, those of a cascade's predictions several steps
    ahead do not (see `Calibration.note`). They hold for a record that the model was not fitted to;
    on the training record they are larger than they should be, as the fit has seen the outputs.

    Args:
        prediction: of the same times as the record, with 50 joint samples or more; at most 500 of
            them are used.
        record: with measured outputs y (n, n_y); missing ones are left out.
        skip: number of initial samples to leave out (a state-initialisation window).
        level: of the simultaneous bands, in (0, 1).
        seed: of the choice among more than 500 joint samples.

    Raises:
        ValueError: wrong types; other times or outputs; skip or level out of range; an output
            without measured samples; too few joint samples (for the level).

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> quick = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
        >>> fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **quick)
        >>> found = dgp.calibration(fit.predict(record), record)
        >>> "calibration" in found.verdict
        True
    """
    pair = paired(prediction, record, skip)
    samples = _chosen(pair, seed)
    _check_level(level, len(samples))
    pit = prediction.probability_integral(pair.outputs)
    replicated = np.stack([prediction.probability_integral(one) for one in samples])
    counts = np.isfinite(pit).sum(axis=0)
    edges = np.linspace(0.0, 1.0, (20 if counts.min() >= 400 else 10) + 1)
    curves = [pit_curves(pit[:, a], replicated[:, :, a], edges, level) for a in range(pit.shape[1])]
    stacked = {
        field.name: np.stack([getattr(one, field.name) for one in curves], axis=-1)
        for field in dataclasses.fields(PitCurves)
    }
    return Calibration(
        kind=prediction.kind,
        output_names=record.output_names,
        output_units=record.output_units,
        level=level,
        replicates=len(samples),
        counts=counts,
        pit=pit,
        levels=LEVELS,
        nominal=NOMINAL,
        edges=edges,
        sharpness=_sharpness(prediction, np.isfinite(pit)),
        crps=decomposition(prediction, pair.outputs, samples[:200]),
        note=pair.note,
        **stacked,
    )


def _chosen(pair: Pair, seed: int) -> np.ndarray:
    if len(pair.samples) <= MOST_SAMPLES:
        return pair.samples
    generator = np.random.default_rng(seed)
    return pair.samples[generator.choice(len(pair.samples), MOST_SAMPLES, replace=False)]


def _check_level(level: float, count: int) -> None:
    number = isinstance(level, (int, float, np.floating)) and not isinstance(level, bool)
    if not number or not 0 < level < 1:
        raise invalid("level", expected="a probability between 0 and 1", got=repr(level))
    if level > count / (count + 1):
        raise invalid(
            "level",
            expected=f"at most {count / (count + 1):.4g} with {count} joint samples",
            got=repr(level),
            advice="Make the prediction with more joint samples, or take a lower level.",
        )


def _sharpness(prediction: Prediction, there: np.ndarray) -> dict[str, np.ndarray]:
    low95, low50, high50, high95 = prediction.quantile([0.025, 0.25, 0.75, 0.975])
    widths = {"width_50": high50 - low50, "width_95": high95 - low95, "sd": prediction.sd}
    return {name: np.mean(value, axis=0, where=there) for name, value in widths.items()}
