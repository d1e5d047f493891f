"""Volts or millivolts, and channels in another order, give the same fit.

Rounding differs: sums are taken in another order, and 1000 is no power of two. What rounding leaves
of a fit that has come to an optimum is below `SAME` of its own units.
"""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.log_joint import Direct
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.optimise.adam import adam
from pyro_dynogp.inference.optimise.descent import polished
from pyro_dynogp.inference.optimise.lengths import Lengths
from pyro_dynogp.inference.starts.linear import linear_starts, one_output
from pyro_dynogp.inference.starts.static import smoothest_first
from pyro_dynogp.layers.functions import StaticFunction, support_points
from pyro_dynogp.layers.kernels import KernelPrior
from pyro_dynogp.models.gauge import in_gauge, usual_length
from pyro_dynogp.models.system import DynamicSystem
from tests.conftest import simulate_record

SAME = 1e-6
QUICK: dict[str, Any] = {"workers": 1, "progress": False}
TRAIN = 110


def plant():
    """Two inputs and two outputs that share a pair, far from zero mean and unit size."""
    modes = dgp.Modes(
        [-0.4 + 1.5j], [[0.8 - 0.3j, 0.3 + 0.5j]], [[1.0], [0.4 + 0.3j]], [[0.05, 0.02]]
    )
    r = simulate_record(modes, 0.02, n=140, seed=3)
    names: dict[str, Any] = {"input_names": ["u", "v"], "output_names": ["y", "z"]}
    return dgp.Record(r.time, r.inputs * [1.0, 1.7] + [0.3, -2.0], r.outputs * [1, 3] + 5, **names)


def first_output():
    return plant().select(outputs=["y"])


def bent():
    r = plant()
    y = (r.outputs - r.outputs.mean(0)) / r.outputs.std(0)
    noise = np.random.default_rng(5).standard_normal(y.shape)
    return r.with_outputs(np.tanh(1.2 * y) * [1.0, 3.0] + 0.02 * noise, names=["y", "z"])


def first_bent():
    return bent().select(outputs=["y"])


@dataclasses.dataclass(frozen=True)
class Kind:
    """A model, its record, how it is fitted, which channels change places, and what is the same.

    Forecasts of functions of several outputs are drawn, and random numbers go by place: such kinds
    are compared `one_step` ahead, where nothing is drawn. `units`: whether units change, too.

    Process noise that vanishes has a logarithm without a mode: where a climb stops for lack of
    slope, what is left of it is as small as that, not as rounding. Such kinds have a `tolerance`.

    Bands of parameters that are held have the inverse of a Fisher matrix by one-sided differences,
    whose rounding grows where the record says little: sds are the same within `spread`.
    """

    record: Any
    model: Any
    options: Any = dataclasses.field(default_factory=dict)
    outputs: bool = False
    inputs: bool = True
    tolerance: float = SAME
    spread: float = SAME
    one_step: bool = False
    units: bool = True


