"""The summary of a fit: text to print, with its numbers as a table."""

from __future__ import annotations

import numpy as np
import pandas as pd

from pyro_dynogp.criticism.parameter_table import parameter_table
from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.summary import summary
from pyro_dynogp.prediction.predict import predict, simulate
from pyro_dynogp.prediction.scores import scores
from pyro_dynogp.support.shown import preformatted

SHOWN = ("rmse", "fit_percent", "crps", "coverage_95")


class Summary(str):
    """Text that a prompt shows as it is, and a notebook as tables.

    Attributes:
        table: of the parameters, one row each: mean, sd, 2.5 %, 97.5 %, unit.
        scores: of predictions of a record, one row for each kind and output; None without one.
    """

    table: pd.DataFrame
    scores: pd.DataFrame | None
    head: str

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        tables = [self.table.map(_cell).rename_axis(None).to_html(border=0)]
        if self.scores is not None:
            tables.append(self.scores.map(_cell).rename_axis(None).to_html(border=0))
        return preformatted(self.head) + "".join(tables)


def summarise(fit: Fitted, record: Record | None) -> Summary:
    """See `Fit.summary`."""
    before, after = summary(fit)
    table = parameter_table(fit)
    scored = None if record is None else _scored(fit, record)
    parts = [before, table.map(_cell).rename_axis(None).to_string()]
    parts += [] if scored is None else [scored.map(_cell).rename_axis(None).to_string()]
    made = Summary("\n".join([*parts, *([after] if after else [])]))
    made.table, made.scores = table, scored
    made.head = "\n".join(part for part in (before, after) if part)
    return made


def _scored(fit: Fitted, record: Record) -> pd.DataFrame:
    """Scores of a record, of each way to predict it."""
    rows = {}
    for kind, predicted in (
        ("simulation", simulate(fit, record)), ("one step ahead", predict(fit, record))
    ):  # fmt: skip
        found = scores(predicted, record)
        for a, output in enumerate(record.output_names):
            rows[f"{kind} of {output}"] = [float(np.atleast_1d(found[key])[a]) for key in SHOWN]
    return pd.DataFrame.from_dict(rows, orient="index", columns=list(SHOWN)).rename_axis("scores")


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "" if np.isnan(value) else f"{value:.4g}"
    return str(value)
