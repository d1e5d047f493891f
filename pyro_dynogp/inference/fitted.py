"""A fitted model: posterior draws, and what can be done with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import pyro
import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.inference.posteriors import (
    DrawsGuide,
    GaussianGuide,
    Guide,
    MixtureGuide,
    PointGuide,
)
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.system import System
from pyro_dynogp.prediction import layers as _layers
from pyro_dynogp.prediction import predict as _predict
from pyro_dynogp.prediction.first_state import beginning
from pyro_dynogp.prediction.layers import LayerTrajectory, StaticBand
from pyro_dynogp.prediction.prediction import Prediction
from pyro_dynogp.support.errors import invalid

Method = Literal["map", "svi", "nuts"]


@dataclass(frozen=True)
class Fit:
    """A fitted model: posterior draws, and what can be done with them.

    Attributes:
        model: the model with the scaling of its training record.
        method: "map", "svi" or "nuts".
        draws: (S, *shape) posterior draws of every latent site; S = 1 for "map".
        mode: values of every latent site at the best optimum found.
        history: objective after each iteration: -log p(y, values) for "map" and "nuts" (of the
            best start), the ELBO for "svi" [nats].
        start_energies: -log p(y, values) that each start came to (-ELBO where trajectories are
            sites), best first.
        diagnostics: what the method says about itself, numbers by name.
        seed: the seed.
        records: the training records.
        posterior: the variational posterior ("svi" without trajectories as sites).
        trajectories: (S, ...) draws of trajectories and other sites that belong to the training
            record, where the guide had them.
        log_q_sites: (S,) log-density of the draws of each site, auxiliary ones of the guide too,
            where the guide had trajectories as sites [nats].
    """

    model: Model
    method: Method
    draws: Mapping[str, Tensor]
    mode: Mapping[str, Tensor]
    history: np.ndarray
    start_energies: np.ndarray
    diagnostics: Mapping[str, float]
    seed: int
    records: tuple[Record, ...]
    posterior: GaussianGuide | MixtureGuide | None = field(default=None)
    trajectories: Mapping[str, Tensor] = field(default_factory=dict)
    log_q_sites: Mapping[str, Tensor] = field(default_factory=dict)

    @property
    def training(self) -> tuple[str, ...]:
        """Fingerprints of the training records."""
        return tuple(record.fingerprint for record in self.records)

    @property
    def collapsed(self) -> bool:
        """Whether the fit had all trajectories integrated out."""
        return not self.log_q_sites

    @property
    def scaling(self) -> Scaling:
        """Learnt from the training records."""
        if self.model.scaling is None:
            raise invalid("model", expected="a model with its scaling", got="none")
        return self.model.scaling

    @property
    def guide(self) -> Guide:
        """The posterior as a Pyro guide, to be called with a record."""
        if self.method == "map":
            return PointGuide(dict(self.mode))
        return DrawsGuide(dict(self.draws)) if self.posterior is None else self.posterior

    @cached_property
    def system(self) -> System:
        """All parameters, batch (S,) of draws, in units of the scaled record."""
        return self.system_at(self.draws)

    def system_at(self, values: Mapping[str, Tensor]) -> System:
        """All parameters at values of the sites."""
        with torch.no_grad():
            return self.model.collapsed.system(values, self.scaling)

    @property
    def modes(self) -> Modes:
        """Poles and gains in the units of the record; batch (S,) of draws, none for "map".

        Of a model of one layer; those of a layer g of others are `system.layer("g").modes`.

        Raises:
            ValueError: for a model of several layers, or of a static one.
        """
        modes = self.system.physical(self.scaling).modes
        return modes[0] if self.method == "map" else modes

    @property
    def noise_sd(self) -> np.ndarray:
        """Posterior mean of the measurement noise's scale (n_y,) [output]."""
        sd = self.system.noise.constant_sd
        if sd is None:
            raise invalid("noise_sd", expected="noise of constant scale", got="noise that varies")
        return self.scaling.output_scale * sd.mean(0).numpy()

    @property
    def elbo(self) -> np.ndarray:
        """Evidence lower bound after each step of SVI; for "map" log p(y, values) [nats].

        One value where Laplace's approximation was so close that SVI did not start.
        """
        return self.history if self.method == "svi" else -self.history

    def at_mode(self) -> Fit:
        """The same fit with its posterior mode in place of its draws."""
        if self.method == "map":
            return self
        draws = MappingProxyType({name: value.unsqueeze(0) for name, value in self.mode.items()})
        return replace(self, method="map", draws=draws)

    def layers(self, record: Record) -> Mapping[str, LayerTrajectory]:
        """Posterior trajectories of all layers along a record, given its inputs and outputs.

        Exactly for linear models, by the smoother of the moment-matching filter for others. A
        record without outputs gives the trajectories that the inputs alone say.
        """
        return _layers.layers(self, record)

    def static_function(
        self, name: str, record: Record, *, channel: int = 0, points: int = 200
    ) -> StaticBand:
        """A static layer's function with its band, where a record moves it.

        Args:
            name: of the layer. record: says over which range, and where data are.
            channel: the input that varies, others at their mean. points: number of points.
        """
        return _layers.static_function(self, name, record, channel, points)

    def log_joint(self, records: Record | Sequence[Record]) -> float:
        """Log p(y, mode): of the records with the sites at the mode."""
        conditioned = pyro.poutine.condition(self.model.collapsed, data=dict(self.mode))
        with torch.no_grad():
            return float(pyro.poutine.trace(conditioned).get_trace(records).log_prob_sum())

    def log_likelihood(self, records: Record | Sequence[Record]) -> np.ndarray:
        """Log p(y | draw) (S,) [nats], exact marginal likelihood in the units of the record."""
        total: Any = 0.0
        with torch.no_grad():
            for record in self.model.check(records):
                outputs = output_process(beginning(self, record), self.scaling, record)
                total = total + outputs.log_prob(record.tensors().observations)
        return total.numpy()

    def simulate(
        self, record: Record, *, process_noise: bool = True, samples: int = 200, seed: int = 0
    ) -> Prediction:
        """Outputs from the inputs alone, from an unknown initial state.

        Args:
            record: time and inputs; its outputs are not used.
            process_noise: False for the response of the deterministic system.
            samples: number of joint samples that `Prediction.samples` draws. seed: for these.
        """
        return _predict.simulate(self, record, process_noise, samples, seed)

    def predict(
        self, record: Record, *, horizon: int = 1, samples: int = 200, seed: int = 0
    ) -> Prediction:
        """Each output from the inputs and from the outputs up to `horizon` samples before it.

        Exact Kalman predictions. Samples of a linear model are its mean plus errors with their
        joint law over time (a moving average of `horizon` innovations on a regular record); those
        of a cascade are independent from time to time.
        """
        return _predict.predict(self, record, horizon, samples, seed)

    def forecast(
        self,
        past: Record,
        future: Record,
        *,
        process_noise: bool = True,
        samples: int = 200,
        seed: int = 0,
    ) -> Prediction:
        """Outputs of `future` given inputs and outputs of `past`, the state carried over exactly.

        Args:
            past: up to now. future: later times, with inputs; its outputs are not used.
            process_noise: False if the future is known to have none.
            samples: number of joint samples. seed: for these.
        """
        return _predict.forecast(self, past, future, process_noise, samples, seed)

    def innovations(self, record: Record) -> np.ndarray:
        """Standardised one-step prediction errors (n, n_y); NaN where the output is missing.

        White and standard normal if the model is right: errors over their standard deviation where
        the prediction is Gaussian, else its normal scores (`Prediction.normal_scores`).
        """
        return self.predict(record, horizon=1).normal_scores(record.outputs)

    def save(self, path: str | Path) -> None:
        """Write the fit to one safetensors file, from which `pyro_dynogp.load` restores it.

        `trajectories` are left out: draws over the whole training record, which no prediction
        needs; `layers` computes smoothed ones.

        Raises:
            ValueError: where the folder does not exist, or a static layer has a gpytorch kernel of
                its own: a file holds numbers, no code.
        """
        from pyro_dynogp.inference.storage import save

        save(self, path)

    def to_arviz(
        self,
        *,
        future: Record | None = None,
        samples: int = 200,
        prior_samples: int = 200,
        seed: int = 0,
    ) -> Any:
        """The fit as ArviZ's InferenceData, for `arviz` plots, tables and files.

        Groups:

        - posterior: every latent site (chain, draw, *shape), in scaled units; trajectories where
          the guide had them; and in physical units decay rate, frequency and time constant of each
          pole, gains of a linear model, scale of the measurement noise and offset of the outputs.
          Chains are those of NUTS, else one; "map" has one draw.
        - prior, prior_predictive: the same sites and quantities from the prior, outputs at them;
          left out with ``priors="paper"``, whose draws exceed floating-point range.
        - posterior_predictive: replicated outputs of the training record, jointly, from its inputs
          alone, at draws spread evenly over all of them.
        - predictions, predictions_constant_data: forecast of `future` after the last training
          record, on its own clock.
        - log_likelihood: one-step-ahead density of each output, trajectories integrated out [nats];
          they add up to `log_likelihood`, NaN where an output is missing. Do not give them to
          ``az.loo``: they are not independent given the draw. `pyro_dynogp.loo` is for that.
        - sample_stats: ``lp``, log p(y, values) of each draw; of a variational posterior ``log_q``
          and, in attrs, the Pareto shape of their ratios; what `diagnostics` holds, in attrs.
        - observed_data ``y`` and constant_data: inputs ``u``, and ``elbo`` ("svi") or ``log_joint``
          by step.

        Several records give ``y_0``, ``y_1``, ... over ``time_0``, ``time_1``, ...; times are UTC
        time stamps where the record has them. Units are in attrs of the variables and in the
        labels ``input_unit`` and ``output_unit``.

        Args:
            future: a later record with inputs; its outputs are not used.
            samples: number of replicates and of forecasts. prior_samples: of prior draws, 0 for
                none. seed: for all of them.

        Raises:
            ValueError: on numbers that make no sense, a `future` that does not follow the last
                training record or has other channels, and layers named as a dimension is.
        """
        from pyro_dynogp.criticism.inference_data import to_arviz

        return to_arviz(
            self, future=future, samples=samples, prior_samples=prior_samples, seed=seed
        )

    def summary(self) -> str:
        """A few lines: what was fitted, how well it went, the modes at the best optimum."""
        from pyro_dynogp.inference.summary import summary

        return summary(self)