MODE = {"method": "map"}
SHORT = {"method": "map", "restarts": 2, "steps": 120}
LINEAR = dgp.LinearDynamicGP
KINDS = {
    "linear": Kind(first_output, lambda: LINEAR(2, pairs=1), MODE),
    "linear, two pairs": Kind(first_output, lambda: LINEAR(2, pairs=2), MODE),
    "linear, draws": Kind(first_output, lambda: LINEAR(2, pairs=1), {"restarts": 3}, inputs=False),
    "linear, two outputs": Kind(plant, lambda: LINEAR(2, outputs=2, pairs=1), MODE, outputs=True),
    "Wiener": Kind(first_bent, lambda: dgp.Wiener(2, pairs=1, inducing=5), SHORT),
    "Wiener, two outputs": Kind(
        bent,
        lambda: dgp.Wiener(2, outputs=2, pairs=1, inducing=5),
        SHORT,
        outputs=True,
        one_step=True,
    ),
    "Wiener-Hammerstein": Kind(
        first_bent, lambda: dgp.WienerHammerstein(2, pairs=1, inducing=5), SHORT
    ),
    "Wiener-Hammerstein, two outputs": Kind(
        bent,
        lambda: dgp.WienerHammerstein(2, outputs=2, pairs=1, inducing=5),
        SHORT,
        outputs=True,
        units=False,
    ),
    "Hammerstein": Kind(first_bent, lambda: dgp.Hammerstein(2, pairs=1, inducing=5), SHORT),
    "Hammerstein-Wiener": Kind(
        first_bent, lambda: dgp.HammersteinWiener(2, pairs=1, inducing=5), SHORT, units=False
    ),
    "Hammerstein, fixed locations": Kind(
        first_bent,
        lambda: dgp.Cascade(
            2, [dgp.Static(outputs=1, inducing=5, learn_locations=False), dgp.Dynamic(pairs=1)]
        ),
        SHORT,
        units=False,
    ),
    "noise by the inputs": Kind(
        first_output,
        lambda: LINEAR(2, pairs=1, likelihood=dgp.Heteroscedastic(inducing=4)),
        SHORT,
        units=False,
    ),
    "feedback": Kind(first_bent, lambda: dgp.NonlinearFeedback(2, pairs=1, inducing=5), MODE),
    "feedback of hidden signals": Kind(
        first_bent, lambda: dgp.NonlinearFeedback(2, pairs=1, inducing=5, hidden=1), SHORT
    ),
    "feedback, two outputs": Kind(
        bent, lambda: dgp.NonlinearFeedback(2, outputs=2, pairs=1, inducing=5), MODE, outputs=True
    ),
    "feedback, draws": Kind(
        bent,
        lambda: dgp.NonlinearFeedback(2, outputs=2, pairs=1, inducing=5),
        {"restarts": 1, "steps": 20, "draws": 20},
        outputs=True,
        spread=1e-3,
    ),
    "Student's t": Kind(
        first_output,
        lambda: LINEAR(2, pairs=1, likelihood=dgp.StudentT(4.0)),
        {"method": "map", "restarts": 2},
        tolerance=1e-4,
    ),
}


@dataclasses.dataclass(frozen=True)
class Told:
    """What a fit says, per unit of the first record and with channels in its order."""

    fit: Any
    mean: np.ndarray
    sd: np.ndarray
    noise: np.ndarray
    log_p: float


def told(kind, record, units=(1.0, 1.0), outputs=None):
    fit = dgp.fit(kind.model(), record[:TRAIN], **kind.options, **QUICK)
    if kind.one_step:
        forecast = fit.predict(record)
    else:
        forecast = fit.forecast(record[:TRAIN], record[TRAIN:], samples=20)
    units = np.array(units[: record.n_outputs])
    places = slice(None) if outputs is None else outputs
    if "noise_sd" in fit.mode:
        noise = fit.mode["noise_sd"].numpy()
    else:
        noise = fit.mode["log_noise_constant"].exp().numpy()
    log_p = -float(fit.start_energies[0]) + TRAIN * float(np.log(units).sum())
    return Told(
        fit, (forecast.mean / units)[:, places], (forecast.sd / units)[:, places],
        noise[places], log_p,
    )  # fmt: skip


@pytest.fixture(scope="module")
def first():
    """The fit of each kind that others are compared with, made when it is asked for."""
    found: dict[str, Told] = {}

    def of(name):
        if name not in found:
            found[name] = told(KINDS[name], KINDS[name].record())
        return found[name]

    return of


def same(one, other, tolerance=SAME, spread=SAME):
    for name in ("mean", "sd", "noise"):
        a, b = getattr(one, name), getattr(other, name)
        off = np.abs(a - b).max() / np.abs(a).max()
        assert off < (max(tolerance, spread) if name == "sd" else tolerance), (name, off)
    assert abs(one.log_p - other.log_p) < max(tolerance, SAME)


