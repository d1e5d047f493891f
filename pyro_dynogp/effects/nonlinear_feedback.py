"""What acts back on the dynamics: a spring, a friction, an outflow, a flow that carries heat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import hermite, hinges
from pyro_dynogp.effects.base import Effect, Parameters
from pyro_dynogp.effects.bilinear import dominant_rates, products, with_products_of_inputs
from pyro_dynogp.effects.feedback_sentence import what_acts_back
from pyro_dynogp.lti.views import steady_state_gain
from pyro_dynogp.models.compartments import in_place_of
from pyro_dynogp.models.feedback_variants import (
    with_feedback,
    with_form,
    with_forms,
    with_hysteresis,
    with_joint_feedback,
    with_products,
    with_products_of_states,
)
from pyro_dynogp.models.forms import FormName, hysteresis
from pyro_dynogp.models.product import is_product
from pyro_dynogp.models.system import DynamicSystem
from pyro_dynogp.models.variants import Model
from pyro_dynogp.models.wiring import INPUTS
from pyro_dynogp.statistics.bootstrap import Scan
from pyro_dynogp.statistics.detecting import lasting
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, against, evidence, labelled
from pyro_dynogp.statistics.regression import with_past
from pyro_dynogp.statistics.responses import filtered, standardised
from pyro_dynogp.statistics.serial import one_step_sd
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.support.tensors import as_tensor

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit

# Ends of the low, middle and high part of the output's range, as quantiles of the record.
PARTS = (0.02, 0.35, 0.65, 0.98)
NAMES = ("low end", "middle", "high end")
# Samples of outputs and inputs before an innovation whose linear part in it is no evidence.
LAGS = 7
# Standard errors by which two of their slopes must differ to be said to.
CERTAIN = 2.0
# Forms that are tried alone: a spring, a friction, an outflow.
SIMPLE: tuple[FormName, ...] = ("cube", "step", "root")
# Compartments of a chain.
CHAIN = 2
# Share of what the best column gains from which on products are tried beside functions.
ALIKE = 0.5


def nonlinear_feedback(residuals: Residuals, settings: LoopSettings, *, seed: int = 0) -> Evidence:
    r"""Test for a function of the output that drives the model's own poles.

    Where x' = A x + B u + F f(y), y = C x + D u, and f departs from a line by h, the residual of
    the linear model is to first order what the poles of A make of h(y), with y as the model has it:
    columns are h(mean) through each pole (`filtered`), with shapes h as in the test for a function
    of the output: Hermite polynomials of the second and third degree, apart and together, and
    piecewise linear functions with one knot; then the same of the mean's rate of change, which is
    what friction acts on where a position is measured, and with several pairs of poles of that
    one's, which is most of what a spring between two masses has beside the position of one, and the
    two products that a hysteresis is made of (see `Form`) of the mean and its rate of change; and
    h = u y, products of each input with the mean, alone and beside those with other inputs. What
    the mean itself does through the poles is nuisance. A sensor that is not linear sets this test
    off as well: refits tell the two apart.
    `where`: ``output``, its name; ``products``, what the best product gains of what the best column
    does, zero to one.

    Where what is missing is large the simulated mean is far from the output, and says little of h;
    a controller can hide it there altogether. One step ahead h is known from what was measured: the
    second test is of the innovations of a linear model, which functions of past outputs, and their
    products with inputs, do not foretell where nothing is missing. The smaller of the two p-values
    counts, twice. (Functions that a model has err beyond their data, and look like others there: no
    second test then.)

    Source: first-order Volterra response of a feedback loop (Schetzen, The Volterra and Wiener
    Theories of Nonlinear Systems, 1980, chapter 8); shapes after Ramsey's RESET, J. R. Stat. Soc. B
    31:350, 1969. Innovations against functions of past outputs: Tsay, Biometrika 73(2):461, 1986.
    """
    r = residuals
    signals = [r.mean, np.gradient(r.mean, r.time)]
    if len(r.poles) > 1:
        signals.append(np.gradient(signals[1], r.time))
    shapes = [shape for signal in signals for shape in _shapes(signal)]
    if len(r.poles) > 1:
        shapes.append(_hysteretic(signals[1], r.mean))
    multiplied = products(r.inputs, r.mean)
    shapes += multiplied
    variants = [_driven(r, shape) for shape in shapes]
    nuisance = _driven(r, r.mean[:, None])
    scan = lasting(r, variants, nuisance, settings, seed)
    best = scan
    if r.linear:
        ahead = _one_step_ahead(r, settings, seed)
        best = min(scan, ahead, key=lambda one: one.p_value)
        best = replace(best, p_value=min(1.0, 2.0 * best.p_value))
    share = 0.0
    if multiplied:
        most = max(best.gain, np.finfo(float).tiny)
        share = float(np.clip(best.gains[-len(multiplied) :].max() / most, 0.0, 1.0))
    label = labelled(f"simulated {r.output_name}", r.output_unit)
    return evidence(
        "nonlinear feedback",
        best,
        {"output": r.output_name, "products": share},
        f"A nonlinear function of '{r.output_name}' acts back on its dynamics, "
        f"{about(r, scan.size)}.",
        against(r, r.mean, label, nuisance, scan.fitted),
        scan.size,
    )


def _one_step_ahead(r: Residuals, settings: LoopSettings, seed: int) -> Scan:
    """Test of the innovations for functions of the last output, and of its last change.

    The last outputs and inputs themselves are nuisance: their part is a parameter's affair. What
    parameters leave uncertain in a free run is more than they do one step ahead.
    """
    y = np.where(np.isfinite(r.output), r.output, r.mean)
    innovations = replace(
        r,
        output=np.where(np.isfinite(r.output), r.innovations, np.nan),
        mean=np.zeros(len(r)),
        deviations=r.deviations / one_step_sd(r, settings),
    )
    last = _earlier(y, 1)
    change = last - _earlier(y, 2)
    shapes = [*_shapes(last), *_shapes(change)]
    shapes += [_hysteretic(change, last)] if len(r.poles) > 1 else []
    shapes += products(_earlier(r.inputs, 1), last)
    variants = [with_past(shape) for shape in shapes]
    lags = [_earlier(y, k + 1) for k in range(LAGS)]
    lags += [_earlier(r.inputs, k) for k in range(LAGS)]
    linear = np.column_stack(lags)
    return lasting(innovations, variants, linear - linear.mean(0), settings, seed)


def _earlier(x: np.ndarray, samples: int) -> np.ndarray:
    """A series (n, ...) as it was so many samples before, at the beginning as it was first."""
    return x[np.maximum(np.arange(len(x)) - samples, 0)]


def _shapes(signal: np.ndarray) -> list[np.ndarray]:
    """Functions of a signal (n,) that are no lines, each (n, c)."""
    powers, bends = hermite(signal), hinges(signal)
    return [powers[:, :1], powers[:, 1:], powers, *bends.T[:, :, None]]


def _hysteretic(rate: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """The parts (n, 2) of a hysteresis of a signal (n,) that changes at a rate, standardised."""
    both = [torch.as_tensor(x) for x in standardised(np.column_stack([rate, signal])).T]
    none = torch.zeros((), dtype=torch.float64)
    parts = [hysteresis(v, w, none).numpy() for v, w in (both, both[::-1])]
    return standardised(np.column_stack(parts))


def _driven(r: Residuals, signals: np.ndarray) -> np.ndarray:
    """Signals (n, c) through each pole of the model, themselves and one step later, (n, c K)."""
    # One that does not decay within the record is as good as one that does so over its length.
    slowest = -1.0 / (r.time[-1] - r.time[0])
    rates = np.minimum(r.poles.real, slowest) + 1j * r.poles.imag
    return standardised(filtered(signals, r.step, r.time, rates).reshape(len(r), -1))


class NonlinearFeedbackOfOutput(Effect):
    """What acts back on the dynamics: spring, friction, outflow, a flow that carries heat.

    A function of the output, of a signal of the same states that nothing measures (a velocity, the
    level of another tank), or one of each, of several outputs one function for each and one of all
    together; a cube, a step or a root of either, which are fitted in seconds and hold beyond the
    data; roots, edges and steps of both; products of the inputs with the output, and with each
    other, or with such a signal; two compartments in place of linear dynamics; products of three
    such signals; a hysteresis of two. A later one only where it is certainly better.
    """

    name = "nonlinear feedback"
    family = "shapes"
    acts_on = "inputs"
    freedom = 5
    compared = "held out"
    experiments: ClassVar = {
        "output nonlinearity": "steps of several sizes: behind a sensor that is not linear the way "
        "to each level takes equally long, in feedback its time or its frequency changes with size",
        "input nonlinearity": "a step, left alone for longer than the dynamics take, from several "
        "levels: an actuator changes its size alone, feedback its time or its frequency",
    }
    test = staticmethod(nonlinear_feedback)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Static layers that see the last dynamic layer and act back on it, or a chain of them.

        Products come first where the test has one as its best column, and are left out where none
        gains nearly as much: refits take as long as those of functions. A step beside a smooth
        function may hold it at a poor optimum, of 70 nats less in one spring between two masses.
        Beside functions of several outputs that act back already there are no steps of hidden
        signals and no forms together: they were tried together with these, and take minutes.
        """
        share = float(evidence.where["products"])
        alone, stepped = (
            with_feedback(model, output=False, hidden=True, step=step) for step in (False, True)
        )
        simple = [with_form(model, form, hidden=h) for h in (False, True) for form in SIMPLE]
        functions = [with_feedback(model), *simple, alone]
        products = [
            with_products(model),
            with_products_of_inputs(model, record),
            with_products(model, hidden=True),
        ]
        leading = [*functions, *products] if share >= ALIKE else functions
        if share == 1.0:
            leading = [*products, *functions]
        forms = [with_forms(model), with_forms(model, hidden=True)]
        chain = in_place_of(model, CHAIN)
        past, both = with_hysteresis(model), with_feedback(model, hidden=True)
        states = with_products_of_states(model)
        extended = [
            *leading, stepped, with_joint_feedback(model), *forms, chain, states, past, both
        ]  # fmt: skip
        if model.has_feedback and model.outputs > 1:
            extended = leading
        return list({repr(variant): variant for variant in extended if variant}.values())

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """Of which signals it is a function."""
        return what_acts_back(model, str(evidence.where["output"]), evidence.sentence)

    def parameters(self, fit: Fit, evidence: Evidence, record: Record) -> Parameters:
        """What it does to the dynamics, in numbers.

        Of products, the decay rate of the dominant mode where an input is low and where it is high.
        Of functions of the output, the inverse steady-state gain at the low end, in the middle and
        at the high end.

        The input that holds the output at y is u(y) = (y - sum_i G_i f_i(y)) / G_u, with
        steady-state gains G_u from the input and G_i from what comes back. Posterior mean and
        standard deviation of its mean slope in each part of the output's range [input / output]; of
        the input with the largest gain. Standard deviations are those of the fit's draws: by
        default they know a Gaussian process alone, as poles and gains stay at their optimum beside
        one. None for several outputs, for integrators, without inputs, and where the output is a
        function of what acts back.
        """
        model, scaling = fit.model, fit.scaling
        fed = [wire for wire in model.wires if wire.feedback]
        if model.outputs > 1 or len(fed) != 1 or not fed[0].last:
            return {}
        names = fed[0].feedback
        multiplied = [w for w in model.wires if w.name in names and is_product(w.layer)]
        if multiplied:
            inputs = len(names) == 1 and multiplied[0].sources[0] == INPUTS
            return dominant_rates(fit, fed[0], record) if inputs else {}
        if len(fed[0].signals) > 1:  # what they see is hidden
            return {}
        system = fit.system_at(fit.draws)
        dynamic = system.layer(fed[0].name)
        assert isinstance(dynamic, DynamicSystem)
        if bool((dynamic.modes.poles == 0).any()) or fed[0].sources != ("inputs",):
            return {}
        gains = steady_state_gain(dynamic.modes).numpy()
        gains = gains.reshape(-1, gains.shape[-1])
        if gains.shape[1] == len(names):
            return {}
        of_inputs, back = gains[:, : -len(names)], gains[:, -len(names) :]
        which = int(np.abs(of_inputs).mean(0).argmax())
        y = record.outputs[:, 0]
        at = np.quantile(y[np.isfinite(y)], PARTS)
        scaled = (at - scaling.output_offset[0]) / scaling.output_scale[0]
        with torch.no_grad():
            x = as_tensor(scaled[:, None])
            values = [
                system.layer(name).mean(x, scaled).numpy().reshape(-1, len(at)) for name in names
            ]
        fed_back = sum(gain[:, None] * f for gain, f in zip(back.T, values, strict=True))
        u = (scaled - fed_back) / of_inputs[:, [which]]
        slopes = np.diff(u) / np.diff(scaled) * scaling.input_scale[which] / scaling.output_scale[0]
        unit = "/".join(x or "1" for x in (scaling.input_units[which], scaling.output_units[0]))
        unit = "" if unit == "1/1" else unit
        whose = f"inverse steady-state gain of {scaling.input_names[which]}"
        return {
            labelled(f"{whose}, {part}", unit): (float(slope.mean()), float(slope.std()))
            for part, slope in zip(NAMES, slopes.T, strict=True)
        }

    def shape(self, parameters: Parameters) -> str:
        """Whether it hardens or softens, where the parts differ by two standard deviations."""
        slopes = [pair for label, pair in parameters.items() if label.startswith("inverse steady")]
        if len(slopes) != len(NAMES):
            return ""
        ends = [_sign(slopes[k], slopes[1]) for k in (0, 2)]
        if not any(ends):
            return ""
        if ends[0] == ends[1]:
            return "It hardens to both ends." if ends[0] > 0 else "It softens to both ends."
        words = {1: "hardens", -1: "softens"}
        both = zip(ends, (NAMES[0], NAMES[2]), strict=True)
        said = [f"{words[sign]} to the {end}" for sign, end in both if sign]
        return f"It {' and '.join(said)}."


def _sign(end: tuple[float, float], middle: tuple[float, float]) -> int:
    """Whether the slope at an end is certainly steeper (1) or less steep (-1), else 0."""
    difference = abs(end[0]) - abs(middle[0])
    certain = abs(difference) > CERTAIN * np.hypot(end[1], middle[1])
    return int(np.sign(difference)) if certain else 0
