"""The ready model of plants whose nonlinearity is in feedback."""

from __future__ import annotations

from typing import Unpack

from gpytorch.kernels import Kernel

from pyro_dynogp.layers.noise import Gaussian, Likelihood
from pyro_dynogp.models.forms import (
    OF_ONE_SIGNAL,
    Form,
    FormName,
    each_form,
    form_of,
    forms_of,
    usual_substeps,
)
from pyro_dynogp.models.layer import INDUCING, fed_back
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.structure import ModelOptions
from pyro_dynogp.models.wiring import Dynamic, StaticLayer
from pyro_dynogp.support.errors import SWITCH, invalid, verify


def NonlinearFeedback(
    inputs: int,
    *,
    outputs: int = 1,
    pairs: int = 1,
    hidden: int = 0,
    step: bool | None = None,
    parametric: bool | FormName = False,
    substeps: int | None = None,
    inducing: int = INDUCING,
    kernel: Kernel | None = None,
    process_noise: bool = True,
    likelihood: Likelihood | None = None,
    **options: Unpack[ModelOptions],
) -> Model:
    """Linear dynamics g whose output comes back through a static nonlinearity f.

    A spring or friction that is not linear, a tank that empties through a valve:
    x' = A x + B u + F f(C x), y = C x + D u, with f held for a step or a part of it. Beyond the
    data f keeps its value. With hidden signals there is a second function f2 of h = H x, and f is
    named f1: friction where the position is measured, a tank above the one that is. A step beside
    them is what Gaussian processes are too smooth for: a friction that changes sign, an edge that
    a tank flows over.

    With `parametric` nothing is a Gaussian process: what comes back are a root and an edge of each
    output, and of each hidden signal, and a step of the latter, or of each output where there is no
    hidden signal (see `Form`). Tanks and valves need fewer data so. The name of a form is for a
    shape that the plant is expected to have: that form of each output and hidden signal. A "cube"
    is a spring that hardens or softens; it is fitted in seconds, and grows beyond the data.

    Arguments are those of `Wiener`. f sees all outputs and has as many; that of g is measured.

    Args:
        hidden: number of signals that f2 sees and has as outputs.
        step: whether a step of the hidden signal, or of the output where there is none, comes back
            as well; by default with one hidden signal.
        parametric: whether what comes back has parametric forms of one signal each, or the name of
            one form; `step`, `inducing` and `kernel` are of functions that are no such forms.
        substeps: equal parts of each interval between samples in which the functions are computed
            anew; by default 3 with a `Form`, 1 without and beside dead times that are parameters.
        kernel: of the functions, a gpytorch kernel; by default Matern-5/2 with a lengthscale of at
            least twice the distance between inducing locations.

    Examples:
        >>> model = dgp.NonlinearFeedback(1, pairs=1)
        >>> [wire.name for wire in model.wires], model.output_wire.name
        (['g', 'f'], 'g')
        >>> [wire.name for wire in NonlinearFeedback(1, hidden=1).wires]
        ['g', 'f1', 'f2', 'step']
        >>> [wire.name for wire in NonlinearFeedback(1, parametric="cube").wires]
        ['g', 'cube_of_output']
        >>> [wire.name for wire in NonlinearFeedback(1, parametric=True).wires]
        ['g', 'output_root', 'output_edge', 'output_step']
    """
    verify(hidden=hidden)
    if not isinstance(parametric, str):
        SWITCH.check("parametric", parametric)
    elif parametric not in OF_ONE_SIGNAL:
        raise invalid(
            "parametric", expected=f"True, False or one of {', '.join(map(repr, OF_ONE_SIGNAL))}",
            got=repr(parametric),
            advice="A Cascade takes other functions, see Form, Known and Product.",
        )  # fmt: skip
    if step is not None:
        SWITCH.check("step", step)
    functions: list[StaticLayer] = []
    if parametric:
        _check_parametric(step, kernel, inducing)
    if isinstance(parametric, str):
        functions += each_form(parametric, "g", outputs=outputs, hidden=hidden)
    elif parametric:
        functions += forms_of("g", outputs=outputs, hidden=hidden)
    else:
        functions += _smooth(outputs, hidden, step, inducing, kernel)
    if substeps is None:
        forms = any(map(form_of, functions))
        substeps = usual_substeps(options.get("channels", ()), forms=forms)
    dynamic = Dynamic(
        outputs=outputs,
        pairs=pairs,
        process_noise=process_noise,
        feedback=tuple(str(function.name) for function in functions),
        hidden=hidden,
        substeps=substeps,
    )
    looped: ModelOptions = {"integrate": "all", "output": "g", **options}
    return Model(inputs, (dynamic, *functions), likelihood or Gaussian(), **looped)


def _smooth(
    outputs: int, hidden: int, step: bool | None, inducing: int, kernel: Kernel | None
) -> list[StaticLayer]:
    """Gaussian processes of the output and of hidden signals, and a step."""
    width = hidden or outputs
    if step and width > 1:
        raise invalid(
            "step", expected="None or False: a step sees one signal", got=f"True, {width} signals",
            advice='A Cascade takes Form layers that see one channel each, as in sees=("g[0]",).',
        )  # fmt: skip
    step = hidden == 1 if step is None else step
    first = "f1" if hidden or step else "f"
    functions: list[StaticLayer] = [fed_back(outputs, inducing=inducing, kernel=kernel, name=first)]
    if hidden:
        sees = ("g_hidden",)
        functions.append(fed_back(hidden, inducing=inducing, kernel=kernel, sees=sees, name="f2"))
    if step:
        functions.append(Form("step", sees=("g_hidden" if hidden else "g",), name="step"))
    return functions


def _check_parametric(step: bool | None, kernel: Kernel | None, inducing: int) -> None:
    """Refuse what parametric forms have no use for."""
    if step is not None or kernel is not None or inducing != INDUCING:
        raise invalid(
            "parametric", expected="False beside step, kernel or inducing",
            got=f"step={step}, kernel={type(kernel).__name__}, inducing={inducing}",
            advice="They are of Gaussian processes, and of a step beside them.",
        )  # fmt: skip