def same_sites(one, other):
    """In scaled units, as sites are."""
    assert one.fit.mode.keys() == other.fit.mode.keys()
    for name, a in one.fit.mode.items():
        b = other.fit.mode[name]
        assert bool(((a - b).abs() <= SAME * a.abs().clamp_min(1.0)).all()), name


UNITS = [
    (kind, channel, factor)
    for kind, one in KINDS.items()
    if one.units
    for channel in (("u", "y", "z") if one.record in (plant, bent) else ("u", "y"))
    for factor in ((1000.0, 0.001) if channel != "u" else (1000.0,))
]


@pytest.mark.parametrize(("kind", "channel", "factor"), UNITS)
def test_units(kind, channel, factor, first):
    record = KINDS[kind].record()
    inputs, outputs = record.inputs.copy(), record.outputs.copy()
    units = [1.0, 1.0]
    if channel == "u":
        inputs[:, 0] *= factor
    else:
        place = "yz".index(channel)
        outputs[:, place] *= factor
        units[place] = factor
    names: dict[str, Any] = {
        "input_names": record.input_names, "output_names": record.output_names,
    }  # fmt: skip
    other = told(KINDS[kind], dgp.Record(record.time, inputs, outputs, **names), units)
    same(first(kind), other, KINDS[kind].tolerance, KINDS[kind].spread)
    if KINDS[kind].tolerance == SAME:
        same_sites(first(kind), other)


@pytest.mark.parametrize("kind", [name for name, one in KINDS.items() if one.inputs])
def test_order_of_inputs(kind, first):
    record = KINDS[kind].record().select(inputs=["v", "u"])
    same(first(kind), told(KINDS[kind], record), KINDS[kind].tolerance, KINDS[kind].spread)


@pytest.mark.parametrize("kind", [name for name, one in KINDS.items() if one.outputs])
def test_order_of_outputs(kind, first):
    record = KINDS[kind].record().select(outputs=["z", "y"])
    other = told(KINDS[kind], record, outputs=[1, 0])
    same(first(kind), other, spread=KINDS[kind].spread)
    for a, b in zip(first(kind).fit.system.layers, other.fit.system.layers, strict=True):
        if isinstance(a, DynamicSystem):
            np.testing.assert_allclose(b.modes.poles.numpy(), a.modes.poles.numpy(), rtol=SAME)


@pytest.mark.parametrize("channel", ["u", "y"])
def test_a_level_far_above_what_varies(channel, first):
    """A million and some tenths: the first six digits say nothing."""
    record = KINDS["linear"].record()
    inputs, outputs = record.inputs.copy(), record.outputs.copy()
    (inputs if channel == "u" else outputs)[:, 0] += 1e6
    names: dict[str, Any] = {
        "input_names": record.input_names, "output_names": record.output_names,
    }  # fmt: skip
    other = told(KINDS["linear"], dgp.Record(record.time, inputs, outputs, **names))
    level = 1e6 if channel == "y" else 0.0
    same(first("linear"), dataclasses.replace(other, mean=other.mean - level))


@pytest.mark.parametrize("change", ["inputs", "outputs", "units"])
def test_a_pair_too_many_is_not_told_from_rounding_but_forecasts_are_the_same(change):
    """The second pair of this record has no pole of its own: the density is flat along it."""
    kind = Kind(plant, lambda: LINEAR(2, outputs=2, pairs=2), MODE)
    record, places, units = plant(), None, (1.0, 1.0)
    one = told(kind, record)
    if change == "units":
        record, units = record.with_outputs(record.outputs * 1000.0), (1000.0, 1000.0)
    else:
        names = {"inputs": ["v", "u"], "outputs": ["z", "y"]}[change]
        record = record.select(**{change: names})
        places = [1, 0] if change == "outputs" else None
    same(one, told(kind, record, units, places), tolerance=1e-3)


