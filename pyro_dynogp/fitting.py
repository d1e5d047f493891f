"""Fit a model to measured records: one call for every model and method, one frozen result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pyro_dynogp.criticism.exports import Exports
from pyro_dynogp.data.record import Record
from pyro_dynogp.inference import storage
from pyro_dynogp.inference.fitted import Fitted, known_fit
from pyro_dynogp.inference.isolation import isolated
from pyro_dynogp.inference.methods.base import Method, Problem
from pyro_dynogp.inference.methods.choose import method_of
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.stability import warnings_of
from pyro_dynogp.inference.training import train_model
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.prepared import with_outputs
from pyro_dynogp.prediction import layers as _layers
from pyro_dynogp.prediction import predict as _predict
from pyro_dynogp.prediction.first_state import beginning
from pyro_dynogp.prediction.layers import LayerTrajectory, StaticBand
from pyro_dynogp.prediction.prediction import Prediction
from pyro_dynogp.support.errors import instance, invalid, warn

__all__ = ["Fit", "fit", "load"]


class Fit(Exports):
    """A fitted model, and what can be done with it.

    The attributes are those of `Fitted`.

    Examples:
        >>> train, test = dgp.datasets.load("gas_furnace").train.split(60)
        >>> quick = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
        >>> fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), train, **quick)
        >>> fit.forecast(train, test).mean.shape
        (88, 1)
    """

    @isolated
    def layers(self, record: Record) -> Mapping[str, LayerTrajectory]:
        """Posterior trajectories of all layers along a record, given its inputs and outputs.

        Exactly for linear models, by the smoother of the moment-matching filter for others. A
        record without outputs gives the trajectories that the inputs alone say.
        """
        return _layers.layers(self, record)

    @isolated
    def static_function(
        self, name: str, record: Record, *, channel: int = 0, points: int = 200
    ) -> StaticBand:
        """A static layer's function with its band, where a record moves it.

        Args:
            name: of the layer. record: says over which range, and where data are.
            channel: the input that varies, others at their mean. points: number of points.
        """
        return _layers.static_function(self, name, record, channel, points)

    @isolated
    def log_likelihood(self, records: Record | Sequence[Record]) -> np.ndarray:
        """Log p(y | draw) (S,) [nats], exact marginal likelihood in the units of the record."""
        total = torch.zeros((), dtype=torch.float64)
        with torch.no_grad():
            for record in with_outputs(self.model.prepare(records)):
                outputs = output_process(beginning(self, record), record)
                total = total + outputs.log_prob(record.observations)
        return total.numpy()

    @isolated
    def simulate(
        self, record: Record, *, process_noise: bool = True, samples: int = 200, seed: int = 0
    ) -> Prediction:
        """Outputs from the inputs alone, from an unknown initial state.

        With feedback, what is uncertain of parameters that the posterior holds at their optimum is
        in the bands to first order, see `inference.held_parameters`.

        Args:
            record: time and inputs; its outputs are not used.
            process_noise: False for the response of the deterministic system.
            samples: number of joint samples that `Prediction.samples` draws. seed: for these.
        """
        return _predict.simulate(self, record, process_noise, samples, seed)

    @isolated
    def predict(
        self, record: Record, *, horizon: int = 1, samples: int = 200, seed: int = 0
    ) -> Prediction:
        """Each output from the inputs and from the outputs up to `horizon` samples before it.

        Exact Kalman predictions. Samples of a linear model are its mean plus errors with their
        joint law over time (a moving average of `horizon` innovations on a regular record); those
        of a cascade are independent from time to time.
        """
        return _predict.predict(self, record, horizon, samples, seed)

    @isolated
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

        Parameters that the posterior holds at their optimum count as for `simulate`.

        Args:
            past: up to now. future: later times, with inputs; its outputs are not used.
            process_noise: False if the future is known to have none.
            samples: number of joint samples. seed: for these.
        """
        return _predict.forecast(self, past, future, process_noise, samples, seed)

    @isolated
    def innovations(self, record: Record) -> np.ndarray:
        """Standardised one-step prediction errors (n, n_y); NaN where the output is missing.

        White and standard normal if the model is right: errors over their standard deviation where
        the prediction is Gaussian, else its normal scores (`Prediction.normal_scores`).
        """
        return self.predict(record, horizon=1).normal_scores(record.outputs)

    @isolated
    def save(self, path: str | Path) -> None:
        """Write the fit to one safetensors file, from which `pyro_dynogp.load` restores it.

        `trajectories` are left out: draws over the whole training record, which no prediction
        needs; `layers` computes smoothed ones.

        Raises:
            ValueError: where the folder does not exist, or a static layer has a gpytorch kernel of
                its own: a file holds numbers, no code.
        """
        storage.save(self, path)


