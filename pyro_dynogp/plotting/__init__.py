"""Figures of records, predictions, identified systems and residuals.

Every function returns a matplotlib Figure that belongs to nobody else: no pyplot, no global state,
no display needed. Save it with ``figure.savefig("name.png")``; a notebook shows it as it is.
"""

from pyro_dynogp.plotting.calibration import calibration, predictive_checks
from pyro_dynogp.plotting.diagnostics import history, residuals, starts
from pyro_dynogp.plotting.signals import prediction, record
from pyro_dynogp.plotting.style import named
from pyro_dynogp.plotting.systems import bode, impulse_response, pole_map
from pyro_dynogp.report.figures import before_after, evidence, residuals_before_after

__all__ = [
    "before_after",
    "bode",
    "calibration",
    "evidence",
    "history",
    "impulse_response",
    "named",
    "pole_map",
    "prediction",
    "predictive_checks",
    "record",
    "residuals",
    "residuals_before_after",
    "starts",
]
