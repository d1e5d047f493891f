"""What leaving data out needs of a fit: draws, densities of single samples, fits without them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np
import torch

from pyro_dynogp.criticism.densities import Kind, pointwise_log_density
from pyro_dynogp.criticism.posterior_draws import carried, draws_of, wider_draws
from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.log_joint import AT_ONCE
from pyro_dynogp.inference.pareto import good_k, psis
from pyro_dynogp.inference.posterior_draws import PosteriorDraws, Values
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.models.output_process import OutputProcess
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.support.errors import invalid

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted


Parameters = Literal["posterior", "mode"]


class Subject(Protocol):
    """A model with its posterior and its N measured samples, in a fixed order."""

    @property
    def draws(self) -> PosteriorDraws:
        """Draws (S) of the posterior."""

    @property
    def places(self) -> Mapping[str, np.ndarray]:
        """Where each measured sample stands: "record", "sample", "output" (N,), all integer."""

    @property
    def data(self) -> str:
        """Fingerprint of the data, gaps included."""

    def pointwise(self, kind: Kind, horizon: int = 1) -> np.ndarray:
        """Log-densities (S, N); see `criticism.densities`."""

    def fresh(self, record: int, first: int, last: int) -> np.ndarray:
        """One-step log-densities (S, N') of samples first to last - 1 as a record of its own."""

    def without(self, left_out: np.ndarray) -> Subject:
        """The same model fitted without some samples (N,), with densities of all of them."""


@dataclass(frozen=True, eq=False)
class FitSubject:
    """A `Fit` along its training records.

    Attributes:
        fit: the fit; of `records`, or of less of them.
        records: where densities are evaluated. count, seed: of the draws.
        parameters: "posterior", or "mode" for the mode alone.
        progress: whether drawing shows a bar where it takes long.
        drawn: draws of the posterior, where they did not come from the fit.
    """

    fit: Fitted
    records: tuple[Record, ...]
    count: int
    seed: int
    parameters: Parameters = "posterior"
    progress: bool = False
    drawn: PosteriorDraws | None = None

    @cached_property
    def draws(self) -> PosteriorDraws:
        """Draws (S) of the posterior, or the mode as the only one.

        Of normals around optima somewhat wider ones, whose ratios have lighter tails when data are
        left out; their own where those do not describe the posterior.
        """
        if self.drawn is not None:
            return self.drawn
        if self.parameters == "mode":
            values = {name: value.unsqueeze(0) for name, value in self.fit.mode.items()}
            return PosteriorDraws(values, None, None, np.zeros(1, dtype=int), "at the mode")
        wider = wider_draws(self.fit, self.count, self.seed)
        if wider is not None and psis(wider.log_ratio)[1] <= good_k(self.count):
            return wider
        return draws_of(self.fit, count=self.count, seed=self.seed, progress=self.progress)

    @cached_property
    def places(self) -> Mapping[str, np.ndarray]:
        """Where each measured sample stands (N,)."""
        rows = [
            np.column_stack([np.full(len(k), index), k])
            for index, record in enumerate(self.records)
            if len(k := np.argwhere(~record.missing))
        ]
        record, sample, output = np.concatenate(rows).T
        return {"record": record, "sample": sample, "output": output}

    @property
    def data(self) -> str:
        """Fingerprint of the data, gaps included."""
        return fingerprint_of([record.outputs for record in self.records])

    def pointwise(self, kind: Kind, horizon: int = 1) -> np.ndarray:
        """Log-densities (S, N)."""
        parts = []
        for index, record in enumerate(self.records):
            parts.append(self._along(record, index, kind, horizon))
        return np.concatenate(parts, axis=1)

    def fresh(self, record: int, first: int, last: int) -> np.ndarray:
        """One-step log-densities (S, N') of a stretch whose first state is unknown."""
        return self._along(self.records[record][first:last], None, "forecast", 1)

    def _along(self, record: Record, index: int | None, kind: Kind, horizon: int) -> np.ndarray:
        """Densities of a record's measured samples."""
        along = PreparedRecord.of(record, self.fit.scaling)

        def observed(part: Fitted) -> OutputProcess:
            return observed_of(part, along, index)

        found = densities_at(self.fit, self.draws.values, along, observed, kind, horizon)
        return found[:, ~record.missing]

    def without(self, left_out: np.ndarray) -> FitSubject:
        """The same model fitted without some samples (N,)."""
        fit = refit(self.fit, self._rest(left_out))
        return replace(self, fit=fit, progress=False, drawn=None)

    @property
    def carries(self) -> bool:
        """Whether draws can be moved to other data without a fit, as `carried` does.

        Of a model with static functions draws of all parameters can; its mode has none.
        """
        ways = ("importance",) if self.fit.model.has_function else ("map", "importance")
        return self.fit.method in ways and self.parameters != "mode"

    def carried(self, left_out: np.ndarray) -> FitSubject:
        """As `without`, by these draws moved to the posterior given those data."""
        fit = replace(self.fit, records=tuple(self._rest(left_out)))
        return replace(self, fit=fit, drawn=carried(self.fit, self.draws, fit, seed=self.seed))

    def moved(self, left_out: np.ndarray) -> FitSubject:
        """As `without`, of a model with static functions `carried` where that is possible.

        Its refit climbs to one optimum, of which the posterior may have several, and costs more.
        """
        moves = self.fit.model.has_function and self.carries
        return self.carried(left_out) if moves else self.without(left_out)

    def _rest(self, left_out: np.ndarray) -> list[Record]:
        """The records without some samples (N,)."""
        rest = []
        for index, record in enumerate(self.records):
            own = self.places["record"] == index
            gone = own & left_out
            y = record.outputs.copy()
            y[self.places["sample"][gone], self.places["output"][gone]] = np.nan
            # What is measured before the first gap to the end is a shorter record.
            there = np.flatnonzero(~np.isnan(y).all(1))
            rest.append(record.with_outputs(y)[: max(there[-1] + 1 if len(there) else 0, 2)])
        if all(one.missing.all() for one in rest):
            raise invalid("record", expected="samples left to fit to", got="none")
        return rest


def densities_at(
    fit: Fitted,
    values: Values,
    record: PreparedRecord,
    observed: Callable[[Fitted], OutputProcess],
    kind: Kind,
    horizon: int = 1,
) -> np.ndarray:
    """Log-densities (S, n, n_y) at draws, as many of them at a time as memory allows.

    Args:
        fit: the fit. values: (S, *shape) of its sites. record: whose outputs.
        observed: distribution of the outputs, of the fit with some of the draws.
        kind, horizon: see `pointwise_log_density`.
    """
    count = len(next(iter(values.values())))
    portion = max(1, AT_ONCE // record.observations.numel())
    parts = []
    for first in range(0, count, portion):
        some = fit.with_draws({k: v[first : first + portion] for k, v in values.items()})
        with torch.no_grad():
            parts.append(
                pointwise_log_density(observed(some), record.observations, kind, horizon=horizon)
            )
    return np.concatenate(parts)


def observed_of(fit: Fitted, record: PreparedRecord, index: int | None) -> OutputProcess:
    """Distribution of a record's outputs for each draw of a fit.

    Args:
        fit: the fit. record: along which.
        index: of the training record whose first state the draws know; None where the first state
            is unknown.
    """
    states = {}
    if index is not None:
        suffix = "" if len(fit.records) == 1 else f"_{index}"
        states = fit.model.states_of(fit.draws, suffix)
    return output_process(fit.model.begin(fit.system, states), record)


def no_refit() -> ValueError:
    """For a model whose author alone knows how it was fitted."""
    return invalid(
        "target",
        expected="one without refits for a model of your own",
        got="one that fits again",
        advice="Set refits=0 and look at Pareto's k, or fit to parts of the record yourself.",
    )


def fingerprint_of(outputs: Sequence[np.ndarray]) -> str:
    """Hex SHA-256 of outputs (n,) or (n, n_y), gaps included: what densities can be compared on.

    Inputs and clocks do not count, since models may use other ones.
    """
    digest = hashlib.sha256()
    for given in outputs:
        one = given[:, 0] if given.ndim == 2 and given.shape[1] == 1 else given
        plain = np.where(np.isnan(one), np.nan, one + 0.0).astype("<f8")
        digest.update(repr(plain.shape).encode() + plain.tobytes())
    return digest.hexdigest()
