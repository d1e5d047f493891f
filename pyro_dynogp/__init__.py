"""Bayesian identification of dynamic systems: deep dynamical Gaussian processes in Pyro."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from pyro_dynogp.support.version import __version__ as __version__

if TYPE_CHECKING:  # the same names, for editors and type checkers; a test compares the two
    from pyro_dynogp import effects as effects
    from pyro_dynogp import guides as guides
    from pyro_dynogp import plotting as plotting
    from pyro_dynogp.criticism.calibration import calibration as calibration
    from pyro_dynogp.criticism.check import check as check
    from pyro_dynogp.criticism.comparison import compare as compare
    from pyro_dynogp.criticism.comparison import stack as stack
    from pyro_dynogp.criticism.from_pyro import from_pyro as from_pyro
    from pyro_dynogp.criticism.loo import loo as loo
    from pyro_dynogp.criticism.predictive_checks import predictive_checks as predictive_checks
    from pyro_dynogp.criticism.simulation_based import (
        simulation_based_calibration as simulation_based_calibration,
    )
    from pyro_dynogp.data.channels.signal import Delayed as Delayed
    from pyro_dynogp.data.record import Record as Record
    from pyro_dynogp.data.scaling import Scaling as Scaling
    from pyro_dynogp.data.scaling import TimeScale as TimeScale
    from pyro_dynogp.distributions.process import LTIProcess as LTIProcess
    from pyro_dynogp.distributions.reparam import InnovationReparam as InnovationReparam
    from pyro_dynogp.examples import datasets as datasets
    from pyro_dynogp.fitting import Fit as Fit
    from pyro_dynogp.fitting import fit as fit
    from pyro_dynogp.fitting import load as load
    from pyro_dynogp.gp import LTIKernel as LTIKernel
    from pyro_dynogp.gp import LTIMean as LTIMean
    from pyro_dynogp.gp import LTIParameters as LTIParameters
    from pyro_dynogp.guides.families import FullRank as FullRank
    from pyro_dynogp.guides.families import GaussMarkov as GaussMarkov
    from pyro_dynogp.guides.families import InducingTimes as InducingTimes
    from pyro_dynogp.guides.layer_guide import LayerGuide as LayerGuide
    from pyro_dynogp.inference.methods.importance import Importance as Importance
    from pyro_dynogp.inference.methods.mode import Mode as Mode
    from pyro_dynogp.inference.methods.nuts import Nuts as Nuts
    from pyro_dynogp.inference.methods.optima import Normal as Normal
    from pyro_dynogp.inference.methods.svi import TrainingDivergedError as TrainingDivergedError
    from pyro_dynogp.inference.methods.trajectories import Trajectories as Trajectories
    from pyro_dynogp.layers.noise import Gaussian as Gaussian
    from pyro_dynogp.layers.noise import Heteroscedastic as Heteroscedastic
    from pyro_dynogp.layers.noise import StudentT as StudentT
    from pyro_dynogp.layers.static import sample_static as sample_static
    from pyro_dynogp.layers.static import static_gp as static_gp
    from pyro_dynogp.lti.modes import Modes as Modes
    from pyro_dynogp.models.architectures import Cascade as Cascade
    from pyro_dynogp.models.architectures import Hammerstein as Hammerstein
    from pyro_dynogp.models.architectures import HammersteinWiener as HammersteinWiener
    from pyro_dynogp.models.architectures import LinearDynamicGP as LinearDynamicGP
    from pyro_dynogp.models.architectures import (
        ParallelWienerHammerstein as ParallelWienerHammerstein,
    )
    from pyro_dynogp.models.architectures import Wiener as Wiener
    from pyro_dynogp.models.architectures import WienerHammerstein as WienerHammerstein
    from pyro_dynogp.models.compartments import Compartments as Compartments
    from pyro_dynogp.models.forms import Form as Form
    from pyro_dynogp.models.layer import Dynamic as Dynamic
    from pyro_dynogp.models.layer import Known as Known
    from pyro_dynogp.models.layer import Static as Static
    from pyro_dynogp.models.model import Model as Model
    from pyro_dynogp.models.nonlinear_feedback import NonlinearFeedback as NonlinearFeedback
    from pyro_dynogp.models.priors import sample_modes as sample_modes
    from pyro_dynogp.models.product import Product as Product
    from pyro_dynogp.prediction.prediction import Prediction as Prediction
    from pyro_dynogp.prediction.scores import scores as scores
    from pyro_dynogp.report.loop import close_loop as close_loop
    from pyro_dynogp.statistics.settings import LoopSettings as LoopSettings

# Where each public name is defined. They are imported when they are first used (PEP 562), so that
# the command line answers at once.
HOMES = {
    # A record and a fit of it.
    "Record": "data.record",
    "fit": "fitting",
    "load": "fitting",
    "Fit": "fitting",
    "Importance": "inference.methods.importance",
    "Mode": "inference.methods.mode",
    "Normal": "inference.methods.optima",
    "Nuts": "inference.methods.nuts",
    "Trajectories": "inference.methods.trajectories",
    "Prediction": "prediction.prediction",
    "Scaling": "data.scaling",
    "TrainingDivergedError": "inference.methods.svi",
    "scores": "prediction.scores",
    # Models, and what they are made of.
    "LinearDynamicGP": "models.architectures",
    "Wiener": "models.architectures",
    "Hammerstein": "models.architectures",
    "WienerHammerstein": "models.architectures",
    "HammersteinWiener": "models.architectures",
    "NonlinearFeedback": "models.nonlinear_feedback",
    "ParallelWienerHammerstein": "models.architectures",
    "Compartments": "models.compartments",
    "Cascade": "models.architectures",
    "Model": "models.model",
    "Dynamic": "models.layer",
    "Known": "models.layer",
    "Static": "models.layer",
    "Product": "models.product",
    "Form": "models.forms",
    "Gaussian": "layers.noise",
    "StudentT": "layers.noise",
    "Heteroscedastic": "layers.noise",
    "TimeScale": "data.scaling",
    "Delayed": "data.channels.signal",
    # Criticism of a fit, and the loop that extends its model.
    "loo": "criticism.loo",
    "compare": "criticism.comparison",
    "stack": "criticism.comparison",
    "check": "criticism.check",
    "calibration": "criticism.calibration",
    "predictive_checks": "criticism.predictive_checks",
    "simulation_based_calibration": "criticism.simulation_based",
    "from_pyro": "criticism.from_pyro",
    "close_loop": "report.loop",
    "LoopSettings": "statistics.settings",
    # Parts of a Pyro model of one's own.
    "LTIProcess": "distributions.process",
    "Modes": "lti.modes",
    "InnovationReparam": "distributions.reparam",
    "sample_modes": "models.priors",
    "sample_static": "layers.static",
    "static_gp": "layers.static",
    "LayerGuide": "guides.layer_guide",
    "FullRank": "guides.families",
    "GaussMarkov": "guides.families",
    "InducingTimes": "guides.families",
    "LTIKernel": "gp",
    "LTIMean": "gp",
    "LTIParameters": "gp",
}
# Public modules.
MODULES = {
    "datasets": "examples.datasets",
    "effects": "effects",
    "guides": "guides",
    "plotting": "plotting",
}
# Names that were here before, and where they are now.
MOVED = {
    "Calibration": "criticism.calibration.Calibration",
    "CascadeSystem": "models.system.System",
    "Check": "criticism.check.Check",
    "Comparison": "criticism.comparison.Comparison",
    "ConditionedLTIProcess": "distributions.process.ConditionedLTIProcess",
    "Family": "guides.families.Family",
    "InducingLTIProcess": "distributions.inducing.InducingLTIProcess",
    "Likelihood": "layers.noise.Likelihood",
    "LogDecayRate": "distributions.decay.LogDecayRate",
    "MeanField": "guides.families.MeanField",
    "ModalState": "lti.state.ModalState",
    "ObservedCascade": "models.output_process.OutputProcess",
    "ObservedLTIProcess": "distributions.process.ObservedLTIProcess",
    "Point": "guides.families.Point",
    "PredictiveChecks": "criticism.predictive_checks.PredictiveChecks",
    "PyroPosterior": "criticism.pyro_posterior.PyroPosterior",
    "SameAsPrior": "guides.families.SameAsPrior",
    "SimulationBasedCalibration": "criticism.rank_results.SimulationBasedCalibration",
    "Stack": "criticism.comparison.Stack",
    "Step": "models.forms.Form",
    "StaticFunction": "layers.functions.StaticFunction",
    "inducing_times": "distributions.inducing.inducing_times",
}

__all__ = sorted([*HOMES, *MODULES])


def __getattr__(name: str) -> Any:
    if name in MODULES:
        value: Any = importlib.import_module(f"{__name__}.{MODULES[name]}")
    elif name in HOMES:
        value = getattr(importlib.import_module(f"{__name__}.{HOMES[name]}"), name)
    elif name in MOVED:
        raise AttributeError(
            f"module {__name__!r} has no attribute {name!r}: it is now {__name__}.{MOVED[name]}"
        )
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])


class _Package(ModuleType):
    """The import system binds a submodule to its package: here a function of that name stays."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