class TestGauge:
    @pytest.fixture
    def problem(self):
        return Problem.of(LINEAR(2, outputs=2, pairs=2, integrators=1), plant()[:TRAIN])

    @pytest.fixture
    def start(self, problem):
        generator = torch.Generator().manual_seed(3)
        (start,) = linear_starts(problem.target, problem.records, 1, 0)
        some = ("g_output_gain", "g_noise_gain_unit", "g_integrator_noise")
        more = {
            k: torch.randn(start[k].shape, generator=generator, dtype=torch.float64) for k in some
        }
        return {**start, **more}

    @pytest.fixture
    def turned(self, start):
        """The same model: phases and lengths of modes, axes of Brownian motions are others."""
        gain = torch.view_as_complex(start["g_output_gain"].clone())
        gain = gain * torch.tensor([0.4 * np.exp(0.7j), 2.0 * np.exp(-2.1j)])
        axes = torch.tensor([[0.6, 0.8], [0.8, -0.6]], dtype=torch.float64)
        return {
            **start,
            "g_output_gain": torch.view_as_real(gain),
            "g_noise_gain_unit": torch.einsum("pbt,bc->pct", start["g_noise_gain_unit"], axes),
            "g_integrator_noise": start["g_integrator_noise"] @ axes,
        }

    def test_likelihood_does_not_depend_on_it(self, problem, start, turned):
        potential = Potential(problem.target, (problem.records,), start)
        assert isinstance(potential.log_density, Direct)
        one, other = (float(potential.log_density.likelihood(v)) for v in (start, turned))
        assert other == pytest.approx(one, abs=1e-8)

    def test_equivalent_points_share_one(self, problem, start, turned):
        one, other = (in_gauge(problem.target, v, problem.scaling) for v in (start, turned))
        assert set(one) == {"g_output_gain", "g_noise_gain_unit", "g_integrator_noise"}
        for name, value in one.items():
            torch.testing.assert_close(other[name], value, rtol=1e-12, atol=1e-12)

    def test_it_is_one_of_them(self, problem, start):
        potential = Potential(problem.target, (problem.records,), start)
        assert isinstance(potential.log_density, Direct)
        shared = {**start, **in_gauge(problem.target, start, problem.scaling)}
        one, other = (float(potential.log_density.likelihood(v)) for v in (start, shared))
        assert other == pytest.approx(one, abs=1e-8)
        gain = torch.view_as_complex(shared["g_output_gain"].contiguous())
        reference = problem.scaling.reference_output
        torch.testing.assert_close(gain[reference].imag, torch.zeros(2).double())
        assert bool((gain[reference].real > 0.0).all())
        torch.testing.assert_close(
            gain.abs().square().sum(0), torch.full((2,), usual_length(2) ** 2).double()
        )
        rows = shared["g_noise_gain_unit"].swapaxes(1, 2).reshape(-1, 2)
        assert float(rows[0, 1]) == pytest.approx(0.0, abs=1e-15)
        assert float(rows[0, 0]) > 0.0

    def test_independent_motions_are_rotated_pair_by_pair(self):
        model = LINEAR(2, outputs=2, pairs=2, noise="independent")
        problem = Problem.of(model, plant()[:TRAIN])
        (start,) = linear_starts(problem.target, problem.records, 1, 0)
        unit = torch.randn(2, 2, 2, dtype=torch.float64)
        start = {**start, "g_noise_gain_unit": unit}
        shared = {**start, **in_gauge(problem.target, start, problem.scaling)}
        torch.testing.assert_close(
            shared["g_noise_gain_unit"][:, 1, 0], torch.zeros(2).double(), atol=1e-14, rtol=0
        )
        potential = Potential(problem.target, (problem.records,), start)
        assert isinstance(potential.log_density, Direct)
        one, other = (float(potential.log_density.likelihood(v)) for v in (start, shared))
        assert other == pytest.approx(one, abs=1e-8)

    def test_lengths_have_their_most_likely_one_where_climbs_stay(self, problem, start):
        """2 n_y normal numbers have a length r with the density r^(2 n_y - 1) exp(-r^2 / 2)."""
        potential = Potential(problem.target, (problem.records,), start)
        lengths = Lengths(potential.sites)
        z = potential.pack(start).numpy()
        more, further = lengths.energies(z[None])
        r = torch.view_as_complex(start["g_output_gain"].contiguous()).abs().square().sum(0).sqrt()
        usual = usual_length(2)
        assert usual == pytest.approx(np.sqrt(3.0))
        expected = -3.0 * (r / usual).log().sum()
        assert more[0] == pytest.approx(float(expected), rel=1e-12)
        step = 1e-6 * np.eye(len(z))
        slopes = (lengths.energies(z + step)[0] - lengths.energies(z - step)[0]) / 2e-6
        np.testing.assert_allclose(further[0], slopes, atol=1e-8)
        shared = {**start, **in_gauge(problem.target, start, problem.scaling)}
        there = lengths.energies(potential.pack(shared).numpy()[None])[0]
        assert there[0] == pytest.approx(0.0, abs=1e-12)

    def test_a_model_of_one_output_has_no_lengths(self):
        def functions(z):
            raise AssertionError

        assert Lengths(()).added(functions) is functions


