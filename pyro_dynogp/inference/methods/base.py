"""What a method of inference is: a frozen object that is called with a problem and a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.posteriors import Posterior
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.delays import without_unknown
from pyro_dynogp.models.delays import longest_delay, where_inputs_are_known
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.prepared import PreparedRecord, as_measured
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping

# Samples below which a record has no time scale.
FEWEST = 3
# Samples from which optima are looked for along an excerpt first, how long that is, and the
# variance that all of its signals have at least, as a share of the record's.
LONG, EXCERPT, LIVELY = 16_000, 8_000, 0.25


@dataclass(frozen=True, eq=False)
class Problem:
    """What is fitted.

    Attributes:
        model: with the scaling of its records. records: to which it is fitted.
        learnt: values of sites of another fit, from which a start is made; None for none.
    """

    model: Model
    records: tuple[PreparedRecord, ...]
    learnt: Mapping[str, Tensor] | None = None

    @classmethod
    def of(
        cls,
        model: Model,
        records: Record | Sequence[Record],
        start: Fitted | None = None,
        units: Scaling | None = None,
    ) -> Problem:
        """Records checked and prepared, the model in their units; `start` is a fit to start from.

        With `units` the model is in these, of all channels that they have. Of a model with dead
        times outputs are missing until inputs have arrived, or, where dead times are free, are
        likely to.

        Raises:
            ValueError: as of `Model.check`; on constant or entirely missing signals.
        """
        dead_time = longest_delay(model)
        checked = [where_inputs_are_known(record, dead_time) for record in model.check(records)]
        longest = max(map(len, checked))
        if longest < FEWEST:
            expected = f"a record of {FEWEST} samples or more to fit to"
            raise invalid("record", expected=expected, got=f"{longest} samples")
        scaling = Scaling.from_records(checked)
        if units is not None:
            scaling = scaling.with_scales_of(units)
        prepared = tuple(PreparedRecord.of(record, scaling) for record in checked)
        if model.late:
            prepared = without_unknown(model, prepared)
        learnt = None if start is None else dict(start.mode)
        return cls(replace(model, scaling=scaling), prepared, learnt)

    @property
    def target(self) -> Model:
        """The model whose trajectories are integrated out."""
        return self.model.collapsed

    @property
    def scaling(self) -> Scaling:
        """In whose units the model is fitted."""
        return self.records[0].scaling

    @property
    def excerpt(self) -> Problem | None:
        """The same of the first part of a long record; None where the whole is needed.

        So it is with several records, with values that are learnt from another fit, and where an
        input or output hardly moves in that part.
        """
        return None if self.learnt is not None else self.beginning(LONG, EXCERPT)

    def beginning(self, long: int, length: int) -> Problem | None:
        """The same of the first samples of a record that has `long` or more; None as above."""
        if len(self.records) > 1 or len(self.records[0]) < long:
            return None
        part = self.records[0].head(length)
        few, whole = _variances(part), _variances(self.records[0])
        return replace(self, records=(part,)) if (few >= LIVELY * whole).all() else None

    def fitted(
        self,
        run: Run,
        posterior: Posterior,
        draws: Mapping[str, Tensor],
        mode: Mapping[str, Tensor],
        history: np.ndarray,
        energies: Sequence[float] | np.ndarray,
        diagnostics: Mapping[str, float],
    ) -> Fitted:
        """The fit that a method has come to; arguments as the fields of `Fitted`."""
        return Fitted(
            self.model, posterior, FrozenMapping(draws), FrozenMapping(mode), history,
            np.asarray(energies), FrozenMapping(diagnostics), run.seed, as_measured(self.records),
        )  # fmt: skip


def _variances(record: PreparedRecord) -> np.ndarray:
    """Of all scaled signals; zero where nothing is measured."""
    signals = np.concatenate([record.scaled_inputs.numpy(), record.scaled_outputs.numpy()], 1)
    count = np.maximum((~np.isnan(signals)).sum(0), 1)
    off = signals - np.nansum(signals, 0) / count
    return np.asarray(np.nansum(off**2, 0) / count)


class Method(Protocol):
    """A method of inference. Its options are its fields, and make checkpoints of it its own."""

    def check(self, model: Model, *, warm: bool) -> None:
        """Refuse a model that the method cannot fit, before any work.

        Args:
            model: without scaling. warm: whether a start from another fit is given.

        Raises:
            ValueError: where the two do not go together.
        """
        ...

    def __call__(self, problem: Problem, run: Run) -> Fitted:
        """Posterior, mode and the history of how they were found."""
        ...