@isolated
def fit(
    model: Model,
    record: Record | Sequence[Record],
    *,
    method: str | Method | None = None,
    start: Fitted | None = None,
    seed: int = 0,
    restarts: int | None = None,
    steps: int | None = None,
    checkpoint: str | Path | None = None,
    workers: int | None = None,
    progress: bool = True,
    **options: Any,
) -> Fit:
    """Fit a model to one record, or to several that share all parameters.

    The marginal posterior (exact for a linear model, by the moment-matching filter for others) is
    climbed from several starts, in parallel. `Importance` ("importance") draws all parameters from
    around the optima; `Mode` ("map") keeps the best optimum alone; `Normal` ("svi") fits normals to
    the posterior around the best optima; `Nuts` ("nuts") samples it. The
    starts of a cascade are the best linear fits, spread over its layers; where static layers see
    process noise they climb without any first, and the better half continues with it. Free runs
    through the training record decide whether it stays, and leave out optima that run worse than
    the linear model (docs/structures.md). With
    `Trajectories` trajectories stay sample sites, and Pyro's SVI fits them and the parameters
    together.

    Args:
        model: a `LinearDynamicGP` or a `Cascade` (`Wiener`, `Hammerstein`, ...).
        record: training record, or a sequence of them; scaling is learnt from it alone. Of a model
            with dead times that are parameters (`Delayed`) outputs are missing in the fit until the
            first input of the record is likely to have arrived, a quarter of it at most.
        method: "importance", "map", "svi", "nuts", or an object with options of its own:
            `Importance`, `Mode`, `Normal`, `Nuts`, `Trajectories`. By default "importance"; "svi"
            with ``guide``, and of models with static layers where one of ``hyperparameters``,
            ``particles``, ``learning_rate`` is given.
        start: a fit to start from beside the restarts: of the same model to other data, or of a
            model that this one extends (what sites have in common is taken over).
        seed: the same seed gives the same numbers to the last bit on one machine.
        restarts: number of starting points (default 8 with static layers; 2 of `Trajectories`; else
            6 with random poles and, on equal steps, up to 6 of subspace identification); 0 for
            `start` alone.
        steps: most iterations of a start (default 100 of Gauss-Newton, 500 of L-BFGS, 1500 of Adam;
            with static layers 40, 600, 600) and, with "svi", of SVI (default 1000; with static
            layers 60, and no more while hyperparameters stay at the optimum, around which it begins
            all but normal).
        checkpoint: a folder that keeps finished pieces of the work. The same call continues from
            there after a kill, and ends in the same bits.
        workers: processes; None for all processors, 1 for none but this one.
        progress: whether to show progress bars.
        options: of the method that a short name stands for: ``optimizer``; ``hyperparameters``
            (`family` of `Normal`), ``draws``, ``particles``, ``learning_rate``; ``chains``,
            ``warmup``; ``guide``, which stands for `Trajectories`.

    Raises:
        ValueError: on channels that do not fit the model, constant or entirely missing outputs,
            unknown options or such that the method does not use, or where no start leads anywhere.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> model = dgp.LinearDynamicGP(inputs=1, pairs=1)
        >>> fit = dgp.fit(model, record, restarts=2, workers=1, progress=False)
        >>> fit.method, len(fit.draws["noise_sd"])
        ('importance', 300)
    """
    instance("model", model, Model, "LinearDynamicGP, Wiener, Cascade, ... make one.")
    if start is not None:
        known_fit(start, "start")
    chosen = method_of(method, model, options)
    run = Run(seed, workers, progress, restarts=restarts, steps=steps)
    if restarts == 0 and start is None:
        raise invalid("restarts", expected="a whole number >= 1 without a start", got="0")
    chosen.check(model, warm=start is not None)
    problem = Problem.of(model, record, start)
    return _trained(problem, chosen, run, checkpoint)


@isolated
def fit_in_units(start: Fit, model: Model, record: Record, run: Run, **options: Any) -> Fit:
    """`fit`, in the units of a fit of the same sites: what is learnt there holds as it is.

    In units of other data inputs have another mean, which an integrator adds up.

    Args:
        start: the fit. model: of its sites. record: training record. run: how.
        options: method, and others of `fit`.
    """
    problem = Problem.of(model, record, start, start.model.scaling)
    chosen = method_of(options.pop("method"), model, options)
    chosen.check(model, warm=True)
    return _trained(problem, chosen, run)


def _trained(
    problem: Problem, method: Method, run: Run, checkpoint: str | Path | None = None
) -> Fit:
    """The fit of a problem, with its warnings."""
    fitted = Fit.of(train_model(problem, method, run, checkpoint))
    for sentence in warnings_of(fitted):
        warn(f"fit: {sentence}")
    return fitted


@isolated
def load(path: str | Path) -> Fit:
    """Read a fit that `Fit.save` wrote.

    Raises:
        ValueError: where the file is missing, damaged, not a pyro_dynogp fit, or of a version
            that this package does not know.

    Examples:
        >>> import tempfile, pathlib
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> quick = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
        >>> fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **quick)
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "furnace.safetensors"
        >>> fit.save(path)
        >>> dgp.load(path).model == fit.model
        True
    """
    return Fit.of(storage.load(path))
