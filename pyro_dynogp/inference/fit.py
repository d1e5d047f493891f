"""Fit a model to measured records: one call for MAP, SVI and NUTS, one frozen result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import pyro
import torch
from torch import Tensor

from pyro_dynogp._errors import invalid
from pyro_dynogp.inference.guides import DrawsGuide, GaussianGuide, Guide, PointGuide
from pyro_dynogp.inference.maximum import Optimizer, maximise
from pyro_dynogp.inference.sampling import sample_posterior
from pyro_dynogp.inference.starts import starting_values
from pyro_dynogp.inference.variational import variational
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.models.linear import LinearDynamicGP, LinearSystem
from pyro_dynogp.parallel import seeded
from pyro_dynogp.prediction import linear as _predict
from pyro_dynogp.prediction.prediction import Prediction
from pyro_dynogp.record import Record, as_records
from pyro_dynogp.scaling import Scaling

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
        start_energies: -log p(y, values) that each start came to, best first.
        diagnostics: what the method says about itself, numbers by name.
        seed: the seed.
        training: fingerprints of the training records.
        gaussian: the variational posterior ("svi" only).
    """

    model: LinearDynamicGP
    method: Method
    draws: Mapping[str, Tensor]
    mode: Mapping[str, Tensor]
    history: np.ndarray
    start_energies: np.ndarray
    diagnostics: Mapping[str, float]
    seed: int
    training: tuple[str, ...]
    gaussian: GaussianGuide | None = field(default=None)

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
        return self.gaussian if self.gaussian is not None else DrawsGuide(dict(self.draws))

    @cached_property
    def system(self) -> LinearSystem:
        """All parameters in the units of the record, one batch dimension (S,) of draws."""
        sample = pyro.poutine.condition(self.model.sample_system, data=dict(self.draws))
        with torch.no_grad(), pyro.poutine.block():
            return sample(self.scaling)

    @property
    def modes(self) -> Modes:
        """Poles and gains in the units of the record; batch (S,) of draws, none for "map"."""
        modes = self.system.modes
        return modes[0] if self.method == "map" else modes

    @property
    def noise_sd(self) -> np.ndarray:
        """Posterior mean of the measurement noise (n_y,) [output]."""
        sd = self.system.noise_sd.mean(0)
        return np.atleast_1d(sd.numpy())

    def log_joint(self, records: Record | Sequence[Record]) -> float:
        """Log p(y, mode): of the records with the sites at the mode."""
        conditioned = pyro.poutine.condition(self.model, data=dict(self.mode))
        with torch.no_grad():
            return float(pyro.poutine.trace(conditioned).get_trace(records).log_prob_sum())

    def log_likelihood(self, records: Record | Sequence[Record]) -> np.ndarray:
        """Log p(y | draw) (S,) [nats], exact marginal likelihood in the units of the record."""
        checked = self.model.check(records)
        total: Any = 0.0
        with torch.no_grad():
            for record in checked:
                process = _predict.prior_process(self, record)
                y = record.tensors().outputs
                y = y if self.model.several_outputs else y[:, 0]
                total = total + process.observed(self.system.noise_sd).log_prob(y)
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

        Exact Kalman predictions. Samples of the result are independent from time to time, since
        each time has its own data.
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

        White and standard normal if the model is right.
        """
        prediction = self.predict(record, horizon=1)
        return (record.outputs - prediction.mean) / prediction.sd

    def save(self, path: str | Path) -> None:
        """Write the fit to one safetensors file, from which `pyro_dynogp.load` restores it."""
        from pyro_dynogp.inference.storage import save

        save(self, path)

    def summary(self) -> str:
        """A few lines: what was fitted, how well it went, the modes at the best optimum."""
        lines = [
            f"{type(self.model).__name__} with pairs={self.model.pairs}, "
            f"inputs={self.model.inputs}, outputs={self.model.outputs}; "
            f"method {self.method!r}, seed {self.seed}",
            "-log p(y, values) of the starts: "
            + ", ".join(f"{e:.1f}" for e in self.start_energies[:6]),
        ]
        condition = pyro.poutine.condition(self.model.sample_system, data=dict(self.mode))
        with torch.no_grad(), pyro.poutine.block():
            modes = condition(self.scaling).modes
        frequency, damping = modes.natural_frequency, modes.damping
        for j in torch.argsort(frequency).tolist():
            lines.append(
                f"  natural frequency {float(frequency[j]):10.4g} rad/{self.scaling.time_unit}"
                f"   damping {float(damping[j]):6.3f}"
            )
        lines.append(
            "measurement noise sd: " + ", ".join(f"{value:.4g}" for value in self.noise_sd)
        )
        return "\n".join(lines)


def fit(
    model: LinearDynamicGP,
    record: Record | Sequence[Record],
    *,
    method: Method = "map",
    seed: int = 0,
    starts: int = 6,
    steps: int | None = None,
    optimizer: Optimizer = "lbfgs",
    draws: int | None = None,
    chains: int = 4,
    warmup: int = 500,
    particles: int = 8,
    learning_rate: float = 0.02,
    workers: int | None = None,
    progress: bool = True,
) -> Fit:
    """Fit a model to one record, or to several that share all parameters.

    The exact marginal posterior is climbed from several starts, in parallel. "map" keeps the best
    optimum; "svi" fits a multivariate normal to the posterior around it; "nuts" samples it.

    Args:
        model: a `LinearDynamicGP`.
        record: training record, or a sequence of them; scaling is learnt from it alone.
        method: "map", "svi" or "nuts".
        seed: the same seed gives the same numbers to the last bit on one machine.
        starts: number of starting points, the best of many random sets of poles.
        steps: most iterations of a start (default 500; Adam 1500), or of SVI (default 1000).
        optimizer: "lbfgs" or "adam", for the starts.
        draws: posterior draws to keep ("svi", default 200) or to sample per chain ("nuts", 500).
        chains, warmup: of NUTS.
        particles, learning_rate: of SVI.
        workers: processes; None for all processors, 1 for none but this one.
        progress: whether to show progress bars.

    Raises:
        ValueError: on channels that do not fit the model, constant or entirely missing outputs,
            unknown options, or where no start leads anywhere.
    """
    if method not in ("map", "svi", "nuts"):
        raise invalid("method", expected="'map', 'svi' or 'nuts'", got=repr(method))
    if optimizer not in ("lbfgs", "adam"):
        raise invalid("optimizer", expected="'lbfgs' or 'adam'", got=repr(optimizer))
    for name, count in (("starts", starts), ("chains", chains), ("particles", particles)):
        if count < 1:
            raise invalid(name, expected="a whole number >= 1", got=repr(count))
    records = as_records(record)
    model.check(records)
    model = model.scaled_to(records)
    argument = record if isinstance(record, Record) else records
    climb = steps if steps is not None and method == "map" else None
    optima = maximise(
        model,
        argument,
        starting_values(model, records, count=starts, seed=seed),
        optimizer=optimizer,
        steps=climb or (500 if optimizer == "lbfgs" else 1500),
        seed=seed,
        workers=workers,
        progress=progress,
    )
    best = optima[0]
    if best.energy >= 1e15:
        raise ValueError(
            "fit: no start reached a point where the likelihood can be evaluated. Check the "
            "record for jumps of many orders of magnitude, or try fewer pairs."
        )
    common: dict[str, Any] = {
        "model": model,
        "method": method,
        "mode": MappingProxyType(best.values),
        "start_energies": np.array([optimum.energy for optimum in optima]),
        "seed": seed,
        "training": tuple(one.fingerprint for one in records),
    }
    if method == "map":
        return Fit(
            draws=MappingProxyType({k: v.unsqueeze(0) for k, v in best.values.items()}),
            history=best.history,
            diagnostics=MappingProxyType({"iterations": float(len(best.history))}),
            **common,
        )
    if method == "svi":
        with seeded(seed):
            posterior = variational(
                model,
                (argument,),
                best.values,
                steps=steps or 1000,
                particles=particles,
                learning_rate=learning_rate,
                progress=progress,
            )
            kept = _draws_of(posterior.guide, argument, draws or 200)
        tail = posterior.elbo[-50:]
        return Fit(
            draws=MappingProxyType(kept),
            history=posterior.elbo,
            diagnostics=MappingProxyType(
                {"elbo": float(tail.mean()), "elbo_sd": float(tail.std())}
            ),
            gaussian=posterior.guide,
            **common,
        )
    sampled = sample_posterior(
        model,
        argument,
        best.values,
        chains=chains,
        draws=draws or 500,
        warmup=warmup,
        seed=seed,
        workers=workers,
        progress=progress,
    )
    diagnostics = {"divergences": float(sampled.divergences), "chains": float(chains)}
    for site, values in sampled.r_hat.items():
        diagnostics[f"r_hat {site}"] = float(values.max())
    for site, values in sampled.effective_samples.items():
        diagnostics[f"effective samples {site}"] = float(values.min())
    return Fit(
        draws=MappingProxyType({k: v.flatten(0, 1) for k, v in sampled.draws.items()}),
        history=best.history,
        diagnostics=MappingProxyType(diagnostics),
        **common,
    )


def _draws_of(guide: GaussianGuide, args: Any, count: int) -> dict[str, Tensor]:
    with torch.no_grad(), pyro.plate("draws", count, dim=-1):
        trace = pyro.poutine.trace(guide).get_trace(args)
    return {site.name: trace.nodes[site.name]["value"] for site in guide.sites}
