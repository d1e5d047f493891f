"""Bayesian identification of dynamic systems: deep dynamical Gaussian processes in Pyro."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pyro_dynogp import datasets, plotting
    from pyro_dynogp.distributions.conditioned import ConditionedLTIProcess
    from pyro_dynogp.distributions.process import LTIProcess, ObservedLTIProcess
    from pyro_dynogp.distributions.reparam import InnovationReparam
    from pyro_dynogp.gp import LTIKernel, LTIMean, LTIParameters
    from pyro_dynogp.inference.fit import Fit, fit
    from pyro_dynogp.inference.storage import load
    from pyro_dynogp.lti.modes import Modes
    from pyro_dynogp.lti.state import ModalState
    from pyro_dynogp.models.linear import LinearDynamicGP
    from pyro_dynogp.models.priors import TimeScale, sample_modes
    from pyro_dynogp.prediction.prediction import Prediction
    from pyro_dynogp.prediction.scores import scores
    from pyro_dynogp.record import Record
    from pyro_dynogp.scaling import Scaling

__version__ = "0.1.0"

# Names are imported when they are first used (PEP 562), so that the command line answers at once.
_HOME = {
    "ConditionedLTIProcess": "pyro_dynogp.distributions.conditioned",
    "Fit": "pyro_dynogp.inference.fit",
    "InnovationReparam": "pyro_dynogp.distributions.reparam",
    "LTIKernel": "pyro_dynogp.gp",
    "LTIMean": "pyro_dynogp.gp",
    "LTIParameters": "pyro_dynogp.gp",
    "LTIProcess": "pyro_dynogp.distributions.process",
    "LinearDynamicGP": "pyro_dynogp.models.linear",
    "ModalState": "pyro_dynogp.lti.state",
    "Modes": "pyro_dynogp.lti.modes",
    "ObservedLTIProcess": "pyro_dynogp.distributions.process",
    "Prediction": "pyro_dynogp.prediction.prediction",
    "Record": "pyro_dynogp.record",
    "Scaling": "pyro_dynogp.scaling",
    "TimeScale": "pyro_dynogp.models.priors",
    "fit": "pyro_dynogp.inference.fit",
    "load": "pyro_dynogp.inference.storage",
    "sample_modes": "pyro_dynogp.models.priors",
    "scores": "pyro_dynogp.prediction.scores",
}
_MODULES = ("datasets", "plotting")

__all__ = [
    "ConditionedLTIProcess",
    "Fit",
    "InnovationReparam",
    "LTIKernel",
    "LTIMean",
    "LTIParameters",
    "LTIProcess",
    "LinearDynamicGP",
    "ModalState",
    "Modes",
    "ObservedLTIProcess",
    "Prediction",
    "Record",
    "Scaling",
    "TimeScale",
    "datasets",
    "fit",
    "load",
    "plotting",
    "sample_modes",
    "scores",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        value: Any = importlib.import_module(f"pyro_dynogp.{name}")
    elif name in _HOME:
        value = getattr(importlib.import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module 'pyro_dynogp' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
