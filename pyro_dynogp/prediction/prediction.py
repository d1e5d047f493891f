"""What a prediction is: a Gaussian mixture at every time, joint samples, shares of the variance."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike
from scipy.special import log_ndtr, logsumexp, ndtr, ndtri, ndtri_exp

from pyro_dynogp.data.checks import as_channels, real_numbers
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.records import one_record
from pyro_dynogp.inference.isolation import alone
from pyro_dynogp.support.errors import SWITCH, invalid
from pyro_dynogp.support.frozen import FrozenMapping

# A quantile is found to this share of the smallest standard deviation of a component; steps for it.
RESOLUTION, ITERATIONS = 1e-10, 100
ROOT_TWO_PI = math.sqrt(2.0 * math.pi)


@dataclass(frozen=True, eq=False)
class Drawn:
    """A sampler of a prediction whose joint samples are drawn already.

    Attributes:
        samples: (S', n, n_y).
    """

    samples: np.ndarray

    def __call__(self) -> np.ndarray:
        """The samples."""
        return self.samples


class Parts(Mapping[str, np.ndarray]):
    """Shares of a variance by cause, computed when they are first asked for.

    Most uses of a prediction never do, and those of a cascade cost more than all the rest of it.

    Args:
        compute: gives the shares (n, n_y) by cause; called once.
    """

    def __init__(self, compute: Callable[[], Mapping[str, np.ndarray]]) -> None:
        self._compute = compute

    @cached_property
    def _found(self) -> Mapping[str, np.ndarray]:
        with alone():
            return self._compute()

    def __getitem__(self, cause: str) -> np.ndarray:
        return self._found[cause]

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predictive distribution of measured outputs, in the units of the record.

    Given the parameters the outputs are Gaussian, or a mixture that stands for a Student-t; over
    posterior draws they are a mixture of S components, of equal weights unless stated, whose
    moments, quantiles and densities here are exact.

    Attributes:
        time: (n,) in the unit of the record.
        output_names: of the n_y outputs.
        component_mean: (S, n, n_y) mean of each component.
        component_variance: (S, n, n_y) variance of the noise-free output in each component.
        noise_variance: (S, n_y) variance of the measurement noise in each; (S, n, n_y) where
            it changes over time.
        parts: share of the variance (n, n_y) by cause; they add up to the variance.
        sampler: draws joint samples (S', n, n_y); called once.
        kind: what was predicted, in words.
        weights: (S,) of the components; None for equal ones.
        output_units: of the n_y outputs; None where they are not known.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> quick = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
        >>> fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **quick)
        >>> simulation = fit.simulate(record)
        >>> simulation.quantile(0.9).shape, list(simulation.parts)[0]
        ((60, 1), 'parameters')
    """

    time: np.ndarray
    output_names: tuple[str, ...]
    component_mean: np.ndarray
    component_variance: np.ndarray
    noise_variance: np.ndarray
    parts: Mapping[str, np.ndarray]
    sampler: Callable[[], np.ndarray]
    kind: str
    weights: np.ndarray | None = None
    output_units: tuple[str, ...] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """With joint samples drawn and shares computed: any callable may have been behind them."""
        samples, parts = self.samples, FrozenMapping(self.parts)
        return {**self.__dict__, "sampler": Drawn(samples), "parts": parts}

    @property
    def component_weights(self) -> np.ndarray:
        """(S,): they add up to one."""
        count = len(self.component_mean)
        return np.full(count, 1.0 / count) if self.weights is None else self.weights

    def _average(self, x: np.ndarray) -> np.ndarray:
        """Weighted mean over the draws, the first dimension."""
        # The plain mean where weights are equal: other sums round differently.
        return x.mean(0) if self.weights is None else np.tensordot(self.weights, x, 1)

    @cached_property
    def mean(self) -> np.ndarray:
        """(n, n_y)."""
        return self._average(self.component_mean)

    @cached_property
    def variance(self) -> np.ndarray:
        """(n, n_y): of measured outputs, measurement noise included."""
        return self.signal_variance + self._average(self.noise_variance)

    @property
    def sd(self) -> np.ndarray:
        """(n, n_y): standard deviation of measured outputs, measurement noise included."""
        return np.sqrt(self.variance)

    @property
    def signal_variance(self) -> np.ndarray:
        """(n, n_y): of the noise-free outputs."""
        spread = self._average((self.component_mean - self.mean) ** 2)
        return self._average(self.component_variance) + spread

    @property
    def signal_sd(self) -> np.ndarray:
        """(n, n_y): standard deviation of the noise-free outputs."""
        return np.sqrt(self.signal_variance)

    @cached_property
    def component_sd(self) -> np.ndarray:
        """(S, n, n_y): standard deviation of measured outputs in each component."""
        noise = self.noise_variance
        return np.sqrt(self.component_variance + (noise if noise.ndim == 3 else noise[:, None, :]))

    @cached_property
    def samples(self) -> np.ndarray:
        """Joint samples (S', n, n_y) of measured outputs."""
        with alone():
            return self.sampler()

    def check(self, record: Record, *, outputs: bool = True) -> None:
        """Refuse a record that this is no prediction of.

        Args:
            record: it was made for. outputs: whether its outputs are to be compared.

        Raises:
            ValueError: no record, other times, other outputs, or outputs in other units.
        """
        advice = "Compare a prediction with the record that it was made for."
        if not np.array_equal(self.time, one_record(record, advice).time):
            same = len(self) == len(record)
            raise invalid(
                "prediction",
                expected=f"the {len(record)} times of the record",
                got="other times of the same number" if same else f"{len(self)} times",
                advice=advice,
            )
        for name in ("output_names", "output_units") if outputs else ():
            expected, got = getattr(self, name), getattr(record, name)
            if expected is not None and tuple(expected) != got:
                expected = f"{list(expected)}, as predicted"
                raise invalid(
                    f"record.{name}", expected=expected, got=f"{list(got)}", advice=advice
                )

    def quantile(self, q: Any) -> np.ndarray:
        """Quantiles of measured outputs.

        Args:
            q: probability in (0, 1), or several.

        Returns:
            (n, n_y) for one probability, (len(q), n, n_y) for several.
        """
        levels = np.atleast_1d(real_numbers("q", q))
        if not ((levels > 0) & (levels < 1)).all():
            raise invalid("q", expected="probabilities between 0 and 1", got=repr(q))
        out = np.stack([self._quantile(float(level)) for level in levels])
        return out[0] if np.ndim(q) == 0 else out

    def _quantile(self, level: float) -> np.ndarray:
        mean, sd = self.component_mean, self.component_sd
        ends = mean + ndtri(level) * sd
        low, high = ends.min(0), ends.max(0)  # the quantile of a mixture lies between these
        if mean.shape[0] == 1:
            return low
        found, last = self._average(ends), high - low
        for _ in range(ITERATIONS):
            z = (found - mean) / sd
            excess = self._average(ndtr(z)) - level
            low, high = np.where(excess < 0, found, low), np.where(excess < 0, high, found)
            # Newton's step, or to the middle of what is left where that leads out of it or is slow.
            with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
                density = self._average(np.exp(-0.5 * z**2) / (ROOT_TWO_PI * sd))
                step = -excess / density
            settled = np.minimum(np.abs(step), high - low) <= RESOLUTION * sd.min(0)
            if settled.all():
                break
            newton = (found + step > low) & (found + step < high) & (np.abs(step) < 0.5 * last)
            step = np.where(newton, step, 0.5 * (low + high) - found)
            step[settled] = 0.0
            found, last = found + step, np.abs(step)
        return found

    def log_density(self, outputs: ArrayLike) -> np.ndarray:
        """Log-density (n, n_y) of each measured output by itself; NaN where it is missing."""
        z = self._standardised(outputs)
        terms = -0.5 * z**2 - np.log(self.component_sd) - 0.5 * np.log(2.0 * np.pi)
        return logsumexp(terms + np.log(self.component_weights)[:, None, None], axis=0)

    def probability_integral(self, outputs: ArrayLike) -> np.ndarray:
        """Predictive distribution function (n, n_y) at the measured outputs."""
        return self._average(ndtr(self._standardised(outputs)))

    def _standardised(self, outputs: ArrayLike) -> np.ndarray:
        """Outputs (n, n_y), or (n,) of one, in deviations from each component (S, n, n_y)."""
        y = as_channels("outputs", outputs, len(self), len(self.output_names))
        return (y - self.component_mean) / self.component_sd

    def normal_scores(self, outputs: ArrayLike) -> np.ndarray:
        """Errors (n, n_y) of measured outputs, as quantiles of the standard normal distribution.

        Standard normal if the prediction is right, of whatever shape it is: the normal quantile of
        `probability_integral`, also far in the tails. NaN where the output is missing.

        Source: randomised quantile residuals of a continuous distribution, Dunn & Smyth, J. Comput.
        Graph. Stat. 5(3):236 (1996).
        """
        z = self._standardised(outputs)
        if len(z) == 1:
            return z[0]
        share = np.log(self.component_weights)[:, None, None]
        below = logsumexp(log_ndtr(z) + share, axis=0)
        above = logsumexp(log_ndtr(-z) + share, axis=0)
        # From the smaller tail: the other one is 1 in floating point far out. Weights add up to
        # one but for rounding, so either may exceed it.
        tail = ndtri_exp(np.minimum(np.minimum(below, above), 0.0))
        return np.where(below < above, tail, -tail)

    def to_frame(self) -> pd.DataFrame:
        """Table of mean, sd and the 95 % interval of every output, indexed by time."""
        low, high = self.quantile([0.025, 0.975])
        columns = {}
        for a, name in enumerate(self.output_names):
            columns[f"{name} mean"] = self.mean[:, a]
            columns[f"{name} sd"] = self.sd[:, a]
            columns[f"{name} 2.5 %"] = low[:, a]
            columns[f"{name} 97.5 %"] = high[:, a]
        return pd.DataFrame(columns, index=pd.Index(self.time, name="time"))

    def to_xarray(self, *, samples: bool = False) -> xr.Dataset:
        """The prediction as a Dataset over "time" and "output".

        Variables `mean`, `sd` and `signal_sd` (time, output), `quantile` (probability, time,
        output) at 2.5, 25, 50, 75 and 97.5 %, `part` (cause, time, output) of the variance by
        cause, and with `samples` the joint samples `sample` (sample, time, output). Units of the
        outputs are in the labels ``output_unit``.

        Args:
            samples: whether to draw and add the joint samples.
        """
        SWITCH.check("samples", samples)
        levels = [0.025, 0.25, 0.5, 0.75, 0.975]
        units = self.output_units or ("",) * len(self.output_names)
        per = ("time", "output")
        variables: dict[str, Any] = {
            "mean": (per, self.mean), "sd": (per, self.sd), "signal_sd": (per, self.signal_sd),
            "quantile": (("probability", *per), self.quantile(levels)),
            "part": (("cause", *per), np.stack([self.parts[cause] for cause in self.parts])),
        }  # fmt: skip
        if samples:
            variables["sample"] = (("sample", *per), self.samples)
        coords = {
            "time": self.time, "output": list(self.output_names), "probability": levels,
            "cause": list(self.parts), "output_unit": ("output", list(units)),
        }  # fmt: skip
        return xr.Dataset(variables, coords, {"kind": self.kind})

    def __repr__(self) -> str:
        return (
            f"Prediction({self.kind!r}, n={len(self)}, outputs={list(self.output_names)}, "
            f"components={len(self.component_mean)})"
        )

    def _repr_html_(self) -> str:
        frame = self.to_frame()
        shown = frame if len(frame) <= 10 else pd.concat([frame[:5], frame[-5:]])
        title = f"{self.kind}, {len(frame)} times"
        title += "" if len(frame) <= 10 else ": the first and last five"
        return f"<p>{html.escape(title)}</p>{shown.to_html(border=0)}"

    def __len__(self) -> int:
        return len(self.time)
