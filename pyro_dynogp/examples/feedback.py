"""Simulated plants with a nonlinear part in feedback: spring, tanks, friction, hysteresis.

    x' = r(x, u),    y_k = c(x(t_k)) + e_k,

with u held from sample to sample, no process noise, and Runge-Kutta steps of fourth order within
each sample. Physical parameters are drawn at random from 70 to 130 % of nominal values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from pyro_dynogp.data.checks import Array
from pyro_dynogp.data.record import Record
from pyro_dynogp.support.errors import POSITIVE_OR_ZERO, SWITCH, invalid, verify, whole

# Physical parameters, or a state: numbers.
Numbers = tuple[float, ...]
# Rate of change of a state under an input.
Rates = Callable[[Numbers, float], Numbers]
# Spread of parameters to either side; what the inputs of the test are multiplied by until its
# outputs stay within the range of the training outputs.
SPREAD, CALMER = 0.3, 0.9


@dataclass(frozen=True, kw_only=True)
class FeedbackSimulation:
    """A simulated experiment with a plant in feedback, and the truth behind it.

    Attributes:
        train, test, full: records; the test goes on where the training ends.
        states: x at all samples (n, n_s), with the output in column `output`.
        noise_sd: standard deviation of the measurement noise e, in the unit of y.
        parameters: physical parameters by name, units as in the simulator's description.
    """

    train: Record
    test: Record
    full: Record
    states: Array
    output: int
    noise_sd: float
    parameters: Mapping[str, float]

    @property
    def clean(self) -> Array:
        """Output without measurement noise at all samples (n,)."""
        return self.states[:, self.output]

    @property
    def clean_test(self) -> Array:
        """The same at the samples of the test (n_test,)."""
        return self.clean[len(self.train) :]


@dataclass(frozen=True, kw_only=True)
class _Plant:
    """A kind of plant.

    Attributes:
        name: of records. nominal: parameters. rates: x' for given parameters.
        start: first state for given parameters. output: entry of the state that is measured.
        step: sampling time [s]. held: samples over which an input is held.
        inputs: lowest and highest input. units: of input and output.
        edge: height of the first entry of the state for given parameters (infinite: none), and the
            share of what would rise above it that goes to the second.
    """

    name: str
    nominal: Mapping[str, float]
    rates: Callable[[Mapping[str, float]], Rates]
    start: Callable[[Mapping[str, float]], Numbers]
    output: int
    step: float
    held: int
    inputs: tuple[float, float]
    units: tuple[str, str]
    edge: Callable[[Mapping[str, float]], tuple[float, float]] = lambda p: (math.inf, 0.0)


def integrated(
    rates: Rates, start: Numbers, inputs: Array, step: float, substeps: int,
    edge: tuple[float, float] = (math.inf, 0.0),
) -> Array:  # fmt: skip
    """State at each sample under held inputs, by the classical Runge-Kutta method.

    Args:
        rates: x' = r(x, u). start: state at the first sample, n_s numbers.
        inputs: u (n,). step: sampling time [s]. substeps: Runge-Kutta steps in each sample.
        edge: of the first entry, see `_Plant`: a step across it ends on it.

    Returns:
        States (n + 1, n_s): the last one is a sample after the last input.
    """
    h = step / substeps
    x, out = start, [start]
    for u in inputs.tolist():
        for _ in range(substeps):
            a = rates(x, u)
            b = rates(_moved(x, a, h / 2), u)
            c = rates(_moved(x, b, h / 2), u)
            d = rates(_moved(x, c, h), u)
            slope = tuple(
                (p + 2 * q + 2 * r + s) / 6 for p, q, r, s in zip(a, b, c, d, strict=True)
            )
            x = _moved(x, slope, h)
            if x[0] > edge[0]:
                x = (edge[0], x[1] + edge[1] * (x[0] - edge[0]), *x[2:])
        out.append(x)
    return np.array(out)


def _moved(x: Numbers, slope: Numbers, by: float) -> Numbers:
    return tuple(a + by * b for a, b in zip(x, slope, strict=True))


def simulate_duffing(
    seed: int = 0, *, samples: int = 1000, training_samples: int = 600,
    noise_ratio: float = 0.02, substeps: int = 10,
) -> FeedbackSimulation:  # fmt: skip
    """A mass on a spring that hardens; its position is measured.

    m x'' + c x' + k x + k3 x³ = u, with nominal m = 1 kg, c = 0.6 N s/m, k = 4 N/m, k3 = 4 N/m³;
    force u uniform in ±8 N, held for 4 samples of 0.05 s; at rest at first. States x [m], x' [m/s].
    Source: G. Duffing, Erzwungene Schwingungen bei veränderlicher Eigenfrequenz, 1918.

    Inputs of the test are multiplied (about their mean) by 0.9 until its outputs stay within the
    range of the training outputs.

    Args:
        seed: of parameters, inputs and noise; the same seed gives the same bits.
        samples: number of samples n. training_samples: those in the training record.
        noise_ratio: measurement noise's standard deviation over that of the clean output.
        substeps: Runge-Kutta steps in each sample.

    Raises:
        ValueError: a number out of its range.
    """

    def rates(p: Mapping[str, float]) -> Rates:
        m, c, k, k3 = p["m"], p["c"], p["k"], p["k3"]
        return lambda s, u: (s[1], (u - c * s[1] - k * s[0] - k3 * s[0] ** 3) / m)

    plant = _Plant(
        name="duffing", nominal={"m": 1.0, "c": 0.6, "k": 4.0, "k3": 4.0}, rates=rates,
        start=lambda p: (0.0, 0.0), output=0, step=0.05, held=4, inputs=(-8.0, 8.0),
        units=("N", "m"),
    )  # fmt: skip
    return _experiment(plant, seed, samples, training_samples, noise_ratio, substeps)


def simulate_tanks(
    seed: int = 0, *, overflow: bool = False, samples: int = 1000, training_samples: int = 600,
    noise_ratio: float = 0.02, substeps: int = 10,
) -> FeedbackSimulation:  # fmt: skip
    """A tank that empties into another one; the level of the lower one is measured.

    h1' = K u - a1 √h1 - o, h2' = a2 √h1 - a3 √h2 + s o, with nominal K = 0.25 dm/s per unit of u,
    a1 = a2 = a3 = 0.25 √dm/s; flow u uniform in 0.3 to 1.7, held for 12 samples of 1 s; both levels
    in the steady state of u = 1 at first. With `overflow` the upper tank has an edge at the height
    `top`, nominally 1.5 times that state's level: there o is all that the level would rise by, of
    which the share s, nominally 0.3, runs into the lower tank; else o = 0. States h1, h2 [dm].
    Source: Torricelli's law; M. Schoukens and J. P. Noël, Three benchmarks addressing open
    challenges in nonlinear system identification, IFAC-PapersOnLine 50, 2017 (cascaded tanks).

    Args: overflow: whether there is an edge; the rest as in `simulate_duffing`, as result and
        errors are.
    """
    SWITCH.check("overflow", overflow)

    def rates(p: Mapping[str, float]) -> Rates:
        K, a1, a2, a3 = p["K"], p["a1"], p["a2"], p["a3"]
        top, share = edge(p)

        def rate(s: Numbers, u: float) -> Numbers:
            upper, lower = (math.sqrt(max(h, 0.0)) for h in s)
            rise = K * u - a1 * upper
            over = max(rise, 0.0) if s[0] >= top else 0.0
            return rise - over, a2 * upper - a3 * lower + share * over

        return rate

    def edge(p: Mapping[str, float]) -> tuple[float, float]:
        return (p["top"] * (p["K"] / p["a1"]) ** 2 if overflow else math.inf), p["share"]

    def steady(p: Mapping[str, float]) -> Numbers:
        upper = p["K"] / p["a1"]
        return upper**2, (p["a2"] * upper / p["a3"]) ** 2

    plant = _Plant(
        name="tanks with overflow" if overflow else "tanks",
        nominal={"K": 0.25, "a1": 0.25, "a2": 0.25, "a3": 0.25, "top": 1.5, "share": 0.3},
        rates=rates, start=steady, output=1, step=1.0, held=12, inputs=(0.3, 1.7),
        units=("", "dm"),
        edge=edge,
    )  # fmt: skip
    return _experiment(plant, seed, samples, training_samples, noise_ratio, substeps)


def simulate_friction(
    seed: int = 0, *, samples: int = 1000, training_samples: int = 600,
    noise_ratio: float = 0.02, substeps: int = 10,
) -> FeedbackSimulation:  # fmt: skip
    """A mass on a spring that slides with friction; its position is measured.

    m x'' + c x' + F tanh(x'/w) + k x = u, with nominal m = 1 kg, viscous friction c = 0.3 N s/m,
    Coulomb's F = 0.8 N, smoothed over w = 0.05 m/s, and k = 4 N/m; force u uniform in ±5 N, held
    for 5 samples of 0.05 s; at rest at first. Forces below F creep at most at w atanh(u/F).
    States x [m], x' [m/s].
    Source: H. Olsson, K. J. Åström et al., Friction models and friction compensation, European
    Journal of Control 4, 1998.

    Arguments, result and errors are those of `simulate_duffing`.
    """

    def rates(p: Mapping[str, float]) -> Rates:
        m, c, F, w, k = p["m"], p["c"], p["F"], p["w"], p["k"]
        return lambda s, u: (s[1], (u - c * s[1] - F * math.tanh(s[1] / w) - k * s[0]) / m)

    plant = _Plant(
        name="friction", nominal={"m": 1.0, "c": 0.3, "F": 0.8, "w": 0.05, "k": 4.0},
        rates=rates, start=lambda p: (0.0, 0.0), output=0, step=0.05, held=5, inputs=(-5.0, 5.0),
        units=("N", "m"),
    )  # fmt: skip
    return _experiment(plant, seed, samples, training_samples, noise_ratio, substeps)


def simulate_bouc_wen(
    seed: int = 0, *, samples: int = 1000, training_samples: int = 600,
    noise_ratio: float = 0.02, substeps: int = 10,
) -> FeedbackSimulation:  # fmt: skip
    """A mass on a spring with hysteresis; its position is measured.

    m x'' + c x' + k x + κ z = u, z' = α x' - β |x'| z - γ x' |z|, with nominal m = 1 kg,
    c = 0.4 N s/m, k = 2 N/m, κ = 3 N/m, α = 1, β = 0.8 1/m, γ = 0.4 1/m; force u uniform in ±5 N,
    held for 5 samples of 0.05 s; at rest at first. States x [m], x' [m/s], z [m]; z stays within
    α / (β + γ). Source: Y.-K. Wen, Method for random vibration of hysteretic systems, Journal of
    the Engineering Mechanics Division 102, 1976.

    Arguments, result and errors are those of `simulate_duffing`.
    """

    def rates(p: Mapping[str, float]) -> Rates:
        m, c, k, kappa = p["m"], p["c"], p["k"], p["kappa"]
        alpha, beta, gamma = p["alpha"], p["beta"], p["gamma"]

        def rate(s: Numbers, u: float) -> Numbers:
            x, v, z = s
            flow = alpha * v - beta * abs(v) * z - gamma * v * abs(z)
            return v, (u - c * v - k * x - kappa * z) / m, flow

        return rate

    nominal = {"m": 1.0, "c": 0.4, "k": 2.0, "kappa": 3.0, "alpha": 1.0, "beta": 0.8, "gamma": 0.4}
    plant = _Plant(
        name="bouc-wen", nominal=nominal, rates=rates, start=lambda p: (0.0, 0.0, 0.0), output=0,
        step=0.05, held=5, inputs=(-5.0, 5.0), units=("N", "m"),
    )  # fmt: skip
    return _experiment(plant, seed, samples, training_samples, noise_ratio, substeps)


def _experiment(
    plant: _Plant, seed: int, samples: int, training: int, noise_ratio: float, substeps: int
) -> FeedbackSimulation:
    """Draw parameters, inputs and noise, run the plant and measure it; all numbers are checked."""
    verify(seed=seed, samples=samples)
    whole(1).check("substeps", substeps)
    POSITIVE_OR_ZERO.check("noise_ratio", noise_ratio)
    fits = isinstance(training, int | np.integer) and not isinstance(training, bool)
    if not fits or not 2 <= training < samples:
        expected = f"a whole number from 2 to samples - 1 = {samples - 1}"
        raise invalid("training_samples", expected=expected, got=repr(training))
    # Independent streams: another length or noise leaves the draws of the plant as they are.
    system, drive, noise = map(np.random.default_rng, np.random.SeedSequence(int(seed)).spawn(3))
    parameters = {
        name: value * float(system.uniform(1 - SPREAD, 1 + SPREAD))
        for name, value in plant.nominal.items()
    }
    low, high = plant.inputs
    inputs = np.repeat(drive.uniform(low, high, -(-samples // plant.held)), plant.held)[:samples]
    rates = plant.rates(parameters)
    edge = plant.edge(parameters)
    first = integrated(
        rates, plant.start(parameters), inputs[:training], plant.step, substeps, edge
    )
    before = first[:training, plant.output]
    middle, begin = (low + high) / 2, tuple(first[-1].tolist())
    later = inputs[training:]
    while True:
        second = integrated(rates, begin, later, plant.step, substeps, edge)[:-1]
        y = second[1:, plant.output]  # the first one the training has decided
        if not len(y) or (y.min() >= before.min() and y.max() <= before.max()):
            break
        later = middle + CALMER * (later - middle)
        if np.abs(later - middle).max() < 1e-3 * (high - low):  # what is left goes on by itself
            break
    states = np.concatenate([first[:-1], second])
    clean = states[:, plant.output]
    sd = float(noise_ratio) * float(clean.std())
    full = Record(
        plant.step * np.arange(samples),
        np.concatenate([inputs[:training], later]),
        clean + sd * noise.standard_normal(samples),
        input_units=[plant.units[0]],
        output_units=[plant.units[1]],
        name=f"{plant.name} {seed}",
    )
    train, test = full.split(training)
    states.setflags(write=False)
    return FeedbackSimulation(
        train=train, test=test, full=full, states=states, output=plant.output, noise_sd=sd,
        parameters=MappingProxyType(parameters),
    )  # fmt: skip
