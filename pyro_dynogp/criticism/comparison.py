"""Comparison of models by the elpd of left-out data, and predictions by all of them together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from pyro_dynogp.criticism import arviz_bridge
from pyro_dynogp.criticism.loo import Target, loo
from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.fitted import known_fit
from pyro_dynogp.inference.isolation import isolated
from pyro_dynogp.prediction import predict as predicting
from pyro_dynogp.prediction.prediction import Parts, Prediction
from pyro_dynogp.support.errors import POSITIVE_OR_ZERO, invalid, one_of
from pyro_dynogp.support.shown import shown

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted

# Differences of total elpd below this are small whatever their standard error (Vehtari's
# cross-validation FAQ), and so many standard errors make one clear.
SMALL, CLEAR = 4.0, 2.0


@shown
@dataclass(repr=False, frozen=True, eq=False)
class Comparison:
    """Models compared on one target.

    Attributes:
        table: one row for each model, best first: ArviZ's columns (rank, elpd_loo, p_loo,
            elpd_diff, weight, se, dse, warning) and `dse_block`, the standard error of the
            difference that knows how neighbouring samples go together, and the Monte Carlo errors
            of both elpds; `n_effective`, how many independent differences the record holds;
            `clear`, whether the model is clearly worse
            than the best one.
        elpds: ELPDData by name. target: what was left out.
    """

    table: pd.DataFrame
    elpds: Mapping[str, Any]
    target: str

    @property
    def weights(self) -> dict[str, float]:
        """Stacking weights by name (Yao, Vehtari, Simpson & Gelman 2018)."""
        names: list[str] = self.table.index.astype(str).tolist()
        return dict(zip(names, self.table["weight"].to_numpy(dtype=float).tolist(), strict=True))

    @property
    def verdict(self) -> str:
        """Which model is preferred, in a sentence."""
        names: list[str] = self.table.index.astype(str).tolist()
        best = names[0]
        if len(names) == 1:
            return f"{best} is the only model."
        close = [n for n in names[1:] if not self.table.loc[n, "clear"]]
        clear = [n for n in names[1:] if n not in close]
        text = f"Target '{self.target}': {best} has the highest elpd"
        if clear:
            behind = dict(zip(names, self.table["elpd_diff"].to_numpy(dtype=float), strict=True))
            worst = ", ".join(f"{n} by {behind[n]:.1f} nats" for n in clear)
            text += f"; clearly worse: {worst}"
        if close:
            text += f"; a tie within errors: {', '.join(close)}"
        if bool(self.table["warning"].any()):
            text += ". Some values are not reliable: see the notes of their ELPDData"
        return text + "."

    def __str__(self) -> str:
        return f"{self.table.to_string(float_format=lambda x: f'{x:.3g}')}\n{self.verdict}"


@isolated
def compare(
    models: Mapping[str, Fitted | Any], *, target: Target, method: str = "stacking", **options: Any
) -> Comparison:
    """Compare models of the same data by their elpd.

    Args:
        models: fits by name, other subjects of `loo`, or ELPDData that `loo` returned.
        target: as of `loo`: what the models are for. options: of `loo`.
        method: of the weights: "stacking", "BB-pseudo-BMA" or "pseudo-BMA", as ArviZ has them.

    Raises:
        ValueError: where data, gaps, target, horizon or scored samples differ: densities of other
            numbers cannot be compared.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> quick = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
        >>> fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **quick)
        >>> two = dgp.fit(dgp.LinearDynamicGP(1, pairs=2), record, **quick)
        >>> options = {"draws": 100, "refits": 0, "workers": 1, "progress": False}
        >>> table = dgp.compare({"one": fit, "two": two}, target="missing sample", **options)
        >>> sorted(table.weights)
        ['one', 'two']
    """
    if not isinstance(models, Mapping) or len(models) < 2:
        raise invalid("models", expected="two models or more by name", got=repr(type(models)))
    one_of(("stacking", "BB-pseudo-BMA", "pseudo-BMA")).check("method", method)
    elpds = {}
    for name, one in models.items():
        known = isinstance(one, pd.Series) and "elpd_loo" in one
        elpds[str(name)] = one if known else loo(one, target=target, **options)
    _check_alike(elpds, target)
    table = arviz_bridge.compare_table(elpds, method)
    best = np.asarray(elpds[str(table.index[0])].loo_i)
    errors, effective, clear = [], [], []
    for name in table.index:
        difference = best - np.asarray(elpds[str(name)].loo_i)
        error, count = block_standard_error(difference)
        if name != table.index[0]:  # draws of two models are independent
            both = (elpds[str(n)].get("monte_carlo_error", 0.0) for n in (name, table.index[0]))
            error = float(np.sqrt(error**2 + sum(e**2 for e in both)))
        total = float(difference.sum())
        errors.append(error)
        effective.append(count)
        clear.append(total > max(SMALL, CLEAR * error))
    table["dse_block"] = errors
    table["n_effective"] = effective
    table["clear"] = clear
    return Comparison(table, elpds, target)


def _check_alike(elpds: Mapping[str, Any], target: str) -> None:
    first_name, first = next(iter(elpds.items()))
    for name, one in elpds.items():
        for entry, why in (
            ("target", "the targets differ"),
            ("horizon", "the horizons differ"),
            ("data", "the data (values, gaps or units) differ"),
            ("n_data_points", "other samples were scored"),
        ):
            if entry not in one or one[entry] != first[entry]:
                raise invalid(
                    f"models[{name!r}].{entry}",
                    expected=f"{first[entry]!r}, as of {first_name!r}",
                    got=repr(one.get(entry, "nothing")),
                    advice=f"{why.capitalize()}: these elpds cannot be compared.",
                )
        if one["target"] != target:
            raise invalid("target", expected=repr(one["target"]), got=repr(target))


def block_standard_error(difference: np.ndarray) -> tuple[float, float]:
    """Standard error of the sum of (N,) autocorrelated differences, and their effective number.

    Neighbouring samples count as blocks of one integrated autocorrelation time tau, estimated by
    Geyer's initial positive sequence (1992): N/tau of them are effective. The variance is divided
    by 1 - 2 tau/N for the mean that was estimated. Measured over 600 autoregressions of 400
    samples, two errors hold the sum in 96 % (tau = 1 and 4) and 93 % (tau = 19); samples taken as
    independent, 68 % (tau = 4) and 37 % (tau = 19).
    """
    N = len(difference)
    d = np.asarray(difference, dtype=float) - np.mean(difference)
    variance = float(np.mean(d**2))
    if variance == 0.0:
        return 0.0, float(N)
    time = _autocorrelation_time(d)
    long_run = variance * time / (1.0 - min(2.0 * time / N, 0.5))
    return float(np.sqrt(N * long_run)), N / time


def _autocorrelation_time(d: np.ndarray) -> float:
    """1 + 2 sum of autocorrelations, pairs of them as long as they are positive."""
    N = len(d)
    spectrum = np.abs(np.fft.rfft(d, 2 * N)) ** 2
    correlation = np.fft.irfft(spectrum)[:N] / (N * np.mean(d**2))
    pairs = correlation[: N - N % 2].reshape(-1, 2).sum(1)
    negative = np.flatnonzero(pairs < 0.0)
    last = negative[0] if len(negative) else len(pairs)
    return float(max(2.0 * pairs[:last].sum() - 1.0, 1.0))


@shown
@dataclass(repr=False, frozen=True, eq=False)
class Stack:
    """Several fits that predict together, each with its weight.

    Attributes:
        fits: by name. weights: by name, they add up to one.
    """

    fits: Mapping[str, Fitted]
    weights: Mapping[str, float]

    def simulate(self, record: Record, **options: Any) -> Prediction:
        """As `Fit.simulate`."""
        return self._mix(
            [predicting.simulate(fit, record, **options) for fit in self.fits.values()]
        )

    def predict(self, record: Record, **options: Any) -> Prediction:
        """As `Fit.predict`."""
        return self._mix([predicting.predict(fit, record, **options) for fit in self.fits.values()])

    def forecast(self, past: Record, future: Record, **options: Any) -> Prediction:
        """As `Fit.forecast`."""
        return self._mix(
            [predicting.forecast(fit, past, future, **options) for fit in self.fits.values()]
        )

    def _mix(self, predictions: Sequence[Prediction]) -> Prediction:
        weights = np.array([self.weights[name] for name in self.fits])
        return mix(predictions, weights)


@isolated
def stack(
    fits: Mapping[str, Fitted], weights: Comparison | Mapping[str, float] | None = None,
    *, target: Target | None = None, **options: Any,
) -> Stack:  # fmt: skip
    """Predict with several fits, weighted by what left-out data say of them.

    Args:
        fits: by name.
        weights: a `Comparison` of them, or numbers >= 0 by name. None: `compare` is run, for
            `target` and with `options`.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> quick = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
        >>> fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **quick)
        >>> two = dgp.fit(dgp.LinearDynamicGP(1, pairs=2), record, **quick)
        >>> mixture = dgp.stack({"one": fit, "two": two}, {"one": 0.3, "two": 0.7})
        >>> mixture.simulate(record).mean.shape
        (60, 1)
    """
    if not isinstance(fits, Mapping) or not fits:
        raise invalid("fits", expected="fits by name", got=repr(fits))
    if weights is None:
        if target is None:
            raise invalid(
                "target", expected="a target of loo, to find weights by", got="None",
                advice="Or give weights.",
            )  # fmt: skip
        weights = compare(fits, target=target, **options)
    numbers = weights.weights if isinstance(weights, Comparison) else weights
    if not isinstance(numbers, Mapping):
        raise invalid("weights", expected="a Comparison, or numbers by name", got=repr(numbers))
    values = [POSITIVE_OR_ZERO.plain(numbers.get(str(name))) for name in fits]
    if None in values or not sum(values) > 0.0:
        raise invalid("weights", expected=f"numbers >= 0 for {list(fits)}", got=repr(numbers))
    for name, fit in fits.items():
        known_fit(fit, f"fits[{name!r}]")
    total = float(sum(values))
    shares = {name: float(v) / total for name, v in zip(fits, values, strict=True)}
    kept = {name: fit for name, fit in fits.items() if shares[name] > 1e-6}
    whole = sum(shares[name] for name in kept)
    return Stack(kept, {name: shares[name] / whole for name in kept})


def mix(predictions: Sequence[Prediction], weights: np.ndarray) -> Prediction:
    """One prediction from several of the same times, by weights that add up to one.

    Its variance has a further part, "choice of model": what the means differ by.
    """
    first = predictions[0]
    component_weights = np.concatenate(
        [w * one.component_weights for w, one in zip(weights, predictions, strict=True)]
    )
    mean = sum(w * one.mean for w, one in zip(weights, predictions, strict=True))

    def parts() -> dict[str, np.ndarray]:
        found = {name: np.zeros_like(first.mean) for one in predictions for name in one.parts}
        found["choice of model"] = np.zeros_like(first.mean)
        for w, one in zip(weights, predictions, strict=True):
            for name, part in one.parts.items():
                found[name] += w * part
            found["choice of model"] += w * (one.mean - mean) ** 2
        return found

    def draw() -> np.ndarray:
        samples = [one.samples for one in predictions]
        count = max(len(one) for one in samples)
        generator = np.random.default_rng(count)
        which = generator.choice(len(samples), size=count, p=weights)
        return np.stack([samples[k][generator.integers(len(samples[k]))] for k in which])

    noise = [
        one.noise_variance
        if one.noise_variance.ndim == 3
        else np.broadcast_to(one.noise_variance[:, None, :], one.component_mean.shape)
        for one in predictions
    ]
    # Samples are joint where those of all models are, which the longer kind says.
    kind = min((one.kind for one in predictions), key=len)
    return Prediction(
        first.time,
        first.output_names,
        np.concatenate([one.component_mean for one in predictions]),
        np.concatenate([one.component_variance for one in predictions]),
        np.concatenate(noise),
        Parts(parts),
        draw,
        kind,
        component_weights,
        first.output_units,
    )
