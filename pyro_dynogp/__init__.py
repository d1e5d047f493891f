"""Bayesian identification of dynamic systems: deep dynamical Gaussian processes in Pyro."""

from pyro_dynogp import datasets
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
    "sample_modes",
    "scores",
]