class TestStarts:
    def test_the_reference_is_the_smoothest_output_wherever_it_is(self):
        r = plant()
        assert Scaling.from_records(r).reference_output == 0
        assert Scaling.from_records(r.select(outputs=["z", "y"])).reference_output == 1
        gaps = r.outputs.copy()
        gaps[::2, 0] = np.nan  # no two neighbours: how smooth it is cannot be said
        assert Scaling.from_records(r.with_outputs(gaps)).reference_output == 1

    def test_a_fit_of_one_output_has_the_reference(self):
        r = plant().select(outputs=["z", "y"])
        problem = Problem.of(LINEAR(2, outputs=2, pairs=1), r)
        assert one_output(problem.records)[0].record.output_names == ("y",)

    @pytest.mark.parametrize("place", [-1, 2, 0.5, True, "y", None])
    def test_a_reference_that_there_is_not_is_refused(self, place):
        scaling = Scaling.from_records(plant())
        with pytest.raises(ValueError, match=r"reference_output: expected .* from 0 to 1"):
            dataclasses.replace(scaling, reference_output=place)

    def test_files_of_before_had_the_first_output(self):
        plain = Scaling.from_records(plant().select(outputs=["z", "y"])).to_dict()
        assert Scaling.from_dict(plain).reference_output == 1
        del plain["reference_output"]
        assert Scaling.from_dict(plain).reference_output == 0

    def test_brownian_motions_begin_in_directions_of_their_own(self):
        """Alike they would have the same slopes, and stay alike to the end."""
        problem = Problem.of(LINEAR(2, outputs=2, pairs=2), plant())
        for start in linear_starts(problem.target, problem.records, 6, 0):
            one, two = start["g_noise_gain_unit"].unbind(1)
            assert bool(((one - two).abs() > 0.5 * torch.minimum(one, two)).all())

    def test_orders_do_not_depend_on_how_channels_are_given(self):
        r = plant()
        orders = [
            Scaling.from_records(r.select(inputs=u, outputs=y))
            for u in (["u", "v"], ["v", "u"])
            for y in (["y", "z"], ["z", "y"])
        ]
        inputs = {tuple(s.input_names[k] for k in s.input_order) for s in orders}
        outputs = {tuple(s.output_names[k] for k in s.output_order) for s in orders}
        changes = np.square(np.diff(r.inputs / r.inputs.std(0), axis=0)).mean(0)
        assert inputs == {("u", "v") if changes[0] < changes[1] else ("v", "u")}
        assert outputs == {("y", "z")}

    def test_channels_that_change_alike_go_by_when_they_are_large(self):
        """Two switched signals of one number of switches: as smooth, and not the same."""
        early, late = np.zeros(40), np.zeros(40)
        early[5:15], late[25:35] = 1.0, 1.0
        t, y = np.arange(40.0), np.sin(np.arange(40.0))
        for columns, expected in ((np.c_[early, late], (0, 1)), (np.c_[late, 1e3 * early], (1, 0))):
            assert Scaling.from_records(dgp.Record(t, columns, y)).input_order == expected

    @pytest.mark.parametrize("order", [(0, 0), (0, 2), (1,), (0, 1, 2), (True, 0), (0.5, 1)])
    def test_an_order_that_there_is_not_is_refused(self, order):
        with pytest.raises(ValueError, match="input_order: expected"):
            dataclasses.replace(Scaling.from_records(plant()), input_order=order)

    def test_files_of_before_had_channels_as_they_were_given(self):
        plain = Scaling.from_records(plant().select(outputs=["z", "y"])).to_dict()
        assert Scaling.from_dict(plain).output_order == (1, 0)
        del plain["input_order"], plain["output_order"]
        assert Scaling.from_dict(plain).output_order == (0, 1)

    def test_support_points_go_with_the_channels(self):
        """Those of a function whose channels change places are the same points."""
        z = torch.randn(6, 2, dtype=torch.float64)
        one = torch.ones(1, dtype=torch.float64)

        def points(z, order):
            kernel = KernelPrior("f", None, 2).sampled({"f_lengthscale": one.expand(2)})
            values = torch.zeros(1, 6, dtype=torch.float64)
            f = StaticFunction(kernel, z, values, one, one, order=order)
            return support_points(f, 7)

        torch.testing.assert_close(points(z[:, [1, 0]], (1, 0))[:, [1, 0]], points(z, (0, 1)))
        assert not torch.equal(points(z[:, [1, 0]], None)[:, [1, 0]], points(z, None))

    def test_channels_by_smoothness(self):
        x = torch.randn(100, 3, dtype=torch.float64)
        x = torch.stack([x[:, 0], x[:, 1].cumsum(0), x[:, 2].cumsum(0).cumsum(0)], 1)
        assert smoothest_first([x]).tolist() == [2, 1, 0]
        assert smoothest_first([1000.0 * x[:, [2, 0, 1]]]).tolist() == [0, 2, 1]


