"""Predictive checks: whether joint samples of a prediction look like the measured record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from pyro_dynogp.criticism.envelope import envelope
from pyro_dynogp.criticism.pairing import Pair, paired
from pyro_dynogp.criticism.statistics import STATISTICS, Statistic, unit
from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.isolation import isolated
from pyro_dynogp.prediction.prediction import Prediction
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.shown import shown

FALSE_ALARM = 0.05


@shown
@dataclass(repr=False, frozen=True, eq=False)
class PredictiveChecks:
    """J statistics of measured outputs beside those of S' joint samples of the prediction.

    Attributes:
        kind: what was predicted, in words.
        statistics: name of each of the J rows. outputs: name of its output. units: its unit.
        observed: (J,) statistic of the measured output.
        replicated: (S', J) statistic of each joint sample, missing outputs masked alike.
        p_value: (J,) two-sided predictive p-value of each statistic by itself.
        p_adjusted: (J,) the same, adjusted for the number of statistics and their dependence.
        left_out: (statistic, output) that cannot be computed on this record, such as
            a long lag on a short one.
        note: what limits the comparison, in words; empty where nothing does.
    """

    kind: str
    statistics: tuple[str, ...]
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    observed: np.ndarray
    replicated: np.ndarray
    p_value: np.ndarray
    p_adjusted: np.ndarray
    left_out: tuple[tuple[str, str], ...]
    note: str

    @property
    def stands_out(self) -> np.ndarray:
        """(J,): adjusted p-value of 5 % or less."""
        return self.p_adjusted <= FALSE_ALARM

    @property
    def verdict(self) -> str:
        """The statistics that stand out, with numbers, in a sentence."""
        rule = "at 5 % for all together (maxT adjustment of Westfall and Young)"
        count = len(self.statistics)
        found = np.flatnonzero(self.stands_out)
        if not len(found):
            least = int(np.argmin(self.p_adjusted))
            return (
                f"None of {count} statistics stands out {rule}; the least adjusted p-value is "
                f"{self.p_adjusted[least]:.2g} ({self.outputs[least]}: {self.statistics[least]})."
            )
        ordered = found[np.argsort(self.p_adjusted[found], kind="stable")]
        texts = [self._described(j) for j in ordered]
        verb = "stands" if len(found) == 1 else "stand"
        return f"{len(found)} of {count} statistics {verb} out {rule}: {'; '.join(texts)}."

    def _described(self, j: int) -> str:
        values = self.replicated[:, j]
        return (
            f"{self.outputs[j]}: {self.statistics[j]} (measured {self.observed[j]:.3g}, "
            f"replicated {values.mean():.3g} ± {values.std():.2g}, "
            f"adjusted p = {self.p_adjusted[j]:.2g})"
        )

    def to_frame(self) -> pd.DataFrame:
        """Table indexed by output and statistic: measured, replicated mean and sd, p-values."""
        index = pd.MultiIndex.from_arrays(
            [self.outputs, self.statistics], names=["output", "statistic"]
        )
        return pd.DataFrame(
            {
                "measured": self.observed,
                "replicated mean": self.replicated.mean(axis=0),
                "replicated sd": self.replicated.std(axis=0),
                "p": self.p_value,
                "adjusted p": self.p_adjusted,
            },
            index=index,
        )

    def __str__(self) -> str:
        table = self.to_frame().to_string(float_format=lambda value: f"{value:.3g}")
        title = f"Predictive checks of a {self.kind}, against {len(self.replicated)} joint samples"
        return "\n".join([title, table, self.verdict, *([self.note] if self.note else [])])


@isolated
def predictive_checks(
    prediction: Prediction,
    record: Record,
    statistics: Mapping[str, Statistic] | None = None,
    *,
    skip: int = 0,
) -> PredictiveChecks:
    """Compare statistics of measured outputs with those of joint samples of the prediction.

    The two-sided p-value is 2 min(P(T >= t), P(T <= t)), at most 1, each share being
    (1 + number of replicates) / (1 + S'), since the measured record counts as one of them
    (Gelman, Meng & Stern 1996; Phipson & Smyth 2010). Whether a statistic stands out among all of
    them is judged by the adjusted p-value of the single-step maxT procedure (Westfall & Young
    1993): 5 % is the probability that a correct prediction shows any that stands out, which
    Bonferroni's correction would need thousands of joint samples for.

    On the record that the model was fitted to p-values are larger than they should be, since the
    fit has seen the outputs; use a simulation or a forecast of another record. Joint samples of a
    cascade's prediction several steps ahead are independent in time and its errors are not (see
    `PredictiveChecks.note`).

    Args:
        prediction: of the same times as the record, with 50 joint samples or more.
        record: with measured outputs y (n, n_y); missing ones are masked in the samples, too.
        statistics: name -> function of time (n,) and one output y (n,) with NaN, to a number.
            None: `pyro_dynogp.criticism.statistics.STATISTICS`. One that is not finite for the
            measured output or for a replicate is left out (see `left_out`).
        skip: number of initial samples to leave out (a state-initialisation window).

    Raises:
        ValueError: wrong types; other times or outputs; skip out of range; an output without
            measured samples; too few joint samples; a statistic that returns no number; none left.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> quick = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
        >>> fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **quick)
        >>> largest = {"largest": lambda t, y: np.nanmax(y)}
        >>> found = dgp.predictive_checks(fit.simulate(record), record, largest)
        >>> found.p_value.shape
        (1,)
    """
    wanted = _checked(statistics)
    pair = paired(prediction, record, skip)
    time = record.time[skip:]
    rows: list[tuple[str, str, str]] = []
    left_out: list[tuple[str, str]] = []
    columns: list[np.ndarray] = []
    for a, output in enumerate(record.output_names):
        for name, statistic in wanted.items():
            values = _values(name, statistic, time, pair, skip, a)
            if np.isfinite(values).all():
                known = statistics is None or STATISTICS.get(name) is statistic
                text = unit(name, record.output_units[a]) if known else ""
                rows.append((name, output, text))
                columns.append(values)
            else:
                left_out.append((name, output))
    if not columns:
        raise invalid(
            "statistics",
            expected="one statistic or more that is finite on the record and all joint samples",
            got=f"none of {list(wanted)}",
            advice="The record may be too short, or have too many gaps, for all of them.",
        )
    observed, replicated = np.split(np.stack(columns, axis=1), [1])
    more = (replicated >= observed).sum(axis=0)
    less = (replicated <= observed).sum(axis=0)
    p_value = np.minimum(1.0, 2.0 * (1 + np.minimum(more, less)) / (1 + len(replicated)))
    names, outputs, units = zip(*rows, strict=True)
    return PredictiveChecks(
        kind=prediction.kind,
        statistics=names,
        outputs=outputs,
        units=units,
        observed=observed[0],
        replicated=replicated,
        p_value=p_value,
        p_adjusted=envelope(observed[0], replicated, 1.0 - FALSE_ALARM).p_values,
        left_out=tuple(left_out),
        note=pair.note,
    )


def _checked(statistics: Mapping[str, Statistic] | None) -> Mapping[str, Statistic]:
    if statistics is None:
        return STATISTICS
    if not isinstance(statistics, Mapping) or not statistics:
        raise invalid(
            "statistics",
            expected="a mapping from names to functions, with one entry or more",
            got=repr(statistics),
        )
    for name, statistic in statistics.items():
        if not isinstance(name, str) or not callable(statistic):
            raise invalid(
                "statistics",
                expected="names as text and functions of (time, y)",
                got=f"{name!r}: {statistic!r}",
            )
    return statistics


def _values(
    name: str, statistic: Statistic, time: np.ndarray, pair: Pair, skip: int, a: int
) -> np.ndarray:
    """Statistic (1 + S',) of the measured output, then of each joint sample."""
    series = [pair.outputs[skip:, a], *pair.samples[:, skip:, a]]
    values = np.empty(len(series))
    for i, y in enumerate(series):
        value = statistic(time, y.copy())  # a copy, so that a statistic cannot change the data
        if np.ndim(value) != 0 or not np.isreal(value) or isinstance(value, str):
            raise invalid(
                f"statistics[{name!r}]",
                expected="a function that returns one real number",
                got=f"{value!r}",
            )
        values[i] = value
    return values
