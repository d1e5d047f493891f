"""Figures of records, predictions, identified systems and residuals.

Every function returns a matplotlib Figure that belongs to nobody else: no pyplot, no global state,
no display needed. Save it with ``figure.savefig("name.png")``; a notebook shows it as it is.
Figures of closing the loop are in `pyro_dynogp.report.figures`.

Examples:
    >>> figure = dgp.plotting.record(dgp.datasets.load("gas_furnace").train)
    >>> len(figure.axes)
    2
"""

from pyro_dynogp.plotting.calibration import calibration, predictive_checks
from pyro_dynogp.plotting.diagnostics import history, residuals, starts
from pyro_dynogp.plotting.models import compare, quantiles, static_function
from pyro_dynogp.plotting.signals import prediction, record
from pyro_dynogp.plotting.style import named
from pyro_dynogp.plotting.systems import bode, impulse_response, pole_map

__all__ = [
    "bode",
    "calibration",
    "compare",
    "history",
    "impulse_response",
    "named",
    "pole_map",
    "prediction",
    "predictive_checks",
    "quantiles",
    "record",
    "residuals",
    "starts",
    "static_function",
]