class TestEnds:
    def test_the_end_of_a_climb_is_the_top(self):
        """Of the sum of a quartic and a steep quadratic, a flat direction left alone."""

        def functions(z):
            x, y = z[:, 0], z[:, 1]
            values = (x - 1.0) ** 4 + (x - 1.0) ** 2 + 50.0 * (y - x) ** 2
            by_y = 100.0 * (y - x)
            by_x = 4.0 * (x - 1.0) ** 3 + 2.0 * (x - 1.0) - by_y
            return values, np.stack([by_x, by_y, 0.0 * x], 1)

        z, value, ended = polished(functions, np.array([2.5, 0.0, 7.0]))
        np.testing.assert_allclose(z, [1.0, 1.0, 7.0], atol=1e-9)
        assert value < 1e-15
        assert ended

    def test_a_step_that_leads_no_lower_is_shortened(self):
        def functions(z):
            x = z[:, 0]
            return np.log(np.cosh(x)) + 1e-3 * x * x, (np.tanh(x) + 2e-3 * x)[:, None]

        z, _, ended = polished(functions, np.array([2.0]))  # a full Newton step goes far beyond
        assert abs(z[0]) < 1e-8
        assert ended

    def test_rounding_is_no_slope(self):
        def functions(z):
            slopes = np.stack([2.0 * z[:, 0], np.full(len(z), 1e-13)], 1)
            return z[:, 0] ** 2, slopes

        z, _, _ = adam(functions, np.array([1.0, 0.0]), 50, 0.05)
        assert abs(z[0]) < 0.5
        assert z[1] == 0.0
