"""Bayesian identification of dynamic systems: deep dynamical Gaussian processes in Pyro."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pyro_dynogp import plotting
    from pyro_dynogp.criticism.calibration import Calibration, calibration
    from pyro_dynogp.criticism.check import Check, check
    from pyro_dynogp.criticism.comparison import Comparison, Stack, compare, stack
    from pyro_dynogp.criticism.from_pyro import from_pyro
    from pyro_dynogp.criticism.loo import loo
    from pyro_dynogp.criticism.predictive_checks import PredictiveChecks, predictive_checks
    from pyro_dynogp.criticism.pyro_posterior import PyroPosterior
    from pyro_dynogp.criticism.rank_results import SimulationBasedCalibration
    from pyro_dynogp.criticism.simulation_based import simulation_based_calibration
    from pyro_dynogp.data.record import Record
    from pyro_dynogp.data.scaling import Scaling
    from pyro_dynogp.distributions.conditioned import ConditionedLTIProcess
    from pyro_dynogp.distributions.decay import LogDecayRate
    from pyro_dynogp.distributions.inducing import InducingLTIProcess, inducing_times
    from pyro_dynogp.distributions.process import LTIProcess, ObservedLTIProcess
    from pyro_dynogp.distributions.reparam import InnovationReparam
    from pyro_dynogp.examples import datasets
    from pyro_dynogp.fitting import Fit, fit, load
    from pyro_dynogp.gp import LTIKernel, LTIMean, LTIParameters
    from pyro_dynogp.guides.families import (
        Family,
        FullRank,
        GaussMarkov,
        InducingTimes,
        MeanField,
        Point,
        SameAsPrior,
    )
    from pyro_dynogp.guides.layer_guide import LayerGuide
    from pyro_dynogp.inference.methods.mode import Mode
    from pyro_dynogp.inference.methods.nuts import Nuts
    from pyro_dynogp.inference.methods.optima import Normal
    from pyro_dynogp.inference.methods.svi import TrainingDivergedError
    from pyro_dynogp.inference.methods.trajectories import Trajectories
    from pyro_dynogp.layers.functions import StaticFunction
    from pyro_dynogp.layers.noise import Gaussian, Heteroscedastic, Likelihood, StudentT
    from pyro_dynogp.layers.static import sample_static, static_gp
    from pyro_dynogp.lti.modes import Modes
    from pyro_dynogp.lti.state import ModalState
    from pyro_dynogp.models.architectures import (
        Cascade,
        Hammerstein,
        HammersteinWiener,
        LinearDynamicGP,
        Wiener,
        WienerHammerstein,
    )
    from pyro_dynogp.models.model import Model
    from pyro_dynogp.models.output_process import OutputProcess
    from pyro_dynogp.models.priors import TimeScale, sample_modes
    from pyro_dynogp.models.system import System
    from pyro_dynogp.models.wiring import Dynamic, Static
    from pyro_dynogp.prediction.prediction import Prediction
    from pyro_dynogp.prediction.scores import scores

__version__ = "0.1.0"

# Names are imported when they are first used (PEP 562), so that the command line answers at once.
_HOME = {
    "Calibration": "pyro_dynogp.criticism.calibration",
    "Cascade": "pyro_dynogp.models.architectures",
    "System": "pyro_dynogp.models.system",
    "Check": "pyro_dynogp.criticism.check",
    "Comparison": "pyro_dynogp.criticism.comparison",
    "ConditionedLTIProcess": "pyro_dynogp.distributions.conditioned",
    "Dynamic": "pyro_dynogp.models.wiring",
    "Family": "pyro_dynogp.guides.families",
    "Fit": "pyro_dynogp.fitting",
    "FullRank": "pyro_dynogp.guides.families",
    "GaussMarkov": "pyro_dynogp.guides.families",
    "Gaussian": "pyro_dynogp.layers.noise",
    "Hammerstein": "pyro_dynogp.models.architectures",
    "HammersteinWiener": "pyro_dynogp.models.architectures",
    "Heteroscedastic": "pyro_dynogp.layers.noise",
    "InducingLTIProcess": "pyro_dynogp.distributions.inducing",
    "InducingTimes": "pyro_dynogp.guides.families",
    "InnovationReparam": "pyro_dynogp.distributions.reparam",
    "LTIKernel": "pyro_dynogp.gp",
    "LTIMean": "pyro_dynogp.gp",
    "LTIParameters": "pyro_dynogp.gp",
    "LTIProcess": "pyro_dynogp.distributions.process",
    "LayerGuide": "pyro_dynogp.guides.layer_guide",
    "Likelihood": "pyro_dynogp.layers.noise",
    "LinearDynamicGP": "pyro_dynogp.models.architectures",
    "Model": "pyro_dynogp.models.model",
    "LogDecayRate": "pyro_dynogp.distributions.decay",
    "MeanField": "pyro_dynogp.guides.families",
    "ModalState": "pyro_dynogp.lti.state",
    "Mode": "pyro_dynogp.inference.methods.mode",
    "Normal": "pyro_dynogp.inference.methods.optima",
    "Nuts": "pyro_dynogp.inference.methods.nuts",
    "Trajectories": "pyro_dynogp.inference.methods.trajectories",
    "Modes": "pyro_dynogp.lti.modes",
    "OutputProcess": "pyro_dynogp.models.output_process",
    "ObservedLTIProcess": "pyro_dynogp.distributions.process",
    "Point": "pyro_dynogp.guides.families",
    "Prediction": "pyro_dynogp.prediction.prediction",
    "PredictiveChecks": "pyro_dynogp.criticism.predictive_checks",
    "PyroPosterior": "pyro_dynogp.criticism.pyro_posterior",
    "Record": "pyro_dynogp.data.record",
    "SameAsPrior": "pyro_dynogp.guides.families",
    "Scaling": "pyro_dynogp.data.scaling",
    "SimulationBasedCalibration": "pyro_dynogp.criticism.rank_results",
    "Stack": "pyro_dynogp.criticism.comparison",
    "Static": "pyro_dynogp.models.wiring",
    "StaticFunction": "pyro_dynogp.layers.functions",
    "StudentT": "pyro_dynogp.layers.noise",
    "TimeScale": "pyro_dynogp.models.priors",
    "TrainingDivergedError": "pyro_dynogp.inference.methods.svi",
    "Wiener": "pyro_dynogp.models.architectures",
    "WienerHammerstein": "pyro_dynogp.models.architectures",
    "calibration": "pyro_dynogp.criticism.calibration",
    "check": "pyro_dynogp.criticism.check",
    "close_loop": "pyro_dynogp.discrepancy.loop",
    "compare": "pyro_dynogp.criticism.comparison",
    "fit": "pyro_dynogp.fitting",
    "from_pyro": "pyro_dynogp.criticism.from_pyro",
    "inducing_times": "pyro_dynogp.distributions.inducing",
    "load": "pyro_dynogp.fitting",
    "loo": "pyro_dynogp.criticism.loo",
    "predictive_checks": "pyro_dynogp.criticism.predictive_checks",
    "sample_modes": "pyro_dynogp.models.priors",
    "sample_static": "pyro_dynogp.layers.static",
    "scores": "pyro_dynogp.prediction.scores",
    "simulation_based_calibration": "pyro_dynogp.criticism.simulation_based",
    "stack": "pyro_dynogp.criticism.comparison",
    "static_gp": "pyro_dynogp.layers.static",
}
_MODULES = {"datasets": "pyro_dynogp.examples.datasets", "plotting": "pyro_dynogp.plotting"}

__all__ = [
    "Calibration",
    "Cascade",
    "Check",
    "Comparison",
    "ConditionedLTIProcess",
    "Dynamic",
    "Family",
    "Fit",
    "FullRank",
    "GaussMarkov",
    "Gaussian",
    "Hammerstein",
    "HammersteinWiener",
    "Heteroscedastic",
    "InducingLTIProcess",
    "InducingTimes",
    "InnovationReparam",
    "LTIKernel",
    "LTIMean",
    "LTIParameters",
    "LTIProcess",
    "LayerGuide",
    "Likelihood",
    "LinearDynamicGP",
    "LogDecayRate",
    "MeanField",
    "ModalState",
    "Mode",
    "Model",
    "Modes",
    "Normal",
    "Nuts",
    "ObservedLTIProcess",
    "OutputProcess",
    "Point",
    "Prediction",
    "PredictiveChecks",
    "PyroPosterior",
    "Record",
    "SameAsPrior",
    "Scaling",
    "SimulationBasedCalibration",
    "Stack",
    "Static",
    "StaticFunction",
    "StudentT",
    "System",
    "TimeScale",
    "TrainingDivergedError",
    "Trajectories",
    "Wiener",
    "WienerHammerstein",
    "calibration",
    "check",
    "close_loop",
    "compare",
    "datasets",
    "fit",
    "from_pyro",
    "inducing_times",
    "load",
    "loo",
    "plotting",
    "predictive_checks",
    "sample_modes",
    "sample_static",
    "scores",
    "simulation_based_calibration",
    "stack",
    "static_gp",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        value: Any = importlib.import_module(_MODULES[name])
    elif name in _HOME:
        value = getattr(importlib.import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module 'pyro_dynogp' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
