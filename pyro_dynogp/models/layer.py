"""The layers that models are made of, as a user writes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import pyro.distributions as dist
import torch
from gpytorch.kernels import Kernel
from torch import Tensor

from pyro_dynogp.layers.kernels import RESOLVED, ROUGH, SMOOTH
from pyro_dynogp.lti.modes import NoiseStructure
from pyro_dynogp.support.errors import invalid

# What follows a layer's name in that of its hidden signals.
HIDDEN = "_hidden"
# Lowest and highest value, None where there is none.
Limits = tuple[float | None, float | None]


@dataclass(frozen=True)
class Dynamic:
    """A stochastic LTI layer: its output is the trajectory of a linear system with process noise.

    Args:
        outputs: width of the layer. pairs: P conjugate pairs (order 2P), shared by all signals.
        noise: "shared" or "independent" Brownian motions, see `Modes`.
        brownian: number of Brownian motions; by default one for each output.
        feedthrough: whether the layer's input acts on its output at once.
        process_noise: whether there is any.
        integrators: 1 for a pole at zero beside the pairs, one for each output: of a plant that
            integrates its input (a level, a position, a charge). Hidden signals do not see it.
        skip: names of earlier signals ("inputs", or layers) that the layer sees beside the
            output of the layer before it.
        sees: names of the earlier signals that it sees instead, for branches side by side; "g[0]"
            is the first channel of the signal "g", in `skip` as well.
        feedback: names of later static layers whose outputs are further inputs of this layer. Each
            acts from the sample after the one that it is computed at, and never on the output at
            once: the loop has a delay.
        hidden: number of further signals of the same states, which nothing measures: a velocity
            beside a position, a level in another tank. Functions see them by the name of the layer
            and "_hidden", as in ``Static(sees=("g_hidden",))``; in models with feedback.
        substeps: equal parts of each interval between samples in which functions in feedback are
            computed anew. With 1 they are held from sample to sample, which is too long for one
            that changes faster (friction of a mass that stops between two samples); the work grows
            with their number. Not beside dead times that are parameters.
        real: whether poles are real, `pairs` of them in place of pairs: first-order lags. Of one
            signal, in a cascade with static layers, without integrators.
        name: prefix of its sites; g, or g1, g2, ... by default.

    Examples:
        >>> layers = (dgp.Dynamic(outputs=2, pairs=3), dgp.Static(), dgp.Dynamic(skip=("inputs",)))
        >>> [wire.sources for wire in dgp.Cascade(1, layers).wires]
        [('inputs',), ('g1',), ('f', 'inputs')]
    """

    outputs: int = 1
    pairs: int = 5
    noise: NoiseStructure = "shared"
    brownian: int | None = None
    feedthrough: bool = True
    process_noise: bool = True
    integrators: int = 0
    skip: tuple[str, ...] = ()
    sees: tuple[str, ...] = ()
    feedback: tuple[str, ...] = ()
    hidden: int = 0
    substeps: int = 1
    real: bool = False
    name: str | None = None

    @property
    def width(self) -> int:
        """Number of signals, outputs and hidden ones."""
        return self.outputs + self.hidden

    @property
    def mostly_hidden(self) -> bool:
        """Whether there are more hidden signals than outputs."""
        return self.hidden > self.outputs

    @property
    def levels(self) -> int:
        """Number of integrators: one for each output, where there are any.

        Hidden signals have none: where an output integrates nothing depends on its level.
        """
        return self.integrators * self.outputs

    @property
    def modes(self) -> int:
        """Number of poles that stand for pairs: an integrator counts, and its random walk."""
        return self.pairs + self.levels * (2 if self.process_noise else 1)

    @property
    def past_states(self) -> tuple[int, ...]:
        """Entries of [Re x; Im x] that inputs before a record can have moved.

        That of an integrator is real, and its random walk has no input; that of a real pole is.
        """
        real = self.pairs + self.levels
        imaginary = 0 if self.real else self.pairs
        return (*range(real), *range(self.modes, self.modes + imaginary))


@dataclass(frozen=True)
class Static:
    """A static layer: a Gaussian process of the signals below, with inducing values.

    Args:
        outputs: width of the layer. inducing: number of inducing values for each output.
        kernel: a gpytorch kernel; by default Matern with a lengthscale for each channel.
        smoothness: nu of the default kernel, 0.5, 1.5 or 2.5.
        least_lengthscale: of the default kernel of a function of one signal, in distances between
            inducing locations, which do not tell what varies between them; 0 for none.
        mean: "linear" or "constant" prior mean; by default linear for a first layer, in feedback
            from several signals and where there are limits, else constant. Beyond the data a
            function goes back to it; in feedback from one signal it keeps its value, so that what
            comes back is bounded.
        limits: lowest and highest value of the linear mean [output], None for none: those of a
            sensor that stops. Of a last layer of one signal and one output.
        skip: names of earlier signals that the layer sees too. sees: those that it sees instead.
        learn_locations: whether the inducing locations are learnt.
        support: number of points at which the residual of the function given its inducing values
            is drawn, where the layer feeds a dynamic one and is not integrated out.
        name: prefix of its sites; f, or f1, f2, ... by default.

    Examples:
        >>> sensor = dgp.Static(inducing=8, mean="linear")
        >>> dgp.Cascade(1, (dgp.Dynamic(pairs=2), sensor)).wires[1].name
        'f'
    """

    outputs: int = 1
    inducing: int = 32
    kernel: Kernel | None = None
    mean: Literal["constant", "linear"] | None = None
    limits: Limits | None = None
    skip: tuple[str, ...] = ()
    sees: tuple[str, ...] = ()
    learn_locations: bool = True
    support: int = 64
    name: str | None = None
    smoothness: float = ROUGH
    least_lengthscale: float = 0.0


# Inducing values of a function in feedback, and of any that is added to a model.
INDUCING = 32


def fed_back(
    outputs: int,
    *,
    inducing: int = INDUCING,
    kernel: Kernel | None = None,
    sees: tuple[str, ...] = (),
    name: str | None = None,
) -> Static:
    """A function in feedback; smooth, and no finer than its inducing values, by default."""
    smoothness, least = (SMOOTH, RESOLVED) if kernel is None else (ROUGH, 0.0)
    return Static(
        outputs, inducing=inducing, kernel=kernel, sees=sees, name=name, smoothness=smoothness,
        least_lengthscale=least,
    )  # fmt: skip


@dataclass(frozen=True)
class Known:
    """A static layer whose function the user writes: a friction law, the root of a level.

    The function sees inputs, and the output that is measured, in the units of the record; as the
    model's output it gives that output in its units, and sees what a linear model of the record
    would have as its own. Other signals have no unit: it sees them as they are, and what goes on
    from it to other layers is shifted and scaled to mean zero and standard deviation one, for
    normal signals of the size of the training record and parameters in the middle of their priors.
    With `scaled` inputs and output, too, are standard deviations from the mean of the training
    record. The gains of the layer that sees it take up its size and sign: leave them out of the
    parameters.

    Args:
        function: torch, differentiable in the parameters and, in models whose trajectories are not
            integrated out, in the signals; finite everywhere. Called with each signal (*b, n), then
            the parameters (*b, 1) by name; returns (*b, n), or (*b, n, outputs) for several.
        parameters: their prior distributions by name, of pyro, of one number each: sites
            ``<layer>_<name>``.
        outputs: width of the layer.
        range: beyond these values of a signal [its unit] the function keeps its value; by default 8
            standard deviations from the mean of the training record.
        scaled: whether it sees and gives inputs and output without their units.
        skip: names of earlier signals that the layer sees too. sees: those that it sees instead.
            More than one signal only where all of them are inputs, or static functions of inputs.
        name: prefix of its sites; f, or f1, f2, ... by default.

    Examples:
        >>> friction = dgp.Known(lambda v, w: (v / w).tanh(), {"w": dist.LogNormal(0.0, 1.0)})
        >>> friction.outputs, sorted(friction.parameters)
        (1, ['w'])
    """

    function: Callable[..., Tensor]
    parameters: Mapping[str, dist.Distribution] = field(default_factory=dict)
    outputs: int = 1
    range: tuple[float, float] | None = None
    scaled: bool = False
    skip: tuple[str, ...] = ()
    sees: tuple[str, ...] = ()
    name: str | None = None
    support: ClassVar[int] = 0  # points at which the rest of the function is drawn


StaticLayer = Static | Known
Layer = Dynamic | StaticLayer


def in_double(prior: dist.Distribution, what: str) -> dist.Distribution:
    """The prior of one number, in float64.

    Args:
        prior: of a parameter of `Known`. what: to call it in errors.

    Raises:
        ValueError: where it is none, or cannot be made anew from its parameters.
    """
    expected = "a distribution of pyro, of one number"
    if (
        not isinstance(prior, torch.distributions.Distribution)
        or prior.batch_shape + prior.event_shape
    ):
        raise invalid(what, expected=expected, got=repr(prior))
    given = {name: getattr(prior, name, None) for name in prior.arg_constraints}
    try:
        kind: Callable[..., dist.Distribution] = type(prior)
        return kind(**{name: x.double() for name, x in given.items() if isinstance(x, Tensor)})
    except TypeError:
        expected += " that is made from its parameters alone"
        raise invalid(what, expected=expected, got=repr(prior)) from None
