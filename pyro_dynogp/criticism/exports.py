"""A fit as other libraries and people take it: ArviZ, python-control, tables and text."""

from __future__ import annotations

from typing import Any

from pyro_dynogp.criticism import inference_data
from pyro_dynogp.criticism.control_bridge import Kind, to_control
from pyro_dynogp.criticism.summary import Summary, summarise
from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.isolation import isolated


class Exports(Fitted):
    """A fitted model in the forms that other libraries and people take.

    The attributes are those of `Fitted`.
    """

    @isolated
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

        - posterior: every latent site (chain, draw, *shape), in scaled units (``delay`` in units of
          time); trajectories where
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
        return inference_data.to_arviz(
            self, future=future, samples=samples, prior_samples=prior_samples, seed=seed
        )

    @isolated
    def to_control(
        self,
        *,
        kind: Kind = "state space",
        step: float | None = None,
        draws: int | None = None,
        layer: str | None = None,
    ) -> Any:
        """The linear system as an object of python-control, which has to be installed.

        Args:
            kind: "state space" (control.StateSpace) or "transfer function"
                (control.TransferFunction).
            step: sampling time [time unit], for a system that is exactly sampled with the input
                held over each step; None for one in continuous time.
            draws: a list of so many posterior draws, spread evenly over all; None for the system
                at the best optimum alone.
            layer: of a cascade, the dynamic layer, whose signals are in standard deviations. A
                linear model needs none, and is in the units of the record.

        Raises:
            ImportError: where python-control is not installed.
            ValueError: no such layer, one without inputs, dead times that are parameters.
        """
        return to_control(self, kind, step, draws, layer)

    @isolated
    def summary(self, record: Record | None = None) -> Summary:
        """What was fitted, how well it went, and a table of what it says about the plant.

        The table has the mean, the standard deviation and the central 95 % interval of natural
        frequencies and damping ratios (in each draw ordered by the frequency), steady-state gains
        of linear models, noise, dead times and lengthscales, in the units of the record. A fit at
        the mode has no spread.

        Args:
            record: to score predictions of, from the inputs alone and one step ahead.

        Returns:
            Text; its `table` and `scores` are DataFrames.

        Raises:
            ValueError: a record of other channels or units, or without outputs.
        """
        return summarise(self, record)

    def __repr__(self) -> str:
        layers = " -> ".join(wire.name for wire in self.model.wires)
        samples = sum(len(record) for record in self.records)
        return (
            f"Fit({layers}, inputs={list(self.scaling.input_names)}, "
            f"outputs={list(self.scaling.output_names)}, method={self.method!r}, "
            f"draws={self.n_draws}, samples={samples}, seed={self.seed})"
        )

    def _repr_html_(self) -> str:
        return self.summary()._repr_html_()
