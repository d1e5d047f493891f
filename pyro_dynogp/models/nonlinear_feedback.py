"""The ready model of plants whose nonlinearity is in feedback."""

from __future__ import annotations

from typing import Unpack

from gpytorch.kernels import Kernel

from pyro_dynogp.layers.noise import Gaussian, Likelihood
from pyro_dynogp.models.arrival import free_delays
from pyro_dynogp.models.layer import fed_back
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.step import Step, usual_substeps
from pyro_dynogp.models.structure import ModelOptions
from pyro_dynogp.models.wiring import Dynamic, Layer
from pyro_dynogp.support.errors import SWITCH, invalid, verify


def NonlinearFeedback(
    inputs: int,
    *,
    outputs: int = 1,
    pairs: int = 1,
    hidden: int = 0,
    step: bool | None = None,
    substeps: int | None = None,
    inducing: int = 32,
    kernel: Kernel | None = None,
    process_noise: bool = True,
    likelihood: Likelihood | None = None,
    **options: Unpack[ModelOptions],
) -> Model:
    """Linear dynamics g whose output comes back through a static nonlinearity f.

    A spring or friction that is not linear, a tank that empties through a valve:
    x' = A x + B u + F f(C x), y = C x + D u, with f held for a step or a part of it. Beyond the
    data f keeps its value. With hidden signals there is a second function f2 of h = H x, and f is
    named f1: friction where the position is measured, a tank above the one that is. A `Step` beside
    them is what Gaussian processes are too smooth for: a friction that changes sign, an edge that
    a tank flows over.

    Arguments are those of `Wiener`. f sees all outputs and has as many; that of g is measured.

    Args:
        hidden: number of signals that f2 sees and has as outputs.
        step: whether a step of the hidden signal, or of the output where there is none, comes back
            as well; by default with one hidden signal.
        substeps: equal parts of each interval between samples in which the functions are computed
            anew; by default 3 with a `Step`, 1 without and beside dead times that are parameters.
        kernel: of the functions, a gpytorch kernel; by default Matern-5/2 with a lengthscale of at
            least twice the distance between inducing locations.

    Examples:
        >>> model = dgp.NonlinearFeedback(1, pairs=1)
        >>> [wire.name for wire in model.wires], model.output_wire.name
        (['g', 'f'], 'g')
        >>> [wire.name for wire in NonlinearFeedback(1, hidden=1).wires]
        ['g', 'f1', 'f2', 'step']
    """
    verify(hidden=hidden)
    if step is not None:
        SWITCH.check("step", step)
    width = hidden or outputs
    if step and width > 1:
        raise invalid(
            "step", expected="None or False: a step sees one signal", got=f"True, {width} signals",
            advice="A Cascade takes Step layers that see layers of one signal each.",
        )  # fmt: skip
    step = hidden == 1 if step is None else step
    back: tuple[str, ...] = ("f1", "f2") if hidden else ("f1",) if step else ("f",)
    back = (*back, "step") if step else back
    if substeps is None:
        late = bool(free_delays(options.get("channels", ())))
        substeps = usual_substeps(steps=step, late=late)
    layers: list[Layer] = [
        Dynamic(
            outputs=outputs,
            pairs=pairs,
            process_noise=process_noise,
            feedback=back,
            hidden=hidden,
            substeps=substeps,
        ),
        fed_back(outputs, inducing=inducing, kernel=kernel),
    ]
    if hidden:
        layers.append(fed_back(hidden, inducing=inducing, kernel=kernel, sees=("g_hidden",)))
    if step:
        layers.append(Step(sees=("g_hidden" if hidden else "g",), name="step"))
    looped: ModelOptions = {"integrate": "all", "output": "g", **options}
    return Model(inputs, tuple(layers), likelihood or Gaussian(), **looped)
