"""What a method of inference is: a frozen object that is called with a problem and a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.model import Model


@dataclass(frozen=True, eq=False)
class Problem:
    """What is fitted.

    Attributes:
        model: with the scaling of its records. records: to which it is fitted.
        learnt: values of sites of another fit, from which a start is made; None for none.
    """

    model: Model
    records: tuple[Record, ...]
    learnt: Mapping[str, Tensor] | None = None

    @property
    def target(self) -> Model:
        """The model whose trajectories are integrated out."""
        return self.model.collapsed

    @property
    def argument(self) -> Record | tuple[Record, ...]:
        """What the Pyro model is called with."""
        return self.records[0] if len(self.records) == 1 else self.records


class Method(Protocol):
    """A method of inference. Its options are its fields."""

    def check(self, model: Model, *, warm: bool) -> None:
        """Refuse a model that the method cannot fit, before any work.

        Args:
            model: without scaling. warm: whether a start from another fit is given.

        Raises:
            ValueError: where the two do not go together.
        """
        ...

    @property
    def identity(self) -> object:
        """Everything that changes the result, with the same `repr` in every process."""
        ...

    def __call__(self, problem: Problem, run: Run) -> Fitted:
        """Posterior, mode and the history of how they were found."""
        ...
