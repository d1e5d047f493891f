"""The linear dynamic Gaussian process as a Pyro model: one stochastic LTI system, white noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from pyro_dynogp.data.channels import Channel, count_direct, prepared
from pyro_dynogp.data.record import Record, as_records
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.lti.covariance import real_covariance, state_covariance
from pyro_dynogp.lti.modes import Modes, NoiseStructure
from pyro_dynogp.lti.state import ModalState
from pyro_dynogp.models.priors import FLAT, PriorName, TimeScale, sample_direct, sample_modes
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.tensors import as_tensor

InitialState = Literal["integrated", "zero", "site"]


@dataclass(frozen=True)
class LinearSystem:
    """One draw (or a batch of draws) of all parameters, in the units of the record.

    Attributes:
        modes: poles and gains, batch shape *b.
        offset: (*b,) or (*b, n_y): mean output at the mean inputs of the training record.
        noise_sd: (*b,) or (*b, n_y): measurement noise [output].
        past_inputs: (*b, 2P, 2P): covariance that unknown past inputs give the initial state.
    """

    modes: Modes
    offset: Tensor
    noise_sd: Tensor
    past_inputs: Tensor


@dataclass(frozen=True)
class LinearDynamicGP:
    """Output = stochastic LTI system driven by the inputs + offset + white measurement noise.

    The trajectory is integrated out, so that the observed site ``y`` carries the exact marginal
    likelihood. Calling the model with a record runs the Pyro model; with several records
    they share every hyperparameter (sites ``y_0``, ``y_1``, ...). A record without outputs leaves
    ``y`` unobserved, to be sampled.

    Sites: those of `sample_modes` under the prefix ``g``, ``offset`` and ``noise_sd`` (n_y,) in
    standard deviations of the training output (normal(0, 1) and log-normal around 0.1), and with
    ``initial_state="site"`` ``initial_state`` (2P,), standard normal; ``direct`` (n_y, K) for
    inputs that act at once.

    Args:
        inputs: n_u, may be 0, those that channels make included. outputs: n_y.
        pairs: P, the number of conjugate pairs (order 2P).
        noise: "shared" (one set of Brownian motions drives all pairs) or "independent".
        brownian: n_l, number of Brownian motions; by default n_y.
        feedthrough: whether the input acts on the output at once.
        process_noise: whether there is any.
        initial_state: "integrated", what unknown past inputs of one standard deviation and past
            process noise would have left, a Gaussian, integrated out; "zero" (but for the past
            process noise); or "site", sampled.
        direct: the last K inputs act on the output at once and without dynamics (trends, steps,
            calendars): their weights are the site ``direct``, normal(0, 1) in standard deviations.
        channels: made from each record before the model sees it, see `pyro_dynogp.data.channels`.
        priors: "default", or "paper" for flat ones but for the horseshoe on the noise gains: fit
            with them, but do not sample from them, their draws exceed floating-point range.
        scaling: what one time step and one standard deviation are; learnt by `fit` from the
            training record. Without it the record that the model is called with sets them.

    Raises:
        ValueError: on numbers below the least that makes sense, or unknown options.
    """

    # Sites may have a batch dimension on the left: many points go through the model at once.
    takes_batches: ClassVar[bool] = True

    inputs: int
    outputs: int = 1
    pairs: int = 5
    noise: NoiseStructure = "shared"
    brownian: int | None = None
    feedthrough: bool = True
    process_noise: bool = True
    initial_state: InitialState = "integrated"
    direct: int = 0
    channels: tuple[Channel, ...] = ()
    priors: PriorName = "default"
    scaling: Scaling | None = None

    def __post_init__(self) -> None:
        for name, least in (("inputs", 0), ("outputs", 1), ("pairs", 1)):
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise invalid(name, expected=f"a whole number >= {least}", got=repr(value))
        if self.initial_state not in ("integrated", "zero", "site"):
            raise invalid(
                "initial_state",
                expected="'integrated', 'zero' or 'site'",
                got=repr(self.initial_state),
            )
        if self.noise not in ("shared", "independent"):
            raise invalid("noise", expected="'shared' or 'independent'", got=repr(self.noise))
        if self.priors not in ("default", "paper"):
            raise invalid("priors", expected="'default' or 'paper'", got=repr(self.priors))
        check_direct(self.inputs, self.direct, self.channels)
        if self.inputs == 0 and not self.process_noise:
            raise invalid("process_noise", expected="True for a system without inputs", got="False")

    def scaled_to(self, records: Record | Sequence[Record]) -> LinearDynamicGP:
        """The same model with the scaling of the given training record(s)."""
        return replace(self, scaling=Scaling.from_records(prepare(self, records)))

    def check(self, records: Record | Sequence[Record]) -> tuple[Record, ...]:
        """Records prepared with the model's channels, whose channels and units fit the model.

        Raises:
            ValueError: where the number of channels or a unit differs.
        """
        return check_records(self, records)

    @property
    def collapsed(self) -> LinearDynamicGP:
        """The model with its trajectory integrated out, as it is: see `Cascade.collapsed`."""
        return self

    @property
    def several_outputs(self) -> bool:
        """Whether trajectories have an output dimension."""
        return self.outputs > 1

    def sample_system(self, scaling: Scaling) -> LinearSystem:
        """Sample all hyperparameters; the result is in the units of the record."""
        n_y = self.outputs
        several = self.several_outputs
        time_scale = TimeScale.of(scaling)
        modes = sample_modes(
            "g",
            inputs=self.inputs - self.direct,
            pairs=self.pairs,
            outputs=n_y if several else None,
            brownian=self.brownian or n_y,
            noise=self.noise,
            feedthrough=self.feedthrough,
            process_noise=self.process_noise,
            time_scale=time_scale,
            priors=self.priors,
        )
        flat = self.priors == "paper"
        if self.direct:
            modes = with_direct(modes, sample_direct(self.direct, n_y, flat=flat))
        zero = torch.zeros(n_y, dtype=torch.float64)
        offset = pyro.sample(
            "offset", dist.Normal(zero, zero + (FLAT if flat else 1.0)).to_event(1)
        )
        noise_sd = pyro.sample(
            "noise_sd",
            dist.LogNormal(zero + math.log(0.1), zero + (FLAT if flat else 1.5)).to_event(1),
        )
        y_scale = as_tensor(scaling.output_scale)
        y_offset = as_tensor(scaling.output_offset)
        shift, sd = y_offset + y_scale * offset, y_scale * noise_sd
        return LinearSystem(
            modes=modes.rescale(inputs=as_tensor(scaling.input_scale), outputs=y_scale)
            if several
            else modes.rescale(inputs=as_tensor(scaling.input_scale), outputs=y_scale[0]),
            offset=shift if several else shift.squeeze(-1),
            noise_sd=sd if several else sd.squeeze(-1),
            past_inputs=past_input_covariance(modes, 1.0 / time_scale.typical_rate),
        )

    def process(
        self,
        system: LinearSystem,
        record: Record,
        scaling: Scaling,
        initial_state: ModalState | Tensor | None = None,
        *,
        process_noise: bool = True,
        inputs: Tensor | None = None,
    ) -> LTIProcess:
        """Noise-free trajectory of the output along a record.

        Args:
            system: parameters. record: time and inputs. scaling: of the training record.
            initial_state: state at the first time; by default the prior that the model states.
            process_noise: False for the response of the deterministic system.
            inputs: u (*b, n, n_u) [input] in place of the record's.
        """
        modes = system.modes if process_noise else system.modes.without_process_noise()
        data = record.tensors()
        u = data.inputs if inputs is None else inputs
        driving = u - as_tensor(scaling.input_offset) if self.inputs else None
        if initial_state is None and self.initial_state == "integrated":
            initial_state = self.prior_state(system, modes)
        return LTIProcess(modes, data.time, driving, initial_state, offset=system.offset)

    @staticmethod
    def prior_state(system: LinearSystem, modes: Modes) -> ModalState:
        """Gaussian prior of the initial state: unknown past inputs plus past process noise."""
        mean = torch.zeros_like(modes.poles)
        return ModalState(mean, state_covariance(modes) + system.past_inputs)

    def sample_states(self, suffix: str) -> dict[str, Tensor]:
        """Sample the numbers behind the first state of a record, where they are a site."""
        if self.initial_state != "site":
            return {}
        one = torch.ones(2 * self.pairs, dtype=torch.float64)
        name = f"initial_state{suffix}"
        return {"initial_state": pyro.sample(name, dist.Normal(0.0 * one, one).to_event(1))}

    def __call__(
        self, records: Record | Sequence[Record], inputs: Sequence[Tensor] | None = None
    ) -> None:
        """Run the Pyro model on one record or on several.

        Args:
            records: with inputs and outputs.
            inputs: for each record u (k, n, n_u) [input] in place of its own, where every site has
                k values: each of them with inputs of its own.
        """
        checked = self.check(records)
        single = len(checked) == 1
        scaling = self.scaling or Scaling.from_records(checked)
        system = self.sample_system(scaling)
        for index, record in enumerate(checked):
            suffix = "" if single else f"_{index}"
            states = self.sample_states(suffix)
            state: Any = None
            if states:
                state = initial_mean(system.past_inputs, states["initial_state"])
            u = None if inputs is None else inputs[index]
            process = self.process(system, record, scaling, state, inputs=u)
            y = record.tensors().observations if record.n_outputs else None
            pyro.sample(f"y{suffix}", process.observed(system.noise_sd), obs=y)


def prepare(model: Any, records: Record | Sequence[Record]) -> tuple[Record, ...]:
    """Records with the channels that a model makes from them."""
    return tuple(prepared(record, model.channels) for record in as_records(records))


def check_records(model: Any, records: Record | Sequence[Record]) -> tuple[Record, ...]:
    """Records, prepared, whose channels and units fit a model with inputs, outputs and scaling."""
    checked = prepare(model, records)
    for record in checked:
        for what, expected, got in (
            ("inputs", model.inputs, record.n_inputs),
            ("outputs", model.outputs, record.n_outputs or model.outputs),
        ):
            if expected != got:
                raise invalid(
                    "record",
                    expected=f"{expected} {what}, as the model has",
                    got=f"{got}",
                    advice=f"Choose channels with record.select(...) or set {what}={got}.",
                )
        if model.scaling is not None:
            model.scaling.check(record, outputs=record.n_outputs > 0)
    return checked


def check_direct(inputs: int, direct: int, channels: Sequence[Channel]) -> None:
    """Whether so many inputs can act directly.

    Raises:
        ValueError: where they are more than the inputs, or fewer than direct channels make.
    """
    least = count_direct(channels)
    if not isinstance(direct, int) or not least <= direct <= inputs:
        raise invalid(
            "direct", expected=f"a whole number from {least} to {inputs}", got=repr(direct)
        )


def with_direct(modes: Modes, weights: Tensor) -> Modes:
    """The system with more inputs, which act on the output alone: weights (*b, n_y, K)."""
    B, D = modes.B, modes.D
    silent = torch.zeros((*B.shape[:-1], weights.shape[-1]), dtype=B.dtype)
    batch = torch.broadcast_shapes(D.shape[:-1], weights.shape[:-1])
    joined = torch.cat([one.expand((*batch, one.shape[-1])) for one in (D, weights)], -1)
    if not modes.several_outputs:
        joined = joined.squeeze(-2)
    return replace(modes, input_gain=torch.cat([B, silent], -1), feedthrough=joined)


def past_input_covariance(modes: Modes, memory: float) -> Tensor:
    """Covariance (*b, 2P, 2P) of [Re x; Im x] after unknown past inputs of unit variance.

    Each input is taken as the sum of a random constant, which holds the state at -B/lambda, and
    of white noise of intensity 2 memory, as of an input that forgets within `memory` [s].
    """
    lam, B = modes.poles, modes.B
    held = B / lam.unsqueeze(-1)
    hermitian = held @ held.mH - 2.0 * memory * (B @ B.mH) / (
        lam.unsqueeze(-1) + lam.conj().unsqueeze(-2)
    )
    symmetric = held @ held.mT - 2.0 * memory * (B @ B.mT) / (lam.unsqueeze(-1) + lam.unsqueeze(-2))
    return real_covariance(hermitian, symmetric)


def initial_mean(covariance: Tensor, standard: Tensor) -> Tensor:
    """Initial state (*b, P), complex, with the given covariance, from standard normals (*b, 2P)."""
    J = covariance.shape[-1]
    ridge = 1e-9 * covariance.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] + 1e-150
    eye = torch.eye(J, dtype=covariance.dtype)
    root = torch.linalg.cholesky(covariance + ridge * eye)
    x = (root @ standard.unsqueeze(-1)).squeeze(-1)
    return torch.complex(x[..., : J // 2], x[..., J // 2 :])
