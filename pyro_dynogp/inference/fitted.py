"""A fitted model as data: its posterior, how it was found, the records it was fitted to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import pyro
import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.inference.held_parameters import held_sites, moved_along
from pyro_dynogp.inference.isolation import isolated
from pyro_dynogp.inference.posteriors import MethodName, Mixture, Posterior
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import with_outputs
from pyro_dynogp.models.system import System
from pyro_dynogp.support.errors import COUNT, instance, invalid
from pyro_dynogp.support.frozen import FrozenMapping


def known_fit(fit: object, argument: str = "fit") -> None:
    """Refuse what is no fit, or a fit without its training records.

    Raises:
        ValueError: see above.
    """
    instance(argument, fit, Fitted, "dgp.fit(...) makes one.")
    if not getattr(fit, "records", ()):
        raise invalid(argument, expected="a fit that has its training records", got="none")


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fitted model: its posterior, draws of it, and how they were found.

    `pyro_dynogp.Fit` adds what can be done with it.

    Attributes:
        model: the model with the scaling of its training record.
        posterior: a `Mixture` (a mode, or what SVI fits), or `Sampled` (draws by importance, NUTS,
            and SVI with trajectories as sites).
        draws: (S, *shape) posterior draws of every latent site; S = 1 for a mode.
        mode: values of every latent site at the best optimum found.
        history: objective after each iteration: the ELBO for "svi", for others -log p(y, values) of
            the best start [nats].
        start_energies: -log p(y, values) that each start came to (-ELBO where trajectories are
            sites), best first.
        diagnostics: what the method says about itself, numbers by name.
        seed: the seed.
        records: the training records.
    """

    model: Model
    posterior: Posterior
    draws: Mapping[str, Tensor]
    mode: Mapping[str, Tensor]
    history: np.ndarray
    start_energies: np.ndarray
    diagnostics: Mapping[str, float]
    seed: int
    records: tuple[Record, ...]

    @classmethod
    def of(cls, other: Fitted) -> Self:
        """The same fit as one of this class."""
        return cls(**{f.name: getattr(other, f.name) for f in fields(Fitted)})

    def __getstate__(self) -> dict[str, Any]:
        """The fields alone: what was computed from them is computed again."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @property
    def method(self) -> MethodName:
        """The short name of the method: "importance", "map", "svi" or "nuts"."""
        return self.posterior.method

    @property
    def trajectories(self) -> Mapping[str, Tensor]:
        """(S, ...) draws of trajectories of the training record, where they were sites."""
        return getattr(self.posterior, "trajectories", FrozenMapping({}))

    @property
    def log_q_sites(self) -> Mapping[str, Tensor]:
        """(S,) log-density of the draws of each site, where trajectories were sites [nats]."""
        return getattr(self.posterior, "log_q_sites", FrozenMapping({}))

    @property
    def training(self) -> tuple[str, ...]:
        """Fingerprints of the training records."""
        return tuple(record.fingerprint for record in self.records)

    @property
    def n_draws(self) -> int:
        """S, number of posterior draws."""
        return len(next(iter(self.draws.values())))

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
    def guide(self) -> Posterior:
        """The posterior as a Pyro guide, to be called with a record."""
        return self.posterior

    @cached_property
    def system(self) -> System:
        """All parameters, batch (S,) of draws, in units of the scaled record."""
        return self.system_at(self.draws)

    @property
    def held(self) -> tuple[str, ...]:
        """Sites of which predictions know no draws, see `held_sites`."""
        return held_sites(self.model, self.posterior) if self.records else ()

    @cached_property
    def moved(self) -> Self | None:
        """The fit with those moved, see `moved_along`; None where predictions are not finite."""
        values = moved_along(self.model.collapsed, self.records, self.mode, self.held)
        return None if values is None else self.with_draws(values)

    @isolated
    def system_at(self, values: Mapping[str, Tensor]) -> System:
        """All parameters at values of the sites."""
        with torch.no_grad():
            return self.model.collapsed.system(values, self.scaling)

    @property
    @isolated
    def modes(self) -> Modes:
        """Poles and gains in the units of the record; batch (S,) of draws, none for "map".

        Of a model of one layer; those of a layer g of others are `system.layer("g").modes`.

        Raises:
            ValueError: for a model of several layers, or of a static one.
        """
        modes = self.system.physical(self.scaling).modes
        return modes[0] if self.method == "map" else modes

    @property
    @isolated
    def noise_sd(self) -> np.ndarray:
        """Posterior mean of the measurement noise's scale (n_y,) [output]."""
        sd = self.system.noise.constant_sd
        if sd is None:
            raise invalid("noise_sd", expected="noise of constant scale", got="noise that varies")
        return self.scaling.output_scale * sd.mean(0).numpy()

    @property
    def elbo(self) -> np.ndarray:
        """Evidence lower bound after each step of SVI; for others log p(y, values) [nats].

        One value where Laplace's approximation was so close that SVI did not start.
        """
        return self.history if self.method == "svi" else -self.history

    def at_mode(self) -> Self:
        """The same fit with its posterior mode in place of its draws.

        Raises:
            ValueError: where trajectories were sites: the middle of that posterior is not the mode
                of the parameters with trajectories integrated out.
        """
        self.check_collapsed()
        if self.method == "map":
            return self
        draws = FrozenMapping({name: value.unsqueeze(0) for name, value in self.mode.items()})
        return replace(self, posterior=Mixture.at(self.mode), draws=draws)

    def check_collapsed(self) -> None:
        """Refuse a fit with trajectories as sites.

        Raises:
            ValueError: on such a fit.
        """
        if not self.collapsed:
            raise invalid(
                "fit",
                expected="a fit whose trajectories are integrated out",
                got="one with trajectories as sites, whose guide belongs to its record",
                advice="Fit with guide='collapsed' or method='map', or do without refits.",
            )

    def with_draws(self, values: Mapping[str, Tensor]) -> Self:
        """The fit with other draws (S, *shape), for what is computed from draws alone."""
        return replace(self, posterior=self.posterior.with_values(values), draws=values)

    def thinned(self, number: int) -> Self:
        """The fit with at most so many of its draws, spread evenly over all of them.

        Raises:
            ValueError: fewer than one.
        """
        COUNT.check("number", number)
        if self.n_draws <= number:
            return self
        index = np.linspace(0, self.n_draws - 1, number).round().astype(int)
        return self.with_draws({name: value[index] for name, value in self.draws.items()})

    @isolated
    def log_joint(self, records: Record | Sequence[Record]) -> float:
        """Log p(y, mode): of the records with the sites at the mode [nats].

        Raises:
            ValueError: where a record does not fit the model, or has no outputs.
        """
        measured = with_outputs(self.model.prepare(records))
        conditioned = pyro.poutine.condition(self.model.collapsed, data=dict(self.mode))
        with torch.no_grad():
            return float(pyro.poutine.trace(conditioned).get_trace(measured).log_prob_sum())
