"""Scores of a prediction against measured outputs, in the units of the record."""

from __future__ import annotations

from typing import Any

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.isolation import isolated
from pyro_dynogp.prediction.mixture_score import mixture_scores
from pyro_dynogp.prediction.prediction import Prediction
from pyro_dynogp.support.errors import instance, invalid, whole


@isolated
def scores(prediction: Prediction, record: Record, skip: int = 0) -> dict[str, Any]:
    """Compare a prediction with the outputs of a record.

    Args:
        prediction: of the same times as the record.
        record: with measured outputs; missing ones are left out.
        skip: number of initial samples to leave out (a state-initialisation window).

    Returns:
        For one output numbers, for several arrays (n_y,):

        - ``rmse``, ``mae`` [output]: of the predictive mean.
        - ``nrmse``: rmse over the standard deviation of the measured output.
        - ``fit_percent``: 100 (1 - nrmse), the fit index of system identification [%].
        - ``crps`` [output]: of the normal mixture (`pyro_dynogp.prediction.mixture_score`).
        - ``negative_log_density`` [nats per sample]: of each sample by itself.
        - ``coverage_50``, ``coverage_95``: share of samples within the central intervals.
        - ``count``: number of samples scored.

    Raises:
        ValueError: where times, outputs or units differ, none is left, or skip is out of range.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> quick = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
        >>> fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **quick)
        >>> dgp.scores(fit.simulate(record), record)["count"]
        60
    """
    instance("prediction", prediction, Prediction)
    prediction.check(record)
    skip = whole(0, len(record) - 1).check("skip", skip)
    y = record.outputs
    columns: dict[str, list[float]] = {}
    for a in range(y.shape[1]):
        there = np.isfinite(y[:, a])
        there[:skip] = False
        if not there.any():
            raise invalid(
                "record", expected=f"measured samples of {record.output_names[a]}", got="none"
            )
        target = y[there, a]
        error = target - prediction.mean[there, a]
        spread = float(target.std())
        rmse = float(np.sqrt(np.mean(error**2)))
        nrmse = rmse / spread if spread > 0 else float("nan")
        found = mixture_scores(
            y[:, a],
            prediction.component_mean[:, :, a],
            prediction.component_sd[:, :, a],
            prediction.component_weights,
        )
        values = {
            "rmse": rmse,
            "mae": float(np.mean(np.abs(error))),
            "nrmse": nrmse,
            "fit_percent": 100.0 * (1.0 - nrmse),
            "crps": float(found.crps[there].mean()),
            "negative_log_density": -float(np.mean(found.log_density[there])),
            "coverage_50": _central(found.level[there], 0.5),
            "coverage_95": _central(found.level[there], 0.95),
            "count": int(there.sum()),
        }
        for name, value in values.items():
            columns.setdefault(name, []).append(value)
    if y.shape[1] == 1:
        return {name: values[0] for name, values in columns.items()}
    return {name: np.asarray(values) for name, values in columns.items()}


def _central(level: np.ndarray, share: float) -> float:
    """Share of samples whose level (n,) lies in the central interval of this probability."""
    return float(np.mean(np.abs(level - 0.5) <= 0.5 * share))
