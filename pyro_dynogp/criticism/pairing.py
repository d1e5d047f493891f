"""A prediction beside the record it was made for: both checked, and what of them is compared."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.prediction.prediction import Prediction
from pyro_dynogp.support.errors import invalid, whole

FEWEST_SAMPLES = 50  # with fewer the p-value is too coarse for a level of 5 %


@dataclass(frozen=True, eq=False)
class Pair:
    """Measured outputs and joint samples at the same times.

    Attributes:
        outputs: (n, n_y) measured; NaN where missing or skipped.
        samples: (S', n, n_y) joint samples of the prediction; NaN at the same places.
        note: what limits the comparison, in words; empty where nothing does.
    """

    outputs: np.ndarray
    samples: np.ndarray
    note: str


def paired(prediction: Prediction, record: Record, skip: int) -> Pair:
    """Check that the two belong together; leave out what is missing or skipped.

    Raises:
        ValueError: wrong types; other times or outputs; skip out of range; an output without
            measured samples; too few joint samples, or samples of another shape.
    """
    _check_types(prediction, record)
    n = len(record)
    skip = whole(0, n - 1).check("skip", skip)
    outputs = np.array(record.outputs, dtype=np.float64)
    outputs[:skip] = np.nan
    absent = ~np.isfinite(outputs)
    for a, name in enumerate(record.output_names):
        if absent[:, a].all():
            raise invalid(
                "record",
                expected=f"measured samples of {name!r} from sample {skip} on",
                got="none",
                advice="Skip fewer samples, or use a record in which the output was measured.",
            )
    samples = np.array(prediction.samples, dtype=np.float64)
    if samples.ndim != 3 or samples.shape[1:] != outputs.shape or len(samples) < FEWEST_SAMPLES:
        n_y = outputs.shape[1]
        raise invalid(
            "prediction",
            expected=f"joint samples of shape (S', {n}, {n_y}) with S' >= {FEWEST_SAMPLES}",
            got=f"shape {samples.shape}",
            advice="Make the prediction with more joint samples, for instance samples=200.",
        )
    if not np.isfinite(samples[:, ~absent]).all():
        raise invalid(
            "prediction",
            expected="finite joint samples wherever the output was measured",
            got="infinite ones or NaN",
        )
    samples[:, absent] = np.nan
    return Pair(outputs, samples, _note(prediction.kind))


def _check_types(prediction: Prediction, record: Record) -> None:
    if not isinstance(prediction, Prediction):
        raise invalid(
            "prediction",
            expected="a Prediction",
            got=type(prediction).__name__,
            advice="Make one with fit.predict, fit.simulate or fit.forecast.",
        )
    prediction.check(record)


def _note(kind: str) -> str:
    steps = re.fullmatch(r"(\d+)-step prediction", kind)  # no word of joint errors
    if steps is None or int(steps[1]) == 1:
        return ""
    return (
        f"The errors of a {kind} depend on each other up to {int(steps[1]) - 1} samples apart, its "
        "joint samples do not: bands are too narrow and p-values too small."
    )
