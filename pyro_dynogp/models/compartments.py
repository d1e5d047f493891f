"""A chain of compartments: what flows out of one enters the next."""

from __future__ import annotations

from dataclasses import replace
from typing import Unpack

from pyro_dynogp.layers.noise import Gaussian, Likelihood
from pyro_dynogp.models.feedback_variants import noise_allows_feedback
from pyro_dynogp.models.forms import Form, usual_substeps
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.structure import ModelOptions
from pyro_dynogp.models.wiring import Dynamic, Layer
from pyro_dynogp.support.errors import verify


def Compartments(
    inputs: int,
    *,
    count: int = 2,
    substeps: int | None = None,
    process_noise: bool = True,
    likelihood: Likelihood | None = None,
    **options: Unpack[ModelOptions],
) -> Model:
    r"""A chain of compartments, of which the last one's level is measured: tanks, vessels, rooms.

    Each has one level x_k, a first-order lag that inputs or the compartment before it raise, and
    that a root and an edge of itself lower (see `Form`):

        x_1' = -a_1 x_1 + B u + F_1 f_1(x_1),
        x_k' = -a_k x_k + b_k x_(k-1) + G_k f_(k-1)(x_(k-1)) + F_k f_k(x_k),

    f_k = (root, edge) with gains F_k, G_k of each. What leaves one compartment is a function of its
    level, and the next one sees the same function: `NonlinearFeedback(hidden=1)` would have to
    learn it twice. What flows over an edge may be lost, or enter the next one, or both. Poles are
    real: no compartment oscillates.

    Args:
        inputs: number of inputs, of the first compartment. count: number of compartments.
        substeps: equal parts of each interval between samples in which the functions are computed
            anew; by default 3, 1 beside dead times that are parameters.
        process_noise: whether levels have any; `fit` leaves it out where free runs are no better.
        likelihood: measurement noise; by default Gaussian.
        options: as of `Wiener`.

    Returns:
        A `Cascade` of layers level1, root1, edge1, level2, ...

    Raises:
        ValueError: on arguments that are none of these.

    Examples:
        >>> [wire.name for wire in dgp.Compartments(1).wires]
        ['level1', 'root1', 'edge1', 'level2', 'root2', 'edge2']
        >>> Compartments(2, count=1).wires[0].feedback
        ('root1', 'edge1')
    """
    verify(count=count)
    if substeps is None:
        substeps = usual_substeps(options.get("channels", ()), forms=True)
    layers: list[Layer] = []
    above: tuple[str, ...] = ()
    for place in range(1, count + 1):
        level, flows = f"level{place}", (f"root{place}", f"edge{place}")
        dynamic = Dynamic(
            pairs=1,
            real=True,
            feedthrough=False,
            process_noise=process_noise,
            substeps=substeps,
            feedback=flows,
            sees=above,
            name=level,
        )
        root, edge = flows
        layers += [dynamic, Form("root", sees=(level,), name=root)]
        layers.append(Form("edge", sees=(level,), name=edge))
        above = (level, *flows)
    chain: ModelOptions = {"integrate": "all", "output": f"level{count}", **options}
    return Model(inputs, tuple(layers), likelihood or Gaussian(), **chain)


def in_place_of(model: Model, count: int) -> Model | None:
    """Compartments in place of the dynamics of a linear model, with its channels and noise.

    None for other models, several outputs, integrators, dead times that are parameters, and noise
    that feedback does not allow.
    """
    if not model.is_linear or model.outputs > 1 or model.late or model.inputs == model.direct:
        return None
    if any(layer.integrators for _, layer in model.dynamic):
        return None
    if not noise_allows_feedback(model):
        return None
    chain = Compartments(1, count=count)
    return replace(model, layers=chain.layers, scaling=None, output=chain.output, integrate="all")
